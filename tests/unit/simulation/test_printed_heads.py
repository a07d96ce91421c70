# SPDX-License-Identifier: Apache-2.0
"""The heads of two lasers and of eleven lines against the thesis's printed numbers."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.poses import Base, Plate, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.head import (
    CROSS_SHEETS,
    HEADS,
    LEFT,
    MULTI_SHEETS,
    RIGHT,
    Head,
    Tolerances,
    build_head,
    sheet_middle_mm,
    sheet_points_mm,
)
from armscan.simulation.objects.shapes import FlatPlate, Placed
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.scene import SceneObject
from armscan.simulation.station import ExposureSettings, Station, TrueStripe, true_stripes

EXACT = Tolerances(*([0.0] * 8))
HALF_FIELD_MM = 36.0
MIDDLE_FIVE = ("A.4", "A.5", "A.6", "A.7", "A.8")
LEFT_MATRIX = np.array([[5174.97, 0, 1524.358], [0, 5175.62, 1032.405], [0, 0, 1.0]])
RIGHT_MATRIX = np.array([[5163.38, 0, 1563.458], [0, 5162.49, 1039.554], [0, 0, 1.0]])
LEFT_DISTORTION = np.array([-0.1035, 0.3449, 0.000706, -0.00032, -0.139])
RIGHT_DISTORTION = np.array([-0.0895, 0.192148, 0.000079, -0.00015, -0.5824])


def plate_facing(head: Head, tilt: NDArray[np.float64] | None = None) -> Station:
    """A wide plate through the middle of the view, 140 mm deep, that faces the whole head."""
    places = [camera.camera_from_sensor.inverse().translation_mm for camera in head.cameras]
    centre = np.array([0.0, 0.0, 140.0])
    up = np.mean(places, axis=0) - centre
    up /= np.linalg.norm(up)
    x = np.cross(np.array([0.0, 1.0, 0.0]), up)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up], axis=1)
    if tilt is not None:
        rotation = rotation @ rotation_from_vector(tilt)
    pose: Pose[Base, Plate] = Pose(rotation, centre)
    return Station((SceneObject("plate", Placed(FlatPlate(np.array([300.0, 300.0])), pose)),))


def stripes(head: Head, station: Station, camera: int = LEFT) -> dict[str, TrueStripe]:
    here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    settings = ExposureSettings(head.cameras[camera].scan_window, head.sources)
    found = true_stripes(head, station, here, settings, camera=camera)
    return {stripe.sheet: stripe for stripe in found}


def slope_deg(stripe: TrueStripe) -> float:
    """Direction in the image between the stripe's ends, up to the right counted negative."""
    pixels = stripe.points_px[np.argsort(stripe.points_px[:, 0])]
    run, fall = pixels[-1] - pixels[0]
    return float(np.degrees(np.arctan2(fall, run)))


def off_plane_mm(laser: LineLaser, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights over the printed plane of the line's middle and of its ends, over the field."""
    distance = laser.waist_distance_mm
    angles = np.array([-HALF_FIELD_MM, 0.0, HALF_FIELD_MM]) / distance
    points = laser.source_mm + distance / np.cos(angles)[:, None] * laser.rays(angles)
    return np.asarray((points @ plane[:3] + plane[3]) / np.linalg.norm(plane[:3]))


def test_the_cameras_of_the_stereo_head_stand_as_printed() -> None:
    head = build_head("thesis-multi", tolerances=EXACT)
    right_from_sensor = head.cameras[RIGHT].camera_from_sensor
    place = right_from_sensor.inverse().translation_mm
    assert np.linalg.norm(place) == pytest.approx(133.4, abs=0.05)
    # the two optical axes: nearest points by least squares of s e_z - t z_right = place
    z_right = right_from_sensor.rotation[2]
    (s, t), *_ = np.linalg.lstsq(np.stack([[0, 0, 1.0], -z_right], axis=1), place, rcond=None)
    gap = np.linalg.norm([0.0, 0.0, s] - (place + t * z_right))
    assert s == pytest.approx(140.0, abs=1.5)
    assert gap < 1.4
    np.testing.assert_array_equal(head.cameras[LEFT].camera_from_sensor.matrix, np.eye(4))


def test_both_cameras_project_as_opencv_does() -> None:
    head = build_head("thesis-multi", tolerances=EXACT)
    points = np.random.default_rng(1).uniform([-20, -15, 125], [20, 15, 160], (40, 3))
    printed = ((LEFT_MATRIX, LEFT_DISTORTION), (RIGHT_MATRIX, RIGHT_DISTORTION))
    for mounted, (matrix, distortion) in zip(head.cameras, printed, strict=True):
        pose = mounted.camera_from_sensor
        ours = mounted.camera.project(points @ pose.rotation.T + pose.translation_mm)
        theirs, _ = cv2.projectPoints(
            points, pose.rotation_vector_rad, pose.translation_mm, matrix, distortion
        )
        np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-6)


