# SPDX-License-Identifier: Apache-2.0
"""Options of the stereo calibration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import get_args

from armscan.calibration.camera.options import CameraOptions
from armscan.errors import OptionError
from armscan.models.stereo import IntrinsicsUse

INTRINSICS_USES: tuple[IntrinsicsUse, ...] = get_args(IntrinsicsUse)

MIN_PAIRS = 3
"""Two pairs that disagree do not say which of them is wrong."""


@dataclass(frozen=True, slots=True)
class StereoOptions:
    """How two cameras are calibrated together.

    Parameters
    ----------
    camera
        Of each camera: distortion model, what is held, least points of a view, most steps. What it
        says of views to leave out and of folds does not count here.
    intrinsics
        What given calibrations of the cameras are for: ``free`` takes none, ``prior`` takes their
        values with their covariance as observations beside the images, ``fixed`` holds them (their
        covariance is carried into the result).
    leave_out
        Names of images whose pairs are not used.
    leave_out_misfits
        Use the images of pairs that disagree with the others for each camera alone, instead of
        only naming such pairs. Pairs that are plainly wrong are taken apart in any case.
    n_folds
        Folds of the hold-out test over pairs; 0 switches it off.
    """

    camera: CameraOptions = field(default_factory=CameraOptions)
    intrinsics: IntrinsicsUse = "free"
    leave_out: tuple[str, ...] = ()
    leave_out_misfits: bool = False
    n_folds: int = 5

    def __post_init__(self) -> None:
        if self.intrinsics not in INTRINSICS_USES:
            raise OptionError(
                f"intrinsics '{self.intrinsics}' is not known",
                remedy="choose " + ", ".join(INTRINSICS_USES),
            )
        if self.n_folds < 0 or self.n_folds == 1:
            raise OptionError(f"n_folds is {self.n_folds}", remedy="give 0 (off) or at least 2")
