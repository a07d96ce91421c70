# SPDX-License-Identifier: Apache-2.0
"""Registration by markers beside registration by the arm's pose, on one scene.

    python benchmarks/registration_study.py strip  [--views 8] [--pitch 15] [--seeds 20]
    python benchmarks/registration_study.py around [--views 8] [--pitch 15] [--seeds 20]
    python benchmarks/registration_study.py leapfrog --seeds 200

Simulated at feature level. A head with a field of 80 x 55 mm looks at a part from places 40 mm
apart: along a strip, or once around a drum. Markers stand every ``--pitch`` mm at random, nine in
ten are seen, each with 0.02 mm noise an axis and no systematic error. The arm has a repeatability
of 0.02 mm: at the scan point 0.011 mm (three axes together) and 0.00115 degrees, new in every view,
and a hand-eye calibrated on twelve postures: 0.005 mm and 0.002 degrees an axis, the same in all
views. Error: distance of the views' surface points from the truth, root mean square over all views
after the best rigid fit of the whole; and of the worst view in the frame of the first. Time is that
of one processor. A run fails if a view is not joined, or is wrong by more than 5 mm.

``leapfrog``: an arm moved to a new place; markers within 300 x 200 mm measured from both places.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Frame, Pose
from armscan.geometry.registration import PointPairs, closed_form_pose, register_points
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation
from armscan.markers.join_views import JoinedViews, join_views
from armscan.pipeline.register import register_place
from armscan.storage.points import MarkerList
from armscan.thesis.two_cameras import match_after_thesis
from rigs.marker_scenes import DISTANCE_MM, FIELD_MM, NOISE_MM, Walk, marker_set, random_pose, walk

AnyPose = Pose[Frame, Frame]

ARM_MM, ARM_DEG = 0.011 / np.sqrt(3.0), 0.00115 / np.sqrt(3.0)
HAND_EYE_MM, HAND_EYE_DEG = 0.005, 0.002
LIMIT_MM = 8.0 * NOISE_MM
GROSS_MM = 5.0
BESIDE_MM = np.array([300.0, 0.0, 0.0])
DRUM_MM_A_VIEW = 40.0 / (2.0 * np.pi)
SURFACE = np.array(
    [
        (x, y, DISTANCE_MM)
        for x in np.linspace(-0.45, 0.45, 9) * FIELD_MM[0]
        for y in np.linspace(-0.45, 0.45, 7) * FIELD_MM[1]
    ]
)
"""(63, 3) points in Sensor that stand for what a view measures."""


@dataclass(frozen=True)
class Outcome:
    """One run: errors in mm, None where it failed; seconds of computing."""

    errors_mm: tuple[float, float] | None
    seconds: float


def small(generator: np.random.Generator, shift_mm: float, turn_deg: float) -> AnyPose:
    turn = np.radians(turn_deg) * generator.normal(size=3)
    return Pose(rotation_from_vector(turn), shift_mm * generator.normal(size=3))


def at(pose: AnyPose, points_mm: FloatArray) -> FloatArray:
    return points_mm @ pose.rotation.T + pose.translation_mm


def errors(found: Sequence[AnyPose], true: Sequence[AnyPose]) -> tuple[float, float] | None:
    """Root mean square after a best fit of all, and of the worst view in the first one's frame."""
    placed = np.concatenate([at(pose, SURFACE) for pose in found])
    truth = np.concatenate([at(pose, SURFACE) for pose in true])
    best: AnyPose = closed_form_pose(truth, placed)
    shape = np.linalg.norm(at(best, placed) - truth, axis=1)
    first: AnyPose = true[0] @ found[0].inverse()
    by_view = np.linalg.norm(at(first, placed) - truth, axis=1).reshape(len(true), -1)
    worst = float(np.sqrt((by_view**2).mean(axis=1)).max())
    return None if worst > GROSS_MM else (float(np.sqrt((shape**2).mean())), worst)


def by_arm(scene: Walk, generator: np.random.Generator) -> Outcome:
    """Each view placed by the arm's pose and the hand-eye."""
    hand_eye = small(generator, HAND_EYE_MM, HAND_EYE_DEG)
    about: AnyPose = Pose(np.eye(3), np.array([0.0, 0.0, DISTANCE_MM]))
    found = []
    start = time.process_time()
    for pose in scene.part_from_sensor:
        # the arm errs at the scan point
        there = pose @ about
        moved: AnyPose = Pose(
            small(generator, 0.0, ARM_DEG).rotation @ there.rotation,
            there.translation_mm + ARM_MM * generator.normal(size=3),
        )
        found.append(moved @ hand_eye @ about.inverse())
    return Outcome(errors(found, scene.part_from_sensor), time.process_time() - start)


def by_markers(scene: Walk) -> tuple[Outcome, Outcome]:
    """Checked matching: the chain alone, and all solved together."""
    start = time.process_time()
    joined = join_views(scene.views)
    seconds = time.process_time() - start
    if not isinstance(joined, JoinedViews) or joined.left:
        return Outcome(None, seconds), Outcome(None, seconds)
    true = [scene.part_from_sensor[view] for view in joined.placed]
    return (
        Outcome(errors(joined.chain, true), seconds),
        Outcome(errors(joined.map.part_from_view, true), seconds),
    )


