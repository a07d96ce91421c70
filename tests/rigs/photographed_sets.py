# SPDX-License-Identifier: Apache-2.0
"""What somebody who has an instrument photographs and records with it, as files that a user has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.geometry.poses import Base, Board, Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.objects.shapes import Placed
from armscan.simulation.optics.scene import (
    CERAMIC,
    MATT_PAINT,
    Floor,
    RoomLight,
    SceneObject,
)
from armscan.simulation.station import ExposureSettings, Station, Target, render_exposure
from rigs.photographed_instrument import BACKGROUND_SHARE, TIP_MM, DrawnInstrument

LAMP = RoomLight(even=0.7, direct=0.3, position_mm=(300.0, -400.0, -100.0), up=(0.0, 0.0, -1.0))


@dataclass(slots=True)
class Photographer:
    """Takes photographs with one instrument; its numbers follow from the seed."""

    drawn: DrawnInstrument
    rng: np.random.Generator = field(init=False)
    n_images: int = 0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.drawn.seed, 2200])

    def board_pose(
        self, tilt_deg: float, place: tuple[float, float], depth_share: float, roll_deg: float
    ) -> Pose[Sensor, Board]:
        """Place of the board, moved inward until every camera sees all marks."""
        d = self.drawn
        azimuth = self.rng.uniform(0.0, 2.0 * np.pi)
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        tilt = rotation_from_vector(np.radians(tilt_deg) * axis)
        roll = rotation_from_vector(np.array([0.0, 0.0, np.radians(roll_deg)]))
        rotation = tilt @ roll
        marks = d.pattern.marks_board_mm
        middle = marks.mean(axis=0)
        depth = d.depth_mm * depth_share
        half = 0.5 * d.field_mm * depth_share
        aspect = d.head.camera.height_px / d.head.camera.width_px
        for share in np.linspace(1.0, 0.0, 9):
            for farther in (1.0, 1.06, 1.12, 1.2, 1.3) if share == 0.0 else (1.0,):
                spot = np.array(
                    [share * place[0] * half, share * place[1] * half * aspect, depth * farther]
                )
                pose: Pose[Sensor, Board] = Pose(rotation, spot - rotation @ middle)
                if self._is_seen(pose.apply(marks)):
                    return pose
        return pose

    def _is_seen(self, points_mm: FloatArray) -> bool:
        pitch = np.ptp(points_mm, axis=0).max() / 20.0
        for eye in self.drawn.head.cameras:
            seen = eye.camera.project(eye.camera_from_sensor.apply(points_mm))
            rim = 8.0 + pitch * eye.camera.fx / self.drawn.depth_mm
            size = np.array([eye.camera.width_px, eye.camera.height_px])
            if not bool(((seen > rim) & (seen < size - rim)).all()):
                return False
        return True

    def of_board(
        self, pose: Pose[Sensor, Board], lasers: tuple[str, ...], light: float, camera: int = 0
    ) -> ImageArray:
        """The board with some lasers on, in some light."""
        d = self.drawn
        target = Target(d.pattern, Pose(pose.rotation, pose.translation_mm), substrate=d.substrate)
        wall = Floor(
            np.array([0.0, 0.0, BACKGROUND_SHARE * d.depth_mm]),
            np.array([0.0, 0.0, -1.0]),
            (0.25, 0.25, 0.25),
        )
        station = Station((SceneObject("wall", wall),), target, LAMP)
        here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
        return self._expose(station, here, lasers, light, camera)

    def of_thing(
        self, thing: SceneObject, pose: Pose[Base, Sensor], lasers: tuple[str, ...], camera: int = 0
    ) -> ImageArray:
        """A thing in Base with some lasers on, in dim light."""
        return self._expose(Station((thing,)), pose, lasers, None, camera)

    def _expose(
        self,
        station: Station,
        pose: Pose[Base, Sensor],
        lasers: tuple[str, ...],
        light: float | None,
        camera: int,
    ) -> ImageArray:
        head = self.drawn.head
        window = head.cameras[camera].full_window
        settings = ExposureSettings(window, lasers, light)
        rng = np.random.default_rng([self.drawn.seed, 3300, self.n_images])
        self.n_images += 1
        return render_exposure(head, station, [pose], settings, rng, camera=camera)


def save_image(path: Path, image: ImageArray) -> None:
    """Write a PNG; colour in the order red, green, blue."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image[..., ::-1] if image.ndim == 3 else image
    if not cv2.imwrite(str(path), pixels):
        raise OSError(f"cannot write {path}")


