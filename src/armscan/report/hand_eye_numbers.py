# SPDX-License-Identifier: Apache-2.0
"""A hand-eye as people read it: matrix, Euler angles, lengths, each with its sigma."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.euler import euler_from_rotations
from armscan.geometry.rotation import rotation_from_vector
from armscan.models.scanner import HandEyeCalibration, ScannerCalibration
from armscan.report.numbers import significant, with_sigma

ANGLE_STEP_RAD = 1e-6
EULER_NAMES = ("θ (about X)", "γ (about Y)", "φ (about Z)")


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeNumbers:
    """What is printed of a hand-eye.

    Parameters
    ----------
    euler_deg, euler_sigma_deg
        (3,) angles of eq. 2.69, ``R = Rx(theta) Ry(gamma) Rz(phi)``, and standard deviations.
    translation_mm, translation_sigma_mm
        (3,) origin of Sensor in Tool.
    rotation_sigma_deg
        Root mean square standard deviation of a rotation about an axis of Tool.
    size_sigma_mm
        Root mean square standard deviation of a component of the translation.
    """

    euler_deg: FloatArray
    euler_sigma_deg: FloatArray
    translation_mm: FloatArray
    translation_sigma_mm: FloatArray
    rotation_sigma_deg: float
    size_sigma_mm: float


def hand_eye_numbers(hand_eye: HandEyeCalibration, covariance: FloatArray) -> HandEyeNumbers:
    """Numbers of a hand-eye under a covariance (6, 6), in the order of its own."""
    rotation = hand_eye.tool_from_sensor.rotation
    steps = np.stack([rotation_from_vector(ANGLE_STEP_RAD * axis) @ rotation for axis in np.eye(3)])
    angles = euler_from_rotations(rotation[None], "intrinsic-xyz")[0]
    difference = euler_from_rotations(steps, "intrinsic-xyz") - angles
    wrapped = (difference + np.pi) % (2.0 * np.pi) - np.pi
    by_rotation = wrapped.T / ANGLE_STEP_RAD
    euler_variance = np.diag(by_rotation @ covariance[:3, :3] @ by_rotation.T)
    variance = np.diag(covariance)
    return HandEyeNumbers(
        np.degrees(angles),
        np.degrees(np.sqrt(euler_variance)),
        np.asarray(hand_eye.tool_from_sensor.translation_mm),
        np.sqrt(variance[3:]),
        float(np.degrees(np.sqrt(variance[:3].mean()))),
        float(np.sqrt(variance[3:].mean())),
    )


def total_covariance(scanner: ScannerCalibration) -> FloatArray:
    """(6, 6) covariance of the hand-eye with what the sensor's uncertainty does to it."""
    return np.asarray(scanner.covariance[-6:, -6:])


def hand_eye_facts(scanner: ScannerCalibration) -> tuple[tuple[str, str], ...]:
    """Labels and values of the hand-eye."""
    hand_eye = scanner.hand_eye
    numbers = hand_eye_numbers(hand_eye, total_covariance(scanner))
    rows = "\n".join(
        "  ".join(f"{value:+.6f}" for value in row)
        for row in np.round(hand_eye.tool_from_sensor.rotation, 6)
    )
    angles = (
        f"{name} {with_sigma(value, sigma)}°"
        for name, value, sigma in zip(
            EULER_NAMES, numbers.euler_deg, numbers.euler_sigma_deg, strict=True
        )
    )
    lengths = (
        f"{name} {with_sigma(value, sigma, 'mm')}"
        for name, value, sigma in zip(
            "XYZ", numbers.translation_mm, numbers.translation_sigma_mm, strict=True
        )
    )
    return (
        ("Rotation tool_from_sensor", rows),
        ("The same as R = Rx(θ) Ry(γ) Rz(φ), eq. 2.69", ", ".join(angles)),
        ("Origin of Sensor in Tool", ", ".join(lengths)),
    )


def size_facts(fit: HandEyeFit) -> tuple[tuple[str, str], ...]:
    """How much went in and what was left over."""
    hand_eye = fit.calibration
    facts = [
        (
            "Rests on",
            f"{hand_eye.n_postures} postures, {hand_eye.n_exposures} exposures, "
            f"{hand_eye.n_points:,} points",
        ),
        ("Residual", f"{significant(hand_eye.rms_mm)} mm rms from the reference"),
    ]
    known = hand_eye.diagnostics
    if known is not None:
        facts += [
            ("Condition", f"{known.condition:.0f}, rank {known.rank} of 6"),
            ("Known least", known.weakest),
            (
                "Largest change without one posture",
                f"{significant(known.left_out_rotation_deg)}°, "
                f"{significant(known.left_out_translation_mm)} mm",
            ),
            (
                "Residuals under the noise model",
                "the model's scatters were estimated from them, so they test nothing"
                if known.is_noise_estimated
                else chi2_verdict(known.chi2_probability),
            ),
        ]
    return tuple(facts)


def chi2_verdict(probability: float) -> str:
    """A probability of chi2 in words."""
    if not np.isfinite(probability):
        return "nothing is redundant, so nothing can be tested"
    if probability < 0.001:
        return f"larger than the noise model allows (p = {probability:.2g})"
    if probability > 0.999:
        return f"smaller than the noise model expects (p = {probability:.4f})"
    return f"as expected (p = {probability:.2f})"
