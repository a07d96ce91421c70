# SPDX-License-Identifier: Apache-2.0
"""Two calibrated cameras and where they are to each other (eqs. 4.12 to 4.16)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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

IntrinsicsUse = Literal["free", "prior", "fixed"]
"""What calibrations of single cameras are for: nothing, observations beside the images, held."""


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
        Images of pairs that do not tell where the cameras are to each other, with the reason.
    intrinsics
        What given calibrations of the cameras were for: ``free`` (none), ``prior`` or ``fixed``.
    hold_out_rms_px
        Reprojection error on pairs that were not used to solve; None without such a test.
    typical_level
        Squared distance of the typical pair's own ``right_from_left`` from the others' over its
        covariance and six degrees of freedom: about 1 where noise is all there is.
    target_error_mm
        By how much the target's points miss their places, one standard deviation an axis.
    """

    epipolar_rms_px: float
    epipolar_mean_px: float
    left_out: tuple[tuple[str, str], ...] = ()
    intrinsics: IntrinsicsUse = "free"
    hold_out_rms_px: float | None = None
    typical_level: float = 1.0
    target_error_mm: float = 0.0


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
