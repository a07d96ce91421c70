# SPDX-License-Identifier: Apache-2.0
"""Repeated hand-eye calibrations side by side, as the thesis's Table 4."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.report.hand_eye_numbers import hand_eye_numbers
from armscan.report.summary import Table

COLUMNS = ("calibration", "θ °", "γ °", "φ °", "tx mm", "ty mm", "tz mm")


def repeat_tables(names: Sequence[str], fits: Sequence[HandEyeFit]) -> tuple[Table, ...]:
    """Angles of eq. 2.69 and translation of each calibration, their mean and standard deviation.

    The last line is what the calibrations themselves expect: the root mean square of their stated
    sigmas, the sensor's share left out, since all share the sensor.
    """
    numbers = [hand_eye_numbers(fit.calibration, fit.calibration.covariance) for fit in fits]
    angles = np.degrees(np.unwrap(np.radians([item.euler_deg for item in numbers]), axis=0))
    values = np.hstack([angles, [item.translation_mm for item in numbers]])
    stated = np.hstack(
        [
            [item.euler_sigma_deg for item in numbers],
            [item.translation_sigma_mm for item in numbers],
        ]
    )
    rows = [_row(name, row, 3) for name, row in zip(names, values, strict=True)]
    rows.append(_row("mean", values.mean(axis=0), 3))
    rows.append(_row("standard deviation", values.std(axis=0, ddof=1), 4))
    rows.append(_row("stated sigma", np.sqrt(np.mean(stated**2, axis=0)), 4))
    return (Table(COLUMNS, tuple(rows), "One calibration each (as Table 4)"),)


def _row(name: str, values: np.ndarray, decimals: int) -> tuple[str, ...]:
    return (name, *(f"{value:.{decimals}f}" for value in values))
