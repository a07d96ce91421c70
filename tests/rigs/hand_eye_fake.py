# SPDX-License-Identifier: Apache-2.0
"""A hand-eye fit made by hand, to test what shows it: its numbers are plausible, not solved."""

from __future__ import annotations

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit, PostureResult, StripeResidual
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector
from armscan.geometry.shapes import Plane
from armscan.models.calibration import ArmNoise, HandEyeCalibration, HandEyeDiagnostics

TOOL_FROM_SENSOR: Pose[Tool, Sensor] = Pose.from_vectors([0.4, -0.9, -1.9], [41.4, 21.5, 112.3])
STAND_OFF_MM = 140.0
N_POSTURES = 6
EXPOSURES_OF_POSTURE = 2


def fake_fit(method: str = "plate") -> tuple[HandEyeFit, tuple[PosedStripe, ...]]:
    """Six postures of two exposures over the plane Z = 0 of Base, and what was placed."""
    generator = np.random.default_rng(1)
    stripes, residuals, postures = [], [], []
    for k in range(N_POSTURES):
        name, mean = f"{k + 1}", 0.006 * generator.standard_normal()
        for j in range(EXPOSURES_OF_POSTURE):
            source = f"images/{name}-{j}.png"
            stripe, points = _stripe(source, name, k, generator)
            stripes.append(stripe)
            residual = mean + 0.003 * generator.standard_normal(len(points))
            residuals.append(
                StripeResidual(
                    source=source, posture=name, points_base_mm=points, residual_mm=residual
                )
            )
        postures.append(_posture(name, mean, k, is_plate=method == "plate"))
    plate = Plane(np.zeros(3), np.eye(3)) if method == "plate" else None
    hand_eye = HandEyeCalibration(
        tool_from_sensor=TOOL_FROM_SENSOR,
        covariance=np.diag([2e-4, 1e-4, 2e-4, 0.015, 0.024, 0.02]) ** 2 + 1e-12,
        dhand_eye_dsensor=None,
        arm_noise=ArmNoise(
            position_mm=0.005,
            rotation_rad=2e-5,
            exposure_position_mm=0.001,
            exposure_rotation_rad=4e-6,
        ),
        rms_mm=0.0068,
        n_postures=N_POSTURES,
        n_exposures=N_POSTURES * EXPOSURES_OF_POSTURE,
        n_points=sum(len(stripe) for stripe in stripes),
        plate=plate,
        diagnostics=_diagnostics(method),
    )
    fit = HandEyeFit(
        calibration=hand_eye,
        start=TOOL_FROM_SENSOR,
        stripes=tuple(residuals),
        postures=tuple(postures),
        reference=(("Plate", "plane of 40 probed points, 0.008 mm rms"),),
        warnings=("posture 3 is the only one tilted towards the far side",),
    )
    return fit, tuple(stripes)


def _diagnostics(method: str) -> HandEyeDiagnostics:
    return HandEyeDiagnostics(
        method="plate" if method == "plate" else "sphere",
        rank=6,
        condition=31.0,
        weakest="a shift along Y of Tool",
        plate_flatness_mm=0.004 if method == "plate" else 0.0,
        flatness_length_mm=40.0,
        is_noise_estimated=True,
        left_out_rotation_deg=0.012,
        left_out_translation_mm=0.02,
        chi2_probability=0.41,
    )


def _posture(name: str, mean_mm: float, k: int, *, is_plate: bool) -> PostureResult:
    return PostureResult(
        posture=name,
        n_exposures=EXPOSURES_OF_POSTURE,
        n_points=400,
        mean_mm=mean_mm,
        rms_mm=float(np.hypot(mean_mm, 0.003)),
        normalised_mean=mean_mm / 0.006,
        tilt_deg=35.0 if is_plate else float("nan"),
        azimuth_deg=60.0 * k if is_plate else float("nan"),
        stand_off_mm=STAND_OFF_MM,
        left_out_rotation_deg=0.004 + 0.001 * k,
        left_out_translation_mm=0.02 - 0.001 * k,
        left_out_normalised=0.8 + 0.1 * k,
    )


def _stripe(
    source: str, posture: str, k: int, generator: np.random.Generator
) -> tuple[PosedStripe, FloatArray]:
    """A stripe on Z = 0, seen from a tilted place over it, and its points in Base."""
    along = np.linspace(-32.0, 32.0, 200)
    turn = np.radians(60.0 * k)
    centre = np.array([650.0, -180.0, 0.0]) + 20.0 * generator.standard_normal(3) * [1, 1, 0]
    points = centre + np.outer(along, [np.cos(turn), np.sin(turn), 0.0])
    facing = rotation_from_vector(np.array([np.pi, 0.0, 0.0]))
    tilted = rotation_from_vector(0.6 * np.array([np.cos(turn), np.sin(turn), 0.0])) @ facing
    camera: Pose = Pose(tilted, centre - STAND_OFF_MM * tilted[:, 2])
    in_sensor = (points - camera.translation_mm) @ camera.rotation
    stripe = PosedStripe(
        source=source,
        posture=posture,
        base_from_tool=camera @ TOOL_FROM_SENSOR.inverse(),
        points_mm=in_sensor,
        noise_mm=np.tile([0.0, 0.0, 0.003], (len(points), 1))[:, :, None],
        sheet=np.zeros(len(points), dtype=np.int64),
    )
    return stripe, points
