# SPDX-License-Identifier: Apache-2.0
"""A cross-line head moved by hand over height fields: stripe features with known sheets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Base, Points, Pose, Sensor
from armscan.models.calibration import CameraCalibration, SensorCalibration, SheetCalibration
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.records.profile import Profile, StripeFlag
from armscan.simulation.arm.hand import HeadOrientation, sensor_over, sway
from rigs.sheet_rig import PROVENANCE
from rigs.thesis_instrument import CAMERA, DISTORTION, IMAGE_PX

PLANES = {
    "A": np.array([-0.659905, -0.551732, 0.51, -68.7215]),
    "B": np.array([0.76417, -0.543156, 0.34787, -49.616]),
}
"""Printed cross sheets a b c D, camera frame, mm."""
Planes = dict[str, FloatArray]
NAMES = ("A", "B")
WINDOW = (207.0, 624.0, 207.0 + 2658.0, 624.0 + 800.0)
MIDDLE_DEPTH_MM = 138.0
HALF_ANGLE_RAD = 0.32
TICK_NS = 12_500_000
N_RAYS = 800
WIDTH_PX = 2.8
NEIGHBOUR_PX = 4.5 * WIDTH_PX
MERGED_PX = 4.0
STEP_PX = 1.4
"""Distance of points along a stripe at 45 degrees that is measured in every row."""

HeightField = Callable[[FloatArray, FloatArray], FloatArray]


def _plate(x: FloatArray, _y: FloatArray) -> FloatArray:
    return np.zeros_like(x)


def _ball(x: FloatArray, y: FloatArray) -> FloatArray:
    left = 17.48**2 - x * x - y * y
    return np.where(left > 0.0, np.sqrt(np.maximum(left, 0.0)), -90.0)


def _steps(x: FloatArray, y: FloatArray) -> FloatArray:
    high = (np.abs(x + 19.0) < 11.0) & (np.abs(y) < 15.0)
    low = (np.abs(x - 19.0) < 11.0) & (np.abs(y) < 15.0)
    return np.where(high, 20.0, np.where(low, 5.0, 0.0))


def _waves(x: FloatArray, y: FloatArray) -> FloatArray:
    return 2.0 * np.sin(2.0 * np.pi * x / 20.0) * np.cos(2.0 * np.pi * y / 26.0)


def _part(x: FloatArray, y: FloatArray) -> FloatArray:
    """A body with bosses, a groove and an edge beyond which nothing is seen."""
    top = 4.0 - 0.004 * (x * x + y * y)
    for cx, cy, height, size in ((-16, 4, 7, 6), (3, -8, 5, 4), (17, 6, 9, 5), (-4, 14, 4, 3)):
        top = top + height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * size**2))
    groove = (np.abs(x - 8.0 + 0.3 * y) < 1.5) & (y > -14.0)
    return np.where((x / 38.0) ** 2 + (y / 24.0) ** 2 < 1.0, top - 3.0 * groove, -90.0)


SCENES: dict[str, HeightField] = {
    "plate": _plate,
    "ball": _ball,
    "steps": _steps,
    "waves": _waves,
    "part": _part,
}
_LIFT_MM = {"ball": 12.0, "steps": 8.0, "part": 5.0}
LOWEST_MM, HIGHEST_MM = -12.0, 24.0


@dataclass(frozen=True)
class Disturbance:
    """What is imperfect; standard deviations, and shares of stripes."""

    sigma_px: float = 0.06
    pose_mm: float = 0.01
    pose_rad: float = 2e-5
    sheet_mm: float = 0.01
    holes_per_stripe: float = 0.5
    strays_per_exposure: float = 0.0
    tilt_deg: float = 1.5


THESIS = Disturbance()
HARSH = Disturbance(0.15, 0.03, 6e-5, 0.03, 4.0, 0.3, 3.0)


@dataclass(frozen=True, eq=False)
class CrossExposure:
    """Stripe points of one exposure and the sheet that truly drew each; -1 for stray light."""

    profile: Profile
    true_sheet: IntArray
    lasers: tuple[str, ...]
    base_from_sensor: Pose[Base, Sensor]
    t_ns: int


def camera() -> CameraModel:
    """The printed camera."""
    return CameraModel.from_parameters([*CAMERA, *DISTORTION], *IMAGE_PX)


def _at_depth(depth_mm: float, planes: Planes = PLANES) -> FloatArray:
    """Point of the line in which the two sheets meet."""
    a, b = (plane / np.linalg.norm(plane[:3]) for plane in planes.values())
    level = np.array([0.0, 0.0, 1.0])
    right = np.array([-a[3], -b[3], depth_mm])
    return np.asarray(np.linalg.solve(np.stack([a[:3], b[:3], level]), right))


def _turned(*directions_deg: float) -> Planes:
    """Sheets through the same line, whose stripes run so in the image of a wall."""
    foot, middle = _at_depth(0.0), _at_depth(MIDDLE_DEPTH_MM)
    planes = {}
    for name, angle in zip(NAMES, np.radians(directions_deg), strict=True):
        n = np.cross(middle - foot, [np.cos(angle), np.sin(angle), 0.0])
        n /= np.linalg.norm(n)
        planes[name] = np.array([*n, -float(n @ foot)])
    return planes


HEADS: dict[str, Planes] = {
    "thesis": PLANES,
    "flat": _turned(-25.0, 30.0),
    "skew": _turned(-15.0, 65.0),
    "steep": _turned(-62.0, 60.0),
}
"""Heads whose stripes cross at 105 degrees (printed), 55, 80 and 122; the laser lies at 97."""


def light_sheet(name: str, planes: Planes = PLANES) -> LightSheet:
    """One sheet without bow, its depth along e_v; the printed one unless planes are given."""
    n = planes[name][:3] / np.linalg.norm(planes[name][:3])
    along = np.cross(n, [0.0, 0.0, 1.0])
    along /= np.linalg.norm(along)
    axes = np.stack([along, np.cross(n, along), n])
    return LightSheet(
        origin_mm=_at_depth(MIDDLE_DEPTH_MM, planes), axes=axes, scale_mm=20.0, bow_mm=np.zeros(5)
    )


def sensor(sheet_error_mm: FloatArray | None = None, planes: Planes = PLANES) -> SensorCalibration:
    """The head's calibration, each sheet shifted along its normal by an error."""
    error = np.zeros(2) if sheet_error_mm is None else sheet_error_mm
    box = np.array([0.0, 0.0, IMAGE_PX[0] - 1.0, IMAGE_PX[1] - 1.0])
    calibrated = CameraCalibration(
        camera=camera(),
        covariance=np.zeros((9, 9)),
        has_covariance=True,
        rms_px=0.1,
        sigma_point_px=0.05,
        n_views=9,
        n_points=99,
        covered_px=box,
        provenance=PROVENANCE,
    )
    sheets = []
    for k, name in enumerate(NAMES):
        shift = np.array([0.0, 0.0, error[k], 0.0, 0.0, 0.0, 0.0, 0.0])
        sheet = light_sheet(name, planes).updated(shift)
        sheets.append(
            SheetCalibration(
                name=name,
                sheet=sheet,
                rms_mm=0.01,
                n_boards=8,
                n_points=900,
                depth_range_mm=(112.0, 168.0),
                is_redundant=True,
            )
        )
    return SensorCalibration(
        camera=calibrated,
        sheets=tuple(sheets),
        covariance=np.zeros((25, 25)),
        provenance=PROVENANCE,
    )


