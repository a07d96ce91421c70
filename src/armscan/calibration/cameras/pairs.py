# SPDX-License-Identifier: Apache-2.0
"""Pairs of views for a stereo calibration, its options, and what each camera gives by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np

from armscan.calibration.cameras.adjustment import basis_of
from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.distortion import rms
from armscan.calibration.cameras.result import (
    MIN_VIEW_POINTS,
    CameraFit,
    CameraOptions,
)
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import (
    CameraCalibration,
    independent_parameters,
    is_aspect_held,
)
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.models.two_views import IntrinsicsUse
from armscan.vision.targets.detect import Numbering, renumbered
from armscan.vision.targets.target import Target, TargetView

INTRINSICS_USES: tuple[IntrinsicsUse, ...] = get_args(IntrinsicsUse)

MIN_PAIRS = 3
"""Two pairs that disagree do not say which of them is wrong."""


@dataclass(frozen=True, slots=True)
class StereoOptions:
    """How two cameras are calibrated together.

    Parameters
    ----------
    camera
        Of each camera: distortion model, what is held, most steps. Where calibrations are given,
        these say what is solved: the model is then that of the solutions which they are compared
        with. What it says of views to leave out and of folds does not count here.
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

    def check_given(self, *, is_given: bool) -> None:
        """Raise `OptionError` if calibrations are given for nothing, or missing."""
        if is_given and self.intrinsics == "free":
            raise OptionError(
                "calibrations of the cameras are given, and free intrinsics take none",
                where="--intrinsics free",
                remedy="leave --left and --right out, or count them (prior) or hold them (fixed)",
            )
        if not is_given and self.intrinsics != "free":
            raise OptionError(
                f"intrinsics '{self.intrinsics}' need calibrations of both cameras",
                remedy="give them, or let the intrinsics be free",
            )


SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """What the two cameras saw of the target at one instant; None where one did not find it."""

    left: TargetView | None
    right: TargetView | None

    def __post_init__(self) -> None:
        if self.left is None and self.right is None:
            raise InputError("a pair needs a view of at least one camera")

    @property
    def name(self) -> str:
        """Names of its images."""
        return " + ".join(view.source for view in self.views if view is not None)

    @property
    def views(self) -> tuple[TargetView | None, TargetView | None]:
        """Left and right view."""
        return self.left, self.right

    @property
    def is_seen_by_both(self) -> bool:
        """True if both cameras found the target."""
        return self.left is not None and self.right is not None

    def numbered(self, target: Target, right: Numbering) -> StereoPair:
        """The pair with other numbers of the target's points in the right image."""
        view = self.right
        return self if view is None else replace(self, right=renumbered(view, target, right))


def views_of(pairs: Sequence[StereoPair], side: int) -> list[TargetView]:
    """All views of one camera, 0 for the left and 1 for the right."""
    return [view for pair in pairs if (view := pair.views[side]) is not None]


