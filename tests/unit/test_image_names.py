# SPDX-License-Identifier: Apache-2.0
"""Names of images: sorted as people count, chosen by name or pattern."""

from __future__ import annotations

import pytest

from armscan.errors import OptionError
from armscan.storage.image_paths import named_by, natural_key

NAMES = ("on/a1.png", "on/a2.png", "off/a1.png", "b[1].png", "place 3")


def test_numbers_count_and_other_digits_are_letters() -> None:
    """A superscript is a digit to `str.isdigit`, and no number."""
    names = ["a10.png", "1\u00b22.png", "a2.png", "\u0663.png", "12.png"]
    assert sorted(names, key=natural_key)[-2:] == ["a2.png", "a10.png"]
    assert len(sorted(names, key=natural_key)) == 5


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("a1.png", ("on/a1.png", "off/a1.png")),
        ("on/a1.png", ("on/a1.png",)),
        ("on/*", ("on/a1.png", "on/a2.png")),
        ("a[12].png", ("on/a1.png", "on/a2.png", "off/a1.png")),
        ("b[1].png", ("b[1].png",)),
        ("place 3", ("place 3",)),
    ],
)
def test_a_name_its_end_or_a_pattern_chooses(pattern: str, found: tuple[str, ...]) -> None:
    assert named_by([pattern], NAMES) == found


@pytest.mark.parametrize("pattern", ["1.png", "c*", "A1.png", "on"])
def test_what_names_nothing_is_refused(pattern: str) -> None:
    with pytest.raises(OptionError, match=r"on/a1\.png") as error:
        named_by(["a1.png", pattern], NAMES)
    assert pattern in error.value.what
