# SPDX-License-Identifier: Apache-2.0
"""Six numbers are a box, or a sentence names the one that is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.geometry.arrays import Box


def test_corners_are_every_second_number() -> None:
    box = Box.from_limits((0, 1, -5, 5, 2, 3), "--region")
    np.testing.assert_array_equal([box.low_mm, box.high_mm], [[0, -5, 2], [1, 5, 3]])
    np.testing.assert_array_equal(Box.parse("0,1,-5,5,2,3", "--volume").high_mm, box.high_mm)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0,nan,0,1,0,1", "xmax is nan"),
        ("0,1,0,1,0,inf", "zmax is inf"),
        ("0,1,5,1,0,1", "ymin 5 is not below ymax 1"),
        ("0,1,0,1,2,2", "zmin 2 is not below zmax 2"),
        ("0,1,2", "3 numbers where 6 are needed"),
        ("0,1,left,3,4,5", "'left' is no number"),
    ],
)
def test_what_is_wrong_is_named(text: str, said: str) -> None:
    with pytest.raises(OptionError) as caught:
        Box.parse(text, "--volume")
    assert str(caught.value).startswith(f"--volume: {said}; give xmin,xmax,")
