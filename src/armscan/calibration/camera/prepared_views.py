# SPDX-License-Identifier: Apache-2.0
"""Which views can take part in a camera calibration, and whether they are enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from armscan.calibration.camera.observations import gather
from armscan.calibration.camera.options import MIN_VIEWS, CameraOptions
from armscan.calibration.camera.result import RefusedView
from armscan.calibration.camera.starting_values import repeated_views, view_homography
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.view import TargetView


@dataclass(frozen=True, slots=True, eq=False)
class PreparedViews:
    """Views sorted by what can be done with them.

    Parameters
    ----------
    used
        Indices of the views that take part.
    homographies
        (3, 3) of each used view.
    left_out
        Index and reason of views that have a pose and do not take part.
    refused
        Views from which no pose can be had.
    repeats
        Used views that repeat an earlier one: index to earlier index.
    """

    used: tuple[int, ...]
    homographies: tuple[FloatArray, ...]
    left_out: dict[int, str]
    refused: tuple[RefusedView, ...]
    repeats: dict[int, int]


def prepare_views(
    views: Sequence[TargetView], options: CameraOptions
) -> PreparedViews | FitFailure:
    """Sort the views, and refuse a set that cannot determine a camera.

    Raises
    ------
    InputError
        If the images differ in size, or two views have one name.
    OptionError
        If a view to leave out does not exist.
    """
    gather(views)
    sources = [view.source for view in views]
    twice = sorted({source for source in sources if sources.count(source) > 1})
    if twice:
        raise InputError(f"views share a name: {', '.join(twice)}", remedy="give each image once")
    unknown = sorted(set(options.leave_out) - set(sources))
    if unknown:
        raise OptionError(
            f"cannot leave out {', '.join(unknown)}: no such view",
            remedy=f"the views are {', '.join(sources)}",
        )
    used: list[int] = []
    homographies: list[FloatArray] = []
    left_out: dict[int, str] = {}
    refused: list[RefusedView] = []
    for index, view in enumerate(views):
        homography = view_homography(view, options.min_points)
        if isinstance(homography, FitFailure):
            refused.append(RefusedView(view.source, homography.reason))
        elif view.source in options.leave_out:
            left_out[index] = "left out by request"
        else:
            used.append(index)
            homographies.append(homography)
    among_used = repeated_views([views[i] for i in used])
    repeats = {used[later]: used[earlier] for later, earlier in among_used.items()}
    prepared = PreparedViews(tuple(used), tuple(homographies), left_out, tuple(refused), repeats)
    failure = _too_few(prepared, len(views))
    return prepared if failure is None else failure


def _too_few(prepared: PreparedViews, n_given: int) -> FitFailure | None:
    n_distinct = len(prepared.used) - len(prepared.repeats)
    if n_distinct >= MIN_VIEWS:
        return None
    facts = []
    if prepared.refused:
        listed = "; ".join(f"{view.source}: {view.reason}" for view in prepared.refused)
        facts.append(f"{len(prepared.refused)} not usable ({listed})")
    if prepared.left_out:
        facts.append(f"{len(prepared.left_out)} left out")
    if prepared.repeats:
        facts.append(f"{len(prepared.repeats)} nearly identical to another")
    detail = f": of {n_given}, " + ", ".join(facts) if facts else ""
    return FitFailure(
        f"{n_distinct} different usable views of the target, a camera needs {MIN_VIEWS}{detail}",
        "take 10 to 20 images with the board tilted by 20 to 45 degrees in different directions",
    )
