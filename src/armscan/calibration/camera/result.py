# SPDX-License-Identifier: Apache-2.0
"""What a camera calibration yields: the camera, its uncertainty, and the evidence for both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.options import CameraOptions
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.models.camera import CameraModel
from armscan.vision.targets.view import TargetView


@dataclass(frozen=True, slots=True, eq=False)
class ViewFit:
    """One view of the target and how it fits.

    Parameters
    ----------
    view
        The view itself: ``view.source``, ``view.points_px``.
    sensor_from_board
        Pose of the board; of a view that was left out, from a fit of the pose alone.
    pose_covariance
        (6, 6) covariance of (rotation-vector increment in rad in the Sensor frame, applied on the
        left; translation in mm), the camera's uncertainty included for views that were used.
    residuals_px
        (M, 2) observed minus predicted.
    is_outlier
        (M,) True for points that were left out of the solution as outliers.
    chi2_per_point
        Robust mean square of the residuals over that of the typical view: 1 for a view like the
        others.
    tilt_deg
        Angle between the board's normal and the optical axis.
    distance_mm
        Depth Z of the middle of the points.
    is_used
        False if the view did not take part in the solution.
    is_misfit
        True if the view fits so much worse than the others that leaving it out is proposed.
    note
        Why the view was left out, or why that is proposed; empty for a good view.
    """

    view: TargetView
    sensor_from_board: Pose[Sensor, Board]
    pose_covariance: FloatArray
    residuals_px: FloatArray
    is_outlier: BoolArray
    chi2_per_point: float
    tilt_deg: float
    distance_mm: float
    is_used: bool
    is_misfit: bool
    note: str

    def __post_init__(self) -> None:
        m = len(self.view)
        object.__setattr__(
            self, "pose_covariance", frozen_floats(self.pose_covariance, (6, 6), "pose_covariance")
        )
        object.__setattr__(
            self, "residuals_px", frozen_floats(self.residuals_px, (m, 2), "residuals_px")
        )
        is_outlier = np.array(self.is_outlier, dtype=np.bool_)
        if is_outlier.shape != (m,):
            raise InputError(f"is_outlier has shape {is_outlier.shape}, expected ({m},)")
        is_outlier.setflags(write=False)
        object.__setattr__(self, "is_outlier", is_outlier)

    @property
    def source(self) -> str:
        """Source name of the exposure."""
        return self.view.source

    @property
    def rms_px(self) -> float:
        """Root mean square over all its points of the residual's length (as OpenCV defines it)."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


