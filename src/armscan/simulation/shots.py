# SPDX-License-Identifier: Apache-2.0
"""Exposures to be rendered and the recording that consists of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.records.exposure import Exposure, SensorWindow
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session, SessionKind
from armscan.simulation.head import Head
from armscan.simulation.station import (
    ExposureSettings,
    Station,
    TrueStripe,
    render_exposure,
    true_stripes,
)


@dataclass(frozen=True, slots=True, eq=False)
class RenderRequest:
    """One exposure before it is rendered.

    Parameters
    ----------
    row
        Its line in the list of exposures.
    station
        What stands before the head.
    base_from_sensor
        Where the head is in the middle of the exposure.
    settings
        Window, lasers, light.
    sub_poses
        The same at evenly weighted times of the exposure; empty if the head stands still.
    """

    row: ExposureRow
    station: Station
    base_from_sensor: Pose[Base, Sensor]
    settings: ExposureSettings
    sub_poses: tuple[Pose[Base, Sensor], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class TwinScan:
    """One scene, in the form of any recording; see `armscan.devices.sources.ScanSource`.

    Parameters
    ----------
    name
        What messages and reports call it.
    kind
        Scan or calibration.
    head
        That looks.
    shots
        In order of time.
    arm
        What the arm reported, or None.
    seed
        (K,) numbers from which, with the row, the noise of an exposure follows.
    """

    name: str
    kind: SessionKind
    head: Head
    shots: tuple[RenderRequest, ...]
    arm: ArmTrack | None
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.shots:
            raise InputError("a scan without exposures", where=self.name)

    @property
    def session(self) -> Session:
        """Facts that hold for all exposures."""
        cameras = tuple(self._setup(camera) for camera in range(len(self.head.cameras)))
        return Session(kind=self.kind, cameras=cameras, is_simulated=True)

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """All exposures without their pixels, in order of time."""
        return tuple(shot.row for shot in self.shots)

    @property
    def is_simulated(self) -> bool:
        """True: the images are rendered."""
        return True

    def exposure(self, row: int) -> Exposure:
        """Render one exposure; the same every time and in whatever order they are asked for."""
        return self.expose(row, self.shots[row].settings.lasers)

    def expose(self, row: int, lasers: tuple[str, ...]) -> Exposure:
        """Render one exposure with other lasers on than its row says."""
        shot = self.shots[row]
        rng = np.random.default_rng([*self.seed, row])
        poses = shot.sub_poses or (shot.base_from_sensor,)
        settings = replace(shot.settings, lasers=lasers)
        camera = shot.row.camera
        image = render_exposure(self.head, shot.station, poses, settings, rng, camera=camera)
        window = shot.settings.window
        return Exposure(
            image,
            shot.row.source,
            bits_used=self.head.imaging.detector.bits,
            window=SensorWindow(window.x_px, window.y_px),
            lasers=lasers,
            t_ns=shot.row.t_ns,
            camera=camera,
            trigger_id=shot.row.trigger_id,
            view=shot.row.view,
        )

    def true_pose(self, row: int) -> Pose[Base, Sensor]:
        """Where the head truly is in the middle of an exposure."""
        return self.shots[row].base_from_sensor

    def true_stripes(self, row: int) -> tuple[TrueStripe, ...]:
        """Where all sheets' centres truly lie in one exposure, at its middle, on or off.

        Pixels are those of the row's own camera.
        """
        shot = self.shots[row]
        settings = replace(shot.settings, lasers=self.head.sources)
        return true_stripes(
            self.head, shot.station, shot.base_from_sensor, settings, camera=shot.row.camera
        )

    def _setup(self, camera: int) -> CameraSetup:
        """How a camera delivers its images: all with one window."""
        window = next(shot for shot in self.shots if shot.row.camera == camera).settings.window
        return CameraSetup(
            width_px=window.width_px,
            height_px=window.height_px,
            window=SensorWindow(window.x_px, window.y_px),
            bits_used=self.head.imaging.detector.bits,
        )


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
) -> list[RenderRequest]:
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
            index=first_index + camera,
            t_ns=moment.t_ns,
            camera=camera,
            source=f"images/{folder}{moment.file}",
            lasers=light.lasers,
            trigger_id=moment.trigger_id,
            view=moment.view,
        )
        window = mounted.scan_window if light.is_windowed else mounted.full_window
        settings = ExposureSettings(window, light.lasers, room_light=light.room_light)
        shots.append(RenderRequest(row, station, poses[0], settings, poses[1:]))
    return shots
