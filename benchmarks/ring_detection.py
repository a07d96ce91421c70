# SPDX-License-Identifier: Apache-2.0
"""Ring markers: centre errors beside their sigma, false rings among clutter, and stereo matching.

Command: ``python benchmarks/ring_detection.py`` (two minutes on one core); ``centres``,
``clutter`` or ``matching`` after it gives one part.

Images are drawn by the brute-force renderer of the tests, scenes of two cameras by the tests' own
projection: all of it is simulated.

Centres: one ring of 6 mm with a disc of 3 mm at 300 mm, f = 5150 px (103 px across), blur 1 px,
noise 2 grey levels; 6 azimuths, 6 images each. Printed are the rms an axis, the mean error along
the tilt (the bias), the same of the outer ellipse's centre, the predicted sigma, and the mean
normalised error squared over 2, which is 1 for an honest covariance.

Clutter: 6 rings of 60 px among 10 discs, square frames, stripes and letters, tilts up to 45
degrees; 12 images.

Matching: 20 to 40 markers on tilted planes, two planes that meet, and bumps, seen by the stereo
head of section 5.3.2; noise 0.1 px an axis, 20 % missing in each image, cameras off as a
calibration's covariance says; 200 scenes. Then the same with markers of mixed sizes, whose size
says nothing about their depth. Seeds: azimuth, image and scene numbers; the matching's scenes
start at 10,000 (thresholds were set on 0 to 199).
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.markers.stereo_matching import RingStatus, match_rings
from armscan.records.exposure import Exposure
from armscan.records.points import RingImages
from armscan.vision.rings import detect_rings, measure_rims
from armscan.vision.targets.circle_lattice import Blobs
from rigs.ring_pair_scenes import CALIBRATION_COVARIANCE, MarkerScene, random_scene
from rigs.ring_scenes import Mark, Rendered, render, tilted

N_AZIMUTHS, N_IMAGES = 6, 6
N_CLUTTER = 12
N_SCENES, FIRST_SCENE = 200, 10_000


def outer_centre(exposure: Exposure, rings: RingImages) -> FloatArray:
    """Centre of the outer rim's ellipse: what a method without correction gives."""
    angle, (short, long) = rings.direction_rad[0], rings.outer_half_px[0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shape = turn @ np.diag([long**2, short**2]) @ turn.T
    blob = Blobs(
        centres_px=rings.centres_px[:1], shapes_px2=shape[None], is_light=np.zeros(1, np.bool_)
    )
    return measure_rims(exposure.image, blob, np.array([12.0]), 10.0).centres_px[0]


def centres(tilt_deg: float) -> None:
    errors, plain, sigmas, squares, n_missed = [], [], [], [], 0
    for azimuth in range(0, 360, 360 // N_AZIMUTHS):
        place = np.random.default_rng(azimuth).uniform(-0.05, 0.05, 2)
        marks = [Mark("ring", float(place[0]), float(place[1]))]
        pose = tilted(tilt_deg, azimuth), np.array([0.0, 0.0, 300.0])
        rendered = render(marks, *pose, (150, 150))
        along = np.array([-np.sin(np.deg2rad(azimuth)), np.cos(np.deg2rad(azimuth))])
        axes = np.stack([along, [along[1], -along[0]]])
        for k in range(N_IMAGES):
            exposure = rendered.exposure(1000 * azimuth + k)
            rings = detect_rings(exposure).rings
            if len(rings) != 1:
                n_missed += 1
                continue
            error = rings.centres_px[0] - rendered.centres_px[0]
            errors.append(axes @ error)
            plain.append(axes @ (outer_centre(exposure, rings) - rendered.centres_px[0]))
            sigmas.append(np.sqrt(np.trace(rings.covariance_px2[0]) / 2.0))
            squares.append(error @ np.linalg.solve(rings.covariance_px2[0], error))
    own, other = np.array(errors), np.array(plain)
    print(
        f"{tilt_deg:4.0f} {len(own):5d} {n_missed:6d} {np.sqrt(np.mean(own**2)):9.4f} "
        f"{own[:, 0].mean():+9.4f} {np.mean(sigmas):9.4f} {np.mean(squares) / 2.0:8.2f} "
        f"{other[:, 0].mean():+12.4f}",
        flush=True,
    )


def clutter(seed: int) -> tuple[Rendered, int]:
    rng = np.random.default_rng(seed)
    kinds = ["ring"] * 6 + ["disc"] * 4 + ["square"] * 2 + ["stripes"] * 2 + ["letter"] * 2
    cells = rng.permutation([(x, y) for x in range(-2, 3) for y in range(-2, 2)])
    marks = [
        Mark(kind, 9.0 * x, 9.0 * y + 4.5, 3.0, 1.5 if kind != "stripes" else 1.0)
        for kind, (x, y) in zip(kinds, cells, strict=False)
    ]
    pose = tilted(float(rng.uniform(0.0, 45.0)), float(rng.uniform(0.0, 360.0)))
    rendered = render(marks, pose, np.array([0.0, 0.0, 300.0]), (640, 560), focal_px=3500.0, rays=3)
    return rendered, 6


def false_rings() -> None:
    n_found = n_false = n_rings = 0
    for seed in range(N_CLUTTER):
        rendered, n = clutter(seed)
        found = detect_rings(rendered.exposure(seed)).rings.centres_px
        distance = np.linalg.norm(found[:, None] - rendered.centres_px[:n], axis=2)
        is_true = (distance < 1.0).any(axis=1)
        n_rings += n
        n_found += int(is_true.sum())
        n_false += int((~is_true).sum())
    print(
        f"clutter: {n_found} of {n_rings} rings found in {N_CLUTTER} images, {n_false} false "
        f"({10 * N_CLUTTER} other things)"
    )


def mixed_sizes(scene: MarkerScene, seed: int) -> MarkerScene:
    factor = 0.7 + 0.6 * np.random.default_rng(seed).random(100)
    left, right = (
        replace(rings, outer_half_px=rings.outer_half_px * factor[markers][:, None])
        for rings, markers in ((scene.left, scene.left_marker), (scene.right, scene.right_marker))
    )
    return replace(scene, left=left, right=right)


def matching(title: str, *, is_mixed: bool) -> None:
    n_both = n_right = n_wrong = 0
    statuses: Counter[RingStatus] = Counter()
    for seed in range(FIRST_SCENE, FIRST_SCENE + N_SCENES):
        scene = random_scene(seed)
        if is_mixed:
            scene = mixed_sizes(scene, seed)
        matches = match_rings(scene.left, scene.right, scene.views, CALIBRATION_COVARIANCE)
        same = scene.left_marker[matches.left] == scene.right_marker[matches.right]
        n_both += scene.seen_by_both
        n_right += int(same.sum())
        n_wrong += int((~same).sum())
        statuses.update(matches.statuses)
    dropped = ", ".join(
        f"{statuses[status]} {status.name.lower()}"
        for status in RingStatus
        if status not in (RingStatus.MATCHED, RingStatus.NO_PARTNER)
    )
    print(
        f"matching, {title}: {n_right} of {n_both} pairs ({100.0 * n_right / n_both:.2f} %), "
        f"{n_wrong} wrong; left rings not decided: {dropped}",
        flush=True,
    )


if __name__ == "__main__":
    cv2.setNumThreads(1)
    parts = sys.argv[1:] or ["centres", "clutter", "matching"]
    if "matching" in parts:
        matching("one size", is_mixed=False)
        matching("mixed sizes", is_mixed=True)
    if "centres" in parts:
        print("tilt     n missed    rms px      bias  sigma px  nees/2  ellipse's bias", flush=True)
        for tilt in (0.0, 20.0, 45.0, 50.0):
            centres(tilt)
    if "clutter" in parts:
        false_rings()
