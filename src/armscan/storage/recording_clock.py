# SPDX-License-Identifier: Apache-2.0
"""What joins exposures and arm samples: trigger ids, or one clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError
from armscan.geometry.arrays import BoolArray, IntArray
from armscan.records.arm_track import NO_TRIGGER, ArmTrack
from armscan.records.session import ExposureRow
from armscan.storage.recording_arm import ARM_FILE
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_session import SessionFile

Times: TypeAlias = IntArray | NDArray[np.float64]

SPAN_RATIO = 50
"""Spans of exposures and arm that differ more than so are suspected of two units."""
UNIT_FACTORS = (1_000, 1_000_000, 1_000_000_000)
"""Nanoseconds in a microsecond, a millisecond, a second."""
CROWD = 3
"""So many arrangements between two samples of the arm are warned of."""


def check_clock(
    rows: Sequence[ExposureRow], arm: ArmTrack, said: SessionFile, folder: Path
) -> tuple[list[str], list[str]]:
    """Refuse a recording whose poses cannot be found.

    Returns
    -------
    assumed
        What is assumed of its clock, in words.
    warnings
        What is odd in its times, in words.

    Raises
    ------
    FileFormatError
        If there are neither common trigger ids nor a shared clock, no exposure is within the
        arm's times, or one table's times are in another unit.
    """
    where = str(folder / EXPOSURES_FILE)
    ids = {row.trigger_id for row in rows} - {None}
    of_arm = set() if arm.trigger_ids is None else set(arm.trigger_ids.tolist()) - {NO_TRIGGER}
    if ids & of_arm:
        return [], []
    if ids and of_arm:
        raise FileFormatError(
            "no trigger_id is in both tables",
            where=where,
            remedy="write the number of one trigger into both tables, or leave the columns out",
        )
    if said.session.clock == "separate":
        raise FileFormatError(
            "cameras and arm have neither a shared clock nor trigger ids, so no pose can be found",
            where=where,
            remedy="record trigger ids, or bring the times to one clock and say clock = 'shared'",
        )
    times = np.array([row.t_ns for row in rows], dtype=np.int64)
    warnings = _unit_warning(times, arm.t_ns, len({_arrangement(row) for row in rows}), where)
    if not _is_within(times, arm.t_ns).any():
        raise FileFormatError(
            f"no exposure ({times[0]} to {times[-1]} ns) is within the arm's times "
            f"({arm.t_ns[0]} to {arm.t_ns[-1]} ns)",
            where=where,
            remedy="write both times in nanoseconds of one clock, or record trigger ids",
        )
    warnings += _crowd_warning(rows, arm.t_ns, where)
    return ([] if "time.clock" in said.stated else ["cameras and arm share one clock"]), warnings


def _is_within(times: Times, span: Times) -> BoolArray:
    return np.asarray((times >= span[0]) & (times <= span[-1]))


def _arrangement(row: ExposureRow) -> str | int:
    """Rows of one view or one instant saw one arrangement."""
    return row.t_ns if row.view is None else row.view


def _unit_warning(times: IntArray, arm_ns: IntArray, n_arrangements: int, where: str) -> list[str]:
    """Refuse times of another unit; a sentence where a short burst of images looks the same."""
    found = _wrong_unit(times.astype(np.float64), arm_ns.astype(np.float64))
    if found is None:
        return []
    table, factor = found
    seconds = [float(span[-1] - span[0]) / 1e9 for span in (times, arm_ns)]
    fact = (
        f"the exposures span {seconds[0]:.3g} s and the arm's samples {seconds[1]:.3g} s; the "
        f"exposures would be within the arm's times if t_ns of {table} were {factor:,} times as "
        "large"
    )
    is_burst = table == EXPOSURES_FILE and bool(_is_within(times, arm_ns).any())
    step_ns = np.median(np.diff(times)) if is_burst else 0.0
    if is_burst and (n_arrangements < CROWD or step_ns >= np.median(np.diff(arm_ns))):
        return [f"{where}: {fact}: are both in nanoseconds?"]
    raise FileFormatError(
        fact,
        where=where,
        remedy="write both times in nanoseconds; if they are, leave out the arm's samples long "
        "before and after the exposures, or record trigger ids",
    )


def _wrong_unit(times: Times, arm_ns: Times) -> tuple[str, int] | None:
    """The table whose times need a factor to agree with the other's, and the factor."""
    span, arm_span = float(times[-1] - times[0]), float(arm_ns[-1] - arm_ns[0])
    if min(span, arm_span) <= 0.0 or max(span, arm_span) < SPAN_RATIO * min(span, arm_span):
        return None
    is_shorter = span < arm_span
    for factor in UNIT_FACTORS:
        scaled, reference = (factor * times, arm_ns) if is_shorter else (times, factor * arm_ns)
        ratio = float((scaled[-1] - scaled[0]) / (reference[-1] - reference[0]))
        if 1.0 / SPAN_RATIO < ratio < SPAN_RATIO and _is_within(scaled, reference).mean() > 0.5:
            return (EXPOSURES_FILE if is_shorter else ARM_FILE), factor
    return None


def _crowd_warning(rows: Sequence[ExposureRow], arm_ns: IntArray, where: str) -> list[str]:
    """A sentence if the arm was sampled far more seldom than images were taken."""
    times = np.array([row.t_ns for row in rows], dtype=np.int64)
    step = np.searchsorted(arm_ns, times, side="right")
    seen = [
        (int(k), _arrangement(row))
        for k, row in zip(step, rows, strict=True)
        if 0 < k < len(arm_ns)
    ]
    count = Counter(k for k, _ in set(seen))
    if not count or max(count.values()) < CROWD:
        return []
    first, most = next(item for item in count.items() if item[1] == max(count.values()))
    return [
        f"{where}: {most} exposures fall between the same two samples of the arm (t_ns "
        f"{arm_ns[first - 1]} and {arm_ns[first]}): are both times in nanoseconds, and are all "
        "samples in the table?"
    ]
