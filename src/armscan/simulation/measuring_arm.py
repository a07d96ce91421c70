# SPDX-License-Identifier: Apache-2.0
"""A measuring arm with its errors, and the controller that believes it has none.

The true arm's axes differ a little from the drawing, and its encoders see each angle with the
eccentricity of their discs (a wave once and twice per turn) and white noise. The controller
computes the drawing's pose from what the encoders say: that is all that a program ever gets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.simulation.screw_arm import N_JOINTS, ScrewArm, nominal_arm, turns_about

ARC_SECOND_RAD = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class ArmErrors:
    """Sizes of an arm's errors.

    Parameters
    ----------
    white_arcsec
        Standard deviation of the noise of one reading of one encoder.
    once_arcsec, twice_arcsec
        Amplitudes of the eccentricity, once and twice per turn; each encoder has its own phases.
    tilt_arcsec
        Standard deviation of each axis's direction about the drawing's, in both directions.
    shift_mm
        The same of its position.
    """

    white_arcsec: float
    once_arcsec: float
    twice_arcsec: float
    tilt_arcsec: float
    shift_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringArm:
    """The true arm, the controller's arm and the encoders between them.

    Parameters
    ----------
    true, nominal
        The arm that stands there, and the drawing.
    white_rad
        Standard deviation of one reading.
    waves_rad
        (7, 4) cosine and sine amplitudes once per turn, then twice per turn, of each encoder.
    """

    true: ScrewArm
    nominal: ScrewArm
    white_rad: float
    waves_rad: FloatArray

    def __post_init__(self) -> None:
        waves = frozen_floats(self.waves_rad, (N_JOINTS, 4), "waves_rad")
        object.__setattr__(self, "waves_rad", waves)

    @staticmethod
    def build(errors: ArmErrors, rng: np.random.Generator) -> MeasuringArm:
        """Draw one arm: its axes and the phases of its encoders."""
        nominal = nominal_arm()
        phases = rng.uniform(0.0, 2.0 * np.pi, (N_JOINTS, 2))
        sizes = np.array([errors.once_arcsec, errors.twice_arcsec]) * ARC_SECOND_RAD
        waves = np.stack([sizes * np.cos(phases), sizes * np.sin(phases)], axis=2)
        true = bent_arm(nominal, errors.tilt_arcsec * ARC_SECOND_RAD, errors.shift_mm, rng)
        return MeasuringArm(
            true, nominal, errors.white_arcsec * ARC_SECOND_RAD, waves.reshape(N_JOINTS, 4)
        )

    def readings(self, joints_rad: FloatArray, rng: np.random.Generator) -> FloatArray:
        """What the encoders say (N, 7) at true angles (N, 7); noise is new for every row."""
        joints = np.asarray(joints_rad, dtype=np.float64)
        once_cos, once_sin, twice_cos, twice_sin = self.waves_rad.T
        eccentric = (
            once_cos * np.cos(joints)
            + once_sin * np.sin(joints)
            + twice_cos * np.cos(2.0 * joints)
            + twice_sin * np.sin(2.0 * joints)
        )
        return np.asarray(joints + eccentric + self.white_rad * rng.standard_normal(joints.shape))

    def true_pose(self, joints_rad: FloatArray) -> Pose[Base, Tool]:
        """Where the tool truly is at true angles (7,)."""
        return self.true.pose(joints_rad)


def bent_arm(arm: ScrewArm, tilt_rad: float, shift_mm: float, rng: np.random.Generator) -> ScrewArm:
    """Copy of an arm whose axes are tilted and shifted at random, square to themselves.

    The tool at rest stays: an error there belongs to the hand-eye.
    """
    axes, points = [], []
    for axis, point in zip(arm.axes, arm.points_mm, strict=True):
        aside = _square_to(axis)
        tilts = rng.normal(0.0, 1.0, 2) * tilt_rad
        tilted = turns_about(aside[0], tilts[:1])[0] @ turns_about(aside[1], tilts[1:])[0] @ axis
        axes.append(tilted)
        points.append(point + rng.normal(0.0, 1.0, 2) * shift_mm @ aside)
    return ScrewArm(np.array(axes), np.array(points), arm.rest)


def _square_to(axis: FloatArray) -> FloatArray:
    """(2, 3) unit vectors square to an axis and to each other."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, start)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])