def check_pairs(pairs: Sequence[StereoPair], leave_out: Sequence[str]) -> list[StereoPair]:
    """The pairs without those to leave out.

    Raises
    ------
    InputError
        If two views of one camera have one name.
    OptionError
        If a pair to leave out does not exist.
    """
    for side, word in enumerate(SIDES):
        names = [view.source for view in views_of(pairs, side)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(
                f"{word} images share a name: {', '.join(twice)}", remedy="give each image once"
            )
    known = {view.source for pair in pairs for view in pair.views if view is not None}
    unknown = sorted(set(leave_out) - known)
    if unknown:
        raise OptionError(
            f"cannot leave out {', '.join(unknown)}: no such image with the target",
            remedy=f"the images are {', '.join(sorted(known))}",
        )
    return [
        pair
        for pair in pairs
        if not any(view is not None and view.source in leave_out for view in pair.views)
    ]


FOREIGN_LEVEL = 100.0
"""Given intrinsics ten standard deviations from what the images say are of another camera, if those
given for the other camera lie within three..."""
RIGHT_LEVEL = 9.0

STRANGE_RATIO = 2.0
"""Given intrinsics under which the images fit twice as badly as with a camera of their own belong
to another camera, or to another focus."""


@dataclass(frozen=True, slots=True, eq=False)
class SingleCamera:
    """One camera before the two are solved together.

    Parameters
    ----------
    camera
        Starting values, or what is held.
    free_parameters
        Names of those of its parameters that will be solved.
    basis
        (9, F) directions of these.
    outliers
        (M,) outliers among the points of each view that can be used, by source.
    left_out
        Reason for each other view, by source.
    fit
        The camera by itself; None if its views do not determine one and it was given.
    has_covariance
        False if it is held as a calibration without uncertainty gives it.
    given_level
        Squared distance of given intrinsics from what the images say by themselves, over both
        covariances and the degrees of freedom; NaN where there is none.
    """

    camera: CameraModel
    free_parameters: tuple[str, ...]
    basis: FloatArray
    outliers: Mapping[str, BoolArray]
    left_out: Mapping[str, str]
    fit: CameraFit | None
    reason: str
    given_level: float = float("nan")
    has_covariance: bool = True

    def kept(self, view: TargetView | None) -> TargetView | None:
        """The view if it can be used."""
        return view if view is not None and view.source in self.outliers else None


def prepare_cameras(
    views: Sequence[Sequence[TargetView]],
    options: StereoOptions,
    given: tuple[CameraCalibration, CameraCalibration] | None,
) -> tuple[SingleCamera, SingleCamera] | FitFailure:
    """Solve each camera by itself, and check given intrinsics against its images.

    Raises
    ------
    InputError
        If images and a given camera differ in size.
    """
    prepared = []
    for side, word in enumerate(SIDES):
        fit = calibrate_camera(views[side], replace(options.camera, leave_out=()))
        if given is None:
            if isinstance(fit, FitFailure):
                return FitFailure(f"{word} camera: {fit.reason}", fit.remedy)
            prepared.append(_solved(fit, options))
            continue
        _check_size(views[side], given[side].camera, word)
        own = None if isinstance(fit, FitFailure) else fit
        strange = None if own is None else _strange(views[side], own, given, side)
        if strange is not None:
            return strange
        prepared.append(_given(views[side], given[side], own, options))
    return prepared[0], prepared[1]


@dataclass(frozen=True, slots=True, eq=False)
class KnownBow:
    """Bow of the board as both cameras found it, each by itself; see `BoardWarp`.

    Parameters
    ----------
    bow_mm
        (2,) along x and along y.
    covariance_mm2
        (2, 2).
    """

    bow_mm: FloatArray
    covariance_mm2: FloatArray


def common_bow(cameras: tuple[SingleCamera, SingleCamera]) -> KnownBow | None:
    """Weighted mean of the bows that the cameras by themselves could not do without."""
    information, weighted = np.zeros((2, 2)), np.zeros(2)
    for camera in cameras:
        warp = None if camera.fit is None else camera.fit.warp
        if warp is not None and warp.is_significant:
            own = np.linalg.inv(warp.covariance_mm2)
            information += own
            weighted += own @ warp.bow_mm
    if not information.any():
        return None
    covariance = np.linalg.inv(information)
    return KnownBow(np.asarray(covariance @ weighted), np.asarray(covariance))


def common_design_effect(cameras: tuple[SingleCamera, SingleCamera]) -> float:
    """Mean factor by which the cameras' own variances are widened for residuals that are alike."""
    found = [camera.fit.design_effect for camera in cameras if camera.fit is not None]
    return float(np.mean(found)) if found else 1.0


def _solved(fit: CameraFit, options: StereoOptions) -> SingleCamera:
    left_out = {view.source: view.note for view in fit.views if not view.is_used}
    left_out |= {view.source: view.reason for view in fit.refused_views}
    free, reason = fit.free_parameters, fit.model_reason
    if options.camera.distortion == "auto":
        # which of them each camera tells by itself is not what the pairs tell
        is_fisheye = fit.camera.lens == "fisheye"
        named = "all three of a fisheye" if is_fisheye else "all five coefficients"
        reason = f"{named}: what the pairs say little of, the sigmas tell"
    basis = basis_of(free, is_aspect_fixed=options.camera.is_aspect_fixed)
    return SingleCamera(
        fit.camera,
        free,
        basis[: len(PARAMETER_NAMES)],
        {view.source: view.is_outlier for view in fit.used_views},
        left_out,
        fit,
        reason,
    )


def _given(
    views: Sequence[TargetView],
    given: CameraCalibration,
    fit: CameraFit | None,
    options: StereoOptions,
) -> SingleCamera:
    is_prior = options.intrinsics == "prior"
    known = independent_parameters(given.covariance)
    free = tuple(PARAMETER_NAMES[k] for k in known) if is_prior else ()
    is_held = is_prior and is_aspect_held(given.covariance)
    outliers: dict[str, BoolArray] = {}
    left_out: dict[str, str] = {}
    found = {view.source: view for view in fit.used_views} if fit is not None else {}
    refused = {view.source: view.reason for view in fit.refused_views} if fit is not None else {}
    for view in views:
        if len(view) < MIN_VIEW_POINTS or view.source in refused:
            left_out[view.source] = refused.get(view.source, f"only {len(view)} target points")
        elif fit is not None and view.source not in found:
            left_out[view.source] = "its residuals are far larger than those of the other views"
        else:
            is_known = view.source in found
            outliers[view.source] = (
                found[view.source].is_outlier if is_known else np.zeros(len(view), dtype=np.bool_)
            )
    word = "a prior" if is_prior else "held"
    return SingleCamera(
        given.camera,
        free,
        basis_of(free, is_aspect_fixed=is_held)[: len(PARAMETER_NAMES)],
        outliers,
        left_out,
        fit,
        f"the given calibration is {word}",
        float("nan") if fit is None else _level(fit, given),
        given.has_covariance,
    )


def _check_size(views: Sequence[TargetView], camera: CameraModel, word: str) -> None:
    for view in views:
        if (view.width_px, view.height_px) != (camera.width_px, camera.height_px):
            raise InputError(
                f"the image is {view.width_px}x{view.height_px} px, the {word} camera was "
                f"calibrated with {camera.width_px}x{camera.height_px} px",
                where=view.source,
                remedy="give the calibration of the camera that took the images, and check that "
                "left and right are not swapped",
            )


def _strange(
    views: Sequence[TargetView],
    own: CameraFit,
    given: tuple[CameraCalibration, CameraCalibration],
    side: int,
) -> FitFailure | None:
    """Why the given camera cannot be the one that took the images."""
    word, other = SIDES[side], SIDES[1 - side]
    if _level(own, given[side]) > FOREIGN_LEVEL and _level(own, given[1 - side]) < RIGHT_LEVEL:
        return FitFailure(
            f"the {word} images fit the calibration given for the {other} camera, and not that "
            f"given for the {word} one: left and right are swapped",
            "swap the lists of images, or the two calibrations",
        )
    # Of its own camera, too, with flat boards: its fit holds the bow of a bent one.
    with_own, with_given, with_other = (
        rms_of_poses_px(views, camera)
        for camera in (own.camera, given[side].camera, given[1 - side].camera)
    )
    if with_given < STRANGE_RATIO * with_own:
        return None
    reason = (
        f"the {word} images do not fit the calibration given for the {word} camera: rms "
        f"{with_given:.2f} px, and {with_own:.2f} px with a camera of their own"
    )
    if with_other < STRANGE_RATIO * with_own:
        return FitFailure(
            f"{reason}; they fit that of the {other} camera ({with_other:.2f} px)",
            "swap the lists of images, or the two calibrations",
        )
    return FitFailure(reason, "calibrate the cameras as they are focused now, or give none")


def _level(own: CameraFit, given: CameraCalibration) -> float:
    """Squared distance of given intrinsics from the camera's own, per degree of freedom."""
    a, b = own.camera, given.camera
    if (a.width_px, a.height_px) != (b.width_px, b.height_px):
        return float("inf")
    both = own.covariance + given.covariance
    free = np.intersect1d(np.flatnonzero(own.sigma > 0.0), independent_parameters(both))
    apart = (a.parameters - b.parameters)[free]
    covariance = both[np.ix_(free, free)]
    sigma = np.sqrt(np.diag(covariance))
    white = np.linalg.solve(covariance / np.outer(sigma, sigma), apart / sigma)
    return float(white @ (apart / sigma)) / len(free)


def rms_of_poses_px(views: Sequence[TargetView], camera: CameraModel) -> float:
    """Residuals of views in px if nothing but their poses is solved; flat targets.

    Infinite if the camera cannot have taken the images.
    """
    residuals = []
    for view in views:
        if (view.width_px, view.height_px) != (camera.width_px, camera.height_px):
            return float("inf")
        pose = estimate_board_pose(view, camera, allow_ambiguous=True)
        if not isinstance(pose, FitFailure):
            residuals.append(pose.residuals)
    return rms(np.concatenate(residuals)) if residuals else float("inf")
