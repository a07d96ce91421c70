# SPDX-License-Identifier: Apache-2.0
"""Scanners drawn at random, at feature level: lenses, lasers, targets, and what is wrong with them.

Projection, distortion, light and arm are written here, apart from `armscan.models`, so that the
software is judged by optics that are not its own. All lengths in mm, image lengths in px.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import BoolArray, FloatArray

DEGENERATE = {
    "camera": ("two views", "parallel boards", "all boards fronto-parallel"),
    "sheet": ("one board", "boards in one plane"),
    "stereo": ("two pairs", "pairs shuffled"),
    "handeye": ("pure translation", "turns about the plate's normal only", "two postures"),
}
"""By stage, what some instruments are drawn with so that no calibration can be right."""
DEGENERATE_SHARE = 0.12
SIZES_PX = ((640, 480), (1280, 1024), (1920, 1200), (2048, 1536), (3072, 2048), (4096, 3000))


@dataclass(frozen=True)
class Lens:
    """Pinhole with radial and tangential distortion (``k1 k2 p1 p2 k3``)."""

    focal: FloatArray
    centre: FloatArray
    distortion: FloatArray
    width_px: int
    height_px: int

    @property
    def parameters(self) -> FloatArray:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3."""
        return np.concatenate([self.focal, self.centre, self.distortion])

    def moved(self, step: FloatArray) -> Lens:
        """The lens with a step (9,) added to its parameters."""
        p = self.parameters + step
        return replace(self, focal=p[:2], centre=p[2:4], distortion=p[4:])

    def _bent(self, xy: FloatArray) -> FloatArray:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy.T
        r2 = x**2 + y**2
        radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
        bent_y = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=1)

    def project(self, points: FloatArray) -> FloatArray:
        """(N, 2) pixels of points (N, 3) in the camera's frame."""
        return self._bent(points[:, :2] / points[:, 2:]) * self.focal + self.centre

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(N, 3) directions ``(x, y, 1)`` of pixels, by fixed-point steps."""
        wanted = (pixels - self.centre) / self.focal
        xy = wanted.copy()
        for _ in range(60):
            xy = xy - (self._bent(xy) - wanted)
        return np.column_stack([xy, np.ones(len(xy))])

    def sees(self, pixels: FloatArray, rim_px: float = 6.0) -> BoolArray:
        """(N,) inside the image and at least a rim away from its border."""
        far = np.array([self.width_px, self.height_px]) - 1.0 - rim_px
        return np.asarray(((pixels > rim_px) & (pixels < far)).all(axis=1))


@dataclass(frozen=True)
class Light:
    """A laser line: rays from a source that fill a circular cone, as a tilted line lens makes it.

    The cone touches the plane of ``forward`` and ``across`` in its middle ray and rises from it by
    ``cone (|p| - p.forward)``; a twist of ``skew`` (p.across)^3 / (p.forward)^2 is added.
    """

    source: FloatArray
    forward: FloatArray
    across: FloatArray
    cone: float
    skew: float
    half_angle: float
    name: str

    @property
    def normal(self) -> FloatArray:
        """(3,) of the plane without cone."""
        return np.cross(self.forward, self.across)

    def rays(self, n: int) -> FloatArray:
        """(n, 3) directions over the fan."""
        f = np.linspace(-self.half_angle, self.half_angle, n)[:, None]
        along, aside = np.cos(f), np.sin(f)
        rise = np.zeros_like(f)
        for _ in range(8):
            rise = self._rise(along, aside, rise)
        return np.asarray(along * self.forward + aside * self.across + rise * self.normal)

    def height(self, points: FloatArray) -> FloatArray:
        """(N,) distance of points from the surface of light, along the plane's normal."""
        local = points - self.source
        along, aside, up = local @ self.forward, local @ self.across, local @ self.normal
        return np.asarray(up - self._rise(along, aside, up))

    def _rise(self, along: FloatArray, aside: FloatArray, up: FloatArray) -> FloatArray:
        whole = np.sqrt(along**2 + aside**2 + up**2)
        return np.asarray(self.cone * (whole - along) + self.skew * aside**3 / along**2)


