# SPDX-License-Identifier: Apache-2.0
"""Stripes of several sheets are named alike over all images."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import LaserFit, PointUse, SheetOptions
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from rigs.sheet_rig import SheetRig, SheetTruth, placed, thesis_rig

CROSS_A = np.array([-0.659905, -0.551732, 0.51, -68.7215])
CROSS_B = np.array([0.76417, -0.543156, 0.34787, -49.616])
"""The thesis's printed cross sheets."""
CENTRE = (16.0, 12.0)


def tilted_about_y(angle_deg: float, x_mm: float, z_mm: float) -> SheetTruth:
    """A sheet of vertical stripes through (x, 0, z)."""
    normal = np.array([np.cos(np.radians(angle_deg)), 0.0, np.sin(np.radians(angle_deg))])
    return SheetTruth(np.array([*normal, -normal @ [x_mm, 0.0, z_mm]]))


def is_sheet(found: FloatArray, truth: FloatArray) -> bool:
    truth = truth / np.linalg.norm(truth[:3])
    middle = np.array([0.0, 0.0, 136.0])
    same = min(np.abs(found[:3] - s * truth[:3]).max() for s in (1, -1))
    here = found[:3] @ middle + found[3]
    there = truth[:3] @ middle + truth[3]
    return bool(same < 5e-3 and abs(abs(here) - abs(there)) < 0.2)


def assert_names_follow_truth(rig: SheetRig, fit: LaserFit, order: list[list[int]]) -> None:
    """Each named sheet holds the points of exactly one true sheet."""
    for image, shown in zip(fit.images, order, strict=True):
        for place, true_sheet in enumerate(shown):
            own = image.profile.segment == place
            used = own & (image.use == PointUse.USED)
            named = np.unique(image.sheet[used])
            assert len(named) == 1
            plane = fit.sheets[int(named[0])].sheet.plane
            assert is_sheet(plane, rig.sheets[true_sheet].plane)


def crossing_rig() -> SheetRig:
    """Two sheets whose stripes swap their order between near and far boards."""
    sheets = (tilted_about_y(35.0, -1.0, 136.0), tilted_about_y(-35.0, 1.0, 136.0))
    tilts = ((10, 5, 128), (-20, 15, 145), (25, -10, 143), (-15, -20, 127))
    poses = tuple(placed(a, b, z, CENTRE) for a, b, z in tilts)
    return replace(thesis_rig(), sheets=sheets, poses=poses)


def fitted(rig: SheetRig, order: list[list[int]], options: SheetOptions | None = None) -> LaserFit:
    boards = rig.boards(rig.camera, np.random.default_rng(2), order=order)
    fit = calibrate_sheets(boards, rig.calibration(rig.camera), options)
    assert isinstance(fit, LaserFit), fit
    return fit


def test_stripes_that_swap_their_order_are_named_by_coplanarity() -> None:
    rig = crossing_rig()
    order = [[0, 1], [1, 0], [0, 1], [1, 0]]
    fit = fitted(rig, order)
    assert "coplanarity" in fit.diagnostics.naming, fit.diagnostics.naming
    assert fit.sheet_names == ("A", "B")
    assert_names_follow_truth(rig, fit, order)
    middles = [
        {k: float(image.profile.points_px[image.sheet == k, 0].mean()) for k in (0, 1)}
        for image in fit.images
    ]
    assert len({m[0] < m[1] for m in middles}) == 2, "the stripes should swap in this scene"
    assert middles[0][0] < middles[0][1], "A is the left stripe of the first image"


def test_the_printed_cross_sheets_from_crossing_stripes() -> None:
    sheets = (SheetTruth(CROSS_A), SheetTruth(CROSS_B))
    rig = replace(thesis_rig(), sheets=sheets)
    order = [[0, 1]] * 6
    fit = fitted(rig, order)
    assert_names_follow_truth(rig, fit, order)
    assert all(s.calibration.n_boards == 6 for s in fit.sheets)


def test_five_parallel_lines_and_an_image_that_misses_some() -> None:
    sheets = tuple(tilted_about_y(30.0 + 3.15 * k, -5.0 + 2.5 * k, 136.0) for k in range(5))
    rig = replace(thesis_rig(), sheets=sheets)
    order = [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 2, 3], [0, 1, 2, 3, 4], [2, 3, 4], [0, 2, 4]]
    fit = fitted(rig, order, SheetOptions(n_sheets=5))
    assert fit.sheet_names == ("A", "B", "C", "D", "E")
    assert_names_follow_truth(rig, fit, order)


def test_parallel_stripes_on_two_boards_go_by_order_with_a_warning() -> None:
    """Boards tilted about the stripes' own direction: any pairing is coplanar."""
    sheets = (tilted_about_y(30.0, -6.0, 136.0), tilted_about_y(-30.0, 6.0, 136.0))
    poses = (placed(0.0, 12.0, 134.0, CENTRE), placed(0.0, -12.0, 139.0, CENTRE))
    rig = replace(thesis_rig(), sheets=sheets, poses=poses)
    fit = fitted(rig, [[0, 1], [1, 0]])
    assert "order" in fit.diagnostics.naming
    assert any("one laser at a time" in warning for warning in fit.warnings)
    assert_names_follow_truth(rig, fit, [[0, 1], [1, 0]])


def test_one_laser_an_image_is_the_callers_word() -> None:
    rig = crossing_rig()
    rig = replace(rig, poses=rig.poses * 2)
    order = [[0]] * 4 + [[1]] * 4
    lasers = [("left",)] * 4 + [("right",)] * 4
    boards = rig.boards(rig.camera, np.random.default_rng(3), order=order, lasers=lasers)
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    assert fit.sheet_names == ("left", "right")
    assert "caller" in fit.diagnostics.naming
    assert_names_follow_truth(rig, fit, order)


def test_names_given_run_across_the_first_image() -> None:
    rig = crossing_rig()
    fit = fitted(rig, [[0, 1]] * 4, SheetOptions(sheet_names=("west", "east")))
    first = fit.images[0]
    west, east = (first.profile.points_px[first.sheet == k, 0].mean() for k in (0, 1))
    assert fit.sheet_names == ("west", "east")
    assert west < east


@pytest.mark.parametrize(
    ("names", "said"), [(("west", "west"), "repeat"), (("west", " "), "empty")]
)
def test_names_that_tell_no_sheet_are_refused(names: tuple[str, ...], said: str) -> None:
    with pytest.raises(OptionError, match=said):
        SheetOptions(sheet_names=names)


def test_several_sheets_share_the_boards_errors() -> None:
    """The joint covariance couples sheets through boards and camera, and stays a covariance."""
    fit = fitted(crossing_rig(), [[0, 1]] * 4)
    free = [*range(12), *range(17, 20)]
    joint = fit.covariance[np.ix_(free, free)]
    sigma = np.sqrt(np.diag(joint))
    correlation = joint / np.outer(sigma, sigma)
    assert np.abs(correlation[9:12, 12:]).max() > 0.1
    assert np.linalg.eigvalsh(correlation).min() > 0.0


def test_unnamed_and_named_images_do_not_mix() -> None:
    rig = crossing_rig()
    lasers = [("left",), (), (), ()]
    boards = rig.boards(
        rig.camera, np.random.default_rng(3), order=[[0], [0, 1], [0, 1], [0, 1]], lasers=lasers
    )
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert not isinstance(fit, LaserFit)
    assert "lasers" in fit.reason
