# SPDX-License-Identifier: Apache-2.0
"""Stripe points to Sensor points: by hand, by OpenCV, by differences, by repeats."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import CameraCalibration, SensorCalibration, SheetCalibration
from armscan.models.camera import CameraModel, Lens
from armscan.models.light_sheet import LightSheet
from armscan.reconstruction.place import merge_clouds
from armscan.reconstruction.triangulate import (
    differentiated,
    intersect_sheets,
    lens_numbers,
    sheet_numbers,
    triangulate,
)
from armscan.records.profile import Profile
from rigs.fisheye import TANGENTIAL, as_fisheye, fisheye_sensor
from rigs.sheet_rig import CAMERA_SIGMA, PROVENANCE, THESIS_PLANE, make_profile, thesis_rig
from rigs.stereo_head import StereoHead

SHEET_SIGMA_MM = np.array([0.02, 0.03, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
SIGMA_PX = 0.1
PINHOLE = CameraModel(
    fx_px=1000.0,
    fy_px=1000.0,
    cx_px=500.0,
    cy_px=400.0,
    distortion=np.zeros(5),
    width_px=1001,
    height_px=801,
)


def printed_sheet(bow_mm: FloatArray | None = None) -> LightSheet:
    normal = THESIS_PLANE[:3] / np.linalg.norm(THESIS_PLANE[:3])
    e_u = np.cross(normal, [0.0, 0.0, 1.0])
    e_u = e_u / np.linalg.norm(e_u)
    origin = np.array([0.0, 0.0, THESIS_PLANE[3] / 0.67742])
    axes = np.stack([e_u, np.cross(normal, e_u), normal])
    return LightSheet(
        origin_mm=origin, axes=axes, scale_mm=20.0, bow_mm=np.zeros(5) if bow_mm is None else bow_mm
    )


def sensor(
    camera: CameraModel, *sheets: LightSheet, covariance: FloatArray | None = None
) -> SensorCalibration:
    n = 9 + 8 * len(sheets)
    joint = np.zeros((n, n)) if covariance is None else covariance
    box = np.array([0.0, 0.0, camera.width_px - 1.0, camera.height_px - 1.0])
    calibrated = CameraCalibration(
        camera=camera,
        covariance=joint[:9, :9],
        has_covariance=True,
        rms_px=0.1,
        sigma_point_px=0.05,
        n_views=9,
        n_points=99,
        covered_px=box,
        provenance=PROVENANCE,
    )
    entries = tuple(
        SheetCalibration(
            name="AB"[k],
            sheet=sheet,
            rms_mm=0.01,
            n_boards=6,
            n_points=600,
            depth_range_mm=(120.0, 150.0),
            is_redundant=True,
            shape_mm=0.0,
        )
        for k, sheet in enumerate(sheets)
    )
    return SensorCalibration(
        camera=calibrated, sheets=entries, covariance=joint, provenance=PROVENANCE
    )


def profile_at(points_px: FloatArray) -> Profile:
    normals = np.tile([0.6, 0.8], (len(points_px), 1))
    return make_profile("stripe.png", [(points_px, normals)], SIGMA_PX)


def test_by_hand_on_the_printed_plane() -> None:
    """Eq. 2.21 for x_u = 0.1, y_u = -0.02 with the printed numbers."""
    cloud = triangulate(
        profile_at(np.array([[600.0, 380.0]])), np.array([0]), sensor(PINHOLE, printed_sheet())
    )
    depth = -91.78 / (-0.0042275 * 0.1 + 0.73558 * -0.02 - 0.67742)
    np.testing.assert_allclose(cloud.points_mm, [[0.1 * depth, -0.02 * depth, depth]], rtol=1e-10)
    assert cloud.frame == "Sensor"
    assert cloud.sheet_names == ("A",)


def test_points_on_boards_come_back_through_a_distorting_lens() -> None:
    """Stripes projected by OpenCV meet the boards' points again: 0.027 mm/px by 1e-6 px."""
    rig = replace(thesis_rig(), sigma_stripe_px=1e-6)
    for index in range(len(rig.poses)):
        q, _ = rig.stripe(index, rig.sheets[0], np.random.default_rng(0))
        points, is_met = intersect_sheets(
            q, np.zeros(len(q), dtype=np.int64), sensor(rig.camera, printed_sheet())
        )
        assert is_met.all()
        board = (points - rig.poses[index].translation_mm) @ rig.poses[index].rotation
        np.testing.assert_allclose(board[:, 2], 0.0, atol=1e-6)