@dataclass(frozen=True)
class Print:
    """A target as it was made: places that are stated, and those where the points are."""

    kind: str
    columns: int
    rows: int
    pitch_mm: float
    stated: FloatArray
    missed: FloatArray
    bow_mm: FloatArray

    @property
    def made(self) -> FloatArray:
        """(M, 3) places of the points on the bowed board."""
        flat = self.stated + self.missed
        return flat + self.rise(flat)[:, None] * [0.0, 0.0, 1.0]

    def rise(self, flat: FloatArray) -> FloatArray:
        """(N,) height of the board's surface at places (N, 2 or 3)."""
        half = 0.5 * np.ptp(self.stated[:, :2], axis=0)
        unit = (flat[:, :2] - self.stated[:, :2].mean(axis=0)) / half
        # Rays along the board run out of it without end.
        return np.asarray((1.0 - np.clip(unit, -9.0, 9.0) ** 2) @ self.bow_mm)


@dataclass(frozen=True)
class Placement:
    """Where something is: ``p_there = R p + t``."""

    rotation: FloatArray
    shift: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """(N, 3) moved points."""
        return np.asarray(points @ self.rotation.T + self.shift)

    def back(self, points: FloatArray) -> FloatArray:
        """(N, 3) points moved the other way."""
        return np.asarray((points - self.shift) @ self.rotation)


@dataclass(frozen=True)
class ArmKind:
    """How an arm errs, and how it is used.

    A posture's pose is turned about a point (`rigs.instrument_arm.turning_point`) and shifted;
    ``exposure_share`` of both standard deviations is new in every exposure.
    """

    position_mm: float
    lever_mm: float
    exposure_share: float
    n_postures: int
    n_exposures: int
    spread: str


@dataclass(frozen=True)
class References:
    """Plate and sphere of the hand-eye."""

    flatness_mm: float
    flatness_length_mm: float
    plate_half_mm: float
    probing_mm: float
    n_probed: int
    diameter_mm: float
    has_sphere: bool


@dataclass(frozen=True)
class Instrument:
    """All that is true of one drawn scanner but the errors of its measurements."""

    seed: int
    fault: str
    field_mm: float
    stand_off_mm: float
    angle_deg: float
    left: Lens
    right: Lens | None
    right_from_left: Placement | None
    lights: tuple[Light, ...]
    is_crossed: bool
    target: Print
    target_px: float
    stripe_px: float
    claimed: tuple[float, float]
    n_views: int
    tilt_deg: float
    reach: float
    n_boards: int
    arm: ArmKind
    references: References
    tool_from_sensor: Placement

    @property
    def lasers_alone(self) -> bool:
        """True where the lines are switched on one at a time."""
        return len(self.lights) > 2 or self.seed % 2 == 0

    def rng(self, stage: int) -> np.random.Generator:
        """Noise of one stage."""
        return np.random.default_rng([self.seed, 1000 + stage])


def draw_instrument(seed: int) -> Instrument:
    """One scanner; equal seeds give equal scanners."""
    rng = np.random.default_rng([seed, 77])
    fault = _draw_fault(rng)
    while True:
        field, stand_off = _log(rng, 20.0, 400.0), _log(rng, 60.0, 600.0)
        if 0.8 < stand_off / field < 8.0:
            break
    width, height = SIZES_PX[rng.integers(len(SIZES_PX))]
    angle = float(rng.uniform(15.0, 50.0))
    left = _draw_lens(rng, width, height, width * stand_off / field)
    has_right = bool(rng.random() < 0.4) or fault in DEGENERATE["stereo"]
    right, pose = _draw_right(rng, left, stand_off) if has_right else (None, None)
    is_crossed = bool(rng.random() < 0.5)
    return Instrument(
        seed=seed,
        fault=fault,
        field_mm=field,
        stand_off_mm=stand_off,
        angle_deg=angle,
        left=left,
        right=right,
        right_from_left=pose,
        lights=_draw_lights(rng, field, stand_off, angle, is_crossed),
        is_crossed=is_crossed,
        target=_draw_print(rng, field),
        target_px=_log(rng, 0.02, 0.3),
        stripe_px=_log(rng, 0.02, 0.3),
        claimed=(_log(rng, 0.6, 1.6), _log(rng, 0.6, 1.6)),
        n_views=int(rng.integers(5, 17)),
        tilt_deg=float(rng.uniform(20.0, 45.0)),
        reach=float(rng.uniform(0.05, 0.4)),
        n_boards=int(rng.integers(3, 11)),
        arm=_draw_arm(rng, fault),
        references=_draw_references(rng, field),
        tool_from_sensor=Placement(
            Rotation.random(random_state=rng).as_matrix(), rng.uniform(-120.0, 120.0, 3)
        ),
    )


