# SPDX-License-Identifier: Apache-2.0
"""What a report is about and rests on: its title block, and whether the calibration still holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from armscan.records.cloud import CalibrationMark

SECONDS_A_DAY = 86_400.0
LONG_AGO = datetime.min.replace(tzinfo=UTC)
"""Stands for a date that is missing, so that it comes first."""


@dataclass(frozen=True, slots=True)
class TitleBlock:
    """What stands at the head of a report, as the person who inspects tells it.

    Parameters
    ----------
    calibration_valid_days
        How long a calibration of this instrument holds, as its owner has laid down; NaN where
        nothing is laid down.
    scanner, scanner_name
        The calibration that the instrument has, and the file that it was read from; None and empty
        where none was named.
    """

    part: str = ""
    serial: str = ""
    order: str = ""
    customer: str = ""
    operator: str = ""
    instrument: str = ""
    temperature: str = ""
    remark: str = ""
    calibration_valid_days: float = math.nan
    scanner: CalibrationMark | None = None
    scanner_name: str = ""


TITLE_LABELS = {
    "part": "Part",
    "serial": "Serial number",
    "order": "Order",
    "customer": "Customer",
    "operator": "Operator",
    "instrument": "Instrument",
    "temperature": "Temperature",
    "remark": "Remark",
}
"""Texts of a title block in the order of a page."""


@dataclass(frozen=True, slots=True)
class CalibrationState:
    """How old the calibration of a cloud is, and whether it still holds.

    Parameters
    ----------
    marks
        The calibrations, oldest first, those without a date before all others; none where neither
        the cloud nor the title block names one.
    is_of_cloud
        Whether the cloud names them; else they are those of the title block.
    age_days
        Of the oldest at the inspection; NaN where a date is missing.
    valid_days
        As laid down; NaN where nothing is.
    is_of_scanner
        Whether the cloud was measured with the instrument's calibration; None where it is not known
        of either.
    """

    marks: tuple[CalibrationMark, ...]
    is_of_cloud: bool
    age_days: float
    valid_days: float
    is_of_scanner: bool | None

    @property
    def is_valid(self) -> bool | None:
        """Whether it is younger than laid down; None where either is not known.

        A calibration dated after the inspection is not known to hold: one of the clocks is wrong.
        """
        if not self.age_days >= 0.0 or math.isnan(self.valid_days):
            return None
        return self.age_days <= self.valid_days


def calibration_state(
    block: TitleBlock, marks: Sequence[CalibrationMark], now: datetime
) -> CalibrationState:
    """How the calibrations ``marks`` that a cloud names stand at a time.

    ``now`` has its time zone.
    """
    own = None if block.scanner is None else block.scanner.document_id
    used = tuple(marks) or (() if block.scanner is None else (block.scanner,))
    ordered = tuple(sorted(used, key=lambda mark: _time(mark) or LONG_AGO))
    first = _time(ordered[0]) if ordered else None
    return CalibrationState(
        marks=ordered,
        is_of_cloud=bool(marks),
        age_days=math.nan if first is None else (now - first).total_seconds() / SECONDS_A_DAY,
        valid_days=block.calibration_valid_days,
        is_of_scanner=(
            all(mark.document_id == own for mark in marks) if marks and own is not None else None
        ),
    )


def _time(mark: CalibrationMark) -> datetime | None:
    """When it was made; None for a text that is no date."""
    try:
        found = datetime.fromisoformat(mark.created_utc)
    except ValueError:
        return None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)
