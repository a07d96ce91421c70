# SPDX-License-Identifier: Apache-2.0
"""The objects that stand on the simulated table: plate, ball, steps, free-form part and the
plate of markers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np

from armscan.devices.sources import Preset
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Base, Part, Plate, Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.objects.body import Body, free_form_part
from armscan.simulation.objects.mesh import Mesh
from armscan.simulation.objects.rings import RING_DIAMETER_MM, RingMarker
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed, Wave, WavyPlate
from armscan.simulation.optics.scene import (
    CERAMIC,
    GROUND_STEEL,
    MATT_PAINT,
    SceneObject,
    Sphere,
    Surface,
)
from armscan.simulation.station import Station

N_MARKERS = 30
SLAB_MM = (96.0, 62.0, 6.0)
BLOCKS_MM = (
    (-33.0, 17.0, 22.0, 18.0, 13.0),
    (-8.0, -16.0, 20.0, 22.0, 10.0),
    (15.0, 16.0, 24.0, 20.0, 16.0),
    (37.0, -14.0, 15.0, 26.0, 11.5),
)
"""Middle x and y, length, width and height over the foot of each block on the slab."""
_GREY = (0.55, 0.55, 0.55)
_CLEAR_MM = 0.6
"""Between a marker's rim and an edge or a wall's foot."""
_APART_MM = 7.0
_TRIES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class MarkedPlate:
    """The plate's shapes and its markers, in its own frame.

    Parameters
    ----------
    markers
        (N,) on upward faces, no two nearer than a marker's width.
    """

    markers: tuple[RingMarker, ...]

    @staticmethod
    def draw(rng: np.random.Generator) -> MarkedPlate:
        """Strew the markers: a place is taken if it keeps clear of edges and of other markers."""
        half = 0.5 * np.array(SLAB_MM[:2])
        taken: list[FloatArray] = []
        for place in rng.uniform(-half, half, (_TRIES, 2)):
            is_apart = all(np.hypot(*(place - other[:2])) > _APART_MM for other in taken)
            height = face_height_mm(place)
            if is_apart and height is not None:
                taken.append(np.array([*place, height]))
            if len(taken) == N_MARKERS:
                break
        up = np.array([0.0, 0.0, 1.0])
        return MarkedPlate(tuple(RingMarker(centre, up) for centre in taken))

    @property
    def centres_mm(self) -> FloatArray:
        """(N, 3) middles of the discs."""
        return np.array([marker.centre_mm for marker in self.markers])

    @property
    def shapes(self) -> tuple[Surface, ...]:
        """The slab and the blocks."""
        slab = Box(np.array(SLAB_MM), _GREY)
        blocks = [
            Placed(Box(np.array(size), _GREY), Pose(np.eye(3), np.array([x, y, 0.0])))
            for x, y, *size in BLOCKS_MM
        ]
        return (slab, *blocks)


def face_height_mm(place_mm: FloatArray) -> float | None:
    """Height of the face on which a marker at (2,) lies as a whole; None if it meets an edge."""
    reach = 0.5 * RING_DIAMETER_MM + _CLEAR_MM
    if not _is_inside(place_mm, np.zeros(2), np.array(SLAB_MM[:2]), -reach):
        return None
    for x, y, length, width, height in BLOCKS_MM:
        middle, size = np.array([x, y]), np.array([length, width])
        if _is_inside(place_mm, middle, size, -reach):
            return height
        if _is_inside(place_mm, middle, size, reach):
            return None
    return SLAB_MM[2]


def _is_inside(place: FloatArray, middle: FloatArray, size: FloatArray, wider: float) -> bool:
    beyond: BoolArray = np.abs(place - middle) > 0.5 * size + wider
    return not bool(beyond.any())


BALL_DIAMETER_MM = 34.96
STEP_HEIGHTS_MM = (20.0, 5.0)
STEP_CENTRES_MM = ((-19.0, 0.0), (19.0, 0.0))
STEP_FACE_MM = (22.0, 30.0)
PLATE_SIZE_MM = (200.0, 200.0)

_PLATE_MM = (620.0, -160.0, -6.4)
_BALL_MM = (610.0, -140.0, 60.0)
_PART_MM = (610.0, -150.0, 20.0)
_WORKPIECE_MM = (610.0, -150.0, 4.0)
_BORE_MM = (-18.0, 12.0, 2.0)
"""Middle of the workpiece's bore, in the frame of its CAD model."""
_WAVES_MM = (612.0, -150.0, 10.0)
_MARKED_MM = (612.0, -152.0, 6.0)
_MARKED_AFTER_MOVE_MM = (585.0, 95.0, 21.0)
_TURN_OF_MOVE_RAD = 0.35
"""How the part stands in Base after the arm was put down in another place."""
_GROUND_SIZE_MM = (120.0, 120.0)
_GROUND_FLATNESS_MM = 0.001
_FLATNESS_MM: dict[Preset, float] = {"clean": 0.001, "thesis": 0.015, "harsh": 0.04}
_WAVES = (Wave(1.6, 40.0, 15.0), Wave(0.9, 26.0, 105.0), Wave(0.35, 15.0, 60.0))
_WAVES_SIZE_MM = (110.0, 110.0)
_WHITE = (0.8, 0.8, 0.8)
_STEEL = (0.45, 0.45, 0.45)
_PLACE_MM = 15.0
_LEVEL_RAD = 0.004