def _draw_fault(rng: np.random.Generator) -> str:
    stage = rng.choice(list(DEGENERATE))
    kind = str(rng.choice(DEGENERATE[stage]))
    return kind if rng.random() < DEGENERATE_SHARE else ""


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _draw_lens(rng: np.random.Generator, width: int, height: int, focal: float) -> Lens:
    """Distortion of up to 1.5 % of the image at its corner, and no fold inside of it."""
    while True:
        corner = 0.5 * np.hypot(width, height) / focal
        bend = rng.uniform(-0.03, 0.015)
        k1 = bend / corner**2
        k2 = rng.normal(0.0, 0.25) * bend / corner**4
        k3 = (rng.random() < 0.5) * rng.normal(0.0, 0.08) * bend / corner**6
        p1, p2 = rng.normal(0.0, 4e-4, 2) / max(corner, 0.3)
        lens = Lens(
            focal * (1.0 + rng.normal(0.0, [0.0, 0.0007], 2)),
            0.5 * np.array([width, height]) * (1.0 + rng.normal(0.0, 0.015, 2)),
            np.array([k1, k2, p1, p2, k3]),
            width,
            height,
        )
        r2 = np.linspace(0.0, 1.3 * corner, 50) ** 2
        slope = 1.0 + 3.0 * k1 * r2 + 5.0 * k2 * r2**2 + 7.0 * k3 * r2**3
        if slope.min() > 0.5:
            return lens


def _draw_right(rng: np.random.Generator, left: Lens, stand_off: float) -> tuple[Lens, Placement]:
    """A second camera that looks at the middle of the field from any side."""
    base, azimuth = np.radians(rng.uniform(8.0, 50.0)), rng.uniform(0.0, 2.0 * np.pi)
    middle = np.array([0.0, 0.0, stand_off])
    aside = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    far = stand_off * rng.uniform(0.9, 1.1)
    place = middle + far * (np.sin(base) * aside - np.cos(base) * np.array([0.0, 0.0, 1.0]))
    z = (middle - place) / np.linalg.norm(middle - place)
    turn = Rotation.from_rotvec(base * np.cross(z, [0.0, 0.0, 1.0]) / max(np.sin(base), 1e-9))
    roll = Rotation.from_rotvec(np.radians(rng.normal(0.0, 3.0)) * np.array([0.0, 0.0, 1.0]))
    rotation = (roll * turn).as_matrix()
    lens = _draw_lens(rng, left.width_px, left.height_px, left.focal[0] * rng.uniform(0.95, 1.05))
    return lens, Placement(rotation, -rotation @ place)


