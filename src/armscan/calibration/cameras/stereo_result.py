# SPDX-License-Identifier: Apache-2.0
"""What a stereo calibration gives: result, warnings, suggestions, and the reasons for which it
is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.pairs import (
    SIDES,
    SingleCamera,
    StereoOptions,
    StereoPair,
    common_bow,
    common_design_effect,
)
from armscan.calibration.cameras.result import (
    ALIKE,
    FEW_VIEWS,
    UNSEEN_WORSE,
    Coverage,
    CrossValidation,
    about_coverage,
    about_stretch,
    focal_reasons,
    is_much_bowed,
    rms_reasons,
)
from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    RowRecord,
    bools,
    floats,
)
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.calibration import without_covariance
from armscan.models.camera import PARAMETER_NAMES
from armscan.models.two_views import TwoViews


class ViewResiduals(ArrayRecord):
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
    residuals_px: FloatArray = floats("M", 2)
    is_outlier: BoolArray = bools("M")

    @property
    def rms_px(self) -> float:
        """Root mean square over all its points of the residual's length."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


class MatchedPoints(RowRecord):
    """Target points that both views of a pair show, where the lenses' models reach.

    Parameters
    ----------
    left_px
        (K, 2) pixels in the left image.
    in_left_px, in_right_px
        (K,) signed distances from each other's epipolar lines, see
        `armscan.models.two_views.epipolar_distances_px`.
    depth_mm
        (K,) Z in the Sensor frame, of the board's pose.
    """

    left_px: FloatArray = floats("N", 2)
    in_left_px: FloatArray = floats("N")
    in_right_px: FloatArray = floats("N")
    depth_mm: FloatArray = floats("N")

    @property
    def rms_px(self) -> float:
        """Root mean square of the distances in both images; NaN without points."""
        both = np.concatenate([self.in_left_px, self.in_right_px])
        return float(np.sqrt(np.mean(both**2))) if len(both) else float("nan")


class PairFit(ArrayRecord):
    """One pair and how it fits.

    Parameters
    ----------
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
    apart: FloatArray = floats(6, nan=True)
    level: float
    is_related: bool
    is_misfit: bool
    note: str


@dataclass(frozen=True, slots=True, eq=False)
class SideFit:
    """One of the cameras in the joint solution.

    Parameters
    ----------
    rms_px
        Root mean square over its used points of the residual's length.
    sigma_point_px
        Standard deviation of one detected coordinate, per axis, told of the residuals.
    noise_scale
        By how much its points scatter more than their detector says.
    """

    single: SingleCamera
    rms_px: float
    sigma_point_px: float
    noise_scale: float
    n_views: int
    n_points: int
    coverage: Coverage


class StereoFit(ArrayRecord):
    """Two calibrated cameras with their uncertainty and evidence.

    Parameters
    ----------
    views
        The cameras and their relative pose.
    covariance
        (24, 24) in the order of `armscan.models.two_views.STEREO_PARAMETER_NAMES`.
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
    covariance: FloatArray = floats(24, 24)
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


UNSTEADY_LEVEL = 9.0
"""The typical pair lies three of its standard deviations from where the others put the camera."""

ODD_GIVEN_LEVEL = 9.0
"""Given intrinsics lie three standard deviations from what the images say."""

BIAS_SIGMAS = 4.0
LEANING = 2.0
"""A baseline is horizontal if it is this many times longer along x than along y."""
AGREEING = 3.0
"""Sigmas by which two cameras may differ about one print."""


def advise(fit: StereoFit) -> StereoFit:
    """Add warnings to a result."""
    warnings = [
        *_about_solution(fit),
        *_about_sides(fit),
        *_about_board(fit),
        *_about_stretch(fit),
        *_about_pairs(fit),
        *_about_epipolar(fit),
        *_about_cameras(fit),
    ]
    return replace(fit, warnings=tuple(warnings))