@dataclass(frozen=True, slots=True, eq=False)
class Fixtures:
    """The things of one twin, each where it stands for its scene.

    Parameters
    ----------
    plate, base_from_plate
        The reference plate; z = 0 of its frame is the best plane through it.
    waves, base_from_waves
        The wavy plate in its own frame, and where it lies.
    marked, base_from_marked
        The plate with ring markers in its own frame, and where it stands.
    moved_from_base
        From Base to what Base is after the arm was put down in another place.
    workpiece, base_from_workpiece
        The part as it was made, in the frame of its CAD model, and where it stands.
    bore_mm
        (3,) middle of its bore in that frame; None of another part.
    """

    plate: FlatPlate
    base_from_plate: Pose[Base, Plate]
    ball: Sphere
    ground: FlatPlate
    base_from_ground: Pose[Base, Plate]
    part: Body
    base_from_part: Pose[Base, Part]
    waves: WavyPlate
    base_from_waves: Pose[Base, Plate]
    marked: MarkedPlate
    base_from_marked: Pose[Base, Part]
    moved_from_base: Pose[Base, Base]
    workpiece: Mesh
    base_from_workpiece: Pose[Base, Part]
    bore_mm: FloatArray | None

    @staticmethod
    def build(
        preset: Preset, rng: np.random.Generator, part_mm: FloatArray | None = None
    ) -> Fixtures:
        """Draw the things and put them down by hand: a little aside, not quite level.

        ``part_mm`` (T, 3, 3) are the triangles of a part in place of the workpiece.
        """
        plate = FlatPlate.draw(PLATE_SIZE_MM, _FLATNESS_MM[preset], rng, _WHITE)
        ground = FlatPlate.draw(_GROUND_SIZE_MM, _GROUND_FLATNESS_MM, rng, _STEEL)
        ball = np.array(_BALL_MM) + _PLACE_MM * rng.uniform(-1.0, 1.0, 3)
        base_from_plate = _put_down(_PLATE_MM, rng)
        base_from_ground = _put_down(_PLATE_MM, rng)
        base_from_part = _put_down(_PART_MM, rng)
        base_from_waves = _put_down(_WAVES_MM, rng)
        phases = rng.uniform(0.0, 2.0 * np.pi, len(_WAVES))
        waves = [replace(w, phase_rad=float(p)) for w, p in zip(_WAVES, phases, strict=True)]
        base_from_marked = _put_down(_MARKED_MM, rng)
        moved_from_marked = _put_down(_MARKED_AFTER_MOVE_MM, rng, _TURN_OF_MOVE_RAD)
        workpiece = Mesh(made_workpiece() if part_mm is None else part_mm, _GREY)
        low, high = workpiece.bounds_mm
        middle_below = np.array([*(0.5 * (low + high))[:2], low[2]])
        from_foot: Pose[Any, Part] = Pose(np.eye(3), -middle_below)
        return Fixtures(
            plate=plate,
            base_from_plate=base_from_plate,
            ball=Sphere(ball, 0.5 * BALL_DIAMETER_MM, _WHITE),
            ground=ground,
            base_from_ground=base_from_ground,
            part=free_form_part(),
            base_from_part=base_from_part,
            waves=WavyPlate(_WAVES_SIZE_MM, tuple(waves), _WHITE),
            base_from_waves=base_from_waves,
            marked=MarkedPlate.draw(rng),
            base_from_marked=base_from_marked,
            moved_from_base=moved_from_marked @ base_from_marked.inverse(),
            workpiece=workpiece,
            base_from_workpiece=_put_down(_WORKPIECE_MM, rng) @ from_foot,
            bore_mm=np.array(_BORE_MM) if part_mm is None else None,
        )

    @property
    def plate_plane(self) -> FloatArray:
        """(4,) unit normal and D of the best plane through the plate, in Base (eq. 2.55)."""
        normal = self.base_from_plate.rotation[:, 2]
        return np.array([*normal, -normal @ self.base_from_plate.translation_mm])

    def with_plate(self) -> Station:
        """The reference plate alone."""
        return Station((SceneObject("plate", Placed(self.plate, self.base_from_plate), CERAMIC),))

    def with_ball(self) -> Station:
        """The ball alone, held from below by what no camera sees."""
        return Station((SceneObject("ball", self.ball, MATT_PAINT),))

    def with_steps(self) -> Station:
        """Two gauge blocks wrung to a ground plate."""
        things = [SceneObject("ground", Placed(self.ground, self.base_from_ground), GROUND_STEEL)]
        for height, (x, y) in zip(STEP_HEIGHTS_MM, STEP_CENTRES_MM, strict=True):
            block = Box(np.array([*STEP_FACE_MM, height]), _STEEL)
            foot: Pose[Plate, Part] = Pose(np.eye(3), np.array([x, y, 0.0]))
            placed = Placed(block, self.base_from_ground @ foot)
            things.append(SceneObject(f"block {height:g} mm", placed, GROUND_STEEL))
        return Station(tuple(things))

    def with_part(self) -> Station:
        """The free-form part alone."""
        return Station((SceneObject("part", Placed(self.part, self.base_from_part), MATT_PAINT),))

    def with_workpiece(self) -> Station:
        """The workpiece alone, or the part in its place."""
        placed = Placed(self.workpiece, self.base_from_workpiece)
        return Station((SceneObject("workpiece", placed, MATT_PAINT),))

    def with_waves(self) -> Station:
        """The wavy plate alone."""
        return Station(
            (SceneObject("waves", Placed(self.waves, self.base_from_waves), MATT_PAINT),)
        )

    def with_markers(self, is_moved: bool = False) -> Station:
        """The stepped plate with ring markers, in Base before or after the arm was moved."""
        pose = self.marked_pose(is_moved)
        things = tuple(
            SceneObject(f"step {k}", Placed(shape, pose), MATT_PAINT)
            for k, shape in enumerate(self.marked.shapes)
        )
        markers = tuple(
            RingMarker(centre, pose.rotation[:, 2])
            for centre in self.marked.centres_mm @ pose.rotation.T + pose.translation_mm
        )
        return Station(things, markers=markers)

    def marked_pose(self, is_moved: bool = False) -> Pose[Base, Part]:
        """Where the plate with markers stands, in Base before or after the arm was moved."""
        return self.moved_from_base @ self.base_from_marked if is_moved else self.base_from_marked

    def marker_centres_mm(self) -> FloatArray:
        """(N, 3) middles of the ring markers, in Base before the arm was moved."""
        pose = self.base_from_marked
        return np.asarray(self.marked.centres_mm @ pose.rotation.T + pose.translation_mm)

    def part_distance_mm(self, points_base_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) in Base from the free-form part."""
        return self.part.distance_mm(self._in_part(points_base_mm))

    def part_normals(self, points_base_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals, in Base, of the part next to points (N, 3)."""
        normals = self.part.normals(self._in_part(points_base_mm))
        return np.asarray(normals @ self.base_from_part.rotation.T)

    def _in_part(self, points_base_mm: FloatArray) -> FloatArray:
        pose = self.base_from_part
        return np.asarray((points_base_mm - pose.translation_mm) @ pose.rotation)


def made_workpiece() -> FloatArray:
    """(T, 3, 3) triangles of the workpiece as it was made, its two faults included."""
    raw = (files("armscan.simulation") / "workpiece" / "as_made.stl").read_bytes()
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    return np.frombuffer(raw, facet, offset=84)["corners"].astype(np.float64)


def _put_down(
    place_mm: tuple[float, float, float], rng: np.random.Generator, turn_rad: float = 0.0
) -> Pose[Base, Any]:
    """Pose near a place, turned by hand and not quite level."""
    turn = rotation_from_vector(np.array([0.0, 0.0, turn_rad + rng.uniform(-0.3, 0.3)]))
    level = rotation_from_vector(np.array([*(_LEVEL_RAD * rng.standard_normal(2)), 0.0]))
    shift = np.array([_PLACE_MM, _PLACE_MM, 1.0]) * rng.uniform(-1.0, 1.0, 3)
    return Pose(level @ turn, np.array(place_mm) + shift)