def _draw_lights(
    rng: np.random.Generator, field: float, stand_off: float, angle_deg: float, is_crossed: bool
) -> tuple[Light, ...]:
    """One to fifteen lines; parallel ones turn about their common direction, crossed ones do not.

    All come from one side at the triangulation angle, and lie at most 55 degrees from the
    direction that measures best.
    """
    n = int(rng.choice([1, 1, 2, 2, 3, 5, 11, 15]))
    if is_crossed and n > 2:
        n = int(rng.integers(2, 6))
    side, theta = rng.uniform(0.0, 2.0 * np.pi), np.radians(angle_deg)
    aside = np.array([np.cos(side), np.sin(side), 0.0])
    level = np.cross([0.0, 0.0, 1.0], aside)
    middle = np.array([0.0, 0.0, stand_off])
    reach = 0.9 * stand_off / np.cos(theta)
    forward = np.sin(theta) * aside + np.cos(theta) * np.array([0.0, 0.0, 1.0])
    source = middle - reach * forward
    half = np.arctan(0.75 * field / reach)
    turns = np.zeros(n)
    if is_crossed and n > 1:
        turns = np.radians(np.linspace(-50.0, 50.0, n) + rng.uniform(-5.0, 5.0, n))
    elif n == 1:
        turns = np.radians(rng.uniform(-50.0, 50.0, 1))
    steps = np.zeros(n)
    if not is_crossed:
        width = 0.5 * field / reach * rng.uniform(0.4, 1.0)
        steps = (np.arange(n) - 0.5 * (n - 1)) * width / max(n - 1, 1)
    straight = rng.random() < 0.3
    lights = []
    for k in range(n):
        tilted = Rotation.from_rotvec(steps[k] * level).apply(forward)
        across = Rotation.from_rotvec(turns[k] * tilted).apply(level)
        bow = 0.0 if straight else rng.normal(0.0, 2e-3) * 0.5 * field
        cone = 2.0 * bow * reach / (0.5 * field) ** 2
        skew = 0.03 * rng.normal() * bow * reach**2 / (0.5 * field) ** 3
        name = f"{chr(65 + k)}"
        lights.append(Light(source, tilted, across, cone, skew, float(half), name))
    return tuple(lights)


def _draw_print(rng: np.random.Generator, field: float) -> Print:
    """Any grid; the errors are those of a good to a poor print, for its size."""
    kind = str(rng.choice(["circles", "chessboard"]))
    columns, rows = int(rng.integers(7, 14)), int(rng.integers(5, 11))
    pitch = field * rng.uniform(0.35, 0.8) / (columns - 1)
    j, i = np.mgrid[:rows, :columns]
    stated = np.stack([i, j, 0.0 * i], axis=-1).reshape(-1, 3) * pitch
    sigma = 0.0 if rng.random() < 0.4 else field * _log(rng, 5e-6, 5e-5)
    missed = np.zeros_like(stated)
    missed[:, :2] = sigma * rng.normal(size=(len(stated), 2))
    size = 0.0 if rng.random() < 0.5 else field * _log(rng, 1e-5, 2e-4)
    return Print(kind, columns, rows, pitch, stated, missed, size * rng.normal(0.0, 0.7, 2))


def _draw_arm(rng: np.random.Generator, fault: str) -> ArmKind:
    position = _log(rng, 0.005, 0.2)
    n = int(rng.integers(7, 15))
    spread = "all round"
    if rng.random() < 0.25:
        n, spread = int(rng.integers(4, 7)), str(rng.choice(["all round", "one side"]))
    elif rng.random() < 0.15:
        spread = str(rng.choice(["one side", "nearly parallel"]))
    if fault == "two postures":
        n = 2
    exposures = int(rng.choice([1, 1, 1, 2]))
    share = float(rng.uniform(0.1, 0.6)) if exposures > 1 else 0.0
    return ArmKind(position, _log(rng, 30.0, 300.0), share, n, exposures, spread)


def _draw_references(rng: np.random.Generator, field: float) -> References:
    """Flatness is a standard deviation, a fifth of the peak to valley of up to 0.1 mm."""
    return References(
        flatness_mm=0.2 * _log(rng, 0.001, 0.1),
        flatness_length_mm=_log(rng, 30.0, 300.0),
        plate_half_mm=max(0.8 * field, 60.0),
        probing_mm=_log(rng, 0.003, 0.05),
        n_probed=int(rng.integers(12, 65)),
        diameter_mm=float(field * rng.uniform(0.2, 0.6)),
        has_sphere=bool(rng.random() < 0.4),
    )


