# SPDX-License-Identifier: Apache-2.0
"""Two calibrated cameras and where they are to each other (eqs. 4.12 to 4.16)."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.models.calibration import (
    RIGHT_POSE_PARAMETER_NAMES,
    CameraCalibration,
    Provenance,
)
from armscan.models.camera import PARAMETER_NAMES
from armscan.models.two_views import TwoViews

STEREO_PARAMETER_NAMES = (
    *(f"left.{name}" for name in PARAMETER_NAMES),
    *(f"right.{name}" for name in PARAMETER_NAMES),
    *(f"right.{name}" for name in RIGHT_POSE_PARAMETER_NAMES),
)
"""Order of a stereo calibration's covariance."""


@dataclass(frozen=True, slots=True)
class StereoDiagnostics:
    """Evidence of a stereo calibration.

    Parameters
    ----------
    epipolar_rms_px
        Root mean square distance of matched points from each other's epipolar lines (eq. 4.26).
    epipolar_mean_px
        Their signed mean: a bias that no scatter explains.
    left_out
        Pairs that were left out, with the reason.
    """

    epipolar_rms_px: float
    epipolar_mean_px: float
    left_out: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StereoCalibration:
    """A left and a right camera that see one target at one instant.

    Parameters
    ----------
    left, right
        The cameras; each one's own ``covariance`` is its block of the joint one.
    right_from_left
        Pose of the left camera, which is the Sensor frame, in the right camera's (eqs. 4.15 and
        4.16: ``R_LR``, ``T_LR``).
    covariance
        (24, 24) in the order of `STEREO_PARAMETER_NAMES`.
    rms_px
        Root mean square over all points of both cameras of the residual vector's length.
    n_pairs, n_points
        What was used; a point that both cameras see counts once.
    provenance
        How it came to be.
    diagnostics
        Evidence for a reader; None where there is none.
    """

    left: CameraCalibration
    right: CameraCalibration
    right_from_left: Pose[CameraRight, Sensor]
    covariance: FloatArray
    rms_px: float
    n_pairs: int
    n_points: int
    provenance: Provenance
    diagnostics: StereoDiagnostics | None = None

    def __post_init__(self) -> None:
        n = len(STEREO_PARAMETER_NAMES)
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (n, n), "covariance"))

    @property
    def views(self) -> TwoViews:
        """The two cameras as a model, without what is uncertain in them."""
        return TwoViews(self.left.camera, self.right.camera, self.right_from_left)
