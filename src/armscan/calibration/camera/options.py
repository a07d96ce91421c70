# SPDX-License-Identifier: Apache-2.0
"""Options of the camera calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from armscan.errors import OptionError

DistortionModel = Literal["auto", "none", "k1", "k1k2", "k1k2p1p2", "k1k2p1p2k3"]

DISTORTION_PARAMETERS: dict[DistortionModel, tuple[str, ...]] = {
    "none": (),
    "k1": ("k1",),
    "k1k2": ("k1", "k2"),
    "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "k1k2p1p2k3": ("k1", "k2", "p1", "p2", "k3"),
}
"""Free coefficients of each distortion model; those not named are zero."""

MIN_VIEWS = 3
MAX_STEPS = 200
"""A wide lens whose distortion nearly folds over needs more than 60."""


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """How a camera is calibrated.

    Parameters
    ----------
    distortion
        Which coefficients are free; ``auto`` decides by the rule of
        `armscan.calibration.camera.model_choice`.
    is_aspect_fixed
        Hold ``fy = fx`` (square pixels).
    is_principal_point_fixed
        Hold the principal point in the middle of the image.
    solve_warp
        Solve two bow parameters of the board along with the camera.
    leave_out
        Sources of views that are not used.
    leave_out_misfits
        Leave out the views that the robust test proposes (residuals three times those of the
        typical view), instead of only naming them. Views with ten times the residuals are wrong,
        not noisy, and are left out in any case; they are named.
    n_folds
        Folds of the cross-validation over views; 0 switches it off. With fewer views than folds
        each view is a fold of its own.
    min_points
        Fewest points with which a view is used.
    max_steps
        Most iterations of one adjustment; a solution that needs more is returned with a warning.
    """

    distortion: DistortionModel = "auto"
    is_aspect_fixed: bool = False
    is_principal_point_fixed: bool = False
    solve_warp: bool = False
    leave_out: tuple[str, ...] = ()
    leave_out_misfits: bool = False
    n_folds: int = 5
    min_points: int = 6
    max_steps: int = MAX_STEPS

    def __post_init__(self) -> None:
        if self.distortion != "auto" and self.distortion not in DISTORTION_PARAMETERS:
            raise OptionError(
                f"distortion model {self.distortion!r} is not known",
                remedy="choose auto, " + ", ".join(DISTORTION_PARAMETERS),
            )
        if self.n_folds < 0 or self.n_folds == 1:
            raise OptionError(f"n_folds is {self.n_folds}", remedy="give 0 (off) or at least 2")
        if self.min_points < 4:
            raise OptionError(
                f"min_points is {self.min_points}", remedy="a pose needs at least 4 points"
            )
        if self.max_steps < 1:
            raise OptionError(f"max_steps is {self.max_steps}", remedy="give at least 1")
