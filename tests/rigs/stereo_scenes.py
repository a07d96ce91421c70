# SPDX-License-Identifier: Apache-2.0
"""What two cameras see of many sheets on plates, balls, waves and steps, at feature level.

Each sheet's fan of rays is traced to the scene; a lit point is seen by a camera unless something
stands between. Pieces of lines whose ends meet are linked as an extraction would link them, also
where they are of different sheets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.camera import CameraModel
from armscan.records.profile import Profile, StripeFlag
from armscan.simulation.objects.shapes import Box, Placed
from armscan.simulation.optics.scene import Floor, Scene, Sphere, Surface
from rigs.stereo_head import WINDOW_PX, StereoHead

KINDS = ("plate", "ball", "waves", "steps")
N_RAYS = 4200
LINE_SIGMA_PX = 2.5
NEIGHBOUR_PX = 4.0 * LINE_SIGMA_PX
REACH_PX = 2.9
SHORTEST_PX = 12.0
GREY = (0.7, 0.7, 0.7)


@dataclass(frozen=True)
class Waves:
    """A rippled floor: ``z = a sin(kx x + ky y + phase)`` of its own frame, seen from above."""

    amplitude_mm: float
    wave_vector: tuple[float, float]
    phase: float

    def height(self, points: FloatArray) -> FloatArray:
        """Height (N,) of points (N, 3) over the ripples."""
        kx, ky = self.wave_vector
        ripple = np.sin(kx * points[:, 0] + ky * points[:, 1] + self.phase)
        return np.asarray(points[:, 2] - self.amplitude_mm * ripple)

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """First crossing downwards, by steps of 0.5 mm and bisection."""
        origins = np.broadcast_to(origins_mm, directions.shape)
        down = -directions[:, 2]
        enter = (origins[:, 2] - self.amplitude_mm - 1e-9) / np.where(down > 1e-6, down, np.nan)
        low = np.maximum(np.nan_to_num(enter, nan=np.inf), 0.0)
        is_open = np.isfinite(low)
        found = np.full(len(low), np.inf)
        step = 0.5
        for _ in range(120):
            if not is_open.any():
                break
            at = np.flatnonzero(is_open)
            here = self.height(origins[at] + (low[at] + step)[:, None] * directions[at])
            hit = at[here < 0.0]
            found[hit] = low[hit]
            is_open[hit] = False
            low[at[here >= 0.0]] += step
        hit = np.flatnonzero(np.isfinite(found))
        a, b = found[hit], found[hit] + step
        for _ in range(30):
            middle = 0.5 * (a + b)
            above = self.height(origins[hit] + middle[:, None] * directions[hit]) > 0.0
            a, b = np.where(above, middle, a), np.where(above, b, middle)
        found[hit] = b
        return found

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """Not needed here."""
        return np.tile([0.0, 0.0, 1.0], (len(points_mm), 1))

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Not needed here."""
        return np.broadcast_to(np.asarray(GREY), points_mm.shape)


def draw_surfaces(kind: str, rng: np.random.Generator) -> tuple[Surface, ...]:
    """A scene of one kind before the head, at 125 to 155 mm, tilted up to 30 degrees."""
    tilt = rng.uniform(-0.5, 0.5, 2)
    turn = rotation_from_vector(np.array([np.pi + tilt[0], tilt[1], 0.0]))
    spin = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)]))
    where = np.array([rng.uniform(-6, 6), rng.uniform(-3, 3), rng.uniform(128, 152)])
    frame: Pose = Pose(turn @ spin, where)
    up = frame.rotation[:, 2]
    floor = Floor(where, up, GREY)
    if kind == "plate":
        return (floor,)
    if kind == "ball":
        radius = rng.choice([17.48, 12.0, 8.0])
        return (floor, Sphere(where + radius * up, radius, GREY))
    if kind == "waves":
        length, angle = rng.uniform(12.0, 40.0), rng.uniform(0.0, 2.0 * np.pi)
        k = 2.0 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
        amplitude = rng.uniform(0.05, 0.12) * length
        return (Placed(Waves(amplitude, (k[0], k[1]), rng.uniform(0, 6)), frame),)
    blocks: list[Surface] = [floor]
    for _ in range(rng.integers(2, 6)):
        size = np.array([rng.uniform(5, 25), rng.uniform(5, 25), rng.uniform(1.0, 20.0)])
        angle = rng.choice([0.0, rng.uniform(0.0, np.pi)])
        at = frame.rotation @ np.array([rng.uniform(-25, 25), rng.uniform(-10, 10), 0.0]) + where
        pose: Pose = Pose(frame.rotation @ rotation_from_vector(np.array([0, 0, angle])), at)
        blocks.append(Placed(Box(size), pose))
    return tuple(blocks)