@dataclass(slots=True)
class RecordingWriter:
    """A folder recording, row by row.

    Parameters
    ----------
    folder
        Of the recording.
    drawn
        The instrument.
    kind
        Of the session.
    """

    folder: Path
    drawn: DrawnInstrument
    kind: str
    rows: list[str] = field(default_factory=list)
    arm: list[str] = field(default_factory=list)
    n_triggers: int = 0
    now_ns: int = 0

    def add(self, images: Sequence[ImageArray], lasers: tuple[str, ...], view: str) -> None:
        """All cameras' images of one instant."""
        self.n_triggers += 1
        self.now_ns += 1_000_000_000
        for camera, image in enumerate(images):
            name = f"images/{self.n_triggers:04d}-{camera}.png"
            save_image(self.folder / name, image)
            words = (len(self.rows), self.now_ns, camera, name, "+".join(lasers))
            self.rows.append(",".join(map(str, (*words, self.n_triggers, view))))

    def add_pose(self, pose: Pose[Base, Tool]) -> None:
        """What the arm reported at the last instant."""
        w, x, y, z = quaternion(pose.rotation)
        numbers = [*pose.translation_mm, w, x, y, z]
        cells = ",".join(f"{number:.12g}" for number in numbers)
        self.arm.append(f"{self.now_ns},{cells},{self.n_triggers}")

    def close(self) -> None:
        """Write the tables."""
        head = self.drawn.head
        camera = head.camera
        lines = [f'kind = "{self.kind}"']
        if self.arm:
            lines += ["[pose]", 'form = "quaternion"']
            lines += ["[time]", 'clock = "shared"']
        for _ in head.cameras:
            lines += [
                "[[camera]]",
                f"width_px = {camera.width_px}",
                f"height_px = {camera.height_px}",
                f"bits_used = {head.imaging.detector.bits}",
                f'colour = "{"rgb" if self.drawn.colour else "mono"}"',
            ]
        (self.folder / "session.toml").write_text("\n".join(lines) + "\n")
        table = "index,t_ns,camera,file,lasers,trigger_id,view\n"
        (self.folder / "exposures.csv").write_text(table + "\n".join(self.rows) + "\n")
        if self.arm:
            table = "t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz,trigger_id\n"
            (self.folder / "arm.csv").write_text(table + "\n".join(self.arm) + "\n")


