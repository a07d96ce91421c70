# SPDX-License-Identifier: Apache-2.0
"""Looks at a flat target from postures of an arm, and the hand-eye that most of them agree on.

Targets that look alike after a turn, and boards whose pose has a mirrored twin, take part with
every pose that their view allows: which one is right, the other looks tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, combinations
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.cameras.start import estimate_board_poses
from armscan.calibration.hand_eye.alternatives import other_readings
from armscan.calibration.hand_eye.surface import LEVER_MM
from armscan.calibration.sheets.board_points import BoardBow, dpose_dcamera
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, IntArray, floats
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Board, Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation, skew
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.vision.targets.detect import Numbering, numberings
from armscan.vision.targets.target import Target, TargetView, format_target

N_POSE = 6
MAX_TRIPLES, MAX_SUBSETS = 300, 60
TURNED_RAD = np.radians(4.0)
"""Postures turned by less tell nothing of the axis that they turn about."""
APART_SINE = 0.2
"""Between the axes of the two turns of three postures."""
LIKELY_TURN_RAD = np.radians(8.0)
"""Arm and camera that disagree by more about how far two postures are turned do not go together."""
FAR_RAD = np.radians(3.0)
FAR_PART = 0.05
"""Typical misclosure, and part of the target's distance, from which on no hand-eye is returned."""
FAR_OFF = 5.0
"""A look that is off by so many times the median has to show that it belongs to the others."""
HUBER_ROUNDS = 8
TURN_MORE = (
    "take 12 or more postures: turn the camera by 20 to 40 degrees about at least two of its axes "
    "while the target stays in view, nearer and farther"
)


class BoardPose(ArrayRecord):
    """A pose of the target that its view allows.

    Parameters
    ----------
    covariance
        (6, 6) of the points' noise, the camera held; a rotation vector in Sensor from the left,
        then the translation.
    by_common
        (6, 9) derivative by the camera's parameters; (6, 11) with the target's bow, if it has one.
    view
        With the points numbered as this pose has them, where the bow puts them.
    """

    sensor_from_board: Pose[Sensor, Board]
    covariance: FloatArray = floats(6, 6)
    by_common: FloatArray = floats(6, None)
    view: TargetView


@dataclass(frozen=True, slots=True, eq=False)
class BoardLook:
    """The target seen from one posture; looks of equal postures share the arm's error.

    Of ``poses`` the better comes first, with those of every numbering that no view tells apart.
    """

    posture: str
    base_from_tool: Pose[Base, Tool]
    poses: tuple[BoardPose, ...]

    @property
    def source(self) -> str:
        """Name of its image."""
        return self.poses[0].view.source


def board_poses(
    view: TargetView, target: Target, camera: CameraModel, bow: BoardBow | None = None
) -> tuple[BoardPose, ...] | FitFailure:
    """All poses of a target that one view allows, or why there is none.

    Raises
    ------
    InputError
        If view and camera do not belong to images of one size.
    """
    bent = view if bow is None else bow.bent(view)
    estimates = estimate_board_poses(bent, camera)
    if isinstance(estimates, FitFailure):
        return estimates
    found = []
    for numbering in numberings(target):
        forth, back = numbering.new_from_found, numbering.new_from_found.inverse()
        numbered = replace(
            bent,
            point_index=numbering.new_index[view.point_index],
            points_board_mm=forth.apply(bent.points_board_mm),
        )
        for estimate in estimates:
            # The board's origin moves to another of its corners, and turns about there.
            moved = np.eye(N_POSE)
            moved[3:, :3] = -skew(estimate.value.rotation @ back.translation_mm)
            found.append(
                BoardPose(
                    sensor_from_board=estimate.value @ back,
                    covariance=moved @ estimate.covariance @ moved.T,
                    by_common=_numbered(
                        moved @ dpose_dcamera(bent, estimate.value, camera, bow), numbering
                    ),
                    view=numbered,
                )
            )
    return tuple(found)