@dataclass(frozen=True)
class SeenProfile:
    """A profile with its truth: sheet (-1 for stray), point in Sensor, and who else sees it."""

    profile: Profile
    sheet: IntArray
    points_mm: FloatArray
    is_shared: BoolArray

    @property
    def n_segments(self) -> int:
        """Count of linked pieces."""
        return len(np.unique(self.profile.segment))


@dataclass(frozen=True)
class Noise:
    """How bad the pictures are.

    Parameters
    ----------
    sigma_px
        Stripe noise (thesis-like 0.07); correlated over five points.
    n_strays
        Stray lines in each camera, half of them true lines in space that are on no sheet.
    shift_px
        (2,) by which the right picture has drifted since the calibration.
    """

    sigma_px: float = 0.07
    n_strays: int = 0
    shift_px: tuple[float, float] = (0.0, 0.0)


def expose(
    head: StereoHead, surfaces: tuple[Surface, ...], noise: Noise, rng: np.random.Generator
) -> tuple[SeenProfile, SeenProfile]:
    """Stripe points of both cameras."""
    scene = Scene(surfaces)
    left, right = _Pieces(head.views.left), _Pieces(head.views.right)
    pose = head.views.right_from_left
    centre_right = -pose.rotation.T @ pose.translation_mm
    for k, laser in enumerate(head.lasers):
        rays = laser.rays(np.linspace(-0.4, 0.4, N_RAYS))
        hits = scene.trace(laser.source_mm, rays)
        points = hits.points_mm[hits.surface >= 0]
        in_left, q_left = left.see(points, points, np.zeros(3), scene)
        moved = points @ pose.rotation.T + pose.translation_mm
        in_right, q_right = right.see(moved, points, centre_right, scene)
        left.add(points, q_left, in_left, in_right, k)
        right.add(points, q_right + noise.shift_px, in_right, in_left, k)
    for index in range(noise.n_strays):
        start = np.array([*rng.uniform(-25, 25, 2), rng.uniform(120, 160)])
        line = start + np.linspace(0, 1, 600)[:, None] * rng.normal(0, 12, 3)
        moved = line @ pose.rotation.T + pose.translation_mm
        q_left, q_right = head.views.left.project(line), head.views.right.project(moved)
        ok = np.zeros(len(line), dtype=np.bool_)
        if index % 2 == 0 or rng.random() < 0.5:
            left.add(line, q_left, _inside(q_left), ok, -1)
        if index % 2 == 0 or rng.random() < 0.5:
            right.add(line, q_right, _inside(q_right), ok, -1)
    return left.linked("left", noise.sigma_px, rng), right.linked("right", noise.sigma_px, rng)


def _inside(q: FloatArray) -> BoolArray:
    x, y, width, height = WINDOW_PX
    q = np.nan_to_num(q, nan=-1.0)
    inside = (q[:, 0] > x + 8) & (q[:, 0] < x + width - 8)
    return np.asarray(inside & (q[:, 1] > y + 8) & (q[:, 1] < y + height - 8))


