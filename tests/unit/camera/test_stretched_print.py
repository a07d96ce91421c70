# SPDX-License-Identifier: Apache-2.0
"""A print that came out longer one way than the other is told, and can be given as it is."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions, reasons_to_refuse
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import CAMERA, GRID, Scene, make_views, normalised_error

OPTIONS = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)


def views_of(
    stretch: float, seed: int, *, is_told: bool = False, **scene: float
) -> list[TargetView]:
    """Views of a print that is longer from row to row, described as it is or as it should be."""
    printed = replace(GRID, stretch=stretch)
    views, _ = make_views(Scene(target=printed, **scene), seed)  # type: ignore[arg-type]
    if is_told:
        return views
    return [replace(v, points_board_mm=GRID.points_board_mm[v.point_index]) for v in views]


def solved(views: list[TargetView]) -> CameraFit:
    fit = calibrate_camera(views, OPTIONS)
    assert isinstance(fit, CameraFit), fit
    return fit


def warned(fit: CameraFit) -> bool:
    return any("the print seems" in warning for warning in fit.warnings)


@pytest.mark.parametrize("stretch", [0.0, 0.004])
def test_the_stretch_and_its_sigma_hold(stretch: float) -> None:
    fits = [solved(views_of(1.0 + stretch, seed)) for seed in range(40)]
    square = np.array([((fit.stretch - stretch) / fit.stretch_sigma) ** 2 for fit in fits])
    # the mean of 40 squares of one normal deviate: 1 with sigma 0.22
    assert 1.0 - 3.0 * np.sqrt(2.0 / 40.0) < square.mean() < 1.0 + 3.0 * np.sqrt(2.0 / 40.0)
    clear = [fit for fit in fits if stretch > 5.0 * fit.stretch_sigma]
    assert all(warned(fit) for fit in clear)
    assert len(clear) > 30 if stretch else not any(warned(fit) for fit in fits)


def test_a_print_that_is_given_as_it_is_leaves_nothing() -> None:
    said = solved(views_of(1.01, 3, is_told=True))
    assert not warned(said)
    assert normalised_error(CAMERA.parameters, said.camera.parameters, said.covariance) < 27.9
    silent = solved(views_of(1.01, 3))
    assert warned(silent)
    assert silent.rms_px > 1.2 * said.rms_px


@pytest.mark.parametrize("stretch", [1.0, 1.1])
def test_a_print_that_is_far_off_is_refused_and_can_be_forced(stretch: float) -> None:
    reasons = reasons_to_refuse(solved(views_of(stretch, 2)))
    if stretch == 1.0:
        assert reasons == ()
        return
    (reason,) = reasons
    told = float(reason.split(" times as far apart")[0].split()[-1])
    assert told == pytest.approx(stretch, abs=0.01)
    x, y = (np.diff(np.unique(GRID.points_board_mm[:, k])).min() for k in range(2))
    one, other = (
        float(text) for text in reason.split("give both lengths, ")[1].split()[0].split("x")
    )
    assert one == pytest.approx(x)
    assert other == pytest.approx(y * told, rel=1e-3), "the specification that fits"


def test_with_a_fixed_aspect_nothing_is_told() -> None:
    """Pixels that are not quite square would pass for the print."""
    options = replace(OPTIONS, is_aspect_fixed=True)
    fit = calibrate_camera(views_of(1.0, 1), options)
    assert isinstance(fit, CameraFit)
    assert not warned(fit)


def test_cells_that_are_no_squares_are_named_where_no_camera_fits() -> None:
    """A page fitted to another format: the views look parallel, or show no focal length."""
    fit = calibrate_camera(views_of(1.58, 1), OPTIONS)
    reasons = (fit.reason,) if isinstance(fit, FitFailure) else reasons_to_refuse(fit)
    (said,) = [text for text in reasons if "times as far apart" in text]
    told = float(said.split(" times as far apart")[0].split()[-1])
    assert told == pytest.approx(1.58, abs=0.03), "of views with distortion, taken for a pinhole's"


def test_boards_that_are_parallel_are_not_called_stretched() -> None:
    refusal = calibrate_camera(views_of(1.0, 1, max_tilt_deg=0.5), OPTIONS)
    assert isinstance(refusal, FitFailure)
    assert "parallel" in refusal.reason