def by_eight_steps(scene: Walk) -> Outcome:
    """The thesis's way: each view matched with the one before, closed form, one after the other."""
    start = time.process_time()
    found: list[AnyPose] = [scene.part_from_sensor[0]]
    for before, after in zip(scene.views[:-1], scene.views[1:], strict=True):
        pairs = match_after_thesis(before, after, LIMIT_MM)
        if len(pairs) < 3:
            return Outcome(None, time.process_time() - start)
        step: AnyPose = closed_form_pose(
            before.points_mm[pairs[:, 0]], after.points_mm[pairs[:, 1]]
        )
        found.append(found[-1] @ step)
    seconds = time.process_time() - start
    return Outcome(errors(found, scene.part_from_sensor), seconds)


def study(kind: str, n_views: int, pitch: float, seeds: int) -> None:
    rows: dict[str, list[Outcome]] = {
        "arm's pose": [],
        "markers, solved together": [],
        "markers, chain": [],
        "markers, eight steps": [],
    }
    n_markers, n_shared = [], []
    for seed in range(seeds):
        generator = np.random.default_rng([seed, n_views])
        around = DRUM_MM_A_VIEW * n_views if kind == "around" else None
        scene = walk(generator, n_views, pitch_mm=pitch, around_mm=around)
        n_markers.append(len(scene.points_mm))
        n_shared += [
            len(np.intersect1d(a, b)) for a, b in zip(scene.true[:-1], scene.true[1:], strict=True)
        ]
        chain, together = by_markers(scene)
        for name, outcome in zip(
            rows, (by_arm(scene, generator), together, chain, by_eight_steps(scene)), strict=True
        ):
            rows[name].append(outcome)
    low, high = int(np.min(n_shared)), int(np.max(n_shared))
    print(
        f"{kind}, {n_views} views, {np.mean(n_markers):.0f} markers, neighbours share {low} to "
        f"{high} (median {np.median(n_shared):.0f}), {seeds} seeds"
    )
    print(
        "way                       failed   rms mm: median  95 %   worst view mm: median  95 %    s"
    )
    for name, outcomes in rows.items():
        show(name, outcomes)


def show(name: str, outcomes: Sequence[Outcome]) -> None:
    good = np.array([item.errors_mm for item in outcomes if item.errors_mm is not None])
    seconds = float(np.median([item.seconds for item in outcomes]))
    failed = f"{len(outcomes) - len(good):2d} of {len(outcomes)}"
    if not len(good):
        print(f"{name:25s} {failed:>8s}")
        return
    shape, worst = (np.percentile(good[:, k], [50, 95]) for k in range(2))
    print(
        f"{name:25s} {failed:>8s}   {shape[0]:14.3f} {shape[1]:5.3f}   "
        f"{worst[0]:21.3f} {worst[1]:5.3f} {seconds:6.2f}",
        flush=True,
    )


def leapfrog(seeds: int) -> None:
    print(
        f"leapfrog, {seeds} runs: error of the new place within the markers, and 300 mm beside them"
    )
    print(
        "markers   refused   within mm: rms  95 %   beside mm: rms  95 %   inside the 95 % region"
    )
    sigma = float(np.hypot(NOISE_MM, ARM_MM))
    for n in (4, 5, 6, 8, 12, 20):
        within, beside, inside, refused = [], [], 0, 0
        for seed in range(seeds):
            generator = np.random.default_rng([seed, n])
            points = generator.uniform(-0.5, 0.5, (n, 3)) * [300.0, 200.0, 60.0]
            old_from_new = random_pose(generator)
            back = old_from_new.inverse()
            old = points + sigma * generator.normal(size=points.shape)
            new = at(back, points) + sigma * generator.normal(size=points.shape)
            fit = place_of(old, new, sigma)
            if fit is None:
                refused += 1
                continue
            area = generator.uniform(-0.5, 0.5, (200, 3)) * [300.0, 200.0, 60.0]
            for values, place in ((within, area), (beside, area + BESIDE_MM)):
                away = np.linalg.norm(at(fit.value, at(back, place)) - place, axis=1)
                values.append(float(np.sqrt((away**2).mean())))
            turn = vector_from_rotation(old_from_new.rotation @ fit.value.rotation.T)
            e = np.concatenate([turn, old_from_new.translation_mm - fit.value.translation_mm])
            inside += int(e @ np.linalg.solve(fit.covariance, e) < chi2.ppf(0.95, 6))
        texts = [
            f"{np.sqrt(np.mean(np.square(values))):.4f} {np.percentile(values, 95):.4f}"
            for values in (within, beside)
        ]
        print(
            f"{n:7d}   {refused:7d}   {texts[0]:>19s}   {texts[1]:>19s}   "
            f"{inside:8d} of {len(within)}",
            flush=True,
        )


def place_of(old: FloatArray, new: FloatArray, sigma: float) -> Estimate[AnyPose] | None:
    """The new place by matching, as the command finds it; None where it refuses."""
    from armscan.errors import EstimationError

    lists = [
        MarkerList(marker_set(points, sigma), Path(name), False, False)
        for points, name in ((old, "old"), (new, "new"))
    ]
    try:
        place = register_place(*lists)
    except EstimationError:
        return None
    i, k = place.pairs[:, 0], place.pairs[:, 1]
    a, b = lists[0].markers, lists[1].markers
    fit: Estimate[AnyPose] | FitFailure = register_points(
        PointPairs(
            points_a_mm=a.points_mm[i],
            points_b_mm=b.points_mm[k],
            covariance_a_mm2=a.covariance_mm2[i],
            covariance_b_mm2=b.covariance_mm2[k],
        )
    )
    return None if isinstance(fit, FitFailure) else fit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=("strip", "around", "leapfrog"))
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--pitch", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    if given.kind == "leapfrog":
        leapfrog(given.seeds)
    else:
        study(given.kind, given.views, given.pitch, given.seeds)


if __name__ == "__main__":
    main()
