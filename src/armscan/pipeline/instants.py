# SPDX-License-Identifier: Apache-2.0
"""Exposures that the cameras of a head took at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.devices.scan_source import ScanSource
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray
from armscan.pipeline.exposure_pairs import ExposurePair
from armscan.records.exposure import Exposure
from armscan.records.session import ExposureRow


@dataclass(frozen=True, slots=True)
class Instant:
    """One instant of a scan.

    Parameters
    ----------
    rows
        Rows of the recording, one a camera, in the order of the cameras.
    t_ns
        Mid-exposure time of the first.
    """

    rows: tuple[int, ...]
    t_ns: int


def group_instants(rows: Sequence[ExposureRow], where: str) -> tuple[Instant, ...]:
    """Group exposures by instant: by trigger id where they have one, else by time.

    Raises
    ------
    InputError
        If a camera took two exposures at one instant.
    """
    groups: dict[tuple[str, int], list[int]] = {}
    for k, row in enumerate(rows):
        by_trigger = row.trigger_id is not None
        key = ("trigger", int(row.trigger_id or 0)) if by_trigger else ("time", row.t_ns)
        groups.setdefault(key, []).append(k)
    instants = []
    for (kind, value), members in groups.items():
        cameras = [rows[k].camera for k in members]
        if len(set(cameras)) != len(cameras):
            raise InputError(
                f"camera {max(cameras, key=cameras.count)} has {len(members)} exposures of one "
                f"instant ({kind} {value})",
                where=where,
                remedy="give each exposure of a camera its own time and trigger_id",
            )
        ordered = tuple(sorted(members, key=lambda k: rows[k].camera))
        instants.append(Instant(ordered, rows[ordered[0]].t_ns))
    return tuple(sorted(instants, key=lambda instant: instant.t_ns))


class ScanInstants:
    """Reads the exposures of a scan, one background of each camera at a time in memory.

    Parameters
    ----------
    source
        The scan. If any of its rows names a laser, rows without are taken with the laser off and
        are the background of the exposures of their view and camera; else all have it on.
    n_cameras
        Cameras that the scanner has.

    Raises
    ------
    InputError
        If the scan's cameras are not the scanner's.
    """

    def __init__(self, source: ScanSource, n_cameras: int) -> None:
        self._source = source
        cameras = sorted({row.camera for row in source.rows})
        if len(cameras) != n_cameras:
            raise InputError(
                f"the scan holds exposures of camera{'s' if len(cameras) > 1 else ''} "
                f"{', '.join(map(str, cameras))}, the scanner has {n_cameras}",
                where=source.name,
                remedy="give the scanner's calibration that belongs to this scan",
            )
        lit = [bool(row.lasers) for row in source.rows]
        self.is_lit: BoolArray = np.array(lit if any(lit) else [True] * len(lit), dtype=np.bool_)
        self._dark_row = {
            (row.view, row.camera): k
            for k, row in enumerate(source.rows)
            if not self.is_lit[k] and row.view is not None
        }
        self._dark: dict[int, tuple[int, Exposure]] = {}

    @property
    def lit(self) -> tuple[Instant, ...]:
        """Instants at which a laser was on."""
        groups = group_instants(self._source.rows, self._source.name)
        return tuple(group for group in groups if self.is_lit[list(group.rows)].all())

    def pair(self, row: int) -> ExposurePair:
        """Read one exposure and its background, if there is one.

        Raises
        ------
        ArmscanError
            If an image cannot be read.
        """
        exposure = self._source.exposure(row)
        view, camera = self._source.rows[row].view, self._source.rows[row].camera
        dark_row = None if view is None else self._dark_row.get((view, camera))
        if dark_row is None:
            return exposure, None
        if camera not in self._dark or self._dark[camera][0] != dark_row:
            self._dark[camera] = (dark_row, self._source.exposure(dark_row))
        return exposure, self._dark[camera][1]
