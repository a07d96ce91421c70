# SPDX-License-Identifier: Apache-2.0
"""The thesis's printed sheet, hand-eye, plate and five postures are one consistent instrument.

Read with ``base_from_tool`` and R = Rx(A) Ry(B) Rz(C) (eq. 2.69), they put the stripe of every
posture into the image, at the angles to the plate that the text tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import HandEyeOptions, PlateReference, PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit, angle_covariance
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import nearest_rotation, rotations_from_euler, vector_from_rotation
from armscan.geometry.shapes import Plane
from armscan.models.camera import CameraModel
from rigs.thesis_instrument import (
    CAMERA,
    DISTORTION,
    HAND_EYE_ANGLES_DEG,
    HAND_EYE_ROTATION,
    HAND_EYE_TRANSLATION_MM,
    IMAGE_PX,
    PLATE,
    SHEET,
    TABLE_3,
)

TEXT_ANGLES_DEG = np.array([90.0, 45.0, 90.0, 45.0, 90.0])
"""Sheet against plate: a, c, e perpendicular as far as possible, b and d about 45 degrees."""
FOUND_ANGLES_DEG = np.array([86.0, 66.0, 88.0, 49.0, 85.0])
DEPTHS_MM = (128.0, 149.5)
HAND_EYE = Pose(nearest_rotation(HAND_EYE_ROTATION), np.array(HAND_EYE_TRANSLATION_MM))
CAMERA_MODEL = CameraModel.from_parameters([*CAMERA, *DISTORTION], *IMAGE_PX)
BOUND_DEG = np.array([0.049, 0.059, 0.029])
BOUND_MM = np.array([0.12, 0.06, 0.12])
ARM_MM, ARM_RAD = 0.0053, np.radians(0.00115)
"""Of an arm of 0.02 mm repeatability at the scan point."""
FLATNESS_MM, FLATNESS_LENGTH_MM = 0.015 / 3.0, 20.0
"""The plate's flatness of 0.015 mm, taken as three standard deviations of a surface that changes
over 20 mm. Taken as peak to valley over 30 mm (0.003 mm), all six figures are 0.6 of the bound."""
STRIPE_MM = 0.002


@dataclass(frozen=True)
class Stripe:
    """Where the sheet meets the plate, in the camera's frame, as far as it is in the image."""

    points_mm: FloatArray
    angle_deg: float
    normal: FloatArray
    sheet_normal: FloatArray

    @property
    def depth_mm(self) -> float:
        """In the column of the image's centre."""
        return float(self.points_mm[np.argmin(np.abs(self.points_mm[:, 0])), 2])


def base_from_tool(row: tuple[float, ...], sequence: str) -> Pose[Base, Tool]:
    rotation = Rotation.from_euler(sequence, row[:3], degrees=True).as_matrix()
    return Pose(rotation, np.array(row[3:]))


def stripe_at(pose: Pose[Base, Tool]) -> Stripe | None:
    """The stripe in view of one posture, from the planes' equations alone; None out of view."""
    base_from_sensor = pose @ HAND_EYE
    normal = base_from_sensor.rotation.T @ PLATE[:3]
    height = PLATE[:3] @ base_from_sensor.translation_mm + PLATE[3]
    along = np.cross(normal, SHEET[:3])
    along /= np.linalg.norm(along)
    cosine = abs(normal @ SHEET[:3]) / np.linalg.norm(normal) / np.linalg.norm(SHEET[:3])
    start = np.linalg.solve(np.array([normal, SHEET[:3], along]), [-height, -SHEET[3], 0.0])
    points = start + np.linspace(-60.0, 60.0, 601)[:, None] * along
    points = points[(points[:, 2] > 50.0) & (np.abs(points[:, 0]) < 0.4 * points[:, 2])]
    points = points[np.abs(points[:, 1]) < 0.3 * points[:, 2]]
    if len(points):
        points = points[CAMERA_MODEL.is_inside(CAMERA_MODEL.project(points))]
    if len(points) < 10:
        return None
    sheet_normal = SHEET[:3] / np.linalg.norm(SHEET[:3])
    return Stripe(points, float(np.degrees(np.arccos(cosine))), normal, sheet_normal)


def stripes_read_as(sequence: str) -> list[Stripe | None]:
    return [stripe_at(base_from_tool(row, sequence)) for row in TABLE_3.values()]


def in_view() -> list[Stripe]:
    found = [stripe for stripe in stripes_read_as("XYZ") if stripe is not None]
    assert len(found) == len(TABLE_3)
    return found


def test_the_printed_hand_eye_is_the_rotation_of_its_angles() -> None:
    product = HAND_EYE_ROTATION @ HAND_EYE_ROTATION.T
    assert np.abs(product - np.eye(3)).max() < 5e-5
    angles = np.radians([HAND_EYE_ANGLES_DEG])
    of_angles = rotations_from_euler(angles, "intrinsic-xyz")[0]
    np.testing.assert_allclose(HAND_EYE_ROTATION, of_angles, atol=5e-5)
    theta, gamma, phi = angles[0]
    entries = (np.cos(gamma) * np.cos(phi), np.sin(gamma), -np.sin(theta) * np.cos(gamma))
    np.testing.assert_allclose(HAND_EYE_ROTATION[[0, 0, 1], [0, 2, 2]], entries, atol=5e-5)