def board_placements(
    made: Instrument, rng: np.random.Generator, n: int, *, for_sheets: bool
) -> list[Placement]:
    """Targets before the head, of which at least half of the points are seen by every camera.

    Degenerate instruments get theirs: parallel, fronto-parallel, or in one plane.
    """
    found: list[Placement] = []
    middle_of_board = made.target.stated.mean(axis=0)
    fault = made.fault
    held = Rotation.from_rotvec(0.3 * np.array([1.0, 0.4, 0.0]))
    reach = made.reach
    for attempt in range(4000):
        if len(found) == n:
            break
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        tilt = np.radians(made.tilt_deg) * np.sqrt(rng.random())
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        spin = Rotation.from_rotvec([0.0, 0.0, 0.25 * rng.normal()])
        depth = made.stand_off_mm * rng.uniform(0.87, 1.15)
        shift = (0.6 if attempt > 1000 else 1.0) * reach * rng.uniform(-1.0, 1.0, 2)
        if for_sheets:
            depth = made.stand_off_mm + 0.2 * made.field_mm * rng.uniform(-1.0, 1.0)
            shift = shift * 0.5
            if fault == "boards in one plane":
                turn, depth, shift = held, made.stand_off_mm, 0.0 * shift
        elif fault == "parallel boards":
            turn = held
        elif fault == "all boards fronto-parallel":
            turn = Rotation.identity()
        rotation = (turn * spin).as_matrix()
        if fault in ("parallel boards", "all boards fronto-parallel") and not for_sheets:
            rotation = turn.as_matrix()
        sight = shift * [made.left.width_px, made.left.height_px] / made.left.focal
        middle = np.array([*(sight * depth), depth])
        place = Placement(rotation, middle - rotation @ middle_of_board)
        if all(_is_shown(made, place, side) for side in range(1 if made.right is None else 2)):
            found.append(place)
    return found


def _is_shown(made: Instrument, place: Placement, side: int) -> bool:
    points = in_camera(made, place.apply(made.target.made), side)
    if points[:, 2].min() < 0.2 * made.stand_off_mm:
        return False
    shown = lens_of(made, side).sees(lens_of(made, side).project(points))
    slant = abs(float(place_normal(made, place, side) @ points.mean(axis=0)))
    return bool(shown.mean() > 0.5) and slant > 0.45 * float(np.linalg.norm(points.mean(axis=0)))


def place_normal(made: Instrument, place: Placement, side: int) -> FloatArray:
    """(3,) normal of a board in a camera's frame."""
    normal = place.rotation[:, 2]
    if side and made.right_from_left is not None:
        normal = made.right_from_left.rotation @ normal
    return np.asarray(normal)


def lens_of(made: Instrument, side: int) -> Lens:
    """Left (0) or right (1) lens."""
    return made.left if side == 0 or made.right is None else made.right


def in_camera(made: Instrument, points: FloatArray, side: int) -> FloatArray:
    """(N, 3) points of the left camera's frame in that of a camera."""
    if side == 0 or made.right_from_left is None:
        return points
    return made.right_from_left.apply(points)


def lit_on_board(made: Instrument, light: Light, place: Placement, n: int = 240) -> FloatArray:
    """(K, 3) points of one line on a board's surface, within the target, in the left frame."""
    source, rays = place.back(light.source[None])[0], light.rays(n) @ place.rotation
    distance = -source[2] / np.where(np.abs(rays[:, 2]) > 1e-6, rays[:, 2], np.nan)
    for _ in range(6):
        points = source + distance[:, None] * rays
        distance = distance + (made.target.rise(points) - points[:, 2]) / rays[:, 2]
    points = source + distance[:, None] * rays
    low, high = made.target.stated.min(axis=0)[:2], made.target.stated.max(axis=0)[:2]
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1) & (distance > 0.0)
    return place.apply(points[inside])


def seen_stripe(
    made: Instrument, points: FloatArray, side: int, n: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """About n stripe centres (N, 2) with noise, normals (N, 2), and the true points (N, 3)."""
    lens = lens_of(made, side)
    q = lens.project(in_camera(made, points, side)) if len(points) else np.zeros((0, 2))
    seen = lens.sees(q)
    points, q = points[seen], q[seen]
    if len(q) < 25:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 3))
    along = np.gradient(q, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rows = np.unique(np.linspace(0, len(q) - 1, n).astype(int))
    noisy = q[rows] + made.stripe_px * rng.normal(size=(len(rows), 1)) * normal[rows]
    return noisy, normal[rows], points[rows]