def test_the_cross_meets_near_the_image_centre_at_45_degrees() -> None:
    head = build_head("thesis-cross", tolerances=EXACT)
    assert head.sources == ("A", "B")
    found = stripes(head, plate_facing(head))
    # hand geometry on a frontal plate: tan = -a / b of each printed plane
    for name, plane in zip(("A", "B"), CROSS_SHEETS, strict=True):
        expected = np.degrees(np.arctan(-plane[0] / plane[1]))
        assert slope_deg(found[name]) == pytest.approx(expected, abs=1.0)
        assert abs(abs(expected) - 45.0) < 10.0
    # where both planes and the viewing ray through the crossing meet
    line = np.cross(CROSS_SHEETS[0, :3], CROSS_SHEETS[1, :3])
    on_line = np.linalg.lstsq(CROSS_SHEETS[:, :3], -CROSS_SHEETS[:, 3], rcond=None)[0]
    for depth in (135.0, 143.0):
        point = on_line + (depth - on_line[2]) / line[2] * line
        u, v = head.camera.project(point)
        assert np.hypot(u - 1536.0, v - 1024.0) < 200.0
        heights = [np.abs(laser.offset_mm(point[None]))[0] for laser in head.lasers]
        assert max(heights) < 0.01


def test_printed_sheets_are_the_middle_of_the_fans() -> None:
    cross, multi = (build_head(f"thesis-{name}", tolerances=EXACT) for name in ("cross", "multi"))
    middle = [laser for laser in multi.lasers if laser.name in MIDDLE_FIVE]
    pairs = zip((*cross.lasers, *middle), (*CROSS_SHEETS, *MULTI_SHEETS), strict=True)
    for laser, plane in pairs:
        heights = off_plane_mm(laser, plane)
        assert abs(heights[1]) < 0.002
        assert np.abs(heights[[0, 2]]).max() < 0.16


def test_eleven_sheets_go_on_in_equal_steps_and_bow_outwards() -> None:
    head = build_head("thesis-multi", tolerances=EXACT)
    assert [laser.name for laser in head.lasers] == [f"A.{k}" for k in range(1, 12)]
    assert head.sources == ("A",)
    # ends of the middle ray and of the fan's axis span each plane
    normals = np.array(
        [np.cross(laser.rays(np.zeros(1))[0], laser.across) for laser in head.lasers]
    )
    steps = np.degrees([np.arccos(np.clip(a @ b, -1, 1)) for a, b in itertools.pairwise(normals)])
    assert steps.min() > 3.05 and steps.max() < 3.25
    sags = []
    for laser, normal in zip(head.lasers, normals, strict=True):
        heights = off_plane_mm(laser, np.append(normal, -normal @ laser.source_mm))
        sags.append(float(np.mean(heights[[0, 2]]) - heights[1]))
    np.testing.assert_allclose(np.abs(sags)[[0, 5, 10]], [0.3, 0.05, 0.4], rtol=0.1)
    assert max(np.abs(sags[3:8])) < 0.1
    assert np.sign(sags[0]) == -np.sign(sags[10])
    sources = np.array([laser.source_mm for laser in head.lasers])
    np.testing.assert_allclose(sources, np.broadcast_to([63.03, -0.58, 20.89], (11, 3)), atol=0.12)
    power = np.array([laser.irradiance for laser in head.lasers])
    assert power.min() / power.max() == pytest.approx(0.7, abs=1e-9)


def line_px(
    head: Head, laser: LineLaser, plate: Pose[Base, Plate], camera: int
) -> NDArray[np.float64]:
    """Pixels, in the scan window of a camera, of a sheet's line on a plate; by rays and a plane."""
    normal, centre = plate.rotation[:, 2], plate.translation_mm
    rays = laser.rays(np.linspace(-laser.half_angle_rad, laser.half_angle_rad, 801))
    points = (
        laser.source_mm + ((centre - laser.source_mm) @ normal / (rays @ normal))[:, None] * rays
    )
    mounted = head.cameras[camera]
    pose, window = mounted.camera_from_sensor, mounted.scan_window
    pixels = mounted.camera.project(points @ pose.rotation.T + pose.translation_mm)
    inside = (pixels >= [window.x_px, window.y_px]) & (
        pixels < [window.x_px + window.width_px, window.y_px + window.height_px]
    )
    return np.asarray(pixels[inside.all(axis=1)])


