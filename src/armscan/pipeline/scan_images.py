# SPDX-License-Identifier: Apache-2.0
"""Exposures of a scan with the laser on, each with its background if the scan has one."""

from __future__ import annotations

import numpy as np

from armscan.devices.scan_source import ScanSource
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray
from armscan.pipeline.exposure_pairs import ExposurePair
from armscan.records.exposure import Exposure


class ScanImages:
    """Reads the exposures of a scan, one background at a time in memory.

    Parameters
    ----------
    source
        The scan. If any of its rows names a laser, rows without are taken with the laser off and
        are the background of the exposures of their view and camera; else all have it on.

    Raises
    ------
    InputError
        If more than one camera took part.
    """

    def __init__(self, source: ScanSource) -> None:
        self._source = source
        cameras = {row.camera for row in source.rows}
        if len(cameras) > 1:
            raise InputError(
                f"the scan holds exposures of cameras {', '.join(map(str, sorted(cameras)))}, the "
                "scanner has one",
                where=source.name,
            )
        lit = [bool(row.lasers) for row in source.rows]
        self.is_lit: BoolArray = np.array(lit if any(lit) else [True] * len(lit), dtype=np.bool_)
        self._dark_row = {
            row.view: k
            for k, row in enumerate(source.rows)
            if not self.is_lit[k] and row.view is not None
        }
        self._dark: tuple[int, Exposure] | None = None

    def pair(self, row: int) -> ExposurePair:
        """Read one exposure and its background, if there is one.

        Raises
        ------
        ArmscanError
            If an image cannot be read.
        """
        exposure = self._source.exposure(row)
        view = self._source.rows[row].view
        if view is None or view not in self._dark_row:
            return exposure, None
        dark_row = self._dark_row[view]
        if self._dark is None or self._dark[0] != dark_row:
            self._dark = (dark_row, self._source.exposure(dark_row))
        return exposure, self._dark[1]
