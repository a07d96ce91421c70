# SPDX-License-Identifier: Apache-2.0
"""What stands before a head: the image that a camera takes of it, its truth, and scans made of
such images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, ImageArray, floats
from armscan.geometry.poses import Base, Board, Points, Pose, Sensor
from armscan.geometry.rotations import slerp
from armscan.records.exposure import Exposure, SensorWindow, window_of_sensor
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session, SessionKind
from armscan.simulation.head import Head, MountedCamera, Window
from armscan.simulation.objects.boards import (
    FLAT,
    FlatPattern,
    PrintedBoard,
    Substrate,
    render_board,
)
from armscan.simulation.objects.rings import Marked, RingMarker, draw_markers
from armscan.simulation.objects.shapes import Placed
from armscan.simulation.optics.camera import expose_mono, halo_rows, with_ghost, with_halo
from armscan.simulation.optics.lasers import LaserSource, LineLaser, in_sources
from armscan.simulation.optics.render import Image32, Imaging, Region, find_stripe, to_pixels
from armscan.simulation.optics.scene import Material, RoomLight, Scene, SceneObject, Surface
from armscan.simulation.optics.stray_light import stray_lights
from armscan.simulation.optics.stripe_light import PosedView, band_light, lit_pixels, look

_RAY_TOLERANCE = 1e-10
_MOST_POSES = 16
"""Of one exposure, however long."""
_CENTRE_SIGMAS = 2.0
"""A sheet's centre is looked for among pixels so near to it; at edges among all."""
ROOM = RoomLight(even=0.6, direct=0.4, position_mm=(350.0, -400.0, 900.0), up=(0.0, 0.0, 1.0))
"""Light of the room around the arm: white that faces up sees about full scale; scaled later."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A printed target in Base, drawn sharply in images under room light.

    The board's z axis points away from the viewer, into the board.
    """

    pattern: FlatPattern
    base_from_board: Pose[Base, Board]
    light: float = 0.85
    dark: float = 0.08
    substrate: Substrate = FLAT


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """What stands around the arm, in Base.

    Parameters
    ----------
    things
        Surfaces with their finish.
    target
        A printed target, or None.
    room
        Light of the room; its brightness is scaled by each exposure.
    markers
        Ring markers on flat faces of the things, drawn sharply in images under room light.
    """

    things: tuple[SceneObject, ...]
    target: Target | None = None
    room: RoomLight = ROOM
    markers: tuple[RingMarker, ...] = ()

    def under(self, imaging: Imaging) -> Station:
        """The station with the gloss and texture that a preset makes of it."""
        return replace(
            self,
            things=tuple(
                replace(thing, finish=thing.finish.scaled(imaging.gloss, imaging.texture))
                for thing in self.things
            ),
        )


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """What the camera and the lasers do for one image.

    Parameters
    ----------
    window
        Part of the sensor that is read.
    lasers
        Names of the light sources that are on.
    room_light
        Brightness of white that faces up under the room's light, as a part of full scale; None for
        the preset's ambient light.
    """

    window: Window
    lasers: tuple[str, ...] = ()
    room_light: float | None = None

    def __post_init__(self) -> None:
        if self.room_light is not None and self.room_light < 0.0:
            raise InputError("light cannot be negative")


class TrueStripe(ArrayRecord):
    """True centre points of one sheet's stripe, about one a column or row.

    Parameters
    ----------
    points_px
        (N, 2) full-sensor pixels of the camera that was asked for.
    points_sensor_mm, points_base_mm
        (N, 3) in the two frames, whichever camera it was.
    thing
        (N,) index into the station's things, as float64; the target, if any, comes after them.
    """

    sheet: str
    points_px: FloatArray = floats("N", 2)
    points_sensor_mm: FloatArray = floats("N", 3)
    points_base_mm: FloatArray = floats("N", 3)
    thing: FloatArray = floats("N")


def render_exposure(
    head: Head,
    station: Station,
    base_from_sensor: Sequence[Pose[Base, Sensor]],
    settings: ExposureSettings,
    rng: np.random.Generator,
    *,
    camera: int = 0,
) -> ImageArray:
    """Image of one exposure: (H, W), or (H, W, 3) of a colour camera.

    ``base_from_sensor``: poses over the exposure time, equally long each; one if the head stands
    still.
    """
    if not base_from_sensor:
        raise InputError("an exposure needs a pose")
    detector, colour = head.imaging.detector, head.imaging.laser_colour
    if colour is None:
        light = exposure_light(head, station, base_from_sensor, settings, rng, camera=camera)
        return expose_mono(light, detector, rng)
    dark = replace(head, imaging=replace(head.imaging, ambient=0.0))
    in_dark = replace(settings, room_light=None)
    line = exposure_light(dark, station, base_from_sensor, in_dark, rng, camera=camera)
    no_laser = replace(settings, lasers=())
    room = exposure_light(head, station, base_from_sensor, no_laser, rng, camera=camera)
    channels = [np.float32(part) * line + room for part in colour]
    image = np.stack([expose_mono(one, detector, rng) for one in channels], axis=-1)
    return image.astype(np.uint8) if detector.bits <= 8 else image.astype(np.uint16)