def test_lines_in_view_of_both_cameras_are_those_of_the_geometry() -> None:
    """Over plates at about 140 mm, tilted by up to 10 degrees: 8.8 lines on the left, 7.8 in both.

    The two means are those of a computation without images, over other tilts: half a line.
    """
    head = build_head("thesis-multi", tolerances=EXACT)
    left_counts, both_counts, slopes = [], [], []
    for tilt in itertools.product((-0.17, 0.0, 0.17), repeat=2):
        surface = plate_facing(head, np.array([*tilt, 0.0])).things[0].surface
        assert isinstance(surface, Placed)
        seen = []
        for camera in (LEFT, RIGHT):
            lines = [line_px(head, one, surface.scene_from_shape, camera) for one in head.lasers]
            in_view = [len(line) > 10 for line in lines]
            seen.append(np.array(in_view))
            if camera == LEFT:
                ends = np.array([line[-1] - line[0] for line in lines if len(line) > 10])
                ends *= np.sign(ends[:, :1])
                slopes += np.degrees(np.arctan2(ends[:, 1], ends[:, 0])).tolist()
        left_counts.append(int(seen[LEFT].sum()))
        both_counts.append(int((seen[LEFT] & seen[RIGHT]).sum()))
    assert min(left_counts) >= 8 and max(left_counts) <= 10
    assert np.mean(left_counts) == pytest.approx(8.8, abs=0.5)
    assert np.mean(both_counts) == pytest.approx(7.8, abs=0.5)
    assert np.mean(slopes) == pytest.approx(-48.0, abs=4.0)


def test_truth_of_both_cameras_is_one_line_in_space() -> None:
    head = build_head("thesis-multi", seed=4)
    station = plate_facing(head)
    pose = head.cameras[RIGHT].camera_from_sensor
    left, right = stripes(head, station, LEFT), stripes(head, station, RIGHT)
    for laser in head.lasers:
        for camera, found in ((LEFT, left), (RIGHT, right)):
            stripe = found[laser.name]
            if len(stripe.points_px) == 0:
                continue
            points = stripe.points_sensor_mm
            np.testing.assert_allclose(points, stripe.points_base_mm, atol=1e-9)
            assert np.abs(laser.offset_mm(points)).max() < 1e-6
            seen = points if camera == LEFT else points @ pose.rotation.T + pose.translation_mm
            pixels = head.cameras[camera].camera.project(seen)
            np.testing.assert_allclose(pixels, stripe.points_px, atol=1e-6)
    assert len(left["A.6"].points_px) > 700 and len(right["A.6"].points_px) > 700


def test_head_of_five_lines_is_the_middle_of_eleven() -> None:
    eleven = build_head("thesis-multi", tolerances=EXACT)
    five = build_head("thesis-multi-5", tolerances=EXACT)
    assert [laser.name for laser in five.lasers] == [f"A.{k}" for k in range(1, 6)]
    for few, many in zip(five.lasers, eleven.lasers[3:8], strict=True):
        np.testing.assert_allclose(few.source_mm, many.source_mm, atol=1e-12)
        np.testing.assert_allclose(few.forward, many.forward, atol=1e-12)


def test_instruments_of_one_kind_differ_in_both_cameras_and_every_sheet() -> None:
    heads = [build_head("thesis-multi", seed=seed) for seed in range(40)]
    spread = Tolerances()
    shifts = np.array([h.cameras[RIGHT].camera_from_sensor.translation_mm for h in heads])
    # the standard deviation of 120 values is known to 1 / sqrt(2 * 117)
    assert shifts.std(axis=0, ddof=1).mean() == pytest.approx(spread.mount_mm, rel=4 / np.sqrt(234))
    for camera in (LEFT, RIGHT):
        focal = np.array([h.cameras[camera].camera.fx for h in heads])
        share = focal.std(ddof=1) / focal.mean()
        assert share == pytest.approx(spread.focal_share, rel=4 / np.sqrt(78))
    nominal = build_head("thesis-multi", tolerances=EXACT)
    moved = np.array(
        [
            [sheet_middle_mm(h, 140.0, f"A.{k}") - sheet_middle_mm(nominal, 140.0, f"A.{k}")]
            for h in heads
            for k in (1, 6, 11)
        ]
    ).reshape(40, 3, 3)
    together = moved.mean(axis=1, keepdims=True)
    # one projector: its lines move together, and each a little on its own
    assert 0.1 < (moved - together).std() < moved.std() < 2.0


def test_sheet_points_lie_on_their_sheets_in_view() -> None:
    for name in HEADS:
        head = build_head(name)
        points = sheet_points_mm(head)
        assert list(points) == [laser.name for laser in head.lasers]
        for laser in head.lasers:
            assert len(points[laser.name]) > 20
            assert np.abs(laser.offset_mm(points[laser.name])).max() < 1e-9
            assert points[laser.name][:, 2].min() >= 112.0 - 1e-9
            pixels = head.camera.project(points[laser.name])
            assert bool(((pixels >= 0.0) & (pixels <= [3071.0, 2047.0])).all())


def test_unknown_sources_and_cameras_are_refused() -> None:
    head = build_head("thesis-cross")
    station = plate_facing(head)
    with pytest.raises(InputError, match=r"has no laser 'A\.1'"):
        head.sheets_of(("A.1",))
    with pytest.raises(InputError, match="has no camera 1"):
        stripes_of_right = ExposureSettings(head.scan_window, ("A",))
        true_stripes(head, station, Pose(np.eye(3), np.zeros(3)), stripes_of_right, camera=1)
