# SPDX-License-Identifier: Apache-2.0
"""Repeated hand-eye calibrations side by side, as the thesis's Table 4."""

from __future__ import annotations

from collections.abc import Sequence

from armscan.calibration.hand_eye.repeat_study import study_repeats
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.report.page import Text
from armscan.report.summary import Table

COLUMNS = ("calibration", "θ °", "γ °", "φ °", "tx mm", "ty mm", "tz mm")


def repeat_blocks(
    names: Sequence[str],
    fits: Sequence[HandEyeFit],
    sensor_covariance: FloatArray | None = None,
) -> tuple[Table, Text]:
    """Angles of eq. 2.69 and translation of each calibration, and how far they scatter.

    Parameters
    ----------
    names
        One a calibration.
    fits
        The calibrations, two or more, of one sensor.
    sensor_covariance
        (P, P) of its parameters; None where it is taken as exact.
    """
    study = study_repeats([fit.calibration for fit in fits], sensor_covariance)
    if isinstance(study, FitFailure):
        return Table(COLUMNS, ()), Text(study.reason)
    rows = [_row(name, row, 3) for name, row in zip(names, study.values, strict=True)]
    rows.append(_row("mean", study.mean_values, 3))
    rows.append(_row("standard deviation", study.std, 4))
    if study.predicted is not None:
        rows.append(_row("predicted", study.predicted, 4))
    low, high = study.ratio_range
    text = (
        "One calibration from each recording. The standard deviation is that of one calibration, "
        f"n - 1 = {len(fits) - 1} in the denominator; the prediction is what the calibrations "
        "state themselves; of the sensor's share, as all have one sensor, only what their postures "
        "make differ. If it is right, "
        f"their ratio falls between {low:.2f} and {high:.2f} in 95 % of such studies."
    )
    if study.unlike_predicted:
        text += f" It does not for {', '.join(study.unlike_predicted)}."
    return Table(COLUMNS, tuple(rows), "One calibration each (as Table 4)"), Text(text)


def _row(name: str, values: FloatArray, decimals: int) -> tuple[str, ...]:
    return (name, *(f"{value:.{decimals}f}" for value in values))
