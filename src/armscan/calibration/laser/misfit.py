# SPDX-License-Identifier: Apache-2.0
"""Which single image keeps a sheet from being a plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.calibration.laser.lack_of_fit import StripeNoise, lack_of_fit, stripe_noise
from armscan.calibration.laser.observations import SheetObservations
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.solve import CommonErrors, SheetSolution, solve_sheets
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet

MIN_BOARDS = 4
"""With fewer, two boards are left of which each explains the other."""


def find_misfit_image(
    observations: SheetObservations,
    sheet: LightSheet,
    errors: CommonErrors,
    options: SheetOptions,
) -> int | None:
    """Number of an image without whose board a plane explains all others, or None.

    Parameters
    ----------
    observations
        Points of one sheet that a plane does not explain.
    sheet
        Where the fits start.
    errors
        Covariance of boards and camera.
    options
        For the limit of the lack-of-fit test.
    """
    alone = observations.as_one_sheet()
    boards = np.unique(alone.board)
    if len(boards) < MIN_BOARDS:
        return None
    noise = stripe_noise(alone, alone.residuals_px([sheet])[1])
    whole = solve_sheets(alone, [sheet], errors, [False], sigma_factor=noise.sigma_factor)
    if isinstance(whole, FitFailure):
        return None
    p_values = [_probability_without(int(board), alone, whole, noise) for board in boards]
    best = int(np.argmax(p_values))
    if p_values[best] < options.lack_of_fit_p:
        return None
    return int(alone.image[alone.board == boards[best]][0])


def _probability_without(
    board: int, observations: SheetObservations, whole: SheetSolution, noise: StripeNoise
) -> float:
    """Of the lack of fit of all other boards, by one step from the plane of all."""
    linear = whole.linear
    normal = linear.system.solve(linear.weight, 0, without_board=board)
    if normal is None:
        return 0.0
    rest = observations.board != board
    remaining = (linear.system.residual_px + linear.system.times(normal.step))[rest]
    common = normal.step[normal.n_sheet :]
    chi2 = float((linear.weight[rest] * remaining**2).sum() + common @ common)
    share = replace(noise, degrees_of_freedom=noise.degrees_of_freedom * float(rest.mean()))
    return lack_of_fit(observations.select(rest), replace(whole, chi2=chi2), share).p_value