def right_camera_centre_mm(fit: StereoFit) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(3,) the right camera's centre in the Sensor frame."""
    return np.asarray(fit.views.right_from_left.inverse().translation_mm)


def _about_solution(fit: StereoFit) -> list[str]:
    warnings = []
    if not fit.is_converged:
        warnings.append(
            "the solution was stopped before it reached the best fit; do not rely on it: check "
            "the pairs with the largest residuals, and add pairs"
        )
    held_out = fit.hold_out
    if held_out is not None and held_out.rms_px > UNSEEN_WORSE * held_out.rms_in_sample_px:
        warnings.append(
            f"pairs not used in the solution fit worse ({held_out.rms_px:.3f} px) than those used "
            f"({held_out.rms_in_sample_px:.3f} px): add pairs"
        )
    return warnings


def _about_board(fit: StereoFit) -> list[str]:
    cameras = fit.left.single, fit.right.single
    bow, widening = common_bow(cameras), np.sqrt(common_design_effect(cameras))
    warnings = []
    if widening > ALIKE**0.5 and fit.options.intrinsics != "fixed":
        warnings.append(
            "residuals of one view are alike, as if the board were bent or unevenly lit: the "
            f"standard deviations were widened by {widening:.1f}; look at the board's flatness"
        )
    if bow is None:
        return warnings
    fits = [camera.fit for camera in cameras if camera.fit is not None]
    points = np.concatenate([view.view.points_board_mm for own in fits for view in own.views])
    if not is_much_bowed(bow.bow_mm, points):
        return warnings
    along_x, along_y = bow.bow_mm
    return [
        *warnings,
        f"the board is bowed by {along_x:+.3f}, {along_y:+.3f} mm (along x, along y), as each "
        "camera by itself shows: the pairs are solved with it; a flatter board is better",
    ]


def _about_stretch(fit: StereoFit) -> list[str]:
    """What both cameras by themselves say of the print, if they agree; else it is not the print."""
    cameras = [side.single.fit for side in fit.sides if side.single.fit is not None]
    if len(cameras) < len(fit.sides):
        return []
    stretch = np.array([camera.stretch for camera in cameras])
    sigma = np.array([camera.stretch_sigma for camera in cameras])
    if not np.isfinite(sigma).all() or abs(stretch[0] - stretch[1]) > AGREEING * np.hypot(*sigma):
        return []
    weight = sigma**-2 / (sigma**-2).sum()
    points = np.concatenate([view.view.points_board_mm for own in cameras for view in own.views])
    return about_stretch(float(weight @ stretch), float(np.sqrt(weight**2 @ sigma**2)), points)


def _about_sides(fit: StereoFit) -> list[str]:
    x, y, _ = right_camera_centre_mm(fit)
    if not (x < 0.0 and abs(x) > LEANING * abs(y)):
        return []
    return [
        f"the right camera stands {-x:.0f} mm to the LEFT of the left one, in the left image: "
        "if the two lists of images were swapped, swap them back"
    ]


def _about_pairs(fit: StereoFit) -> list[str]:
    warnings = [f"{pair.pair.name}: {pair.note}" for pair in fit.pairs if pair.note]
    n_turned = sum(pair.quarter_turns != 0 for pair in fit.related)
    if n_turned:
        warnings.append(
            f"the target looks the same when it is turned: in {n_turned} of {len(fit.related)} "
            "pairs the right image's numbers were turned so that all pairs agree"
        )
    n_related = len(fit.related)
    if n_related < FEW_VIEWS:
        warnings.append(f"only {n_related} pairs: take 10 to 20")
    if fit.typical_level > UNSTEADY_LEVEL:
        warnings.append(
            "the pairs put the right camera further apart than their noise allows (typically "
            f"{np.sqrt(fit.typical_level):.0f} standard deviations): the images of a pair were "
            "perhaps not taken at one instant, the cameras are not fixed to each other, or the "
            "board is not flat"
        )
    return warnings


