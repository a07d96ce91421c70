# SPDX-License-Identifier: Apache-2.0
"""What a stereo calibration yields: both cameras, their relative pose, and the evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.result import Coverage, CrossValidation
from armscan.calibration.stereo.options import StereoOptions
from armscan.calibration.stereo.pairs import StereoPair
from armscan.calibration.stereo.single_camera import SingleCamera
from armscan.geometry.arrays import BoolArray, FloatArray, frozen_floats
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.models.stereo import STEREO_PARAMETER_NAMES
from armscan.models.two_views import TwoViews


@dataclass(frozen=True, slots=True, eq=False)
class ViewResiduals:
    """How one view fits.

    Parameters
    ----------
    sensor_from_board
        Where the board is in the left camera; of the right view of a pair that was taken apart,
        by that view alone.
    residuals_px
        (M, 2) observed minus predicted.
    is_outlier
        (M,) points left out of the solution as outliers.
    """

    sensor_from_board: Pose[Sensor, Board]
    residuals_px: FloatArray
    is_outlier: BoolArray

    @property
    def rms_px(self) -> float:
        """Root mean square over all its points of the residual's length."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoints:
    """Target points that both views of a pair show.

    Parameters
    ----------
    left_px, right_px
        (K, 2) pixels.
    in_left_px, in_right_px
        (K,) signed distances from each other's epipolar lines, see
        `armscan.models.two_views.epipolar_distances_px`.
    depth_mm
        (K,) Z in the Sensor frame, of the board's pose.
    """

    left_px: FloatArray
    right_px: FloatArray
    in_left_px: FloatArray
    in_right_px: FloatArray
    depth_mm: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square of the distances in both images; NaN without points."""
        both = np.concatenate([self.in_left_px, self.in_right_px])
        return float(np.sqrt(np.mean(both**2))) if len(both) else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """One pair and how it fits.

    Parameters
    ----------
    pair
        Its views, numbered as they were used.
    left, right
        How each view fits; None for a view that was not used.
    matched
        Points that both views show; None unless both were used.
    quarter_turns
        How far the target's numbers in the right image had to be turned to go with the left's.
    apart
        (6,) its own ``right_from_left``, each camera's board by itself, minus that of the solution
        (rad, mm); NaN where there is none.
    level
        Squared distance of its own ``right_from_left`` from that of the other pairs, over the
        covariance and six degrees of freedom, over that of the typical pair; NaN where there is
        none.
    is_related
        True if it told where the cameras are to each other; False if it was taken apart, so that
        its views count for each camera alone, or if one camera did not see the target.
    is_misfit
        True if it disagrees with the others, so that taking it apart is proposed.
    note
        What is to be said of it; empty for a good pair.
    """

    pair: StereoPair
    left: ViewResiduals | None
    right: ViewResiduals | None
    matched: MatchedPoints | None
    quarter_turns: int
    apart: FloatArray
    level: float
    is_related: bool
    is_misfit: bool
    note: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "apart", frozen_floats(self.apart, (6,), "apart", allow_nan=True))


@dataclass(frozen=True, slots=True, eq=False)
class SideFit:
    """One of the cameras in the joint solution.

    Parameters
    ----------
    single
        The camera by itself, where it started from.
    rms_px
        Root mean square over its used points of the residual's length.
    sigma_point_px
        Estimated standard deviation of one detected coordinate, per axis.
    noise_scale
        By how much its points scatter more than their detector says.
    n_views, n_points
        What was used.
    coverage
        Of the image.
    """

    single: SingleCamera
    rms_px: float
    sigma_point_px: float
    noise_scale: float
    n_views: int
    n_points: int
    coverage: Coverage


@dataclass(frozen=True, slots=True, eq=False)
class StereoFit:
    """Two calibrated cameras with their uncertainty and evidence.

    Parameters
    ----------
    views
        The cameras and their relative pose.
    covariance
        (24, 24) in the order of `armscan.models.stereo.STEREO_PARAMETER_NAMES`.
    left, right
        Each camera in the solution.
    pairs
        Every pair given that was not left out by request.
    rms_px
        Root mean square over the used points of both cameras of the residual's length.
    epipolar_rms_px, epipolar_mean_px
        Of the signed distances of matched points from each other's epipolar lines, both images.
    typical_level
        Squared distance of the typical pair's own ``right_from_left`` from that of the others over
        its covariance and the degrees of freedom: about 1 where noise is all there is.
    hold_out
        Hold-out test over pairs, or None.
    degrees_of_freedom
        Observed coordinates minus unknowns.
    condition
        Of the normal matrix of the free shared unknowns, unit diagonal, boards eliminated.
    target_error_mm
        By how much the target's points miss their places, one standard deviation an axis.
    is_converged
        False if the adjustment was stopped before the minimum.
    warnings
        Plain sentences that a person should read.
    options
        The options in force.
    """

    views: TwoViews
    covariance: FloatArray
    left: SideFit
    right: SideFit
    pairs: tuple[PairFit, ...]
    rms_px: float
    epipolar_rms_px: float
    epipolar_mean_px: float
    typical_level: float
    hold_out: CrossValidation | None
    degrees_of_freedom: int
    condition: float
    target_error_mm: float
    is_converged: bool
    warnings: tuple[str, ...]
    options: StereoOptions

    def __post_init__(self) -> None:
        n = len(STEREO_PARAMETER_NAMES)
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (n, n), "covariance"))

    @property
    def parameters(self) -> FloatArray:
        """(24,) values; the pose's rotation vector and translation stand for its increments."""
        pose = self.views.right_from_left
        return np.concatenate(
            [
                self.views.left.parameters,
                self.views.right.parameters,
                pose.rotation_vector_rad,
                pose.translation_mm,
            ]
        )

    @property
    def sigma(self) -> FloatArray:
        """(24,) standard deviations; zero where held without a known one."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sides(self) -> tuple[SideFit, SideFit]:
        """Left and right camera."""
        return self.left, self.right

    @property
    def related(self) -> tuple[PairFit, ...]:
        """The pairs that told where the cameras are to each other."""
        return tuple(pair for pair in self.pairs if pair.is_related)

    @property
    def n_points(self) -> int:
        """Points used; one that both cameras of a pair see counts once."""
        both = sum(_n_common(pair) for pair in self.related)
        return self.left.n_points + self.right.n_points - both


def _n_common(pair: PairFit) -> int:
    left, right = pair.left, pair.right
    if left is None or right is None or pair.pair.left is None or pair.pair.right is None:
        return 0
    seen = np.intersect1d(
        pair.pair.left.point_index[~left.is_outlier], pair.pair.right.point_index[~right.is_outlier]
    )
    return len(seen)