def quaternion(rotation: FloatArray) -> FloatArray:
    """(4,) w, x, y, z of a rotation (3, 3), by the eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])


# -- sets of photographs ----------------------------------------------------------------------

PLACES = (
    (0.0, 0.0),
    (-0.5, -0.5),
    (0.5, -0.5),
    (-0.5, 0.5),
    (0.5, 0.5),
    (0.0, 0.4),
    (0.4, 0.0),
    (-0.4, 0.0),
    (0.0, -0.4),
)


@dataclass(frozen=True, slots=True)
class Held:
    """Where the head or the ball truly was at each instant of a recording.

    Parameters
    ----------
    base_from_sensor
        By name of the image, of camera 0 and of camera 1.
    """

    base_from_sensor: dict[str, Pose[Base, Sensor]]


def photograph_camera_set(shoot: Photographer, folder: Path, count: int) -> None:
    """Views of the board for the cameras, in folders ``left`` and, with two, ``right``."""
    drawn, rng = shoot.drawn, shoot.rng
    for k in range(count):
        tilt = rng.uniform(0.0, 2.0) if drawn.degenerate == "parallel boards" else 0.0
        if drawn.degenerate != "parallel boards":
            tilt = rng.uniform(3.0, 10.0) if k % 4 == 0 else rng.uniform(18.0, 38.0)
        roll = 90.0 * (k % 4) + rng.uniform(-15.0, 15.0)
        share = rng.uniform(0.88, 1.2)
        pose = shoot.board_pose(tilt, PLACES[k % len(PLACES)], share, roll)
        for camera in range(len(drawn.head.cameras)):
            image = shoot.of_board(pose, (), drawn.head.imaging.target_light, camera)
            save_image(folder / ("left", "right")[camera] / f"{k + 1:02d}.png", image)


def laser_board_poses(shoot: Photographer, count: int) -> list[Pose[Sensor, Board]]:
    """Places of the board in the sheets, from near to far, about where the lines lie."""
    drawn, rng = shoot.drawn, shoot.rng
    half = np.array([0.5, 0.5 * drawn.head.camera.height_px / drawn.head.camera.width_px])
    poses = []
    for k in range(count):
        share = 0.88 + 0.24 * k / max(count - 1, 1)
        tilt = rng.uniform(5.0, 25.0)
        if drawn.degenerate == "boards at one depth":
            share, tilt = 1.0, rng.uniform(0.0, 0.3)
        depth = share * drawn.depth_mm
        middles = [
            laser.source_mm
            + (depth - laser.source_mm[2]) / laser.forward[2] * laser.forward
            + 0.2 * drawn.field_mm * rng.uniform(-1.0, 1.0) * laser.across
            for laser in drawn.head.lasers
        ]
        middle = middles[k % len(middles)] if len(drawn.head.sources) > 1 else np.mean(middles, 0)
        place = middle[:2] / (share * drawn.field_mm * half)
        if drawn.degenerate == "boards at one depth":
            place = np.zeros(2)
        poses.append(
            shoot.board_pose(
                tilt, (float(place[0]), float(place[1])), share, rng.uniform(-20.0, 20.0)
            )
        )
    return poses


def photograph_laser_set(shoot: Photographer, folder: Path, count: int) -> None:
    """One camera, one line: folders ``on`` and, where it is taken, ``off``."""
    drawn = shoot.drawn
    for k, pose in enumerate(laser_board_poses(shoot, count), start=1):
        on = shoot.of_board(pose, drawn.head.sources, drawn.laser_light)
        save_image(folder / "on" / f"{k:02d}.png", on)
        if drawn.has_off:
            off = shoot.of_board(pose, (), drawn.head.imaging.target_light)
            save_image(folder / "off" / f"{k:02d}.png", off)


def record_laser_set(shoot: Photographer, folder: Path, count: int) -> None:
    """Each source alone, then none, as a recording."""
    drawn = shoot.drawn
    writer = RecordingWriter(folder, drawn, "calibration")
    cameras = range(len(drawn.head.cameras))
    for k, pose in enumerate(laser_board_poses(shoot, count), start=1):
        states: list[tuple[tuple[str, ...], float]] = [
            ((source,), drawn.laser_light) for source in drawn.head.sources
        ]
        if drawn.has_off:
            states.append(((), drawn.head.imaging.target_light))
        for lasers, light in states:
            images = [shoot.of_board(pose, lasers, light, camera) for camera in cameras]
            writer.add(images, lasers, f"board-{k:02d}")
    writer.close()


def head_pose(
    shoot: Photographer, spot_mm: FloatArray, most_tilt_deg: float, depth_share: float
) -> Pose[Base, Sensor]:
    """Head that brings its aim to a place of Base, tilted and turned by chance.

    Every light and every camera meets the horizontal there at less than 65 degrees from upright.
    """
    drawn, rng = shoot.drawn, shoot.rng
    level = drawn.base_from_plate.rotation
    aim = np.array([0.0, 0.0, drawn.depth_mm * depth_share])
    down = np.diag([1.0, -1.0, -1.0])
    for _ in range(400):
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        tilt = np.radians(most_tilt_deg * np.sqrt(rng.uniform()))
        lean = rotation_from_vector(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        roll = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        if drawn.degenerate == "parallel postures" and most_tilt_deg > 30.0:
            lean = rotation_from_vector(0.002 * rng.standard_normal(3))
            roll = np.eye(3)
        rotation = level @ lean @ roll @ down
        rays = [laser.forward for laser in drawn.head.lasers]
        rays += [eye.camera_from_sensor.rotation[2] for eye in drawn.head.cameras]
        upright = [-(rotation @ ray) @ level[:, 2] for ray in rays]
        if min(upright) > np.cos(np.radians(62.0)):
            break
    return Pose(rotation, spot_mm - rotation @ aim)


def _record_over(
    shoot: Photographer,
    writer: RecordingWriter,
    thing: SceneObject,
    poses: Sequence[Pose[Base, Sensor]],
    view: str,
) -> Held:
    """Expose a thing from each pose: one source after the other, or all before two cameras."""
    drawn, rng = shoot.drawn, shoot.rng
    sensor_from_tool = drawn.head.tool_from_sensor.inverse()
    cameras = range(len(drawn.head.cameras))
    together = len(cameras) > 1
    held: dict[str, Pose[Base, Sensor]] = {}
    for k, pose in enumerate(poses, start=1):
        error = rotation_from_vector(drawn.arm_rad * rng.standard_normal(3))
        true = pose @ sensor_from_tool
        shift = drawn.arm_mm * rng.standard_normal(3)
        told: Pose[Base, Tool] = Pose(error @ true.rotation, true.translation_mm + shift)
        for lasers in [drawn.head.sources] if together else [(s,) for s in drawn.head.sources]:
            images = [shoot.of_thing(thing, pose, lasers, camera) for camera in cameras]
            writer.add(images, lasers, f"{view}-{k:02d}")
            writer.add_pose(told)
            for camera in cameras:
                held[f"{writer.n_triggers:04d}-{camera}.png"] = pose
    writer.close()
    return Held(held)


def record_postures(shoot: Photographer, folder: Path, count: int) -> Held:
    """Postures over the plate for the hand-eye."""
    drawn, rng = shoot.drawn, shoot.rng
    rotation, origin = drawn.base_from_plate.rotation, drawn.base_from_plate.translation_mm
    poses = []
    for _ in range(count):
        on_plate = 0.35 * drawn.field_mm * rng.uniform(-1.0, 1.0, 2)
        spot = origin + rotation[:, :2] @ on_plate
        poses.append(head_pose(shoot, spot, 38.0, rng.uniform(0.92, 1.08)))
    writer = RecordingWriter(folder, drawn, "calibration")
    return _record_over(shoot, writer, plate_thing(drawn), poses, "posture")


def record_plate(shoot: Photographer, folder: Path, count: int) -> Held:
    """A short scan of the plate."""
    drawn = shoot.drawn
    rotation, origin = drawn.base_from_plate.rotation, drawn.base_from_plate.translation_mm
    poses = []
    for k in range(count):
        along = 0.6 * drawn.field_mm * (k / max(count - 1, 1) - 0.5)
        spot = origin + rotation[:, :2] @ np.array([along, 0.1 * along])
        poses.append(head_pose(shoot, spot, 20.0, shoot.rng.uniform(0.96, 1.04)))
    writer = RecordingWriter(folder, drawn, "scan")
    return _record_over(shoot, writer, plate_thing(drawn), poses, "pass")


def record_ball(shoot: Photographer, folder: Path, count: int) -> Held:
    """A short scan of the ball: lines across it from several sides."""
    drawn, rng = shoot.drawn, shoot.rng
    radius = drawn.ball.radius_mm
    up = drawn.base_from_plate.rotation[:, 2]
    poses = []
    for _ in range(count):
        aside = drawn.base_from_plate.rotation[:, :2] @ (0.5 * radius * rng.uniform(-1.0, 1.0, 2))
        spot = drawn.ball.centre_mm + 0.8 * radius * up + aside
        poses.append(head_pose(shoot, spot, 30.0, rng.uniform(0.97, 1.03)))
    writer = RecordingWriter(folder, drawn, "scan")
    return _record_over(shoot, writer, SceneObject("ball", drawn.ball, MATT_PAINT), poses, "pass")


def plate_thing(drawn: DrawnInstrument) -> SceneObject:
    """The plate where it lies."""
    return SceneObject("plate", Placed(drawn.plate, drawn.base_from_plate), CERAMIC)


def write_touches(shoot: Photographer, path: Path, count: int) -> None:
    """Centres of a tip that touched the plate, as the arm reported them."""
    drawn, rng = shoot.drawn, shoot.rng
    x, y = (0.7 * drawn.field_mm * rng.uniform(-1.0, 1.0, count) for _ in range(2))
    height = drawn.plate.height_mm(x, y)
    feet = np.stack([x, y, height + 0.5 * TIP_MM], axis=1)
    pose = drawn.base_from_plate
    centres = feet @ pose.rotation.T + pose.translation_mm
    centres += drawn.arm_mm * rng.standard_normal(centres.shape)
    lines = [f"# point = tip-centre, tip_diameter_mm = {TIP_MM:g}", "x_mm,y_mm,z_mm"]
    lines += [",".join(f"{number:.6f}" for number in centre) for centre in centres]
    path.write_text("\n".join(lines) + "\n")


def plate_distance_mm(drawn: DrawnInstrument, points_base_mm: FloatArray) -> FloatArray:
    """Signed distance (N,) of points (N, 3) in Base from the plate's true face."""
    pose = drawn.base_from_plate
    local = (points_base_mm - pose.translation_mm) @ pose.rotation
    return drawn.plate.distance_mm(local)