@dataclass(frozen=True, slots=True)
class RefusedView:
    """A view from which not even a pose can be had, and why."""

    source: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Which part of the image the target points of the used views cover.

    Parameters
    ----------
    counts
        (R, C) target points in each cell of an even grid over the image.
    fraction
        Share of the cells that hold a point.
    empty
        Plain names of image regions (thirds) without any point, such as ``top left``.
    covered_px
        (4,) smallest x, smallest y, largest x, largest y of the points.
    tilts_deg
        (V,) tilt of each used view.
    tilt_directions_deg
        (V,) direction in the image towards which the board's normal leans, -180 to 180.
    """

    counts: IntArray
    fraction: float
    empty: tuple[str, ...]
    covered_px: FloatArray
    tilts_deg: FloatArray
    tilt_directions_deg: FloatArray

    def __post_init__(self) -> None:
        v = len(self.tilts_deg)
        object.__setattr__(self, "counts", frozen_ints(self.counts, (None, None), "counts"))
        object.__setattr__(self, "covered_px", frozen_floats(self.covered_px, (4,), "covered_px"))
        object.__setattr__(self, "tilts_deg", frozen_floats(self.tilts_deg, (v,), "tilts_deg"))
        object.__setattr__(
            self,
            "tilt_directions_deg",
            frozen_floats(self.tilt_directions_deg, (v,), "tilt_directions_deg"),
        )


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """How well the camera predicts views that it has not seen.

    Each fold's views are left out, the camera is solved from the rest with the same free
    parameters, and each held-out view gets a fit of its pose alone.

    Parameters
    ----------
    n_folds
        Count of folds; view number i of the used views belongs to fold ``i % n_folds``.
    rms_px
        Root mean square over all held-out points of the residual's length.
    rms_in_sample_px
        The same over the same views with the camera solved from all of them.
    sources, view_rms_px
        Held-out rms of each view.
    """

    n_folds: int
    rms_px: float
    rms_in_sample_px: float
    sources: tuple[str, ...]
    view_rms_px: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class BoardWarp:
    """Bow of the board: ``z = bow_x (1 - u^2) + bow_y (1 - v^2)``.

    Here u and v run from -1 to 1 over the target's points along x and y; positive bows lie
    towards +z of the Board frame, away from the camera.

    Parameters
    ----------
    bow_mm
        (2,) bow along x and along y: the height of the middle over the edges.
    covariance_mm2
        (2, 2).
    f_statistic
        Decrease of chi2 per parameter over the noise variance; about 1 for a flat board.
    p_value
        Probability of such a decrease on a flat board.
    """

    bow_mm: FloatArray
    covariance_mm2: FloatArray
    f_statistic: float
    p_value: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "bow_mm", frozen_floats(self.bow_mm, (2,), "bow_mm"))
        object.__setattr__(
            self, "covariance_mm2", frozen_floats(self.covariance_mm2, (2, 2), "covariance_mm2")
        )

    @property
    def sigma_mm(self) -> FloatArray:
        """(2,) standard deviations."""
        return np.sqrt(np.diag(self.covariance_mm2))

    @property
    def is_significant(self) -> bool:
        """True if a flat board would show such a bow less than once in a hundred times."""
        return self.p_value < 0.01


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A calibrated camera with its uncertainty and evidence.

    Parameters
    ----------
    camera
        The solution.
    covariance
        (9, 9) in the order of `armscan.models.camera.PARAMETER_NAMES`; rows of parameters that
        were held are zero.
    free_parameters
        Names of the parameters that were solved.
    joint_covariance
        (9 + 6 V, 9 + 6 V) of the camera and of the poses of the V used views, in the order of
        ``used_views``; pose convention as in `ViewFit`.
    views
        Every view given, in the order given, used or left out.
    refused_views
        Views from which no pose can be had: too few points, or seen edge-on.
    rms_px
        Root mean square over the used points of the residual's length (the definition of OpenCV).
    sigma_point_px
        Estimated standard deviation of one detected coordinate, per axis.
    noise_scale
        By how much the points scatter more than their detector's covariances say: root of chi2
        over the degrees of freedom with these covariances alone. What is done about it:
        `armscan.calibration.camera.noise`.
    target_error_mm
        Standard deviation, along each axis of the board, by which the target's points miss their
        places, as found from residuals that repeat from view to view; 0 where none do. The
        covariance holds its effect.
    degrees_of_freedom
        Count of observed coordinates minus count of unknowns.
    condition
        Condition number of the normal matrix of the camera's free parameters, scaled to unit
        diagonal, after the poses are eliminated.
    coverage
        Coverage of the image.
    cross_validation
        Hold-out test, or None if it was switched off or too few views are left for it.
    warp
        Bow of the board, if it was solved.
    model_reason
        Why these parameters were free.
    warnings
        Plain sentences that a person should read.
    options
        The options in force.
    """

    camera: CameraModel
    covariance: FloatArray
    free_parameters: tuple[str, ...]
    joint_covariance: FloatArray
    views: tuple[ViewFit, ...]
    refused_views: tuple[RefusedView, ...]
    rms_px: float
    sigma_point_px: float
    noise_scale: float
    target_error_mm: float
    degrees_of_freedom: int
    condition: float
    coverage: Coverage
    cross_validation: CrossValidation | None
    warp: BoardWarp | None
    model_reason: str
    warnings: tuple[str, ...]
    options: CameraOptions

    def __post_init__(self) -> None:
        n = 9 + 6 * self.n_views
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (9, 9), "covariance"))
        object.__setattr__(
            self, "joint_covariance", frozen_floats(self.joint_covariance, (n, n), "joint")
        )

    @property
    def used_views(self) -> tuple[ViewFit, ...]:
        """The views that took part in the solution."""
        return tuple(view for view in self.views if view.is_used)

    @property
    def n_views(self) -> int:
        """Count of views used."""
        return len(self.used_views)

    @property
    def n_points(self) -> int:
        """Count of points used; outliers are not counted."""
        return sum(int((~view.is_outlier).sum()) for view in self.used_views)

    @property
    def sigma(self) -> FloatArray:
        """(9,) standard deviations of the camera's parameters; zero where held."""
        return np.sqrt(np.diag(self.covariance))
