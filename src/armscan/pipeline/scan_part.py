# SPDX-License-Identifier: Apache-2.0
"""Some rows of a simulated scan, as a scan of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from armscan.devices.twin import SimulatedScan, TrueStripe
from armscan.records.arm_track import ArmTrack
from armscan.records.exposure import Exposure
from armscan.records.session import ExposureRow, Session


@dataclass(frozen=True, slots=True, eq=False)
class ScanPart:
    """See `armscan.devices.twin.SimulatedScan`; its rows keep the numbers that they have.

    Parameters
    ----------
    whole
        The scan.
    kept
        Rows that are kept, increasing.
    """

    whole: SimulatedScan
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

    def expose(self, row: int, lasers: tuple[str, ...]) -> Exposure:
        """Take the exposure of ``rows[row]`` with other lasers on."""
        return self.whole.expose(self.kept[row], lasers)

    def true_stripes(self, row: int) -> Sequence[TrueStripe]:
        """The true stripes of ``rows[row]``."""
        return self.whole.true_stripes(self.kept[row])
