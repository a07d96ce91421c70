# SPDX-License-Identifier: Apache-2.0
"""The thesis's rule on rows that can be compared by hand."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.labels import PointStatus
from armscan.records.profile import Profile
from armscan.thesis.row_rule import LaserSchedule, RowLabeller, RowOptions, row_differences
from rigs.cross_rig import sensor
from rigs.sheet_rig import make_profile

A, B = 0, 1


def rows(points: list[tuple[float, float]]) -> Profile:
    places = np.array(points)
    return make_profile("by hand", [(places, np.tile([0.0, 1.0], (len(places), 1)))], 0.1)


def taught() -> RowLabeller:
    """After exposure N with A at row 100 and N + 1 with B at row 125, in columns 10 to 13."""
    namer = RowLabeller(sensor())
    namer.label([rows([(x, 100.0) for x in range(10, 14)])], ("A",), None, 0).profiles[0]
    namer.label([rows([(x, 125.0) for x in range(10, 14)])], ("B",), None, 1).profiles[0]
    return namer


@pytest.mark.parametrize(
    ("row", "sheet"),
    [(100.0, A), (110.0, A), (110.1, -1), (89.9, -1), (115.0, B), (134.9, B), (135.1, -1)],
)
def test_threshold_of_equations_3_6_and_3_7(row: float, sheet: int) -> None:
    named = taught().label([rows([(10.0, row), (11.0, row)])], ("A", "B"), None, 2).profiles[0]
    assert named.sheet.tolist() == [sheet, sheet]
    expected = PointStatus.MEASURED if sheet >= 0 else PointStatus.STRAY
    assert (named.status == int(expected)).all()


def test_where_both_hold_the_smallest_difference_wins() -> None:
    namer = RowLabeller(sensor(), RowOptions(threshold_px=20.0))
    namer.label([rows([(10.0, 100.0), (11.0, 100.0)])], ("A",), None, 0).profiles[0]
    namer.label([rows([(10.0, 125.0), (11.0, 125.0)])], ("B",), None, 1).profiles[0]
    named = namer.label([rows([(10.0, 112.0), (11.0, 113.0)])], ("A", "B"), None, 2).profiles[0]
    assert named.sheet.tolist() == [A, B]


def test_a_column_in_which_nothing_was_seen_has_no_name() -> None:
    named = taught().label([rows([(14.4, 100.0), (13.4, 100.0)])], ("A", "B"), None, 2).profiles[0]
    assert named.sheet.tolist() == [-1, A]


def test_of_several_rows_in_a_column_the_nearest_counts() -> None:
    earlier: FloatArray = np.array([[5.0, 10.0], [5.0, 40.0], [6.0, 12.0], [4.0, 29.0]])
    points: FloatArray = np.array([[5.2, 28.0], [4.8, 11.0], [6.0, 30.0], [7.0, 12.0]])
    assert row_differences(points, earlier).tolist() == [12.0, 1.0, 18.0, np.inf]
    assert np.isinf(row_differences(points, earlier[:0])).all()


def test_schedule_of_figure_3_2() -> None:
    namer = RowLabeller(sensor())
    asked = []
    for k in range(6):
        asked.append(namer.next_lasers())
        namer.label([rows([(1.0, 1.0), (2.0, 1.0)])], asked[-1], None, k).profiles[0]
    assert asked == 2 * [("A",), ("B",), ("A", "B")]
    assert sum(len(on) for on in asked) / len(asked) == pytest.approx(4.0 / 3.0)


def test_single_exposures_are_named_by_their_laser_and_renew_its_rows() -> None:
    namer = taught()
    named = namer.label([rows([(10.0, 150.0), (11.0, 150.0)])], ("A",), None, 2).profiles[0]
    assert named.sheet.tolist() == [A, A]
    both = namer.label([rows([(10.0, 152.0), (11.0, 100.0)])], ("A", "B"), None, 3).profiles[0]
    assert both.sheet.tolist() == [A, -1]


def test_without_earlier_exposures_nothing_is_named() -> None:
    namer = taught()
    namer.reset()
    named = namer.label([rows([(10.0, 100.0), (11.0, 100.0)])], ("A", "B"), None, 2).profiles[0]
    assert named.count(PointStatus.STRAY) == 2


def test_wrong_options_are_refused() -> None:
    with pytest.raises(OptionError, match="threshold"):
        RowOptions(threshold_px=0.0)
    with pytest.raises(InputError, match="laser C"):
        RowLabeller(sensor(), RowOptions(schedule=LaserSchedule((("C",),))))