class _Pieces:
    """Unbroken pieces of lines in one picture."""

    def __init__(self, camera: CameraModel) -> None:
        self.camera = camera
        self.pieces: list[tuple[FloatArray, FloatArray, BoolArray, int]] = []

    def see(
        self, in_camera: FloatArray, points: FloatArray, centre: FloatArray, scene: Scene
    ) -> tuple[BoolArray, FloatArray]:
        """Which points are seen, and their pixels (0 where there are none)."""
        q = np.nan_to_num(self.camera.project(in_camera), nan=-1.0)
        seen = _inside(q)
        seen[seen] = scene.sees(centre, points[seen])
        return seen, q

    def add(
        self, points: FloatArray, q: FloatArray, seen: BoolArray, other: BoolArray, sheet: int
    ) -> None:
        """Cut a line where it is hidden or jumps, and thin it to one point a pixel."""
        at = np.flatnonzero(seen)
        if len(at) < 3:
            return
        gap = (np.diff(at) > 1) | (np.hypot(*np.diff(q[at], axis=0).T) > REACH_PX)
        for part in np.split(at, np.flatnonzero(gap) + 1):
            arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(q[part], axis=0).T))])
            if arc[-1] < 2.0:
                continue
            whole = np.searchsorted(arc, np.arange(0.0, arc[-1], 1.0))
            chosen = part[np.unique(whole)]
            self.pieces.append((points[chosen], q[chosen], other[chosen], sheet))

    def linked(self, name: str, sigma_px: float, rng: np.random.Generator) -> SeenProfile:
        """The pieces as segments; ends that meet in place and direction are joined."""
        chains = self._chains()
        whole, q, normals = [], [], []
        flat = [[self.pieces[abs(i) - 1] for i in chain] for chain in chains]
        for chain, parts in zip(chains, flat, strict=True):
            pixels = np.concatenate(
                [p[1] if i > 0 else p[1][::-1] for i, p in zip(chain, parts, strict=True)]
            )
            if len(pixels) < 3:
                continue
            whole.append((chain, parts))
            q.append(pixels)
            tangent = np.gradient(pixels, axis=0)
            smooth = np.stack([_averaged(tangent[:, j], 7) for j in (0, 1)], axis=1)
            smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-9)
            normals.append(np.stack([-smooth[:, 1], smooth[:, 0]], axis=1))
        pixels, across = np.concatenate(q), np.concatenate(normals)
        count = [len(x) for x in q]
        segment = np.repeat(np.arange(len(q)), count)

        def gathered(field: int) -> list[FloatArray]:
            return [
                p[field] if i > 0 else p[field][::-1]
                for chain, parts in whole
                for i, p in zip(chain, parts, strict=True)
            ]

        sheet = np.concatenate([np.full(len(p[1]), p[3]) for _, parts in whole for p in parts])
        piece = np.concatenate(
            [
                np.full(len(p[1]), abs(i))
                for chain, parts in whole
                for i, p in zip(chain, parts, strict=True)
            ]
        )
        white = rng.normal(0.0, sigma_px, len(pixels) + 4)
        error = np.convolve(white, np.full(5, 1 / np.sqrt(5)), "valid")
        flags = np.where(_near_other(pixels, piece), int(StripeFlag.NEIGHBOUR), 0)
        length = np.array(count)[segment]
        flags |= np.where(length < SHORTEST_PX, int(StripeFlag.SHORT_SEGMENT), 0)
        n = len(pixels)
        profile = Profile(
            source=name,
            points_px=pixels + error[:, None] * across,
            normals_px=across,
            sigma_px=np.full(n, sigma_px),
            width_px=np.full(n, LINE_SIGMA_PX),
            intensity=np.full(n, 150.0),
            flags=flags,
            segment=segment,
        )
        return SeenProfile(
            profile, sheet, np.concatenate(gathered(0)), np.concatenate(gathered(2)).astype(bool)
        )

    def _chains(self) -> list[list[int]]:
        """Pieces in their order along chains, counted from 1, negative where turned."""
        ends = {}
        for i, (_, q, _, _) in enumerate(self.pieces, start=1):
            m = min(6, len(q) - 1)
            ends[i] = (q[-1], q[-1] - q[-1 - m])
            ends[-i] = (q[0], q[0] - q[m])
        partner: dict[int, int] = {}
        for a, (at, out) in ends.items():
            for b, (other, back) in ends.items():
                if abs(a) == abs(b) or b in partner or a in partner:
                    continue
                if np.hypot(*(at - other)) <= REACH_PX and _cosine(out, -back) > 0.77:
                    partner[a], partner[b] = b, a
        chains, used = [], set()
        for i in range(1, len(self.pieces) + 1):
            if i in used:
                continue
            chain = [i]
            used.add(i)
            while chain[-1] in partner and abs(partner[chain[-1]]) not in used:
                following = -partner[chain[-1]]
                chain.append(following)
                used.add(abs(following))
            while -chain[0] in partner and abs(partner[-chain[0]]) not in used:
                before = partner[-chain[0]]
                chain.insert(0, before)
                used.add(abs(before))
            chains.append(chain)
        return chains


def _cosine(a: FloatArray, b: FloatArray) -> float:
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))


def _averaged(values: FloatArray, n: int) -> FloatArray:
    padded = np.pad(values, n // 2, mode="edge")
    return np.convolve(padded, np.full(n, 1.0 / n), "valid")


def _near_other(q: FloatArray, piece: IntArray) -> BoolArray:
    """(N,) True where another piece, which does not continue this one, is within reach."""
    near = np.zeros(len(q), dtype=np.bool_)
    pairs = cKDTree(q).query_pairs(NEIGHBOUR_PX, output_type="ndarray")
    pairs = pairs[piece[pairs[:, 0]] != piece[pairs[:, 1]]]
    # the next piece of the same line lies ahead, another line beside
    far = np.abs(pairs[:, 0] - pairs[:, 1]) > 3 * NEIGHBOUR_PX
    near[pairs[far].ravel()] = True
    return near
