# SPDX-License-Identifier: Apache-2.0
"""What each camera's views say by themselves: a start for both together, and a check on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.camera.board_pose import estimate_board_pose
from armscan.calibration.camera.calibrate import calibrate_camera
from armscan.calibration.camera.cross_validation import rms
from armscan.calibration.camera.observations import basis_of
from armscan.calibration.camera.result import CameraFit
from armscan.calibration.stereo.options import StereoOptions
from armscan.calibration.stereo.pairs import SIDES
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.vision.targets.view import TargetView

WRONG_LEVEL = 100.0
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
    reason
        Why these parameters are free.
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

    def kept(self, view: TargetView | None) -> TargetView | None:
        """The view if it can be used."""
        return view if view is not None and view.source in self.outliers else None


def prepare_cameras(
    views: Sequence[Sequence[TargetView]],
    options: StereoOptions,
    given: tuple[CameraCalibration, CameraCalibration] | None,
) -> tuple[SingleCamera, SingleCamera] | FitFailure:
    """Solve each camera by itself, and check given intrinsics against its images.

    Parameters
    ----------
    views
        Of the left and of the right camera.
    options
        See `StereoOptions`.
    given
        Calibrations of both, for intrinsics that are not ``free``.

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


def _solved(fit: CameraFit, options: StereoOptions) -> SingleCamera:
    left_out = {view.source: view.note for view in fit.views if not view.is_used}
    left_out |= {view.source: view.reason for view in fit.refused_views}
    basis = basis_of(fit.free_parameters, is_aspect_fixed=options.camera.is_aspect_fixed)
    return SingleCamera(
        fit.camera,
        fit.free_parameters,
        basis[: len(PARAMETER_NAMES)],
        {view.source: view.is_outlier for view in fit.used_views},
        left_out,
        fit,
        fit.model_reason,
    )


def _given(
    views: Sequence[TargetView],
    given: CameraCalibration,
    fit: CameraFit | None,
    options: StereoOptions,
) -> SingleCamera:
    known = np.diag(given.covariance) > 0.0
    is_prior = options.intrinsics == "prior"
    names = tuple(name for name, is_free in zip(PARAMETER_NAMES, known, strict=True) if is_free)
    free = names if is_prior else ()
    outliers: dict[str, BoolArray] = {}
    left_out: dict[str, str] = {}
    found = {view.source: view for view in fit.used_views} if fit is not None else {}
    refused = {view.source: view.reason for view in fit.refused_views} if fit is not None else {}
    for view in views:
        if len(view) < options.camera.min_points or view.source in refused:
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
        basis_of(free, is_aspect_fixed=False)[: len(PARAMETER_NAMES)],
        outliers,
        left_out,
        fit,
        f"the given calibration is {word}",
        float("nan") if fit is None else _level(fit, given),
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
    if _level(own, given[side]) > WRONG_LEVEL and _level(own, given[1 - side]) < RIGHT_LEVEL:
        return FitFailure(
            f"the {word} images fit the calibration given for the {other} camera, and not that "
            f"given for the {word} one: left and right are swapped",
            "swap the lists of images, or the two calibrations",
        )
    with_given, with_other = (_rms_px(views, given[k].camera) for k in (side, 1 - side))
    if with_given < STRANGE_RATIO * own.rms_px:
        return None
    reason = (
        f"the {word} images do not fit the calibration given for the {word} camera: rms "
        f"{with_given:.2f} px, and {own.rms_px:.2f} px with a camera of their own"
    )
    if with_other < STRANGE_RATIO * own.rms_px:
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
    free = np.flatnonzero(own.sigma > 0.0)
    apart = (a.parameters - b.parameters)[free]
    covariance = (own.covariance + given.covariance)[np.ix_(free, free)]
    sigma = np.sqrt(np.diag(covariance))
    white = np.linalg.solve(covariance / np.outer(sigma, sigma), apart / sigma)
    return float(white @ (apart / sigma)) / len(free)


def _rms_px(views: Sequence[TargetView], camera: CameraModel) -> float:
    """Of the poses alone; infinite if the camera cannot have taken the images."""
    residuals = []
    for view in views:
        if (view.width_px, view.height_px) != (camera.width_px, camera.height_px):
            return float("inf")
        pose = estimate_board_pose(view, camera, allow_ambiguous=True)
        if not isinstance(pose, FitFailure):
            residuals.append(pose.residuals)
    return rms(np.concatenate(residuals)) if residuals else float("inf")