def test_the_sheets_own_shape_moves_a_point_along_its_ray_and_is_no_noise() -> None:
    """A sheet that lies higher by its shape meets the ray elsewhere (eq. 2.21 with D moved)."""
    place, zero = np.array([[620.0, 330.0]]), np.array([0])
    flat = sensor(PINHOLE, printed_sheet())
    waved = replace(flat, sheets=tuple(replace(one, shape_mm=0.004) for one in flat.sheets))
    offset = np.zeros(8)
    offset[2] = 0.004
    moved = replace(
        flat, sheets=tuple(replace(one, sheet=one.sheet.updated(offset)) for one in flat.sheets)
    )
    at, there = (intersect_sheets(place, zero, one)[0] for one in (flat, moved))
    shift = (there - at)[0]
    found, bare = (
        triangulate(profile_at(place), zero, waved),
        triangulate(profile_at(place), zero, flat),
    )
    added = found.covariance_mm2[0] - bare.covariance_mm2[0]
    np.testing.assert_allclose(added, np.outer(shift, shift), rtol=1e-3, atol=1e-12)
    np.testing.assert_array_equal(found.sigma_noise_mm, bare.sigma_noise_mm)


def test_stripe_noise_alone_is_one_direction_by_hand() -> None:
    """On the axis of a pinhole, noise sigma * n: dX/dq by differences of eq. 2.21."""
    place = np.array([[500.0, 400.0]])
    calibration = sensor(PINHOLE, printed_sheet())
    cloud = triangulate(profile_at(place), np.array([0]), calibration)
    step = 1e-4 * np.array([[0.6, 0.8]])
    zero = np.array([0])
    up, down = (intersect_sheets(place + s * step, zero, calibration)[0] for s in (1, -1))
    across = SIGMA_PX * (up - down)[0] / 2e-4
    np.testing.assert_allclose(cloud.covariance_mm2[0], np.outer(across, across), rtol=1e-6)
    np.testing.assert_allclose(cloud.sigma_noise_mm, np.linalg.norm(across), rtol=1e-6)
    normal = THESIS_PLANE[:3] / np.linalg.norm(THESIS_PLANE[:3])
    assert abs(across @ normal) < 1e-9, "noise keeps a point in the sheet"