def exposure_light(
    head: Head,
    station: Station,
    base_from_sensor: Sequence[Pose[Base, Sensor]],
    settings: ExposureSettings,
    rng: np.random.Generator,
    *,
    camera: int = 0,
) -> NDArray[np.float32]:
    """Light (H, W) of one exposure on the sensor, parts of full scale, without sensor noise."""
    imaging, window, eye = head.imaging, settings.window, _mounted(head, camera)
    station = station.under(imaging)
    region = Region.around(window.x_px, window.y_px, window.width_px, window.height_px)
    poses = [_eye_pose(eye, pose) for pose in base_from_sensor]
    views = [_view(eye, station, pose, region) for pose in poses]
    light = np.zeros((window.height_px, window.width_px), np.float32)
    inside, lit = _inside(window, region), slice(0, 0)
    middle = len(views) // 2
    for source in in_sources(_seen_lasers(head, eye, settings.lasers)):
        stray = stray_lights(source, station.things, poses[middle], imaging)
        # What is stray is wide or faint: motion over the exposure does not show in it.
        for one, seen in ((source, views), *((one, [views[middle]]) for one in stray)):
            first, line = band_light(
                seen, eye.camera, one, region, speckle=imaging.speckle, rng=rng
            )
            lit = _joined(lit, _added(light, line[:, inside[1]], first - inside[0].start))
    if lit.start < lit.stop:
        share, sigma_px = imaging.detector.halo_share, imaging.detector.halo_sigma_px
        lit = halo_rows(lit, len(light), sigma_px)
        light[lit] = with_halo(light[lit], share, sigma_px)
    if imaging.ghost_share > 0.0:
        light, lit = with_ghost(light, imaging.ghost_share, imaging.ghost_sigma_px), slice(None)
    brightness = imaging.ambient if settings.room_light is None else settings.room_light
    room = _room(eye, station, poses, views, region)[inside]
    share = brightness / len(views)
    result = np.multiply(room, np.float32(share))
    result[lit] = cv2.scaleAdd(room[lit], share, light[lit])
    return result


def _added(light: Image32, line: Image32, top: int) -> slice:
    """Add rows (K, W) to light (H, W) from row ``top`` on, and tell which rows these are."""
    rows = slice(max(top, 0), max(min(top + len(line), len(light)), 0))
    if rows.start < rows.stop:
        light[rows] += line[rows.start - top : rows.stop - top]
    return rows


def _joined(rows: slice, others: slice) -> slice:
    """The least span of rows that holds both."""
    if others.start >= others.stop:
        return rows
    if rows.start >= rows.stop:
        return others
    return slice(min(rows.start, others.start), max(rows.stop, others.stop))


def true_stripes(
    head: Head,
    station: Station,
    base_from_sensor: Pose[Base, Sensor],
    settings: ExposureSettings,
    *,
    camera: int = 0,
) -> tuple[TrueStripe, ...]:
    """Where the centres of the sheets that are on truly lie, for a head that stands still."""
    window, eye = settings.window, _mounted(head, camera)
    pose = _eye_pose(eye, base_from_sensor)
    sensor_from_eye = eye.camera_from_sensor.inverse()
    lens = eye.camera.cropped(*_corners(window))
    region = Region.around(*_corners(window))
    view = _view(eye, station, pose, region)
    numbers, tracer = view.numbers, None
    if numbers is not None:
        tracer = partial(numbers.trace, lens, tolerance=_RAY_TOLERANCE)
    stripes = []
    for laser in _seen_lasers(head, eye, settings.lasers):
        near = lit_pixels(view.nodes, LaserSource((laser,)), region, _CENTRE_SIGMAS)
        band = near[_inside(window, region)] > 0
        found = find_stripe(view.scene, lens, laser, band, tracer)
        in_sensor = found.points_mm if camera == 0 else sensor_from_eye.apply(found.points_mm)
        stripes.append(
            TrueStripe(
                sheet=laser.name,
                points_px=found.points_px + np.array([window.x_px, window.y_px]),
                points_sensor_mm=in_sensor,
                points_base_mm=pose.apply(found.points_mm),
                thing=found.surface,
            )
        )
    return tuple(stripes)


