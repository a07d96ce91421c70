# SPDX-License-Identifier: Apache-2.0
"""Which single image keeps a sheet from being a plane."""

from __future__ import annotations

import numpy as np

from armscan.calibration.laser.lack_of_fit import lack_of_fit, stripe_noise
from armscan.calibration.laser.observations import SheetObservations
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.solve import CommonErrors, solve_sheets
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet

MAX_TRIED = 6
"""Boards that are left out in turn, those farthest off first."""
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
    normalised = (alone.residuals_px([sheet])[1] / alone.sigma_px) ** 2
    share = np.bincount(alone.board, normalised)[boards] / np.bincount(alone.board)[boards]
    boards = boards[np.argsort(-share)[:MAX_TRIED]]
    p_values = []
    for board in boards:
        rest = alone.select(alone.board != board)
        noise = stripe_noise(rest, rest.residuals_px([sheet])[1])
        solution = solve_sheets(rest, [sheet], errors, [False], sigma_factor=noise.sigma_factor)
        if isinstance(solution, FitFailure):
            p_values.append(0.0)
            continue
        p_values.append(lack_of_fit(rest, solution, noise).p_value)
    best = int(np.argmax(p_values))
    if p_values[best] < options.lack_of_fit_p:
        return None
    return int(alone.image[alone.board == boards[best]][0])
