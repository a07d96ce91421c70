# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration before a flat target returns, and what it says of its size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.hand_eye.board_looks import BoardLook, BoardPose, resized
from armscan.calibration.hand_eye.checks import MOST_OPEN_MM
from armscan.calibration.hand_eye.surface import LEVER_MM, Conditioning
from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, floats
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import scaled_inverse
from armscan.geometry.poses import Base, Board, Pose
from armscan.models.calibration import (
    ArmNoise,
    CameraCalibration,
    HandEyeCalibration,
    Provenance,
    ScannerCalibration,
    SensorCalibration,
)
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import Target

WRONG_SCALE, NO_SCALE, NO_SCALE_PART = 4.0, 10.0, 0.01
"""As of a sphere's diameter: a size that the poses contradict by so many standard deviations is
named, and refused where it is off by so many, and by a part of it."""
NAMED_SCALE_PART = 1e-3
UNLIKELY = 1e-3
TOLD_SCALE = 0.02
"""Standard deviation from which on the arm's shifts do not tell the size."""


@dataclass(frozen=True, slots=True, eq=False)
class AskedScale:
    """Size of the target over the stated one, as the arm's shifts ask for.

    ``sigma``: the scatters not taken as known. ``if_known``: as they are estimated.
    """

    scale: float
    sigma: float
    if_known: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.scale:.4f} times the stated size, standard deviation {self.sigma:.4f} "
            f"({self.if_known:.4f} if all scatters are as estimated)"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardPosture:
    """What one look left over.

    Parameters
    ----------
    rms_px
        Of the target's points in the image, where the arm's pose, the hand-eye and the mean board
        put them.
    shift_mm, turn_deg
        By what the target's middle, and the target, are off the mean board in Base.
    tilt_deg, stand_off_mm
        Of the optical axis against the target's normal; distance of the target's middle.
    left_out_rotation_deg, left_out_translation_mm
        Change of the hand-eye without this look.
    left_out_normalised
        Size of its misclosure when it took no part, over its prediction; 1 is usual.
    """

    posture: str
    source: str
    n_points: int
    rms_px: float
    shift_mm: float
    turn_deg: float
    tilt_deg: float
    stand_off_mm: float
    left_out_rotation_deg: float
    left_out_translation_mm: float
    left_out_normalised: float


class BoardHandEyeFit(ArrayRecord):
    """A hand-eye from looks at a target, and its evidence.

    Parameters
    ----------
    board_covariance
        (6, 6) of it, a rotation vector in Base from the left, then the translation.
    looks, chosen
        Those used, and the pose of each that agrees with the others, as the moved camera sees it.
    camera
        As the looks move it, within its covariance: the calibration belongs to it.
    camera_step, camera_covariance
        (9,) by what the looks move its parameters, and (9, 9) their covariance after it.
    before
        The camera as it was given.
    misclosures_px
        (M, 2) of each look's points: where they were found less where arm, hand-eye and mean board
        put them.
    not_used
        (source, reason) of looks that contradict the others.
    """

    calibration: HandEyeCalibration
    base_from_board: Pose[Base, Board]
    board_covariance: FloatArray = floats(6, 6)
    looks: tuple[BoardLook, ...]
    chosen: tuple[BoardPose, ...]
    postures: tuple[BoardPosture, ...]
    conditioning: Conditioning
    asked: AskedScale
    camera: CameraModel
    camera_step: FloatArray = floats(9)
    camera_covariance: FloatArray = floats(9, 9)
    before: CameraCalibration
    misclosures_px: tuple[FloatArray, ...]
    not_used: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def rms_px(self) -> float:
        """Of all points, as `BoardPosture.rms_px`."""
        return float(np.sqrt((np.concatenate(self.misclosures_px) ** 2).sum(axis=1).mean()))

    def scanner(
        self, sensor: SensorCalibration | None, provenance: Provenance
    ) -> ScannerCalibration:
        """Hand-eye and sensor as the looks move both; without a sensor, of the camera as given.

        Parameters
        ----------
        sensor
            With the camera that was given; None if there are no light sheets yet.
        provenance
            Of the document.
        """
        hand_eye, follow = self.calibration, self.calibration.dhand_eye_dsensor
        if follow is None:
            raise InputError("a hand-eye before a target follows its camera")
        if sensor is None:
            whole = hand_eye.covariance + follow @ self.before.covariance @ follow.T
            pose = hand_eye.tool_from_sensor.retract(-follow @ self.camera_step)
            known = hand_eye.diagnostics
            if known is not None:
                known = replace(known, weakest=self.conditioning.under(whole).weakest)
            alone = replace(
                hand_eye,
                tool_from_sensor=pose,
                covariance=whole,
                dhand_eye_dsensor=None,
                diagnostics=known,
            )
            return ScannerCalibration(None, alone, provenance)
        n = len(self.camera_step)
        given = sensor.covariance[:n, :n]
        by_sheets = sensor.covariance[n:, :n] @ scaled_inverse(given)
        by_camera = np.vstack([np.eye(n), by_sheets])
        after = sensor.covariance + by_camera @ (self.camera_covariance - given) @ by_camera.T
        moved = sensor.updated(by_camera @ self.camera_step, 0.5 * (after + after.T))
        wide = np.zeros((len(follow), len(sensor.parameter_names)))
        wide[:, :n] = follow
        return ScannerCalibration(moved, replace(hand_eye, dhand_eye_dsensor=wide), provenance)


