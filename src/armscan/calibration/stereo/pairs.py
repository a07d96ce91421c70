# SPDX-License-Identifier: Apache-2.0
"""Views of one target at one instant, by two cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from armscan.errors import InputError, OptionError
from armscan.vision.targets.definition import Target
from armscan.vision.targets.symmetry import Numbering, renumbered
from armscan.vision.targets.view import TargetView

SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """What the two cameras saw of the target at one instant.

    Parameters
    ----------
    left, right
        The views; None where a camera did not find the target.
    """

    left: TargetView | None
    right: TargetView | None

    def __post_init__(self) -> None:
        if self.left is None and self.right is None:
            raise InputError("a pair needs a view of at least one camera")

    @property
    def name(self) -> str:
        """Names of its images."""
        return " + ".join(view.source for view in self.views if view is not None)

    @property
    def views(self) -> tuple[TargetView | None, TargetView | None]:
        """Left and right view."""
        return self.left, self.right

    @property
    def is_seen_by_both(self) -> bool:
        """True if both cameras found the target."""
        return self.left is not None and self.right is not None

    def numbered(self, target: Target, right: Numbering) -> StereoPair:
        """The pair with other numbers of the target's points in the right image."""
        view = self.right
        return self if view is None else replace(self, right=renumbered(view, target, right))


def views_of(pairs: Sequence[StereoPair], side: int) -> list[TargetView]:
    """All views of one camera, 0 for the left and 1 for the right."""
    return [view for pair in pairs if (view := pair.views[side]) is not None]


def check_pairs(pairs: Sequence[StereoPair], leave_out: Sequence[str]) -> list[StereoPair]:
    """The pairs without those to leave out.

    Raises
    ------
    InputError
        If two views of one camera have one name.
    OptionError
        If a pair to leave out does not exist.
    """
    for side, word in enumerate(SIDES):
        names = [view.source for view in views_of(pairs, side)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(
                f"{word} images share a name: {', '.join(twice)}", remedy="give each image once"
            )
    known = {view.source for pair in pairs for view in pair.views if view is not None}
    unknown = sorted(set(leave_out) - known)
    if unknown:
        raise OptionError(
            f"cannot leave out {', '.join(unknown)}: no such image with the target",
            remedy=f"the images are {', '.join(sorted(known))}",
        )
    return [
        pair
        for pair in pairs
        if not any(view is not None and view.source in leave_out for view in pair.views)
    ]