@dataclass(eq=False)
class CrossStroke:
    """One stroke of a hand over a scene, drawn from a seed; any lasers can be on."""

    scene: str
    seed: int
    disturbance: Disturbance = THESIS
    n_exposures: int = 48
    lowest_mm_s: float = 50.0
    highest_mm_s: float = 150.0
    head: str = "thesis"

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, list(SCENES).index(self.scene)])
        self.field = SCENES[self.scene]
        self.camera = camera()
        self.planes = HEADS[self.head]
        self.sensor = sensor(self.disturbance.sheet_mm * rng.standard_normal(2), self.planes)
        self.poses = self._walk(rng)
        self._cache: dict[tuple[int, int], list[FloatArray]] = {}

    def _walk(self, rng: np.random.Generator) -> list[Pose[Base, Sensor]]:
        times = np.arange(self.n_exposures) * TICK_NS * 1e-9
        mean = rng.uniform(1.2 * self.lowest_mm_s, self.highest_mm_s / 1.2)
        speed = mean * (1.0 + 0.25 * sway(rng, times))
        speed = np.clip(speed, self.lowest_mm_s, self.highest_mm_s)
        self.way_mm = np.cumsum(speed) * TICK_NS * 1e-9
        way = self.way_mm - 0.5 * self.way_mm[-1]
        heading = rng.uniform(0.0, 2.0 * np.pi)
        tilt, lean, roll = rng.uniform(-30.0, -12.0), rng.uniform(-10.0, 10.0), rng.uniform(0, 360)
        size = self.disturbance.tilt_deg
        stray = [s * sway(rng, times) for s in (size, size, size, 1.0, 1.5)]
        lift = _LIFT_MM.get(self.scene, 0.0)
        poses = []
        for k in range(self.n_exposures):
            along = np.array([np.cos(heading), np.sin(heading), 0.0])
            across = np.array([-along[1], along[0], 0.0])
            spot = way[k] * along + stray[4][k] * across + [0.0, 0.0, lift]
            depth = MIDDLE_DEPTH_MM + stray[3][k]
            aim = HeadOrientation(tilt + stray[0][k], lean + stray[1][k], roll + stray[2][k], depth)
            poses.append(sensor_over(np.eye(3), spot, aim, _at_depth(depth, self.planes)))
        return poses

    def t_ns(self, index: int) -> int:
        """Mid-exposure time."""
        return 1_000_000_000 + index * TICK_NS

    def stripes(self, index: int, sheet: int) -> list[FloatArray]:
        """True pieces (N, 2) of one sheet's stripe in the image, about 1.4 px apart."""
        if (index, sheet) not in self._cache:
            self._cache[index, sheet] = self._draw(index, sheet)
        return self._cache[index, sheet]

    def _draw(self, index: int, sheet: int) -> list[FloatArray]:
        pose = self.poses[index]
        plane = self.planes[NAMES[sheet]]
        n = plane[:3] / np.linalg.norm(plane[:3])
        source = _at_depth(0.0, self.planes)
        forward = _at_depth(MIDDLE_DEPTH_MM, self.planes) - source
        forward /= np.linalg.norm(forward)
        fan = np.linspace(-HALF_ANGLE_RAD, HALF_ANGLE_RAD, N_RAYS)[:, None]
        rays = np.cos(fan) * forward + np.sin(fan) * np.cross(n, forward)
        hits, is_hit = self._first_hit(
            pose.rotation @ source + pose.translation_mm, rays @ pose.rotation.T
        )
        is_seen = is_hit & self._sees(hits, pose.translation_mm)
        in_sensor: Points[Base] = Points(np.where(is_seen[:, None], hits, pose.translation_mm + 1))
        pixels = self.camera.project((pose.inverse() @ in_sensor).xyz_mm)
        x, y = pixels.T
        is_seen &= (x > WINDOW[0]) & (x < WINDOW[2]) & (y > WINDOW[1]) & (y < WINDOW[3])
        step = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
        jump = np.linalg.norm(np.diff(hits, axis=0), axis=1)
        joined = is_seen[1:] & is_seen[:-1] & (step < 20.0) & (jump < 1.0)
        return _resampled(pixels, joined)

    def _first_hit(self, source: FloatArray, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
        down = -rays[:, 2]
        near, far = (source[2] - HIGHEST_MM) / down, (source[2] - LOWEST_MM) / down
        grid = near[:, None] + (far - near)[:, None] * np.linspace(0.0, 1.0, 110)
        below = self._height(source, rays, grid) < 0.0
        first = below.argmax(axis=1)
        is_hit = below.any(axis=1) & (first > 0)
        rows = np.arange(len(rays))
        low, high = grid[rows, np.maximum(first - 1, 0)], grid[rows, first]
        for _ in range(22):
            middle = 0.5 * (low + high)
            inside = self._height(source, rays, middle[:, None])[:, 0] < 0.0
            high, low = np.where(inside, middle, high), np.where(inside, low, middle)
        return source + low[:, None] * rays, is_hit

    def _sees(self, points: FloatArray, eye: FloatArray) -> BoolArray:
        ray = eye - points
        reach = np.clip((HIGHEST_MM + 0.1 - points[:, 2]) / ray[:, 2], 0.0, 1.0)
        share = reach[:, None] * np.linspace(0.01, 1.0, 50)
        x = points[:, :1] + share * ray[:, :1]
        y = points[:, 1:2] + share * ray[:, 1:2]
        z = points[:, 2:] + share * ray[:, 2:]
        return np.asarray((z - self.field(x, y) > -1e-3).all(axis=1))

    def _height(self, source: FloatArray, rays: FloatArray, reach: FloatArray) -> FloatArray:
        x, y, z = (source[k] + reach * rays[:, k : k + 1] for k in range(3))
        return np.asarray(z - self.field(x, y))

    def expose(self, index: int, lasers: tuple[str, ...]) -> CrossExposure:
        """Stripe points as an extraction finds them; the same for the same lasers every time."""
        rng = np.random.default_rng([self.seed, 7, index])
        d = self.disturbance
        drawn = [
            (k, piece) for k in range(2) if NAMES[k] in lasers for piece in self.stripes(index, k)
        ]
        drawn = [item for k, piece in drawn for item in _with_holes(k, piece, d, rng)]
        for _ in range(rng.poisson(d.strays_per_exposure)):
            drawn.append((-1, _stray(rng)))
        profile, truth = _as_chains(drawn, d.sigma_px, rng, f"{self.scene}-{index:03d}")
        error: Pose[Base, Base] = Pose.from_vectors(
            d.pose_rad * rng.standard_normal(3), d.pose_mm * rng.standard_normal(3)
        )
        pose = self.poses[index]
        measured = replace(
            pose,
            rotation=error.rotation @ pose.rotation,
            translation_mm=pose.translation_mm + error.translation_mm,
        )
        return CrossExposure(profile, truth, lasers, measured, self.t_ns(index))


def _resampled(pixels: FloatArray, joined: BoolArray) -> list[FloatArray]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], joined, [False]]).astype(int)))
    pieces = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        run = pixels[first : last + 1]
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(run, axis=0), axis=1))])
        if way[-1] < 15.0:
            continue
        at = np.arange(0.0, way[-1], STEP_PX)
        pieces.append(np.stack([np.interp(at, way, run[:, k]) for k in range(2)], axis=1))
    return pieces


