# SPDX-License-Identifier: Apache-2.0
"""One moment at which all cameras of a head look: a row and a shot for each of them."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.records.session import ExposureRow
from armscan.simulation.head import Head
from armscan.simulation.station import ExposureSettings, Station
from armscan.simulation.twin_scan import Shot

CAMERA_FOLDERS = ("left", "right")


@dataclass(frozen=True, slots=True)
class Light:
    """What shines during an exposure, and how much of the sensors is read.

    Parameters
    ----------
    lasers
        Names of the sources that are on.
    room_light
        As for `ExposureSettings`.
    is_windowed
        True for the scanning windows, False for the full sensors.
    """

    lasers: tuple[str, ...] = ()
    room_light: float | None = None
    is_windowed: bool = False


@dataclass(frozen=True, slots=True)
class Moment:
    """When, and what it is called.

    Parameters
    ----------
    t_ns
        Middle of the exposure.
    file
        Name of the image below ``images``; a head of two cameras keeps a folder for each.
    trigger_id, view
        As for `ExposureRow`.
    """

    t_ns: int
    file: str
    trigger_id: int | None = None
    view: str | None = None


def instant_shots(
    head: Head,
    first_index: int,
    moment: Moment,
    station: Station,
    light: Light,
    *poses: Pose[Base, Sensor],
) -> list[Shot]:
    """One shot a camera.

    Parameters
    ----------
    head, station
        What looks at what.
    first_index
        Of the first camera's row.
    moment
        When.
    light
        What shines.
    poses
        In the middle of the exposure, then those over its time, if the head moves.
    """
    shots = []
    for camera, mounted in enumerate(head.cameras):
        folder = f"{CAMERA_FOLDERS[camera]}/" if len(head.cameras) > 1 else ""
        row = ExposureRow(
            first_index + camera,
            moment.t_ns,
            camera,
            f"images/{folder}{moment.file}",
            lasers=light.lasers,
            trigger_id=moment.trigger_id,
            view=moment.view,
        )
        window = mounted.scan_window if light.is_windowed else mounted.full_window
        settings = ExposureSettings(window, light.lasers, room_light=light.room_light)
        shots.append(Shot(row, station, poses[0], settings, poses[1:]))
    return shots
