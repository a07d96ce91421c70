# SPDX-License-Identifier: Apache-2.0
"""Names of the lines of a drawn instrument that sweeps over a plate with a block, one camera."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Pose
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.labels import PointStatus, SingleLabeller
from armscan.records.profile import Profile, StripeFlag
from rigs.instrument_stages import Outcome
from rigs.instruments import Instrument, Light, Placement, seen_stripe

N_EXPOSURES = 20
TICK_NS = 12_500_000
WIDTH_PX = 2.8
MOST_WRONG = 0.001
"""Share of the named points, as the limit for scenes says."""


def run_naming(
    made: Instrument, sensor: SensorCalibration, names: Sequence[int]
) -> Iterator[Outcome]:
    """Two crossed lines by their past and rays; one line, or unnamed parallel ones, by depth."""
    lights = [made.lights[k] for k in names]
    is_cross = made.is_crossed and len(lights) == 2
    labeller = CrossLabeller(sensor) if is_cross else SingleLabeller(sensor)
    stage = "names, crossed lines" if is_cross else "names, one image"
    rng, wrong, named, asked = made.rng(40), 0, 0, 0
    begun = time.process_time()
    block = made.field_mm * np.array([0.15, 0.12, rng.uniform(0.02, 0.15)])
    try:
        for k, head in enumerate(_sweep(made, rng)):
            profile, truth = _exposed(made, lights, head, block, rng, f"image{k:02d}")
            if not len(profile):
                continue
            pose: Pose = Pose(head.rotation, head.shift)
            time_ns = 1_000_000_000 + k * TICK_NS
            lasers = tuple(sheet.name for sheet in sensor.sheets) if is_cross else ()
            found = labeller.label([profile], lasers, pose, time_ns).profiles[0]
            is_named = found.status == int(PointStatus.MEASURED)
            wrong += int((is_named & (found.sheet != truth)).sum())
            named, asked = named + int(is_named.sum()), asked + len(profile)
    except ArmscanError as error:
        # What several lines in one image are, nothing but their depth tells.
        result = "rightly refused" if len(lights) > 1 and not is_cross else "wrongly refused"
        yield Outcome(stage, result, str(error), seconds=time.process_time() - begun)
        return
    share = wrong / max(named, 1)
    yield Outcome(
        stage,
        "right" if share < MOST_WRONG else "wrong",
        f"{wrong} of {named} named points wrong" if wrong else "",
        groups={"wrong": float(wrong), "named": float(named), "points": float(asked)},
        seconds=time.process_time() - begun,
    )


def _sweep(made: Instrument, rng: np.random.Generator) -> list[Placement]:
    """The head over the block, leaning a little, half a hundredth of the field an exposure."""
    lean = Rotation.from_rotvec([np.pi + rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0.0])
    rotation = (Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 6.0)]) * lean).as_matrix()
    heading = rng.uniform(0.0, 2.0 * np.pi)
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    heads = []
    for k in range(N_EXPOSURES):
        spot = along * made.field_mm * (0.01 * (k - 0.5 * N_EXPOSURES))
        heads.append(Placement(rotation, spot - rotation[:, 2] * made.stand_off_mm))
    return heads


def _lit(light: Light, head: Placement, block: FloatArray) -> FloatArray:
    """(N, 3) points of one line on floor and block that the camera sees, in the head's frame."""
    source = head.apply(light.source[None])[0]
    rays = light.rays(700) @ head.rotation.T
    rays = rays[rays[:, 2] < -1e-3]
    top, on_top = _at_height(source, rays, block)
    floor = source - (source[2] / rays[:, 2])[:, None] * rays
    is_inside = (np.abs(floor[:, :2]) < block[:2]).all(axis=1)
    eye = head.shift
    _, is_hidden = _at_height(eye, floor - eye, block)
    kept = on_top | ~(is_inside | is_hidden)
    return head.back(np.where(on_top[:, None], top, floor)[kept])


def _at_height(
    origin: FloatArray, rays: FloatArray, block: FloatArray
) -> tuple[FloatArray, FloatArray]:
    points = origin + ((block[2] - origin[2]) / rays[:, 2])[:, None] * rays
    return points, np.asarray((np.abs(points[:, :2]) < block[:2]).all(axis=1))


def _exposed(
    made: Instrument,
    lights: Sequence[Light],
    head: Placement,
    block: FloatArray,
    rng: np.random.Generator,
    source: str,
) -> tuple[Profile, IntArray]:
    """Stripe points with flags where lines meet, cut where a line jumps, and their true sheets."""
    points, normals, truth, segments = [], [], [], []
    for sheet, light in enumerate(lights):
        q, normal, _ = seen_stripe(made, _lit(light, head, block), 0, 400, rng)
        if not len(q):
            continue
        step = np.linalg.norm(np.diff(q, axis=0), axis=1)
        cut = np.concatenate([[0], np.cumsum(step > max(8.0, 4.0 * float(np.median(step))))])
        points.append(q)
        normals.append(normal)
        truth.append(np.full(len(q), sheet))
        segments.append(cut + 1000 * sheet)
    if not points:
        empty = np.zeros((0, 2))
        none, numbers = np.zeros(0), np.zeros(0, dtype=np.int64)
        return Profile(source, empty, empty, none, none, none, numbers, numbers), numbers
    q, of_sheet = np.concatenate(points), np.concatenate(truth)
    near = np.full(len(q), np.inf)
    for k in np.unique(of_sheet):
        if (of_sheet != k).any():
            near[of_sheet == k] = cKDTree(q[of_sheet != k]).query(q[of_sheet == k])[0]
    segment = np.unique(np.concatenate(segments), return_inverse=True)[1].astype(np.int64)
    n = len(q)
    profile = Profile(
        source=source,
        points_px=q,
        normals_px=np.concatenate(normals),
        sigma_px=np.full(n, made.claimed[1] * made.stripe_px),
        width_px=np.full(n, WIDTH_PX),
        intensity=np.full(n, 150.0),
        flags=np.where(near < 4.5 * WIDTH_PX, int(StripeFlag.NEIGHBOUR), 0),
        segment=segment,
    )
    return profile, of_sheet.astype(np.int64)
