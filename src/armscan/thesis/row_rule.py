# SPDX-License-Identifier: Apache-2.0
"""The printed rule for a cross-line head: rows of two earlier exposures (eqs. 3.1 to 3.7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.labels import LabelledInstant, LabelledProfile, PointStatus
from armscan.records.profile import Profile


@dataclass(frozen=True, slots=True)
class LaserSchedule:
    """Names of the sources that are on in each exposure of a period, over and over."""

    pattern: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        if not self.pattern or not any(self.pattern):
            raise OptionError(
                "a laser schedule without lasers", remedy="give at least one exposure with a laser"
            )

    def lasers(self, exposure: int) -> tuple[str, ...]:
        """Sources that are on in exposure number ``exposure``, counted from 0."""
        return self.pattern[exposure % len(self.pattern)]


THESIS_SCHEDULE = LaserSchedule((("A",), ("B",), ("A", "B")))
"""Figure 3.2: A alone, B alone, both; four stripes in three exposures, 1.33 of one laser's."""


@dataclass(frozen=True, slots=True)
class RowOptions:
    """Options of the thesis's rule; ``threshold_px`` is T of eqs. 3.6 and 3.7, in rows."""

    threshold_px: float = 10.0
    schedule: LaserSchedule = THESIS_SCHEDULE

    def __post_init__(self) -> None:
        if not self.threshold_px > 0.0:
            raise OptionError(
                f"row threshold of {self.threshold_px} px", remedy="give a positive one"
            )


class RowLabeller:
    """Names a point by the rows of its column while each laser was on alone; a `StripeLabeller`.

    The row ``u_j`` of column j is the grey centre of the light bar S in that column, the sum of
    ``gray(j, y) y`` over S divided by the sum of ``gray(j, y)`` (eqs. 3.1 and 3.3; in the
    numerator of 3.3 the sum is printed over x where y is meant), and U_N and U_N+1 are the rows
    of all columns with laser A and laser B alone (eqs. 3.2 and 3.4). Here the stripe points of
    the extraction are used, each in the column nearest to it: with the method ``centroid`` they
    are the thesis's grey centres. In the exposure N + 2 with both (eq. 3.5) a point is A's if
    its row is within T of A's (eq. 3.6), B's if within T of B's (eq. 3.7), and where both hold,
    of the nearer (section 5.2.3). Where a column has several rows of one laser, the nearest
    counts. Points that match neither are without a name.

    Parameters
    ----------
    sensor
        Camera and sheets; each source has one sheet, of its name.
    options
        Defaults if None.

    Raises
    ------
    InputError
        If a source of the schedule has no sheet.
    """

    def __init__(self, sensor: SensorCalibration, options: RowOptions | None = None) -> None:
        self._options = options or RowOptions()
        self._names = [sheet.name for sheet in sensor.sheets]
        for source in {name for on in self._options.schedule.pattern for name in on}:
            if source not in self._names:
                raise InputError(
                    f"the schedule has a laser {source}, the calibration only "
                    f"{', '.join(self._names)}",
                    remedy="give a calibration of this head",
                )
        self._width_px = sensor.camera.camera.width_px
        self.reset()

    def reset(self) -> None:
        """Forget the rows seen and begin the schedule anew."""
        self._rows: dict[str, FloatArray] = {}
        self._exposure = 0

    def next_lasers(self) -> tuple[str, ...]:
        """What the schedule says."""
        return self._options.schedule.lasers(self._exposure)

    def left_out(self, lasers: tuple[str, ...]) -> str:
        """The printed rule leaves no exposure out."""
        return ""

    def label(
        self,
        profiles: Sequence[Profile],
        lasers: tuple[str, ...] = (),
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> LabelledInstant:
        """Label the points of the next exposure; pose and time do not matter."""
        self._exposure += 1
        (profile,) = profiles
        is_asked = profile.is_accepted
        sheet = np.full(len(profile), -1)
        status = np.where(is_asked, PointStatus.STRAY, PointStatus.FLAGGED)
        if len(lasers) == 1 and lasers[0] in self._names:
            sheet[is_asked] = self._names.index(lasers[0])
            self._rows[lasers[0]] = profile.points_px[is_asked]
            reason = f"sheet {lasers[0]}, the laser that was on"
        else:
            known = [name for name in self._names if name in self._rows]
            if known:
                sheet[is_asked] = self._compared(profile.points_px[is_asked], known)
            reason = f"rows of earlier exposures, within {self._options.threshold_px:g} px"
        status[sheet >= 0] = PointStatus.MEASURED
        labelled = LabelledProfile(profile=profile, sheet=sheet, status=status, reason=reason)
        return LabelledInstant((labelled,))

    def _compared(self, points_px: FloatArray, known: list[str]) -> IntArray:
        """(N,) sheet of the smallest difference of rows, -1 where none is within T."""
        difference = np.stack(
            [row_differences(points_px, self._rows[name]) for name in known], axis=1
        )
        numbers = np.array([self._names.index(name) for name in known])
        best = numbers[difference.argmin(axis=1)]
        return np.where(difference.min(axis=1) <= self._options.threshold_px, best, -1)


def row_differences(points_px: FloatArray, earlier_px: FloatArray) -> FloatArray:
    """(N,) ``|u_j - u'_j|`` to the nearest of the earlier rows (M,) of each point's column.

    Infinite where an earlier exposure had nothing in the column (eqs. 3.6 and 3.7).
    """
    column = np.rint(points_px[:, 0]).astype(np.int64)
    if not len(earlier_px):
        return np.full(len(column), np.inf)
    earlier = np.rint(earlier_px[:, 0]).astype(np.int64)
    order = np.lexsort((earlier_px[:, 1], earlier))
    earlier, rows = earlier[order], earlier_px[order, 1]
    # one sorted key holds column and row, so that one search finds both neighbours in a column
    span = 2.0 * (np.abs(rows).max() + np.abs(points_px[:, 1]).max(initial=0.0) + 1.0)
    after = np.searchsorted(earlier * span + rows, column * span + points_px[:, 1])
    least = np.full(len(column), np.inf)
    for place in (after - 1, after):
        at = np.clip(place, 0, len(rows) - 1)
        is_same = (place == at) & (earlier[at] == column)
        found = np.where(is_same, np.abs(rows[at] - points_px[:, 1]), np.inf)
        least = np.minimum(least, found)
    return least