def test_all_five_stripes_are_in_the_image_at_working_distance() -> None:
    stripes = in_view()
    depths = [stripe.depth_mm for stripe in stripes]
    assert DEPTHS_MM[0] < min(depths) < max(depths) < DEPTHS_MM[1]
    angles = [stripe.angle_deg for stripe in stripes]
    np.testing.assert_allclose(angles, FOUND_ANGLES_DEG, atol=0.6)
    # upright sheets (a, b, d) cross the whole image; c and e leave it at top and bottom
    lengths = [float(np.linalg.norm(one.points_mm[-1] - one.points_mm[0])) for one in stripes]
    assert 45.0 < min(lengths) < max(lengths) < 95.0


def test_no_other_order_of_the_angles_fits_as_well() -> None:
    orders = ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZXZ", "ZYZ", "XYX", "XZX", "YXY", "YZY"]
    misfit = {}
    for sequence in (*orders, *(order.lower() for order in orders)):
        stripes = stripes_read_as(sequence)
        angles = np.array([np.nan if one is None else one.angle_deg for one in stripes])
        misfit[sequence] = float(np.sqrt(np.mean((angles - TEXT_ANGLES_DEG) ** 2)))
    complete = {key: value for key, value in misfit.items() if np.isfinite(value)}
    assert min(complete, key=lambda key: complete[key]) == "XYZ"
    assert complete.pop("XYZ") < 11.0
    assert min(complete.values()) > 18.0


def observed(generator: np.random.Generator, scale: float) -> list[PosedStripe]:
    """Two exposures of every posture, with the arm's and the stripe's errors times ``scale``."""
    found = []
    for (name, row), stripe in zip(TABLE_3.items(), in_view(), strict=True):
        pose = base_from_tool(row, "XYZ")
        scan = (pose @ HAND_EYE).matrix[:3] @ [0.0, 0.0, 140.0, 1.0]
        turn = Rotation.from_rotvec(generator.normal(0.0, scale * ARM_RAD, 3)).as_matrix()
        moved = turn @ (pose.translation_mm - scan) + scan
        shift = generator.normal(0.0, scale * ARM_MM, 3)
        reported: Pose[Base, Tool] = Pose(turn @ pose.rotation, moved + shift)
        across = np.cross(stripe.sheet_normal, np.cross(stripe.normal, stripe.sheet_normal))
        across /= np.linalg.norm(across)
        points = stripe.points_mm[::3]
        for exposure in range(2):
            noise = generator.normal(0.0, scale * STRIPE_MM, (len(points), 1))
            found.append(
                PosedStripe(
                    source=f"{name}{exposure}",
                    posture=name,
                    base_from_tool=reported,
                    points_mm=points + noise * across,
                    noise_mm=np.tile(STRIPE_MM * across, (len(points), 1))[:, :, None],
                    sheet=np.zeros(len(points), dtype=np.int64),
                )
            )
    return found


def plate() -> PlateReference:
    normal = PLATE[:3] / np.linalg.norm(PLATE[:3])
    first = np.cross([0.0, 1.0, 0.0], normal)
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first), normal])
    centre = np.array([650.0, -170.0, 0.0])
    return PlateReference(plane=Plane(centre - (normal @ centre + PLATE[3]) * normal, axes))


KNOWN_NOISE = HandEyeOptions(
    arm_position_mm=ARM_MM,
    arm_rotation_rad=float(ARM_RAD),
    plate_flatness_mm=FLATNESS_MM,
    flatness_length_mm=FLATNESS_LENGTH_MM,
    stripe_noise_factor=1.0,
)


@pytest.fixture(scope="module")
def clean() -> HandEyeFit:
    fit = calibrate_on_plate(observed(np.random.default_rng(0), 0.0), plate(), KNOWN_NOISE)
    assert isinstance(fit, HandEyeFit), fit
    return fit


def test_exact_stripes_give_the_printed_hand_eye_back(clean: HandEyeFit) -> None:
    found = clean.calibration.tool_from_sensor
    turn = vector_from_rotation(found.rotation @ HAND_EYE.rotation.T)
    assert np.degrees(np.linalg.norm(turn)) < 0.02 * BOUND_DEG.min()
    np.testing.assert_allclose(
        found.translation_mm, HAND_EYE_TRANSLATION_MM, atol=0.02 * BOUND_MM.min()
    )
    assert any("5 postures only" in text for text in clean.warnings)


def test_five_postures_bound_the_hand_eye_as_table_4_scatters(clean: HandEyeFit) -> None:
    calibration = clean.calibration
    covariance = angle_covariance(calibration.tool_from_sensor.rotation, calibration.covariance)
    sigma = np.sqrt(np.diag(covariance))
    part = sigma / np.concatenate([BOUND_DEG, BOUND_MM])
    np.testing.assert_allclose(part, 1.0, rtol=0.3)
    # what is set by the five postures alone, not by the size of any noise
    np.testing.assert_allclose(part / part.mean(), 1.0, rtol=0.1)


def test_noisy_stripes_come_back_within_the_bound(clean: HandEyeFit) -> None:
    fit = calibrate_on_plate(observed(np.random.default_rng(4), 1.0), plate(), KNOWN_NOISE)
    assert isinstance(fit, HandEyeFit), fit
    found = fit.calibration.tool_from_sensor
    turn = vector_from_rotation(found.rotation @ HAND_EYE.rotation.T)
    error = np.concatenate([turn, found.translation_mm - HAND_EYE.translation_mm])
    chi2 = float(error @ np.linalg.solve(clean.calibration.covariance, error))
    assert chi2 < 22.5  # 99.9 % of six degrees of freedom