def test_covariance_is_that_of_repeats_with_all_errors() -> None:
    """1000 repeats of camera, sheet and stripe errors: mean of e' C^-1 e is 3 +- 4 sigma."""
    rig = thesis_rig()
    free = SHEET_SIGMA_MM > 0.0
    mixing = np.linalg.qr(np.random.default_rng(4).normal(size=(12, 12)))[0]
    sigma = np.concatenate([CAMERA_SIGMA, SHEET_SIGMA_MM[free]])
    correlation = mixing @ np.diag(np.linspace(0.2, 1.8, 12)) @ mixing.T
    joint = np.zeros((17, 17))
    joint[:12, :12] = correlation * np.outer(sigma, sigma)
    sheet = printed_sheet()
    place = np.array([[1400.0, 600.0]])
    truth, _ = intersect_sheets(place, np.array([0]), sensor(rig.camera, sheet))
    cloud = triangulate(
        profile_at(place), np.array([0]), sensor(rig.camera, sheet, covariance=joint)
    )
    rng = np.random.default_rng(5)
    squares = []
    for error in rng.multivariate_normal(np.zeros(12), joint[:12, :12], 1000):
        camera = CameraModel.from_parameters(rig.camera.parameters + error[:9], 2048, 1536)
        wrong = sheet.updated(np.concatenate([error[9:], np.zeros(5)]))
        noisy = place + rng.normal(0.0, SIGMA_PX) * np.array([[0.6, 0.8]])
        found, _ = intersect_sheets(noisy, np.array([0]), sensor(camera, wrong))
        miss = (found - truth)[0]
        squares.append(miss @ np.linalg.solve(cloud.covariance_mm2[0], miss))
    assert abs(np.mean(squares) - 3.0) < 4.0 * np.sqrt(6.0 / 1000)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_covariance_by_differences_of_every_parameter_on_two_sheets(lens: Lens) -> None:
    """Each point takes the camera and its own sheet, with their signed correlation.

    Compared term by term: camera and sheet errors that cancel in truth must cancel here.
    """
    camera = thesis_rig().camera
    sheets = (printed_sheet(), printed_sheet().updated(np.array([1.0, -2.0, 3.0, 0, 0, 0, 0, 0])))
    sigma = np.concatenate([CAMERA_SIGMA, SHEET_SIGMA_MM, 3.0 * SHEET_SIGMA_MM])
    mixing = np.linalg.qr(np.random.default_rng(8).normal(size=(25, 25)))[0]
    correlation = mixing @ np.diag(np.linspace(0.05, 1.95, 25)) @ mixing.T
    joint = correlation * np.outer(sigma, sigma)
    if lens == "fisheye":
        camera = as_fisheye(camera)
        joint[TANGENTIAL] = joint[:, TANGENTIAL] = sigma[TANGENTIAL] = 0.0
    place = np.array([[1400.0, 600.0], [1400.0, 600.0]])
    cloud = triangulate(
        profile_at(place), np.array([0, 1]), sensor(camera, *sheets, covariance=joint)
    )

    def moved(step: FloatArray, sign: float) -> FloatArray:
        step = sign * step
        other = camera.moved_to(camera.parameters + step[:9])
        turned = (sheets[0].updated(step[9:17]), sheets[1].updated(step[17:]))
        return intersect_sheets(place, np.array([0, 1]), sensor(other, *turned))[0]

    steps = np.diag(1e-3 * np.where(sigma > 0.0, sigma, 0.0))
    by = np.stack([moved(step, 1.0) - moved(step, -1.0) for step in steps], axis=2)
    by = by / np.where(sigma > 0.0, 2e-3 * sigma, 1.0)
    calibration = by @ joint @ by.transpose(0, 2, 1)
    noise = triangulate(profile_at(place), np.array([0, 1]), sensor(camera, *sheets))
    expected = calibration + noise.covariance_mm2
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(cloud.covariance_mm2 / size, expected / size, atol=1e-5)


def test_points_without_sheet_or_ray_are_left_out_and_order_is_kept() -> None:
    behind = LightSheet(
        origin_mm=np.array([0.0, 0.0, -50.0]), axes=np.eye(3), scale_mm=10.0, bow_mm=np.zeros(5)
    )
    q = np.array([[400.0, 300.0], [450.0, 310.0], [500.0, 320.0], [550.0, 330.0]])
    profile = replace(profile_at(q), segment=np.array([0, 0, 1, 1]))
    cloud = triangulate(profile, np.array([0, -1, 1, 0]), sensor(PINHOLE, printed_sheet(), behind))
    np.testing.assert_array_equal(cloud.segment, [0, 1])
    np.testing.assert_allclose(
        cloud.points_mm[:, :2] / cloud.points_mm[:, 2:], [[-0.1, -0.1], [0.05, -0.07]], atol=1e-12
    )