def _about_epipolar(fit: StereoFit) -> list[str]:
    n = sum(len(pair.matched.depth_mm) for pair in fit.related if pair.matched is not None)
    allowed = BIAS_SIGMAS * fit.epipolar_rms_px / np.sqrt(max(n, 1))
    if abs(fit.epipolar_mean_px) <= allowed:
        return []
    return [
        f"matched points lie {fit.epipolar_mean_px:+.3f} px to one side of each other's epipolar "
        f"lines on average, more than the scatter allows ({allowed:.3f} px)"
    ]


def _about_cameras(fit: StereoFit) -> list[str]:
    warnings = []
    cameras = (fit.views.left, fit.views.right)
    for word, side, camera in zip(SIDES, fit.sides, cameras, strict=True):
        warnings += [f"{word} camera: {text}" for text in about_coverage(side.coverage)]
        if not side.single.has_covariance:
            warnings.append(without_covariance("the pair's sigmas", f"the {word} camera"))
        if side.single.given_level > ODD_GIVEN_LEVEL:
            warnings.append(
                f"{word} camera: the given calibration lies {np.sqrt(side.single.given_level):.0f} "
                "standard deviations from what these images say by themselves: was the focus "
                "changed since?"
            )
        n_outliers = _n_outliers(fit, word)
        if n_outliers:
            warnings.append(f"{word} camera: {n_outliers} points lie too far out and were not used")
        if len(camera.folded_border()):
            warnings.append(
                f"{word} camera: the distortion has no inverse at the image's border: do not "
                "measure outside the covered part"
            )
    return warnings


def _n_outliers(fit: StereoFit, word: str) -> int:
    views = [pair.left if word == "left" else pair.right for pair in fit.pairs]
    return sum(int(view.is_outlier.sum()) for view in views if view is not None)


LARGEST_BASELINE_SIGMA = 0.05
"""Relative. The distance of a point scales with the baseline."""


def reasons_to_refuse(fit: StereoFit) -> tuple[str, ...]:
    """Why a solved pair must not be written as if it were one; empty if nothing speaks against.

    The limits of each camera are those of `armscan.calibration.cameras.result`.
    """
    n = len(PARAMETER_NAMES)
    reasons: list[str] = []
    held_out = 0.0 if fit.hold_out is None else fit.hold_out.rms_px
    for side, camera in enumerate((fit.views.left, fit.views.right)):
        sigma = fit.sigma[side * n : side * n + 2]
        rms_px = max(fit.sides[side].rms_px, held_out)
        found = (*focal_reasons(camera, *sigma.tolist()), *rms_reasons(camera, rms_px))
        reasons += [f"{SIDES[side]} camera: {reason}" for reason in found]
    translation = fit.views.right_from_left.translation_mm
    length = float(np.linalg.norm(translation))
    along = translation / length
    sigma_mm = float(np.sqrt(along @ fit.covariance[-3:, -3:] @ along))
    if sigma_mm > LARGEST_BASELINE_SIGMA * length:
        reasons.append(
            f"the cameras' distance of {length:.1f} mm is known to {sigma_mm:.1f} mm only, "
            f"{100.0 * LARGEST_BASELINE_SIGMA:.0f} % is the limit"
        )
    if reasons and fit.typical_level > UNSTEADY_LEVEL:
        # one pair whose board moved between its images bends cameras that are well known alone
        reasons.insert(0, _disagreement(fit))
    return tuple(reasons)


def _disagreement(fit: StereoFit) -> str:
    """How far apart the pairs put the right camera, and which one the farthest, where they do."""
    worst = max(fit.related, key=lambda pair: pair.level)
    return (
        f"the pairs put the right camera {np.sqrt(fit.typical_level):.0f} standard deviations "
        f"apart, {worst.pair.name} the farthest: leave out pairs whose board or head moved between "
        "the two images"
    )
