# SPDX-License-Identifier: Apache-2.0
"""Light sheets from stripes on a flat target (thesis 2.3.2.2, eqs. 2.42 to 2.44)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.laser.assembly import LooseSheet, SheetCase, assemble_fit
from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.conditioning import refuse_few_boards
from armscan.calibration.laser.lack_of_fit import scatter_by_stripe, stripe_noise
from armscan.calibration.laser.naming import (
    NamedStripes,
    board_numbers,
    name_stripes,
)
from armscan.calibration.laser.observations import (
    SheetObservations,
    collect_observations,
    placement_covariances,
)
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.result import BoardStripes, LaserFit
from armscan.calibration.laser.sheet_model import SheetModel, choose_model, start_sheet
from armscan.calibration.laser.sightings import BoardImage, sight_stripes
from armscan.calibration.laser.solve import CommonErrors, solve_sheets
from armscan.calibration.laser.voting import LEAST_BOARDS, Vote, vote_on_sheets
from armscan.geometry.arrays import BoolArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration
from armscan.models.light_sheet import LightSheet
from armscan.models.stereo import StereoCalibration

OUTLIER_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class _Refused:
    """One sheet that its boards do not determine."""

    sheet: int
    failure: FitFailure


def calibrate_sheets(
    boards: Sequence[BoardStripes],
    camera: CameraCalibration | StereoCalibration,
    options: SheetOptions | None = None,
) -> LaserFit | FitFailure:
    """Calibrate one or several light sheets that lie on boards of known pose.

    The stripe points are carried to the board (`meet_board`), sorted into straight stripes, named
    over the images, and fitted: generalised least squares of the residuals across the stripe in
    the image, with the stripe's sigma of each point, and with the errors of the boards' poses and
    of the cameras as common unknowns of known covariance. A bow is added where the lack-of-fit
    test asks for it and the boards support it.

    Parameters
    ----------
    boards
        One entry an image; images of one placement share its board's pose and the error of that.
    camera
        One camera, or the two of a stereo head. Their covariance goes into the weights and into
        the result.
    options
        Defaults if None.

    Returns
    -------
    LaserFit or FitFailure
        A failure for one board, for stripes that are all one line in space, for stripes that
        cannot be named, and where nothing usable is left. Of the lines of a fan, those that the
        boards do not determine are left out with a warning.

    Raises
    ------
    InputError
        If an image is of a camera that is not calibrated.
    """
    options = options or SheetOptions()
    cameras = HeadCameras.of(camera)
    vote = sight_on_boards(boards, cameras, options)
    images = vote.images
    if not any(image.sightings for image in images):
        return FitFailure(
            f"no straight stripe with {options.min_points} accepted points lies on the board in "
            f"any of {len(images)} images",
            "check that laser-on and board images belong together, the target's size, and the "
            "stripe extraction",
        )
    named = name_stripes(images, cameras.covariance, options)
    while not isinstance(named, FitFailure):
        fit = _fit_named(images, named, cameras, options)
        if isinstance(fit, LaserFit):
            return replace(
                fit,
                skipped=(*vote.outlying, *fit.skipped),
                warnings=(*vote.warnings, *fit.warnings),
            )
        if isinstance(fit, FitFailure):
            return fit
        if not named.is_fan or len(named.names) == 1:
            return fit.failure
        named = named.without(fit.sheet, fit.failure.reason)
    return named


def sight_on_boards(
    boards: Sequence[BoardStripes], cameras: HeadCameras, options: SheetOptions
) -> Vote:
    """Straight stripes on the boards, less the lines on which the boards do not agree.

    Stripes are looked for on the print and, where three boards can vote, on the carrier around it
    as far as the print is long (`armscan.calibration.laser.voting`).
    """
    can_vote = len({board.place for board in boards}) >= LEAST_BOARDS
    n_lines = 0 if can_vote else options.n_sheets
    on_print = [
        sight_stripes(board, cameras, options, options.margin_mm, n_lines) for board in boards
    ]
    if not can_vote:
        return Vote(tuple(on_print))
    around = on_print
    if options.margin_mm is None:
        around = [sight_stripes(board, cameras, options, _carrier_mm(board)) for board in boards]
    return vote_on_sheets(on_print, around, cameras, options)


def _carrier_mm(board: BoardStripes) -> float:
    """A board may go on beyond its print by the print's own length."""
    points = board.view.points_board_mm
    return float(np.ptp(points, axis=0).max())


