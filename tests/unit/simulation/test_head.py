# SPDX-License-Identifier: Apache-2.0
"""The head thesis-single against the thesis's printed numbers, computed by hand or by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.poses import Base, Plate, Pose, Sensor, Tool
from armscan.geometry.rotations import rotations_from_euler
from armscan.simulation.head import SINGLE_SHEET, Head, Tolerances, Window, build_head
from armscan.simulation.objects.shapes import FlatPlate, Placed
from armscan.simulation.optics.scene import SceneObject
from armscan.simulation.station import ExposureSettings, Station, TrueStripe, true_stripes

EXACT = Tolerances(*([0.0] * 8))
MATRIX = np.array([[5145.36, 0.0, 1517.37], [0.0, 5153.66, 1023.36], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.09035, 0.1954, -0.000659, -0.000978, -0.4617])
PLATE_PLANE = np.array([0.0001814, 0.00000737, 0.9999, 6.3935])
TABLE_3 = np.array(
    [
        [178.812, 4.462, 19.542, 649.179, -171.705, 201.483],
        [183.281, -23.115, 31.753, 744.115, -197.079, 179.886],
        [146.105, 3.211, 23.922, 649.743, -63.662, 143.021],
        [-176.732, 41.058, 19.680, 499.043, -188.059, 200.824],
        [-145.388, -1.381, 31.560, 651.862, -308.580, 174.691],
    ]
)
ANGLES_DEG = (86.0, 66.0, 88.0, 49.0, 85.0)


def printed_head() -> Head:
    return build_head(tolerances=EXACT)


def plate_on_the_table() -> Station:
    """A plate, 300 mm wide, in the printed plane below the printed postures."""
    normal = PLATE_PLANE[:3] / np.linalg.norm(PLATE_PLANE[:3])
    x = np.array([1.0, 0.0, -normal[0] / normal[2]])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(normal, x), normal], axis=1)
    centre = np.array([600.0, -200.0, 0.0])
    centre[2] = -(PLATE_PLANE[0] * 600.0 - PLATE_PLANE[1] * 200.0 + 6.3935) / PLATE_PLANE[2]
    pose: Pose[Base, Plate] = Pose(rotation, centre)
    return Station((SceneObject("plate", Placed(FlatPlate(np.array([300.0, 300.0])), pose)),))


def posture(row: NDArray[np.float64], head: Head) -> Pose[Base, Sensor]:
    rotation = rotations_from_euler(np.radians(row[None, :3]), "intrinsic-xyz")[0]
    base_from_tool: Pose[Base, Tool] = Pose(rotation, row[3:])
    return base_from_tool @ head.tool_from_sensor


def stripe_of(row: NDArray[np.float64]) -> TrueStripe:
    head = printed_head()
    settings = ExposureSettings(head.full_window, ("A",))
    return true_stripes(head, plate_on_the_table(), posture(row, head), settings)[0]


@pytest.mark.parametrize("k", range(5))
def test_table_3_puts_the_stripe_into_the_image_at_the_depths_found(k: int) -> None:
    stripe = stripe_of(TABLE_3[k])
    pixels = stripe.points_px
    assert len(pixels) > 2900
    assert pixels.min() > -0.5
    assert bool((pixels < [3071.5, 2047.5]).all())
    middle = np.argmin(np.abs(pixels[:, 0] - 1517.37))
    assert 128.0 - 0.5 < stripe.points_sensor_mm[middle, 2] < 149.0 + 0.5
    by_opencv, _ = cv2.projectPoints(
        stripe.points_sensor_mm, np.zeros(3), np.zeros(3), MATRIX, DISTORTION
    )
    np.testing.assert_allclose(by_opencv[:, 0], pixels, atol=1e-6)
    height = stripe.points_base_mm @ PLATE_PLANE[:3] + PLATE_PLANE[3]
    assert np.abs(height).max() < 1e-6 + 1e-4 * abs(np.linalg.norm(PLATE_PLANE[:3]) - 1.0)


@pytest.mark.parametrize("k", range(5))
def test_angles_between_sheet_and_plate_are_those_of_the_text(k: int) -> None:
    rotation = posture(TABLE_3[k], printed_head()).rotation
    cosine = abs((rotation @ SINGLE_SHEET[:3]) @ PLATE_PLANE[:3])
    norm = np.linalg.norm(SINGLE_SHEET[:3]) * np.linalg.norm(PLATE_PLANE[:3])
    assert np.degrees(np.arccos(cosine / norm)) == pytest.approx(ANGLES_DEG[k], abs=0.6)


def test_the_window_shows_the_depths_computed_by_hand() -> None:
    """First and last row: z = 91.78 / (0.67742 - 0.73558 y) = 124.97 and 147.98 mm.

    The lens's distortion and the sheet's bow change a tenth of a millimetre.
    """
    head = printed_head()
    laser = head.lasers[0]
    window = head.scan_window
    assert (window.width_px, window.height_px) == (2658, 800)
    assert (2 * window.x_px + window.width_px, 2 * window.y_px + window.height_px) == (3072, 2048)
    for row, by_hand in ((624, 124.97), (1424, 147.98)):
        depth = np.linspace(100.0, 180.0, 80001)
        ray = np.append(head.camera.rays(np.array([1517.37, row])), 1.0)
        offset = laser.offset_mm(depth[:, None] * ray)
        assert depth[np.argmin(np.abs(offset))] == pytest.approx(by_hand, abs=0.15)


def test_the_sheet_is_the_printed_plane_bowed_by_tenths_of_a_millimetre() -> None:
    laser = printed_head().lasers[0]
    angles = np.array([-0.19, 0.0, 0.19])
    rays = laser.rays(angles)
    points = laser.source_mm + 187.0 / np.cos(angles)[:, None] * rays
    unit = SINGLE_SHEET / np.linalg.norm(SINGLE_SHEET[:3])
    off = points @ unit[:3] + unit[3]
    assert abs(off[1]) < 0.01
    # a cone of skew s leaves its plane by d s phi^2 / 2 on a line at the distance d
    expected = 187.0 * laser.skew_rad * 0.19**2 / 2.0
    np.testing.assert_allclose(np.abs(off[[0, 2]]), expected, rtol=0.1)
    assert 0.1 < expected < 0.5
    np.testing.assert_allclose(laser.source_mm, [0.0, -124.8, 0.0], atol=0.02)


def test_seeds_draw_different_instruments_and_presets_keep_them() -> None:
    one, again, other = build_head(seed=1), build_head(seed=1), build_head(seed=2)
    harsh = build_head(preset="harsh", seed=1)
    assert one.camera == again.camera == harsh.camera
    assert one.camera != other.camera
    np.testing.assert_array_equal(one.lasers[0].source_mm, again.lasers[0].source_mm)
    np.testing.assert_array_equal(one.tool_from_sensor.matrix, harsh.tool_from_sensor.matrix)
    assert harsh.imaging != one.imaging
    heads = [build_head(seed=seed) for seed in range(60)]
    spread = Tolerances()
    focal = np.std([head.camera.fx / 5145.36 - 1.0 for head in heads], ddof=1)
    # the standard deviation of 60 draws is known to 1 / sqrt(2 * 59)
    assert focal == pytest.approx(spread.focal_share, rel=4.0 / np.sqrt(118.0))
    nominal = printed_head().tool_from_sensor.translation_mm
    shifts = np.array([head.tool_from_sensor.translation_mm for head in heads]) - nominal
    rms = np.sqrt(np.mean(shifts**2))
    assert rms == pytest.approx(spread.mount_mm, rel=4.0 / np.sqrt(2.0 * shifts.size))


def test_unknown_heads_and_windows_off_the_sensor_are_refused() -> None:
    with pytest.raises(InputError, match="no simulated head is called 'thesis-quad'"):
        build_head("thesis-quad")
    with pytest.raises(InputError, match="not on a sensor"):
        Window(-1, 0, 10, 10)
