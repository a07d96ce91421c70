# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.errors import InputError, OptionError
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import CAMERA, GRID, Scene, board_pose, make_views, normalised_error, view_of

ALL_FIVE = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)


def refused(views: list[TargetView], options: CameraOptions = ALL_FIVE) -> str:
    failure = calibrate_camera(views, options)
    assert isinstance(failure, FitFailure)
    assert failure.remedy
    return failure.reason


def transposed(view: TargetView) -> TargetView:
    """Numbering with columns and rows exchanged, as after a wrong specification."""
    order = np.argsort(view.points_board_mm[:, 0] * 1000.0 + view.points_board_mm[:, 1])
    return replace(view, points_px=view.points_px[order])


def shaken(view: TargetView, factor: float, seed: int = 0) -> TargetView:
    noise = factor * 0.05 * np.random.default_rng(seed).normal(size=view.points_px.shape)
    return replace(view, points_px=view.points_px + noise)


def test_misfit_view_is_named_and_left_out_on_request() -> None:
    views, _ = make_views(Scene(), seed=1)
    views[4] = shaken(views[4], 8.0)
    named = calibrate_camera(views, ALL_FIVE)
    assert isinstance(named, CameraFit)
    assert [view.source for view in named.views if view.is_misfit] == ["view04.png"]
    assert named.n_views == 12
    assert any("view04.png" in warning and "leave it out" in warning for warning in named.warnings)
    without = calibrate_camera(views, replace(ALL_FIVE, leave_out_misfits=True))
    by_name = calibrate_camera(views, replace(ALL_FIVE, leave_out=("view04.png",)))
    assert isinstance(without, CameraFit)
    assert isinstance(by_name, CameraFit)
    assert without.n_views == by_name.n_views == 11
    assert np.array_equal(without.camera.parameters, by_name.camera.parameters)
    left = next(view for view in without.views if not view.is_used)
    assert left.source == "view04.png"
    assert "times those of the typical view" in left.note
    assert left.chi2_per_point > 20.0
    assert without.sigma[0] < named.sigma[0]


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_wrongly_numbered_view_is_found_and_does_no_harm_once_left_out(seed: int) -> None:
    views, _ = make_views(Scene(reach=0.1), seed)
    views[7] = transposed(views[7])
    fit = calibrate_camera(views, replace(ALL_FIVE, leave_out_misfits=True))
    assert isinstance(fit, CameraFit)
    assert [view.source for view in fit.views if not view.is_used] == ["view07.png"]
    assert normalised_error(CAMERA.parameters, fit.camera.parameters, fit.covariance) < 27.9


def test_outlying_points_are_left_out_and_the_covariance_stays_right() -> None:
    errors = []
    for seed in range(8):
        views, _ = make_views(Scene(), seed)
        rng = np.random.default_rng(seed)
        spoiled = []
        for view in views:
            points = view.points_px.copy()
            points[rng.choice(len(view), 2, replace=False)] += rng.uniform(1.0, 20.0, (2, 2))
            spoiled.append(replace(view, points_px=points))
        fit = calibrate_camera(spoiled, ALL_FIVE)
        assert isinstance(fit, CameraFit)
        n_outliers = sum(int(view.is_outlier.sum()) for view in fit.views)
        assert n_outliers == 24
        assert fit.n_points == sum(len(view) for view in views) - 24
        errors.append(normalised_error(CAMERA.parameters, fit.camera.parameters, fit.covariance))
    assert abs(np.mean(errors) - 9.0) < 4.0 * np.sqrt(18.0 / 8.0)


def test_clean_views_lose_no_points() -> None:
    lost = 0
    for seed in range(30):
        fit = calibrate_camera(make_views(Scene(), seed)[0], ALL_FIVE)
        assert isinstance(fit, CameraFit)
        assert not any(view.is_misfit for view in fit.views)
        lost += sum(int(view.is_outlier.sum()) for view in fit.views)
    # One false alarm in a thousand calibrations.
    assert lost == 0