def _fit_named(
    images: Sequence[BoardImage], named: NamedStripes, cameras: HeadCameras, options: SheetOptions
) -> LaserFit | FitFailure | _Refused:
    observations = collect_observations(images, named)
    errors = CommonErrors(placement_covariances(images), cameras.covariance)
    starts = _starts(images, named, observations)
    if isinstance(starts, _Refused):
        return starts
    scatter = scatter_by_stripe(observations, observations.residuals_px(starts)[1])
    observations = replace(observations, sigma_px=observations.sigma_px * scatter)
    models: list[SheetModel] = []
    kept = np.ones(len(observations), dtype=np.bool_)
    for k, start in enumerate(starts):
        own = observations.sheet == k
        chosen = _model_of(observations.select(own), start, errors, options)
        if isinstance(chosen, FitFailure):
            reason = f"sheet {named.names[k]}: {chosen.reason}"
            return _Refused(k, FitFailure(reason, chosen.remedy))
        kept[own] = chosen[0]
        models.append(chosen[1])
    fit = assemble_fit(
        SheetCase(images, named, observations, scatter, kept, models, errors, cameras, options)
    )
    return _Refused(fit.sheet, fit.failure) if isinstance(fit, LooseSheet) else fit


def _starts(
    images: Sequence[BoardImage], named: NamedStripes, observations: SheetObservations
) -> list[LightSheet] | _Refused:
    boards = np.array(board_numbers(images))
    for k, name in enumerate(named.names):
        shown = [k in sheets for sheets in named.sheets]
        failure = refuse_few_boards(name, len(np.unique(boards[shown])))
        if failure is not None:
            return _Refused(k, failure)
    starts: list[LightSheet] = []
    for k, name in enumerate(named.names):
        start = start_sheet(name, observations.select(observations.sheet == k), images)
        if isinstance(start, FitFailure):
            return _Refused(k, start)
        starts.append(start)
    return starts


def _model_of(
    observations: SheetObservations, start: LightSheet, errors: CommonErrors, options: SheetOptions
) -> tuple[BoolArray, SheetModel] | FitFailure:
    """Points of one sheet that are kept, and the model that they ask for."""
    near = _without_outliers(observations, start, errors, options)
    if isinstance(near, FitFailure):
        return near
    model = choose_model(observations.select(near), start, errors, options)
    return model if isinstance(model, FitFailure) else (near, model)


def _without_outliers(
    observations: SheetObservations,
    start: LightSheet,
    errors: CommonErrors,
    options: SheetOptions,
) -> BoolArray | FitFailure:
    """Keep the points near the plane; a bow widens the robust scale and so keeps its points."""
    keep = np.ones(len(observations), dtype=np.bool_)
    alone = observations.as_one_sheet()
    # Stripes that scatter more than they claim must not drag the boards along.
    noise = stripe_noise(alone, alone.residuals_px([start])[1])
    for _ in range(OUTLIER_ROUNDS):
        used = alone.select(keep)
        solution = solve_sheets(
            used, [start], errors, [False], sigma_factor=noise.sigma_factor, is_robust=True
        )
        if isinstance(solution, FitFailure):
            return solution
        normalised = np.full(len(keep), np.inf)
        normalised[keep] = np.abs(solution.remaining_px / used.sigma_px) / noise.factor
        scale = max(1.0, 1.4826 * float(np.median(normalised[keep])))
        before = int(keep.sum())
        keep = normalised < options.outlier_sigma * scale
        if int(keep.sum()) == before:
            break
    return keep
