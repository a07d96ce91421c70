# SPDX-License-Identifier: Apache-2.0
"""Names of the lines of a drawn instrument that sweeps over a plate with a block, one camera.

By the rule that `labeller_for` gives a user, and of the points that are left in the cloud. In an
image by itself all lines of the head are on and none is named; in a scan those that the software
asks for, and if the sensor lacks a sheet of one, all again: what is named of that is wrong. Of a
head of one line no name can be wrong, and none is counted; where no point at all is named, none is
given, as in a refusal.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.measure import MeasureOptions, labeller_for, laser_warnings
from armscan.reconstruction.labels import PointStatus, sheets_of
from armscan.reconstruction.points import measure_points
from armscan.records.profile import Profile, StripeFlag
from rigs.instrument_stages import Outcome
from rigs.instruments import Instrument, Light, Placement, seen_stripe

N_EXPOSURES = 20
FIRST_NS = 1_000_000_000
TICK_NS = 12_500_000
WIDTH_PX = 2.8
MOST_WRONG = 0.001
"""Share of the named points, as the limit for scenes says."""


def run_naming(
    made: Instrument, sensor: SensorCalibration, names: Sequence[int]
) -> Iterator[Outcome]:
    """Names in each image by itself, and in a scan, whose exposures are known to follow."""
    if len(made.lights) == 1:
        return
    yield _judged(made, sensor, names, is_scan=False)
    if len(sensor.sheets) > 1:
        yield _judged(made, sensor, names, is_scan=True)


def _judged(
    made: Instrument, sensor: SensorCalibration, names: Sequence[int], *, is_scan: bool
) -> Outcome:
    stage = "names, a scan" if is_scan else "names, one image"
    calibrated = list(dict.fromkeys(names))
    unknown = [k for k in range(len(made.lights)) if k not in calibrated]
    # Each line was on alone before the boards, so that those of which no sheet came are known.
    sensor = replace(sensor, lasers_without_sheet=tuple(f"line {k}" for k in unknown))
    options, wrong, named, asked = MeasureOptions(), 0, 0, 0
    labeller = labeller_for(sensor, options, is_scan=is_scan)
    rng, lasers_on = made.rng(40), []
    block = made.field_mm * np.array([0.15, 0.12, rng.uniform(0.02, 0.15)])
    begun = time.process_time()
    try:
        for k, head in enumerate(_sweep(made, rng)):
            if not is_scan:
                labeller.reset()
            lasers = labeller.next_lasers() if is_scan and not unknown else ()
            on = [names[sheet] for sheet in sheets_of(sensor, lasers)]
            lit = on if lasers else [*calibrated, *unknown]
            profile, truth = _exposed(made, lit, head, block, rng, f"image{k:02d}")
            if not len(profile):
                continue
            lasers_on.append(lasers)
            pose: Pose[Base, Sensor] | None = Pose(head.rotation, head.shift) if is_scan else None
            instant = labeller.label([profile], lasers, pose, FIRST_NS + k * TICK_NS)
            found = measure_points(instant, sensor, options.accepted_depths(sensor))[0].labelled
            sheet = np.where(found.status == int(PointStatus.MEASURED), found.sheet, -1)
            is_named = sheet >= 0
            wrong += int((np.asarray(names)[sheet[is_named]] != truth[is_named]).sum())
            named, asked = named + int(is_named.sum()), asked + len(sheet)
        refused = "" if named else "no point was given a name"
    except ArmscanError as error:
        refused = str(error)
    seconds = time.process_time() - begun
    if refused:
        # What several lines are that do not cross, nothing but their depth tells.
        result = "wrongly refused" if is_scan and made.is_crossed else "rightly refused"
        return Outcome(stage, result, refused, seconds=seconds)
    without = f"; {len(unknown)} of {len(made.lights)} lines have no sheet" if unknown else ""
    return Outcome(
        stage,
        "right" if wrong < MOST_WRONG * named else "wrong",
        f"{wrong} of {named} named points wrong{without}" if wrong else "",
        groups={
            "wrong": float(wrong),
            "named": float(named),
            "points": float(asked),
            "lines without a sheet": float(len(unknown)),
        },
        warnings=laser_warnings(lasers_on, labeller, sensor, options),
        seconds=seconds,
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
    lit: Sequence[int],
    head: Placement,
    block: FloatArray,
    rng: np.random.Generator,
    source: str,
) -> tuple[Profile, IntArray]:
    """Stripe points with flags where lines meet, cut where a line jumps, and their true lines."""
    points, normals, truth, segments = [], [], [], []
    for line in lit:
        q, normal, _ = seen_stripe(made, _lit(made.lights[line], head, block), 0, 400, rng)
        if not len(q):
            continue
        step = np.linalg.norm(np.diff(q, axis=0), axis=1)
        cut = np.concatenate([[0], np.cumsum(step > max(8.0, 4.0 * float(np.median(step))))])
        points.append(q)
        normals.append(normal)
        truth.append(np.full(len(q), line))
        segments.append(cut + 1000 * line)
    if not points:
        none, numbers = np.zeros(0), np.zeros(0, dtype=np.int64)
        profile = Profile(
            source=source,
            points_px=np.zeros((0, 2)),
            normals_px=np.zeros((0, 2)),
            sigma_px=none,
            width_px=none,
            intensity=none,
            flags=numbers,
            segment=numbers,
        )
        return profile, numbers
    q, of_line = np.concatenate(points), np.concatenate(truth)
    near = np.full(len(q), np.inf)
    for k in np.unique(of_line):
        if (of_line != k).any():
            near[of_line == k] = cKDTree(q[of_line != k]).query(q[of_line == k])[0]
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
    return profile, of_line.astype(np.int64)
