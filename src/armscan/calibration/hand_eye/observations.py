# SPDX-License-Identifier: Apache-2.0
"""What the hand-eye calibrations are given: stripes with the pose of their exposure, what is
known of the plate, the options; straight pieces of each stripe condensed to a few points on
the plate, and the residuals of those from a plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector
from armscan.geometry.shapes import Plane


@dataclass(frozen=True, slots=True)
class HandEyeOptions:
    """How stripes on a flat plate become a hand-eye, and how much everything scatters.

    A standard deviation that is None is estimated from the data.

    Parameters
    ----------
    arm_position_mm
        Scatter of the scan point by the arm's pose, an axis, common to a posture.
    arm_rotation_rad
        Scatter of the arm's orientation, an axis, common to a posture. None follows the position
        (see `armscan.calibration.hand_eye.solve.ROTATION_LEVER_MM`).
    exposure_position_mm, exposure_rotation_rad
        The parts of both that are new in every exposure. None: none if the arm's position is
        given; else estimated where a posture has several exposures.
    plate_flatness_mm
        Standard deviation of the plate's smooth flatness error.
    flatness_length_mm
        Length over which it stays alike; need not be exact.
    sheet_shape_mm
        Standard deviation of the light sheets' own shape, beyond what their parameters describe.
    stripe_noise_factor
        What the stripes' own noise is multiplied with.
    solve_plate
        Solve the plate's plane along, without regard to where it was probed.
    nodes_per_stripe
        Mean points that an exposure's stripe is condensed to before the refinement.
    line_tolerance_mm
        Half width of the band in which points belong to one stripe on the plate, before robust
        statistics tighten it.
    outlier_sigma
        Points further than this many robust sigmas from their stripe are rejected.
    min_points
        Fewest points that make a stripe.
    max_rms_mm
        Typical distance of a posture's points from the plate above which the data contradict each
        other and no hand-eye is returned.
    """

    arm_position_mm: float | None = None
    arm_rotation_rad: float | None = None
    exposure_position_mm: float | None = None
    exposure_rotation_rad: float | None = None
    plate_flatness_mm: float | None = None
    flatness_length_mm: float = 30.0
    sheet_shape_mm: float | None = None
    stripe_noise_factor: float | None = None
    solve_plate: bool = False
    nodes_per_stripe: int = 12
    line_tolerance_mm: float = 0.5
    outlier_sigma: float = 5.0
    min_points: int = 20
    max_rms_mm: float = 0.5

    def __post_init__(self) -> None:
        for name in (
            "arm_position_mm",
            "arm_rotation_rad",
            "exposure_position_mm",
            "exposure_rotation_rad",
            "plate_flatness_mm",
            "sheet_shape_mm",
            "stripe_noise_factor",
        ):
            value = getattr(self, name)
            _require(
                value is None or (math.isfinite(value) and value >= 0.0),
                f"{name} is {value}",
                "give 0 or more, or leave it out to have it estimated",
            )
        for name in ("arm_rotation_rad", "exposure_rotation_rad"):
            value = getattr(self, name)
            _require(
                value is None or value < 0.1,
                f"{name} is {value} rad",
                "an arm's orientation scatters by less than 0.1 rad: give rad, not degrees",
            )
        _require(
            1.0 <= self.flatness_length_mm <= 1000.0,
            f"flatness length of {self.flatness_length_mm} mm",
            "give 1 to 1000 mm",
        )
        _require(
            4 <= self.nodes_per_stripe <= 60,
            f"{self.nodes_per_stripe} nodes a stripe",
            "give 4 to 60",
        )
        for name in ("line_tolerance_mm", "max_rms_mm"):
            value = getattr(self, name)
            _require(
                math.isfinite(value) and value > 0.0, f"{name} is {value}", "give a positive length"
            )
        _require(
            self.outlier_sigma >= 2.0,
            f"outlier limit of {self.outlier_sigma} sigma",
            "give at least 2, or good points are lost",
        )
        _require(self.min_points >= 5, f"{self.min_points} points a stripe", "give at least 5")


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="hand-eye options", remedy=remedy)


@dataclass(frozen=True, slots=True, eq=False)
class PosedStripe:
    """Points of one exposure, with the pose that the arm reported for it.

    Parameters
    ----------
    source
        Name of the exposure.
    posture
        Exposures of equal posture were taken without moving the arm.
    base_from_tool
        As the arm reported it.
    points_mm
        (N, 3) in the Sensor frame.
    noise_mm
        (N, 3, J) one standard deviation of each of a point's own noises, as the vector in which it
        acts: one of each camera that saw the point.
    sheet
        (N,) index of the light sheet that each point lies on.
    by_sensor
        (N, 3, P) derivative of the points by all the sensor's parameters, or None where the
        sensor delivered points.
    """

    source: str
    posture: str
    base_from_tool: Pose[Base, Tool]
    points_mm: FloatArray
    noise_mm: FloatArray
    sheet: IntArray
    by_sensor: FloatArray | None = None

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_mm, (None, 3), "points_mm")
        object.__setattr__(self, "points_mm", points)
        noise = frozen_floats(self.noise_mm, (len(points), 3, None), "noise_mm")
        object.__setattr__(self, "noise_mm", noise)
        object.__setattr__(self, "sheet", frozen_ints(self.sheet, (len(points),), "sheet"))

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points_mm)


@dataclass(frozen=True, slots=True, eq=False)
class PlateReference:
    """The flat plate in Base, as it was probed (eq. 2.55).

    Parameters
    ----------
    plane
        Plane in Base; its normal points to the side from which it was probed and is scanned.
    covariance
        (3, 3) of `armscan.geometry.shapes.PLANE_PARAMETERS` (rad, rad, mm) at ``plane.point_mm``,
        without the arm's systematic part; None where it is not known, as of A, B, C, D alone.
    rms_mm
        Root mean square distance of the probed points from the plane; None where not known.
    n_points
        Count of probed points; 0 where only A, B, C, D are known.
    source
        Where it came from.
    tip_diameter_mm
        Diameter of the probe's tip that was compensated for; 0 where not known.
    """

    plane: Plane
    covariance: FloatArray | None = None
    rms_mm: float | None = None
    n_points: int = 0
    source: str = ""
    tip_diameter_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.covariance is not None:
            covariance = frozen_floats(self.covariance, (3, 3), "covariance")
            object.__setattr__(self, "covariance", covariance)


SAME_POSTURE_MM = 1.0
SAME_POSTURE_RAD = float(np.radians(0.2))
"""An arm that stands still reports its pose to some 0.02 mm and 0.002 degrees; a robot of 0.2 mm
is within it too."""
STANDING_SIGMAS = 10.0


def check_postures(
    stripes: Sequence[PosedStripe],
    exposure_mm: float | None = None,
    exposure_rad: float | None = None,
) -> None:
    """Refuse a posture's name that stands for different poses of the arm.

    Parameters
    ----------
    stripes
        With their postures and poses.
    exposure_mm, exposure_rad
        Scatter of the pose from exposure to exposure where it was given: a worse arm may move
        that much more.

    Raises
    ------
    InputError
        If two exposures of one posture are further apart than an arm that stands still.
    """
    most_mm = max(SAME_POSTURE_MM, STANDING_SIGMAS * (exposure_mm or 0.0))
    most_rad = max(SAME_POSTURE_RAD, STANDING_SIGMAS * (exposure_rad or 0.0))
    seen: dict[str, PosedStripe] = {}
    for stripe in stripes:
        first = seen.setdefault(stripe.posture, stripe)
        change: Pose[Tool, Tool] = first.base_from_tool.inverse() @ stripe.base_from_tool
        moved_mm = float(np.linalg.norm(change.translation_mm))
        turned_rad = float(np.linalg.norm(change.rotation_vector_rad))
        if moved_mm > most_mm or turned_rad > most_rad:
            raise InputError(
                f"posture '{stripe.posture}' has different poses: the arm moved by "
                f"{moved_mm:.1f} mm and {np.degrees(turned_rad):.1f} deg from {first.source} to "
                f"{stripe.source}",
                remedy="give every posture of the arm a view of its own; if the arm stood still, "
                "check that both exposures have their own poses",
            )


N_PAIRS = 80
MAX_COUNTED = 400
LEAST_SIGMA_MM = 1e-4
MAD_TO_SIGMA = 1.4826


def find_straight_points(
    points_mm: FloatArray, tolerance_mm: float, outlier_sigma: float
) -> BoolArray:
    """Mark the points of the one straight, slightly bowed stripe that most points lie on.

    A sheet of light may be bowed by a tenth of a millimetre, so the points are finally compared
    with a parabola; edges of the plate and whatever lies beyond it are left out.

    Parameters
    ----------
    points_mm
        (N, 3) points of one sheet in one exposure.
    tolerance_mm
        Half width of the band about a straight line in which points belong together.
    outlier_sigma
        Robust sigmas from the parabola that are accepted.
    """
    if len(points_mm) < 3:
        return np.zeros(len(points_mm), dtype=np.bool_)
    kept = _most_common_line(points_mm, tolerance_mm)
    for _ in range(4):
        if int(kept.sum()) < 4:
            return kept
        off = _off_parabola_mm(points_mm, kept)
        sigma = max(MAD_TO_SIGMA * float(np.median(off[kept])), LEAST_SIGMA_MM)
        updated = off <= min(outlier_sigma * sigma, tolerance_mm)
        if bool((updated == kept).all()):
            break
        kept = updated
    return kept


def bow_mm(points_mm: FloatArray) -> float:
    """Root mean square distance of (N, 3) points from their straight line."""
    spread = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return float(np.sqrt((spread[1:] ** 2).sum() / len(points_mm)))


def _most_common_line(points_mm: FloatArray, tolerance_mm: float) -> BoolArray:
    """Points within the tolerance of the line through two points that has most of them."""
    sample = points_mm[:: max(1, len(points_mm) // MAX_COUNTED)]
    draw = np.random.default_rng(0).integers(0, len(sample), (N_PAIRS, 2))
    start, chord = sample[draw[:, 0]], sample[draw[:, 1]] - sample[draw[:, 0]]
    length = np.linalg.norm(chord, axis=1)
    usable = length > 5.0 * tolerance_mm
    if not bool(usable.any()):
        return np.ones(len(points_mm), dtype=np.bool_)
    start, direction = start[usable], chord[usable] / length[usable, None]
    counts = [
        int((_off_line_mm(sample, p, d) <= tolerance_mm).sum())
        for p, d in zip(start, direction, strict=True)
    ]
    best = int(np.argmax(counts))
    return np.asarray(_off_line_mm(points_mm, start[best], direction[best]) <= tolerance_mm)


def _off_line_mm(points_mm: FloatArray, start: FloatArray, direction: FloatArray) -> FloatArray:
    offset = points_mm - start
    across = offset - (offset @ direction)[:, None] * direction
    return np.asarray(np.linalg.norm(across, axis=1))


def _off_parabola_mm(points_mm: FloatArray, kept: BoolArray) -> FloatArray:
    centre = points_mm[kept].mean(axis=0)
    _, _, axes = np.linalg.svd(points_mm[kept] - centre, full_matrices=False)
    local = (points_mm - centre) @ axes.T
    along = local[:, 0] / max(float(np.abs(local[kept, 0]).max()), 1e-12)
    basis = np.column_stack([np.ones(len(along)), along, along**2])
    fitted, *_ = np.linalg.lstsq(basis[kept], local[kept, 1:], rcond=None)
    return np.asarray(np.linalg.norm(local[:, 1:] - basis @ fitted, axis=1))


MAX_NODES = 600
LEAST_NODES = 3


@dataclass(frozen=True, slots=True, eq=False)
class PlateNodes:
    """Mean points of short pieces of stripe; for a given pose they say what their points say.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame.
    noise_mm2
        (N, 3, 3) covariance by the stripe's own noise, points taken as independent.
    by_sensor
        (N, 3, P) derivative by the sensor's parameters; None where there is none.
    sheet
        (N,) light sheet.
    stripe
        (N,) index into ``sources``, ``rotations`` and ``translations_mm``.
    posture
        (N,) index into ``postures``.
    rotations, translations_mm
        (S, 3, 3) and (S, 3) ``base_from_tool`` of each stripe.
    sources, postures
        Names.
    sensor_covariance
        (P, P) of the sensor's parameters; None where it is taken as exact.
    """

    points_mm: FloatArray
    noise_mm2: FloatArray
    by_sensor: FloatArray | None
    sheet: IntArray
    stripe: IntArray
    posture: IntArray
    rotations: FloatArray
    translations_mm: FloatArray
    sources: tuple[str, ...]
    postures: tuple[str, ...]
    sensor_covariance: FloatArray | None = None

    def __len__(self) -> int:
        """Count of nodes."""
        return len(self.points_mm)

    def select(self, kept: BoolArray) -> PlateNodes:
        """Keep some nodes; stripes and postures keep their numbers."""
        return replace(
            self,
            points_mm=self.points_mm[kept],
            noise_mm2=self.noise_mm2[kept],
            by_sensor=None if self.by_sensor is None else self.by_sensor[kept],
            sheet=self.sheet[kept],
            stripe=self.stripe[kept],
            posture=self.posture[kept],
        )

    def moved(self, rotations: FloatArray, translations_mm: FloatArray) -> PlateNodes:
        """Give the stripes other poses, (S, 3, 3) and (S, 3)."""
        return replace(self, rotations=rotations, translations_mm=translations_mm)

    @property
    def used_postures(self) -> IntArray:
        """Numbers of the postures that have nodes."""
        return np.unique(self.posture)


def straight_stripes(
    stripes: Sequence[PosedStripe], options: HandEyeOptions
) -> tuple[BoolArray, ...]:
    """Mark, stripe by stripe, the points that lie on one straight line of their sheet."""
    marks = []
    for stripe in stripes:
        kept = np.zeros(len(stripe), dtype=np.bool_)
        for sheet in np.unique(stripe.sheet):
            own = np.flatnonzero(stripe.sheet == sheet)
            straight = find_straight_points(
                stripe.points_mm[own], options.line_tolerance_mm, options.outlier_sigma
            )
            if int(straight.sum()) >= options.min_points:
                kept[own] = straight
        marks.append(kept)
    return tuple(marks)


def condense(
    stripes: Sequence[PosedStripe], kept: Sequence[BoolArray], nodes_per_stripe: int
) -> PlateNodes:
    """Turn the marked points into nodes; at most about `MAX_NODES` of them."""
    n_pieces = sum(
        len(np.unique(stripe.sheet[mark])) for stripe, mark in zip(stripes, kept, strict=True)
    )
    n_nodes = max(LEAST_NODES, min(nodes_per_stripe, MAX_NODES // max(n_pieces, 1)))
    names = tuple(dict.fromkeys(stripe.posture for stripe in stripes))
    parts: list[tuple[FloatArray, FloatArray, FloatArray | None]] = []
    labels: list[tuple[int, int, int]] = []
    for number, (stripe, mark) in enumerate(zip(stripes, kept, strict=True)):
        for sheet in np.unique(stripe.sheet[mark]):
            own = np.flatnonzero(mark & (stripe.sheet == sheet))
            for piece in _pieces(stripe.points_mm[own], n_nodes):
                parts.append(_mean(stripe, own[piece]))
                labels.append((int(sheet), number, names.index(stripe.posture)))
    labelled = np.array(labels, dtype=np.int64).reshape(-1, 3)
    sensors = [part[2] for part in parts if part[2] is not None]
    return PlateNodes(
        np.array([part[0] for part in parts]).reshape(-1, 3),
        np.array([part[1] for part in parts]).reshape(-1, 3, 3),
        np.array(sensors) if sensors and len(sensors) == len(parts) else None,
        labelled[:, 0],
        labelled[:, 1],
        labelled[:, 2],
        np.array([stripe.base_from_tool.rotation for stripe in stripes]).reshape(-1, 3, 3),
        np.array([stripe.base_from_tool.translation_mm for stripe in stripes]).reshape(-1, 3),
        tuple(stripe.source for stripe in stripes),
        names,
    )


def _pieces(points_mm: FloatArray, n_nodes: int) -> list[IntArray]:
    """Places of the points in ``n_nodes`` pieces of equal length along the stripe."""
    centred = points_mm - points_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    along = centred @ axes[0]
    low, high = float(along.min()), float(along.max())
    piece = ((along - low) / max(high - low, 1e-12) * n_nodes).astype(np.int64)
    piece = np.minimum(piece, n_nodes - 1)
    return [np.flatnonzero(piece == k) for k in np.unique(piece)]


def _mean(stripe: PosedStripe, own: IntArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    noise = stripe.noise_mm[own]
    variance = (noise**2).sum(axis=(1, 2))
    floor = max(1e-2 * float(np.median(variance)), 1e-12)
    weights = 1.0 / np.maximum(variance, floor)
    weights /= weights.sum()
    spread = noise * weights[:, None, None]
    by_sensor = None
    if stripe.by_sensor is not None:
        by_sensor = np.tensordot(weights, stripe.by_sensor[own], axes=1)
    return weights @ stripe.points_mm[own], np.einsum("nij,nkj->ik", spread, spread), by_sensor


N_HAND_EYE = 6
N_PLANE = 3


@dataclass(frozen=True, slots=True, eq=False)
class PlateState:
    """A hand-eye, and the plate as two tilts (rad) and an offset (mm) from the probed one.

    The tilts and the offset are `armscan.geometry.shapes.PLANE_PARAMETERS`.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    plane: FloatArray

    def stepped(self, step: FloatArray) -> PlateState:
        """Add a step of (6,) or (9,): hand-eye, and the plate's plane where it is free."""
        pose = step_hand_eye(self.tool_from_sensor, step[:N_HAND_EYE])
        plane = self.plane if len(step) == N_HAND_EYE else self.plane + step[N_HAND_EYE:]
        return PlateState(pose, plane)


