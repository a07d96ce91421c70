# SPDX-License-Identifier: Apache-2.0
"""A part of a scan: some of its views, as a source of its own."""

from __future__ import annotations

import numpy as np

from armscan.devices.scan_source import ScanSource
from armscan.errors import OptionError
from armscan.records.arm_track import ArmTrack
from armscan.records.exposure import Exposure
from armscan.records.session import ExposureRow, Session


class FewerViews:
    """Evenly chosen views of a scan; exposures of one view or instant stay together."""

    def __init__(self, source: ScanSource, n_views: int) -> None:
        """Choose ``n_views`` views of ``source``; all if it has no more.

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
        self._source = source
        self._kept = [k for k, name in enumerate(names) if name in kept]

    @property
    def name(self) -> str:
        """Name of the whole scan."""
        return self._source.name

    @property
    def session(self) -> Session:
        """Session of the whole scan."""
        return self._source.session

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """Exposures of the views kept."""
        return tuple(self._source.rows[k] for k in self._kept)

    @property
    def arm(self) -> ArmTrack | None:
        """All samples of the arm."""
        return self._source.arm

    @property
    def is_simulated(self) -> bool:
        """As the whole scan."""
        return self._source.is_simulated

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]``."""
        return self._source.exposure(self._kept[row])
