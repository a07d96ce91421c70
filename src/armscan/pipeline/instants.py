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

SAME_TIME_NS = 1_000_000
"""Times of two cameras that differ by no more are one instant: those of cameras with one trigger
agree far better, and frames are some 10 ms apart."""
PERIOD_SHARE = 4
"""Nor may they differ by more than this part of the shortest time between two frames."""
PARTNER_MISSING = "the other camera's image is missing"
"""Why a row of a head with two cameras is not measured."""


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
    """Group exposures by instant: by trigger id where they have one, else by nearly equal time.

    Raises
    ------
    InputError
        If a camera took two exposures at one instant.
    """
    groups: dict[tuple[str, int], list[int]] = {}
    untriggered = []
    for k, row in enumerate(rows):
        if row.trigger_id is None:
            untriggered.append(k)
        else:
            groups.setdefault(("trigger", row.trigger_id), []).append(k)
    groups |= _by_time(rows, untriggered)
    instants = []
    for (kind, value), members in groups.items():
        cameras = [rows[k].camera for k in members]
        if len(set(cameras)) != len(cameras):
            most = max(cameras, key=cameras.count)
            raise InputError(
                f"camera {most} has {cameras.count(most)} exposures of one instant "
                f"({kind} {value})",
                where=where,
                remedy="give each exposure of a camera its own time and trigger_id",
            )
        ordered = tuple(sorted(members, key=lambda k: rows[k].camera))
        instants.append(Instant(ordered, rows[ordered[0]].t_ns))
    return tuple(sorted(instants, key=lambda instant: instant.t_ns))


def _by_time(rows: Sequence[ExposureRow], chosen: list[int]) -> dict[tuple[str, int], list[int]]:
    """Rows whose times differ by no more than the tolerance from the first of their group."""
    ordered = sorted(chosen, key=lambda k: (rows[k].t_ns, rows[k].camera))
    last: dict[int, int] = {}
    apart_ns = SAME_TIME_NS * PERIOD_SHARE
    for k in ordered:
        step = rows[k].t_ns - last.get(rows[k].camera, rows[k].t_ns)
        apart_ns = min(apart_ns, step or apart_ns)
        last[rows[k].camera] = rows[k].t_ns
    groups: dict[tuple[str, int], list[int]] = {}
    first_ns = None
    for k in ordered:
        if first_ns is None or rows[k].t_ns - first_ns > apart_ns // PERIOD_SHARE:
            first_ns = rows[k].t_ns
        groups.setdefault(("time", first_ns), []).append(k)
    return groups


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
        If the scan's cameras are not the scanner's, or none of its instants with the laser on has
        the images of all of them.
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
        self.lit: tuple[Instant, ...] = tuple(
            one
            for one in group_instants(source.rows, source.name)
            if len(one.rows) == n_cameras and self.is_lit[list(one.rows)].all()
        )
        """Instants at which a laser was on and of which every camera has an image."""
        complete = {row for one in self.lit for row in one.rows}
        lit_rows = np.flatnonzero(self.is_lit).tolist()
        self.without_partner: tuple[int, ...] = tuple(k for k in lit_rows if k not in complete)
        """Rows with the laser on whose instant lacks the image of another camera."""
        if self.without_partner and not self.lit:
            raise InputError(
                f"no instant has the images of all {n_cameras} cameras: "
                f"{len(self.without_partner)} images with laser stand alone",
                where=source.name,
                remedy="give the images of one instant the same trigger_id, or, without trigger "
                f"ids, times within {SAME_TIME_NS / 1e6:g} ms and a quarter of the frame period",
            )

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