def _numbered(by_common: FloatArray, numbering: Numbering) -> FloatArray:
    """Derivative by the camera, and by the bow along axes that a quarter turn swaps."""
    n_camera = len(PARAMETER_NAMES)
    if numbering.quarter_turns % 2 == 0:
        return by_common
    return np.concatenate([by_common[:, :n_camera], by_common[:, n_camera:][:, ::-1]], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class BoardStart:
    """A hand-eye that most looks agree on.

    ``chosen`` (N,) is the nearest pose of each look, ``off_rad`` and ``off_mm`` (N,) what is left
    of it, in orientation and place of the target's middle.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    base_from_board: Pose[Base, Board]
    chosen: IntArray
    off_rad: FloatArray
    off_mm: FloatArray

    @property
    def typical_rad(self) -> float:
        """Median over the looks."""
        return float(np.median(self.off_rad))

    @property
    def typical_mm(self) -> float:
        """Median over the looks."""
        return float(np.median(self.off_mm))

    @property
    def typical_at_lever_mm(self) -> float:
        """Both together, turns counted at 100 mm."""
        return self.typical_mm + LEVER_MM * self.typical_rad

    @property
    def is_suspect(self) -> BoolArray:
        """(N,) looks that are far more off than is usual."""
        return (self.off_rad > FAR_OFF * self.typical_rad) | (
            self.off_mm > FAR_OFF * self.typical_mm
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Every allowed pose of every look, in one row each.

    ``look`` (M,) is its look, ``first`` (N,) the row of each look's first; ``arm``, ``board``
    (M, 3, 3) are the rotations of ``base_from_tool`` and ``sensor_from_board``, ``arm_mm``,
    ``board_mm`` (M, 3) the translations, ``middle_mm`` (M, 3) the middle of the target in Board.
    """

    look: IntArray
    first: IntArray
    arm: FloatArray
    board: FloatArray
    arm_mm: FloatArray
    board_mm: FloatArray
    middle_mm: FloatArray

    @staticmethod
    def of(looks: Sequence[BoardLook]) -> _Candidates:
        rows = [(k, look, pose) for k, look in enumerate(looks) for pose in look.poses]
        number = np.array([k for k, _, _ in rows])
        return _Candidates(
            look=number,
            first=np.searchsorted(number, np.arange(len(looks))),
            arm=np.array([look.base_from_tool.rotation for _, look, _ in rows]),
            board=np.array([pose.sensor_from_board.rotation for _, _, pose in rows]),
            arm_mm=np.array([look.base_from_tool.translation_mm for _, look, _ in rows]),
            board_mm=np.array([pose.sensor_from_board.translation_mm for _, _, pose in rows]),
            middle_mm=np.array([middle_of(pose.view) for _, _, pose in rows]),
        )

    def nearest(self, hand_eye: FloatArray, base: FloatArray) -> tuple[IntArray, FloatArray]:
        """Row of each look that is turned least off a board (3, 3) in Base, and by how much."""
        turned = self.arm @ hand_eye @ self.board
        cosine = 0.5 * (np.einsum("mij,ij->m", turned, base) - 1.0)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        least = np.minimum.reduceat(angle, self.first)
        rows = np.flatnonzero(angle == least[self.look])
        _, where = np.unique(self.look[rows], return_index=True)
        return rows[where], least


def middle_of(view: TargetView) -> FloatArray:
    """(3,) mean of the points that were seen, in Board."""
    return np.asarray(view.points_board_mm.mean(axis=0))


def find_board_start(
    looks: Sequence[BoardLook], max_triples: int = MAX_TRIPLES
) -> BoardStart | FitFailure:
    """The hand-eye whose median misclosure over the looks is least, of those that triples give.

    How far the tool turns from one posture to another is how far the camera turns: two turns of
    three looks about different axes give the rotation, and up to half the looks may be wrong. Of
    more than ``max_triples``, so many are drawn.
    """
    rows = _Candidates.of(looks)
    best: tuple[float, FloatArray, FloatArray] | None = None
    for rotation, base in _hypotheses(rows, len(looks), max_triples):
        misclosure = float(np.median(rows.nearest(rotation, base)[1]))
        if best is None or misclosure < best[0]:
            best = (misclosure, rotation, base)
    if best is None:
        return _refuse_turns(rows)
    _, rotation, base = best
    for _ in range(3):
        chosen, misclosures = rows.nearest(rotation, base)
        good = chosen[misclosures <= np.median(misclosures) * 2.0 + 1e-9]
        rotation = _rotation_of_turns(rows, good)
        base = nearest_rotation((rows.arm[good] @ rotation @ rows.board[good]).sum(axis=0))
    chosen, misclosures = rows.nearest(rotation, base)
    shift, place = _translations(rows, chosen, rotation, base)
    hand_eye: Pose[Tool, Sensor] = Pose(rotation, shift)
    board: Pose[Base, Board] = Pose(base, place)
    seen = np.einsum("nij,nj->ni", rows.board[chosen], rows.middle_mm[chosen])
    in_tool = hand_eye.apply(seen + rows.board_mm[chosen])
    placed = np.einsum("nij,nj->ni", rows.arm[chosen], in_tool) + rows.arm_mm[chosen]
    off = placed - board.apply(rows.middle_mm[chosen])
    return BoardStart(
        hand_eye,
        board,
        chosen - rows.first,
        misclosures,
        np.linalg.norm(off, axis=1),
    )


def _hypotheses(rows: _Candidates, n: int, max_triples: int) -> list[tuple[FloatArray, FloatArray]]:
    """Rotations of hand-eye and board from triples of looks that agree about how far they turn."""
    found = []
    for i, j, k in _subsets(n, max_triples):
        for row in range(rows.first[i], np.searchsorted(rows.look, i, side="right")):
            second, third = _turns_from(rows, row, j), _turns_from(rows, row, k)
            for one, seen in second:
                for other, also in third:
                    sine = np.linalg.norm(np.cross(one, other))
                    if sine < APART_SINE * np.linalg.norm(one) * np.linalg.norm(other):
                        continue
                    turns = np.array([one, other, np.cross(one, other)])
                    rotation = nearest_rotation(
                        turns.T @ np.array([seen, also, np.cross(seen, also)])
                    )
                    found.append((rotation, rows.arm[row] @ rotation @ rows.board[row]))
    return found


def _turns_from(rows: _Candidates, row: int, look: int) -> list[tuple[FloatArray, FloatArray]]:
    """Turns of tool and sensor from a row to those of a look that are turned as far as the tool."""
    found = []
    for other in range(rows.first[look], np.searchsorted(rows.look, look, side="right")):
        turn = Rotation.from_matrix(rows.arm[row].T @ rows.arm[other]).as_rotvec()
        seen = Rotation.from_matrix(rows.board[row] @ rows.board[other].T).as_rotvec()
        size = float(np.linalg.norm(turn))
        if size > TURNED_RAD and abs(size - float(np.linalg.norm(seen))) < LIKELY_TURN_RAD:
            found.append((turn, seen))
    return found


def _rotation_of_turns(rows: _Candidates, chosen: IntArray) -> FloatArray:
    """Rotation (3, 3) by all turns between chosen rows, longer ones weighing more."""
    i, j = np.triu_indices(len(chosen), 1)
    arm, board = rows.arm[chosen], rows.board[chosen]
    turns = Rotation.from_matrix(arm[i].transpose(0, 2, 1) @ arm[j]).as_rotvec()
    seen = Rotation.from_matrix(board[i] @ board[j].transpose(0, 2, 1)).as_rotvec()
    return nearest_rotation(turns.T @ seen)


def _translations(
    rows: _Candidates, chosen: IntArray, rotation: FloatArray, base: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Translations of hand-eye and board, from the triple whose median misclosure is least.

    The target's middle is set equal, which its own small turn moves little. Looks that agree with
    the triple take part then, the farther ones weighing less (Huber).
    """
    n = len(chosen)
    arm = rows.arm[chosen]
    middles = np.einsum("nij,nj->ni", rows.board[chosen], rows.middle_mm[chosen])
    seen = np.einsum("nij,nj->ni", arm @ rotation, middles + rows.board_mm[chosen])
    matrix = np.concatenate([arm, np.broadcast_to(-np.eye(3), (n, 3, 3))], axis=2)
    right = rows.middle_mm[chosen] @ base.T - seen - rows.arm_mm[chosen]

    def off_mm(found: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(matrix @ found - right, axis=1))

    def solved(weight: FloatArray) -> FloatArray:
        scaled = (matrix * weight[:, None, None]).reshape(-1, N_POSE)
        found = np.linalg.lstsq(scaled, (right * weight[:, None]).reshape(-1), rcond=None)[0]
        return np.asarray(found, dtype=np.float64)

    some = [solved(np.isin(np.arange(n), few).astype(float)) for few in _subsets(n, MAX_SUBSETS)]
    found = min(some, key=lambda one: float(np.median(off_mm(one))))
    for _ in range(HUBER_ROUNDS):
        off = off_mm(found)
        usual = max(float(np.median(off)), 1e-12)
        weight = 1.0 / np.sqrt(np.maximum(off / usual, 1.0))
        found = solved(np.asarray(np.where(off > FAR_OFF * usual, 0.0, weight)))
    return found[:3], found[3:]


def _subsets(n: int, most: int) -> list[tuple[int, ...]]:
    """All triples of ``n`` looks, or as many as asked for, drawn."""
    triples: list[tuple[int, ...]] = list(combinations(range(n), 3))
    if len(triples) <= most:
        return triples
    some = np.random.default_rng(0).permutation(len(triples))[:most]
    return [triples[k] for k in some]


def _refuse_turns(rows: _Candidates) -> FitFailure:
    """Why no triple of looks gives a rotation: parallel turns, or turns that disagree."""
    arm = rows.arm[rows.first]
    turns = Rotation.from_matrix(arm[0].T @ arm).as_rotvec()
    extent = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False) / np.sqrt(len(turns))
    if np.degrees(extent[1]) > np.degrees(TURNED_RAD):
        return FitFailure(
            "the arm's poses and the views disagree about how far the camera turned from posture "
            "to posture",
            "check the convention of the arm's angles (--euler), and that poses and images have "
            "the same order",
        )
    return FitFailure(
        "the postures do not determine the hand-eye: the tool hardly turns, or about one axis only",
        TURN_MORE,
    )


def refuse_far(
    start: BoardStart, looks: Sequence[BoardLook], target: Target | None = None
) -> FitFailure | None:
    """Refuse looks that stay away from any board at rest; say whether another size would do."""
    near = [
        look.poses[k].sensor_from_board.apply(middle_of(look.poses[k].view))
        for look, k in zip(looks, start.chosen, strict=True)
    ]
    distance_mm = float(np.median(np.linalg.norm(near, axis=1)))
    if start.typical_rad <= FAR_RAD and start.typical_mm <= FAR_PART * distance_mm:
        return None
    reason = (
        f"no hand-eye makes the arm's poses and the views agree: the target, {distance_mm:.0f} mm "
        f"away, stays off its place by {start.typical_mm:.1f} mm and "
        f"{np.degrees(start.typical_rad):.1f} degrees (medians)"
    )
    scale, left_mm = _size_that_fits(start, looks)
    if start.typical_rad <= FAR_RAD and left_mm < FAR_PART * min(scale, 1.0) * distance_mm:
        return FitFailure(
            f"{reason}; a target of {scale:.3g} times the stated size would leave {left_mm:.1f} mm",
            f"measure the target's print and give its size{resized(target, scale)}; check that the "
            "arm's positions are in mm",
        )
    return FitFailure(
        reason,
        "check the convention of the arm's angles (--euler), that positions are in mm, that poses "
        "and images have the same order, and that target and base did not move",
    )


def resized(target: Target | None, scale: float) -> str:
    """What to type for a target of another size; empty if it is not known."""
    if target is None:
        return ""
    lengths: dict[str, Any] = {
        one.name: float(f"{scale * getattr(target, one.name):.4g}")
        for one in fields(target)
        if one.name.endswith("_mm")
    }
    return f" (--target {format_target(replace(target, **lengths))} would suit)"


def _size_that_fits(start: BoardStart, looks: Sequence[BoardLook]) -> tuple[float, float]:
    """Size of the target over the stated one that suits the arm's shifts, and the median left."""
    arm = np.array([look.base_from_tool.rotation for look in looks])
    arm_mm = np.array([look.base_from_tool.translation_mm for look in looks])
    seen = np.array(
        [
            look.poses[k].sensor_from_board.translation_mm
            for look, k in zip(looks, start.chosen, strict=True)
        ]
    )
    along = np.einsum("nij,nj->ni", arm, seen @ start.tool_from_sensor.rotation.T)
    minus = np.broadcast_to(-np.eye(3), arm.shape)
    matrix = np.concatenate([arm, minus, along[:, :, None]], axis=2)
    found = np.linalg.lstsq(matrix.reshape(-1, 7), -arm_mm.reshape(-1), rcond=None)[0]
    left = np.linalg.norm(matrix @ found + arm_mm, axis=1)
    return float(found[6]), float(np.median(left))


MUCH_BETTER = 0.2
"""Part of the misclosures that another reading of the poses must leave, to be told."""
TRIPLES_OF_READING = 60


AT_REST = (
    "; a camera at rest before a target that the arm holds looks so, too: that is no scanner on an "
    "arm, and not solved here"
)
Reading: TypeAlias = tuple[str, str, FloatArray, FloatArray]
"""Words, what to do, and rotations (N, 3, 3) and translations (N, 3) of ``base_from_tool``."""
CLEARLY = 0.9
"""Part of what the best reading so far leaves that another one must leave, to be told instead."""


def better_reading(
    looks: Sequence[BoardLook], fact: str, readings: Iterable[Reading] = ()
) -> FitFailure | None:
    """Refuse in favour of another way to read the arm's poses, if it makes the looks agree.

    ``fact`` is what is wrong as they are read. ``readings`` are of the table that they are from,
    the likelier first; after them convention, direction, unit and order are tried.
    """
    given, found = find_board_start(looks), None
    least_mm = np.inf if isinstance(given, FitFailure) else MUCH_BETTER * given.typical_at_lever_mm
    rotations = np.array([look.base_from_tool.rotation for look in looks])
    translations = np.array([look.base_from_tool.translation_mm for look in looks])
    for words, remedy, turns, shifts in chain(readings, other_readings(rotations, translations)):
        read = [
            replace(look, base_from_tool=Pose(turn, shift))
            for look, turn, shift in zip(looks, turns, shifts, strict=True)
        ]
        start = find_board_start(read, TRIPLES_OF_READING)
        if isinstance(start, FitFailure) or isinstance(refuse_far(start, read), FitFailure):
            continue
        if start.typical_at_lever_mm < least_mm:
            least_mm = CLEARLY * start.typical_at_lever_mm
            found = FitFailure(
                f"{fact}; {words} would leave {start.typical_mm:.2f} mm and "
                f"{np.degrees(start.typical_rad):.2f} degrees (medians)",
                remedy + (AT_REST if "tool_from_base" in words else ""),
            )
    return found
