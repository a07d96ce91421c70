# SPDX-License-Identifier: Apache-2.0
"""Where exposures and arm samples come from: a live rig, a recording or the twin, all alike."""

from __future__ import annotations

from typing import Protocol

from armscan.records.arm_track import ArmTrack
from armscan.records.exposure import Exposure
from armscan.records.session import ExposureRow, Session


class ScanSource(Protocol):
    """One scan that can be read again and in any order."""

    @property
    def name(self) -> str:
        """What messages and reports call it."""

    @property
    def session(self) -> Session:
        """Cameras, clock and form of the poses."""

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """All exposures without their pixels, in order of time."""

    @property
    def arm(self) -> ArmTrack | None:
        """What the arm reported; None where no arm took part."""

    @property
    def is_simulated(self) -> bool:
        """True if the images were rendered."""

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]`` with its pixels."""