def test_parallel_boards_are_refused() -> None:
    rng = np.random.default_rng(5)
    tilt = rotation_from_vector(np.array([0.3, 0.1, 0.0]))
    views = []
    for number in range(8):
        spin = rotation_from_vector(np.array([0.0, 0.0, 0.4 * number]))
        rotation = tilt @ spin
        middle = np.array([*rng.uniform(-30.0, 30.0, 2), rng.uniform(260.0, 400.0)])
        centre = rotation @ GRID.points_board_mm.mean(axis=0)
        pose: Pose[Sensor, Board] = Pose(rotation, middle - centre)
        views.append(view_of(Scene(), pose, rng, f"{number}.png"))
    assert "parallel" in refused(views) or "focal length" in refused(views)
    frontal = [replace(view, source=f"f{view.source}") for view in views[:2]]
    assert "3" in refused(frontal)


def test_repeated_views_do_not_count() -> None:
    views, _ = make_views(Scene(n_views=2), seed=6)
    again = [replace(shaken(views[0], 1.0, n), source=f"again{n}.png") for n in range(5)]
    reason = refused(views + again)
    assert "2 different usable views" in reason
    assert "5 nearly identical" in reason
    enough, _ = make_views(Scene(n_views=8), seed=6)
    copy = replace(shaken(enough[0], 1.0), source="copy.png")
    fit = calibrate_camera([*enough, copy], ALL_FIVE)
    assert isinstance(fit, CameraFit)
    assert any("1 view repeats" in w and "copy.png (as view00.png)" in w for w in fit.warnings)


def test_views_without_enough_points_are_named() -> None:
    views, _ = make_views(Scene(), seed=7)
    views[3] = TargetView(
        source="few.png",
        width_px=views[3].width_px,
        height_px=views[3].height_px,
        point_index=views[3].point_index[:5],
        points_px=views[3].points_px[:5],
        covariance_px2=views[3].covariance_px2[:5],
        points_board_mm=views[3].points_board_mm[:5],
    )
    fit = calibrate_camera(views, ALL_FIVE)
    assert isinstance(fit, CameraFit)
    assert [(view.source, view.reason) for view in fit.refused_views] == [
        ("few.png", "only 5 target points, needs 6")
    ]
    assert "few.png" in refused([views[0], views[1], views[3]])


def test_boards_seen_edge_on_are_named() -> None:
    rng = np.random.default_rng(8)
    views, _ = make_views(Scene(), seed=8)
    rotation = rotation_from_vector(np.array([0.0, np.deg2rad(89.7), 0.0]))
    middle = np.array([0.0, 0.0, 300.0]) - rotation @ GRID.points_board_mm.mean(axis=0)
    pose: Pose[Sensor, Board] = Pose(rotation, middle)
    edge = view_of(Scene(), pose, rng, "edge.png")
    fit = calibrate_camera([*views, edge], ALL_FIVE)
    assert isinstance(fit, CameraFit)
    assert fit.refused_views[0].reason == "the board is seen edge-on"


def test_images_of_different_sizes_are_refused() -> None:
    views, _ = make_views(Scene(n_views=4), seed=9)
    views[2] = replace(views[2], width_px=1024, height_px=768)
    with pytest.raises(InputError, match="1024x768, 2048x1536"):
        calibrate_camera(views)
    with pytest.raises(InputError, match="no views"):
        calibrate_camera([])


def test_wrong_requests_are_refused() -> None:
    views, _ = make_views(Scene(n_views=4), seed=10)
    with pytest.raises(OptionError, match=r"cannot leave out nosuch\.png"):
        calibrate_camera(views, CameraOptions(leave_out=("nosuch.png",)))
    with pytest.raises(InputError, match=r"share a name: view00\.png"):
        calibrate_camera([views[0], *views])
    with pytest.raises(OptionError, match="rational"):
        CameraOptions(distortion="rational")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="n_folds"):
        CameraOptions(n_folds=1)


def test_scattered_points_are_no_board() -> None:
    rng = np.random.default_rng(11)
    views = []
    for number in range(6):
        view = view_of(Scene(), board_pose(Scene(), rng), rng, f"{number}.png")
        noise = rng.uniform([0, 0], [2048, 1536], view.points_px.shape)
        views.append(replace(view, points_px=noise))
    fit = calibrate_camera(views, ALL_FIVE)
    assert isinstance(fit, FitFailure) or any("fit" in warning for warning in fit.warnings)