def refuse_scale(asked: AskedScale, target: Target | None) -> FitFailure | None:
    """Refuse a target of which the arm's shifts say that it has quite another size."""
    off = abs(asked.scale - 1.0)
    if asked.sigma > TOLD_SCALE or off < max(
        NO_SCALE_PART, NO_SCALE * asked.if_known, WRONG_SCALE * asked.sigma
    ):
        return None
    return FitFailure(
        f"the arm's shifts ask for a target of {asked}",
        f"measure the target's print and give its size{resized(target, asked.scale)}; check that "
        "the camera's "
        "calibration is this one, and that the arm's positions are in mm",
    )


def scale_warnings(asked: AskedScale, target: Target | None) -> tuple[str, ...]:
    """Warn of a target that the arm's shifts say has another size."""
    off = abs(asked.scale - 1.0)
    least = max(NAMED_SCALE_PART, WRONG_SCALE * asked.if_known, WRONG_SCALE * asked.sigma)
    if asked.sigma > TOLD_SCALE or off < least:
        return ()
    return (
        f"the arm's shifts ask for a target of {asked}: check the print's size"
        f"{resized(target, asked.scale)}, and the camera's focal length",
    )


def camera_warnings(beside_camera: FloatArray) -> tuple[str, ...]:
    """Warn of a hand-eye that the camera's own uncertainty leaves nearly open."""
    scale = np.array([LEVER_MM] * 3 + [1.0] * 3)
    worst = np.linalg.eigvalsh(beside_camera * scale[:, None] * scale)[-1]
    if worst < MOST_OPEN_MM**2:
        return ()
    return (
        f"beside the camera as it was given, the hand-eye is known to {np.sqrt(worst):.0f} mm only "
        f"in one direction (turns counted at {LEVER_MM:.0f} mm): the camera's calibration decides "
        "that; calibrate it from more views, tilted to all sides",
    )


def given_scatter_warnings(calibration: HandEyeCalibration) -> tuple[str, ...]:
    """Warn of a scatter that was given and that the views contradict: all sigmas rest on it."""
    known = calibration.diagnostics
    if known is None or known.is_noise_estimated or not known.chi2_probability < UNLIKELY:
        return ()
    return (
        "the arm scatters more than was given: the sigmas stated are too small; leave "
        "--arm-position-mm and --arm-rotation-deg out to have it estimated",
    )


LARGE_ARM_MM, LARGE_ARM_RAD = 0.5, np.radians(0.2)


def is_wide(noise: ArmNoise) -> bool:
    """Whether an arm scatters more than robots do."""
    turn_rad = float(np.hypot(noise.rotation_rad, noise.tool_rotation_rad))
    return noise.position_mm > LARGE_ARM_MM or turn_rad > LARGE_ARM_RAD