def test_wrong_sheet_numbers_are_refused() -> None:
    profile = profile_at(np.array([[400.0, 300.0]]))
    calibration = sensor(PINHOLE, printed_sheet())
    for wrong in (np.array([1]), np.array([-2]), np.array([0, 0])):
        with pytest.raises(InputError, match=r"stripe\.png"):
            triangulate(profile, wrong, calibration)


def test_merged_clouds_keep_order_and_exposures() -> None:
    calibration = sensor(PINHOLE, printed_sheet())
    clouds = [
        triangulate(
            replace(profile_at(np.array([[400.0 + k, 300.0]] * (k + 1))), source=f"{k}.png"),
            np.zeros(k + 1, dtype=np.int64),
            calibration,
        )
        for k in range(3)
    ]
    whole = merge_clouds(clouds)
    np.testing.assert_array_equal(whole.exposure, [0, 1, 1, 2, 2, 2])
    assert whole.exposure_sources == ("0.png", "1.png", "2.png")
    np.testing.assert_array_equal(whole.points_mm[1], clouds[1].points_mm[0])
    with pytest.raises(InputError):
        merge_clouds([])
    with pytest.raises(InputError):
        merge_clouds([clouds[0], replace(clouds[1], frame="Base")])


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_rays_meet_sheets_as_in_the_models_of_camera_and_sheet(lens: Lens) -> None:
    """Each pixel on every sheet in turn, on none, and at places that no ray reaches.

    On sheet 0, which stands behind the camera, nothing is met: what is kept from one sheet to the
    next of a pixel must not be what another pixel left. Sheets bend and their light fans out.
    """
    head = StereoHead.thesis().calibration()
    rng = np.random.default_rng(3)
    bent = [
        replace(
            one,
            sheet=replace(one.sheet, bow_mm=rng.normal(0.0, 0.3, 5), fan=rng.uniform(-0.5, 0.5, 2)),
        )
        for one in head.sheets
    ]
    behind = replace(
        bent[0], sheet=replace(bent[0].sheet, origin_mm=bent[0].sheet.origin_mm - [0.0, 0.0, 900.0])
    )
    head = replace(head, sheets=(behind, *bent[1:]))
    head = fisheye_sensor(head) if lens == "fisheye" else head
    camera, n_sheets = head.camera.camera, len(head.sheets)
    size = [camera.width_px, camera.height_px]
    pixels = np.concatenate([rng.uniform(-0.2, 1.2, (300, 2)) * size, [[np.nan, 5.0], [1e7, 1e7]]])
    sheet = np.tile(np.arange(-1, n_sheets), len(pixels))
    pixels = np.repeat(pixels, n_sheets + 1, axis=0)
    points, is_met = intersect_sheets(pixels, sheet, head)
    by_px, by_parameters = differentiated(
        points, np.where(is_met, sheet, -1), lens_numbers(head), sheet_numbers(head)
    )
    xy, has_ray, dxy_dpx, dxy_dcamera = camera.undistort_with_jacobian(pixels)
    assert not is_met[sheet < 0].any()
    assert not is_met[~has_ray].any()
    for k, one in enumerate(head.sheets):
        rows = np.flatnonzero(has_ray & (sheet == k))
        expected, met, by_xy, by_sheet = one.sheet.intersect_with_jacobian(xy[rows])
        np.testing.assert_array_equal(is_met[rows], met)
        rows, by_xy = rows[met], by_xy[met]
        np.testing.assert_allclose(points[rows], expected[met], rtol=1e-10)
        by_sensor = np.concatenate([by_xy @ dxy_dcamera[rows], by_sheet[met]], axis=2)
        for have, want in (
            (by_px[rows], by_xy @ dxy_dpx[rows]),
            (by_parameters[rows], by_sensor),
        ):
            largest = np.abs(want).max(axis=1, keepdims=True)
            assert np.all(np.abs(have - want) <= 1e-8 * largest)
    assert (sheet[is_met] == 1).sum() > 100
    assert not is_met[sheet == 0].all()