def _mounted(head: Head, camera: int) -> MountedCamera:
    if not 0 <= camera < len(head.cameras):
        raise InputError(f"head '{head.name}' has no camera {camera}")
    return head.cameras[camera]


def _eye_pose(eye: MountedCamera, base_from_sensor: Pose[Base, Sensor]) -> Pose[Base, Any]:
    """Where one camera of the head is."""
    return base_from_sensor @ eye.camera_from_sensor.inverse()


def _seen_lasers(head: Head, eye: MountedCamera, sources: tuple[str, ...]) -> list[LineLaser]:
    """The sheets that are on, in the frame of a camera."""
    sheets = head.sheets_of(sources)
    if eye is head.cameras[0]:
        return list(sheets)
    return [laser.moved(eye.camera_from_sensor) for laser in sheets]


def _view(eye: MountedCamera, station: Station, pose: Pose[Base, Any], region: Region) -> PosedView:
    finishes = tuple(thing.finish for thing in station.things)
    return look(seen_from(station, pose), (*finishes, Material()), eye.camera, region)


def _room_nodes(scene: Scene, view: PosedView, region: Region) -> NDArray[np.float32]:
    _, (rows, columns) = region.nodes_px()
    if view.numbers is not None and scene is view.scene:
        light = view.numbers.room_light(view.nodes)
    else:
        light = scene.room_light(view.nodes)[:, 0]
    return light.reshape(rows, columns).astype(np.float32)


def _room(
    eye: MountedCamera,
    station: Station,
    poses: Sequence[Pose[Base, Any]],
    views: Sequence[PosedView],
    region: Region,
) -> NDArray[np.float32]:
    """Light (H, W) of a region under the full room, added up over the views.

    It is coarse, but a target and markers are drawn sharply.
    """
    if station.markers or station.target is not None:
        both = zip(poses, views, strict=True)
        return reduce(np.add, (_drawn(eye, station, pose, view, region) for pose, view in both))
    return to_pixels(np.asarray(sum(_room_nodes(v.scene, v, region) for v in views)), region)


def _drawn(
    eye: MountedCamera, station: Station, pose: Pose[Base, Any], view: PosedView, region: Region
) -> NDArray[np.float32]:
    """Light of one view, with the markers or the target."""
    # The nodes are too far apart for markers: they get the face's own colour.
    scene = seen_from(replace(station, markers=()), pose) if station.markers else view.scene
    coarse = to_pixels(_room_nodes(scene, view, region), region)
    camera = eye.camera.cropped(region.x_px, region.y_px, region.width_px, region.height_px)
    if station.markers:
        markers = [marker.seen_from(pose) for marker in station.markers]
        drawn = draw_markers(coarse.astype(np.float64), markers, scene, camera)
        return drawn.astype(np.float32)
    if station.target is None:
        return coarse
    board = board_seen_from(station.target, pose)
    return render_board(board, camera, view.scene.lamp, coarse)


def seen_from(station: Station, base_from_sensor: Pose[Base, Any]) -> Scene:
    """The station's things, then its target, in the frame of the head or of one camera."""
    sensor_from_base = base_from_sensor.inverse()
    things: Sequence[Surface] = station.things
    if station.markers:
        things = [replace(t, surface=Marked(t.surface, station.markers)) for t in station.things]
    surfaces: list[Surface] = [Placed(thing, sensor_from_base) for thing in things]
    if station.target is not None:
        surfaces.append(board_seen_from(station.target, base_from_sensor))
    return Scene(tuple(surfaces), lamp=_lamp_seen_from(station.room, sensor_from_base))


def _lamp_seen_from(room: RoomLight, sensor_from_base: Pose[Any, Base]) -> RoomLight:
    position: Points[Base] = Points(np.array([room.position_mm]))
    x, y, z = (sensor_from_base @ position).xyz_mm[0]
    up = sensor_from_base.rotation @ np.asarray(room.up)
    return replace(
        room,
        position_mm=(float(x), float(y), float(z)),
        up=(float(up[0]), float(up[1]), float(up[2])),
    )


def board_seen_from(target: Target, base_from_sensor: Pose[Base, Any]) -> PrintedBoard:
    """The target in the frame of the head or of one camera."""
    pose = base_from_sensor.inverse() @ target.base_from_board
    return PrintedBoard(target.pattern, pose, target.light, target.dark, substrate=target.substrate)