def step_hand_eye(pose: Pose[Tool, Sensor], step: FloatArray) -> Pose[Tool, Sensor]:
    """Add (6,) increments in the order of `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`."""
    rotation = nearest_rotation(rotation_from_vector(step[:3]) @ pose.rotation)
    return Pose(rotation, pose.translation_mm + step[3:6])


def hand_eye_difference(pose: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> FloatArray:
    """(6,) increments that lead from ``other`` to ``pose``."""
    turn: Pose[Tool, Tool] = Pose(pose.rotation @ other.rotation.T, np.zeros(3))
    return np.concatenate([turn.rotation_vector_rad, pose.translation_mm - other.translation_mm])


def shifted_plane(plate: Plane, plane: FloatArray) -> Plane:
    """Apply two tilts and an offset (3,) to the plate."""
    raised = plate.axes[2] - plane[0] * plate.axes[0] - plane[1] * plate.axes[1]
    normal = raised / np.linalg.norm(raised)
    across = np.cross(normal, plate.axes[0])
    across /= np.linalg.norm(across)
    return Plane(
        plate.point_mm + plane[2] * normal, np.stack([np.cross(across, normal), across, normal])
    )


@dataclass(frozen=True, slots=True, eq=False)
class PlacedNodes:
    """Nodes placed in Base, and what their distances depend on.

    Parameters
    ----------
    points_base_mm
        (N, 3).
    scan_points_base_mm
        (N, 3) middle of the sensor's working range, as the node's exposure had it.
    normals_tool, normals_sensor
        (N, 3) the plate's normal in Tool (eq. 2.57) and in Sensor.
    residual_mm
        (N,) signed distance from the plate: the misclosure of eq. 2.74.
    by_hand_eye
        (N, 6) its derivative by the hand-eye.
    by_plane
        (N, 3) its derivative by the plate's tilts and offset.
    """

    points_base_mm: FloatArray
    scan_points_base_mm: FloatArray
    normals_tool: FloatArray
    normals_sensor: FloatArray
    residual_mm: FloatArray
    by_hand_eye: FloatArray
    by_plane: FloatArray


def place_nodes(nodes: PlateNodes, plate: Plane, state: PlateState) -> PlacedNodes:
    """Place the nodes with a hand-eye and compare them with the plate."""
    rotations = nodes.rotations[nodes.stripe]
    translations = nodes.translations_mm[nodes.stripe]
    hand_eye = state.tool_from_sensor
    turned = nodes.points_mm @ hand_eye.rotation.T
    middle = hand_eye.rotation @ nodes.points_mm.mean(axis=0) + hand_eye.translation_mm
    placed = np.einsum("nij,nj->ni", rotations, turned + hand_eye.translation_mm) + translations
    local = (placed - plate.point_mm) @ plate.axes.T
    tilt_1, tilt_2, offset = state.plane
    scale = np.sqrt(1.0 + tilt_1**2 + tilt_2**2)
    height = (local[:, 2] - tilt_1 * local[:, 0] - tilt_2 * local[:, 1]) / scale
    normal = (plate.axes[2] - tilt_1 * plate.axes[0] - tilt_2 * plate.axes[1]) / scale
    normals_tool = np.einsum("nij,i->nj", rotations, normal)
    by_plane = -np.column_stack(
        [
            local[:, 0] / scale + height * tilt_1 / scale**2,
            local[:, 1] / scale + height * tilt_2 / scale**2,
            np.ones(len(nodes)),
        ]
    )
    by_hand_eye = np.concatenate([np.cross(turned, normals_tool), normals_tool], axis=1)
    return PlacedNodes(
        placed,
        rotations @ middle + translations,
        normals_tool,
        normals_tool @ hand_eye.rotation,
        height - offset,
        by_hand_eye,
        by_plane,
    )


def residual_by_sensor(nodes: PlateNodes, placed: PlacedNodes) -> FloatArray | None:
    """(N, P) derivative of the residuals by the sensor's parameters; None where not known."""
    if nodes.by_sensor is None:
        return None
    return np.asarray(np.einsum("ni,nip->np", placed.normals_sensor, nodes.by_sensor))


def sensor_covariance(nodes: PlateNodes, placed: PlacedNodes) -> FloatArray | None:
    """(N, N) covariance of the residuals by the sensor's calibration; None where not known."""
    by_sensor = residual_by_sensor(nodes, placed)
    if by_sensor is None or nodes.sensor_covariance is None:
        return None
    return np.asarray(by_sensor @ nodes.sensor_covariance @ by_sensor.T)
