# SPDX-License-Identifier: Apache-2.0
"""Part of a scan as a source of its own: some of its rows, or some of its views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.devices.sources import ScanSource, SimulatedScan, TrueStripe
from armscan.errors import OptionError
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session


@dataclass(frozen=True, slots=True, eq=False)
class ScanPart:
    """See `armscan.devices.sources.ScanSource`; its rows keep the numbers that they have.

    Parameters
    ----------
    whole
        The scan.
    kept
        Rows that are kept, increasing.
    """

    whole: ScanSource
    kept: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the whole scan."""
        return self.whole.name

    @property
    def session(self) -> Session:
        """Session of the whole scan."""
        return self.whole.session

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """The rows that are kept."""
        return tuple(self.whole.rows[row] for row in self.kept)

    @property
    def arm(self) -> ArmTrack | None:
        """All samples of the arm."""
        return self.whole.arm

    @property
    def is_simulated(self) -> bool:
        """As the whole scan."""
        return self.whole.is_simulated

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]``."""
        return self.whole.exposure(self.kept[row])


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPart(ScanPart):
    """Some rows of a simulated scan; see `armscan.devices.sources.SimulatedScan`."""

    whole: SimulatedScan

    def expose(self, row: int, lasers: tuple[str, ...]) -> Exposure:
        """Take the exposure of ``rows[row]`` with other lasers on."""
        return self.whole.expose(self.kept[row], lasers)

    def true_pose(self, row: int) -> Pose[Base, Sensor]:
        """True pose of ``rows[row]``."""
        return self.whole.true_pose(self.kept[row])

    def true_stripes(self, row: int) -> Sequence[TrueStripe]:
        """The true stripes of ``rows[row]``."""
        return self.whole.true_stripes(self.kept[row])


def fewer_views(source: ScanSource, n_views: int) -> ScanPart:
    """Evenly chosen views of a scan, all if it has no more; those of one instant stay together.

    Raises
    ------
    OptionError
        If ``n_views`` is not positive.
    """
    if n_views < 1:
        raise OptionError(f"{n_views} views", remedy="keep at least one")
    names = [f"at {row.t_ns}" if row.view is None else row.view for row in source.rows]
    views = list(dict.fromkeys(names))
    places = np.linspace(0, len(views) - 1, min(n_views, len(views))).round().astype(int)
    kept = {views[k] for k in places}
    return ScanPart(source, tuple(k for k, name in enumerate(names) if name in kept))