def _inside(window: Window, region: Region) -> tuple[slice, slice]:
    """Rows and columns of a window within a region around it."""
    top, left = window.y_px - region.y_px, window.x_px - region.x_px
    return slice(top, top + window.height_px), slice(left, left + window.width_px)


def _corners(window: Window) -> tuple[int, int, int, int]:
    return window.x_px, window.y_px, window.width_px, window.height_px


@dataclass(frozen=True, slots=True, eq=False)
class RenderRequest:
    """One exposure before it is rendered; ``row`` is its line in the list of exposures.

    The pose is that of its middle; ``sub_poses`` are evenly weighted over it, empty if the head
    stands still.
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
            window=self.sensor_window(window, camera),
            lasers=lasers,
            t_ns=shot.row.t_ns,
            camera=camera,
            trigger_id=shot.row.trigger_id,
            view=shot.row.view,
        )

    def as_set(self, longer: float, gain: float, window: Window | None) -> TwinScan:
        """The scan with so many times the exposure time and gain, and another part read.

        The amplifier comes after all noise but that of rounding.
        """
        head, brighter = self.head, longer * gain
        lasers = tuple(replace(one, irradiance=brighter * one.irradiance) for one in head.lasers)
        detector = replace(
            head.imaging.detector,
            electrons_per_level=head.imaging.detector.electrons_per_level / gain,
            read_noise=head.imaging.detector.read_noise * gain,
        )
        ambient = brighter * head.imaging.ambient
        imaging = replace(head.imaging, ambient=ambient, detector=detector)
        shots = []
        for shot in self.shots:
            light = shot.settings.room_light
            settings = replace(
                shot.settings,
                window=window or shot.settings.window,
                room_light=None if light is None else brighter * light,
            )
            poses = _over_time(shot.sub_poses, longer)
            shots.append(replace(shot, settings=settings, sub_poses=poses))
        return replace(self, head=replace(head, lasers=lasers, imaging=imaging), shots=tuple(shots))

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

    def sensor_window(self, window: Window, camera: int) -> SensorWindow:
        """What a record says of a window of one of the head's cameras."""
        sensor = self.head.cameras[camera].camera
        size_px = window.width_px, window.height_px
        place = SensorWindow(window.x_px, window.y_px)
        return window_of_sensor(place, size_px, (sensor.width_px, sensor.height_px))

    def _setup(self, camera: int) -> CameraSetup:
        """How a camera delivers its images: all with one window."""
        window = next(shot for shot in self.shots if shot.row.camera == camera).settings.window
        return CameraSetup(
            width_px=window.width_px,
            height_px=window.height_px,
            window=self.sensor_window(window, camera),
            bits_used=self.head.imaging.detector.bits,
            colour="mono" if self.head.imaging.laser_colour is None else "rgb",
        )


def _over_time(
    poses: tuple[Pose[Base, Sensor], ...], longer: float
) -> tuple[Pose[Base, Sensor], ...]:
    """Poses over an exposure that is so many times as long, the motion being steady.

    Of two poses, whose mean square is that of all; more of them where these lie far apart.
    """
    if not poses or longer == 1.0:
        return poses
    first, last = poses[0], poses[-1]
    n = int(np.clip(np.ceil(longer), 2, _MOST_POSES))
    reach = longer * np.sqrt(3.0 * (n - 1) / (n + 1))
    shares = 0.5 + 0.5 * reach * np.linspace(-1.0, 1.0, n)
    turned = slerp(np.tile(first.rotation, (n, 1, 1)), np.tile(last.rotation, (n, 1, 1)), shares)
    way_mm = last.translation_mm - first.translation_mm
    return tuple(
        Pose(rotation, first.translation_mm + share * way_mm)
        for rotation, share in zip(turned, shares, strict=True)
    )


CAMERA_FOLDERS = ("left", "right")


@dataclass(frozen=True, slots=True)
class Light:
    """What shines during an exposure, by names of sources, and how much of the sensors is read.

    ``room_light`` is as for `ExposureSettings`.
    """

    lasers: tuple[str, ...] = ()
    room_light: float | None = None
    is_windowed: bool = False


@dataclass(frozen=True, slots=True)
class Moment:
    """When, the middle of an exposure, and what it is called; the rest as for `ExposureRow`.

    ``file`` is below ``images``; a head of two cameras keeps a folder for each.
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
    """One shot a camera; ``first_index`` is camera 0's row.

    ``poses`` are in the middle of the exposure, then those over its time, if the head moves.
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