def _with_holes(
    sheet: int, piece: FloatArray, d: Disturbance, rng: np.random.Generator
) -> list[tuple[int, FloatArray]]:
    keep = np.ones(len(piece), dtype=bool)
    for _ in range(rng.poisson(d.holes_per_stripe)):
        start = int(rng.integers(0, len(piece)))
        keep[start : start + int(rng.integers(4, 40))] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(int)))
    parts = [piece[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(sheet, part) for part in parts if len(part) >= 12]


def _stray(rng: np.random.Generator) -> FloatArray:
    start = np.array([rng.uniform(400, 2600), rng.uniform(700, 1350)])
    angle = rng.uniform(0.0, np.pi)
    way = np.arange(0.0, rng.uniform(20.0, 80.0), STEP_PX)[:, None]
    return np.asarray(start + way * [np.cos(angle), np.sin(angle)])


def _as_chains(
    drawn: list[tuple[int, FloatArray]], sigma_px: float, rng: np.random.Generator, source: str
) -> tuple[Profile, IntArray]:
    """Points with noise and flags; every second chain follows the other line past a crossing."""
    points = np.concatenate([piece for _, piece in drawn]) if drawn else np.zeros((0, 2))
    truth = np.concatenate([np.full(len(p), k) for k, p in drawn]) if drawn else np.zeros(0, int)
    near = np.full(len(points), np.inf)
    for k in np.unique(truth):
        own, other = truth == k, truth != k
        if other.any():
            near[own] = cKDTree(points[other]).query(points[own])[0]
    chains = _split_and_swap(drawn, near, rng)
    order = np.concatenate(chains).astype(np.int64) if chains else np.zeros(0, np.int64)
    segment = (
        np.concatenate([np.full(len(c), i) for i, c in enumerate(chains)]) if chains else order
    )
    tangents = [np.gradient(piece, axis=0) for _, piece in drawn]
    tangent = np.concatenate(tangents) if tangents else points
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    normals = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    noisy = points + sigma_px * rng.standard_normal((len(points), 1)) * normals
    flags = np.where(near < NEIGHBOUR_PX, int(StripeFlag.NEIGHBOUR), 0)
    n = len(order)
    profile = Profile(
        source=source,
        points_px=noisy[order],
        normals_px=normals[order],
        sigma_px=np.full(n, sigma_px),
        width_px=np.full(n, WIDTH_PX),
        intensity=np.full(n, 150.0),
        flags=flags[order],
        segment=segment,
    )
    return profile, truth[order].astype(np.int64)


def _split_and_swap(
    drawn: list[tuple[int, FloatArray]], near: FloatArray, rng: np.random.Generator
) -> list[IntArray]:
    """Rows of each chain; a piece that meets another is cut there and may go on as the other."""
    chains: list[IntArray] = []
    cut: list[int] = []
    start = 0
    for _, piece in drawn:
        rows = np.arange(start, start + len(piece))
        start += len(piece)
        merged = near[rows] < MERGED_PX
        if not merged.any():
            chains.append(rows)
            continue
        middle = int(np.flatnonzero(merged).mean())
        cut.append(len(chains))
        chains += [rows[: max(middle - 2, 1)], rows[middle + 2 :]]
    if len(cut) == 2 and rng.random() < 0.5:
        i, j = cut
        a, b = (
            np.concatenate([chains[i], chains[j + 1]]),
            np.concatenate([chains[j], chains[i + 1]]),
        )
        chains[i], chains[j], chains[i + 1], chains[j + 1] = a, b, a[:0], b[:0]
    else:
        for i in cut:
            chains[i], chains[i + 1] = np.concatenate([chains[i], chains[i + 1]]), chains[i][:0]
    return [chain for chain in chains if len(chain)]
