# SPDX-License-Identifier: Apache-2.0
"""Faults put into simulated recordings: which are named, which warned of, which pass in silence.

    python benchmarks/injected_faults.py SCANNER.json faults [--seed 1] [--only WORD]
    python benchmarks/injected_faults.py SCANNER.json clean [--runs 100] [--seed 1000]

SCANNER.json is that of ``armscan demo single -o out --seed 1``: the same simulated instrument scans
here with other hands. Images are not rendered: each exposure's stripes are the twin's true ones,
with 0.08 px of noise and an outlier in a hundred points, and then go through `measure_scan` and
`verify_on_ball` as those of images do. What rests on images alone (an image that is cut, black, of
another size) is no part of this. ``clean`` takes twelve walks of the arm over five scenes, and
draws noise, added scatter of the arm, sampling of the track, its rounding and the way poses are
found anew for each recording.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

import armscan.pipeline.measure as measure_module
from armscan.devices.sources import TwinScene
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Pose
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.models.camera import CameraModel
from armscan.pipeline.scan import ScanOptions, ScanReconstruction, measure_scan
from armscan.pipeline.verify import Measured, verify_on_ball
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.records.recording import ArmTrack, ExposureRow, Session
from armscan.simulation.instrument import Instrument
from armscan.simulation.objects.fixtures import BALL_DIAMETER_MM
from armscan.simulation.station import TwinScan
from armscan.simulation.twin import SimulatedInstrument
from armscan.storage.documents import read_scanner_calibration

NOISE_PX, OUTLIERS = 0.08, 0.01
INSTRUMENT_SEED = 1
ADDED_MM = 0.003
EXCEEDS = 3.0
SCENES = ("ball", "plate", "ball", "steps", "part", "waves")
WALKS = 12
"""Clean recordings share so many walks of the arm; noise, controller and rounding are drawn."""


@dataclass(frozen=True)
class Recording:
    """A scan whose images are known by their stripes."""

    profiles: tuple[Profile, ...]
    rows: tuple[ExposureRow, ...]
    arm: ArmTrack
    session: Session
    name: str = "injected"
    is_simulated: bool = True

    def exposure(self, row: int) -> Exposure:
        """A picture that only carries its number to `_stripes_of`."""
        pixels = np.zeros((1, 2), dtype=np.uint16)
        pixels[0] = divmod(row, 256)
        return Exposure(pixels, self.rows[row].source, bits_used=16, lasers=self.rows[row].lasers)

    def with_poses(self, rotations: FloatArray, translations: FloatArray) -> Recording:
        return replace(
            self, arm=replace(self.arm, rotations=rotations, translations_mm=translations)
        )


Stripes = tuple[tuple[FloatArray, ...], ...]


@cache
def _walked(scene: str, seed: int) -> tuple[TwinScan, Stripes]:
    """One scene by the instrument of the scanner's document with another hand, and its stripes."""
    instrument = Instrument.build("thesis-single", "thesis", INSTRUMENT_SEED)
    scan = SimulatedInstrument(instrument, "thesis", seed).scan(cast(TwinScene, scene))
    rows = range(len(scan.rows))
    return scan, tuple(tuple(one.points_px for one in scan.true_stripes(row)) for row in rows)


def recorded(scene: str, seed: int, noise_seed: int = 0) -> Recording:
    """The scene with noise of its own in the images."""
    scan, stripes = _walked(scene, seed)
    rng = np.random.default_rng([seed, noise_seed, 77])
    profiles = tuple(
        _profile(row.source, points, rng) for row, points in zip(scan.rows, stripes, strict=True)
    )
    return Recording(profiles, scan.rows, cast(ArmTrack, scan.arm), scan.session)


def _profile(source: str, stripes: tuple[FloatArray, ...], rng: np.random.Generator) -> Profile:
    points, segments = [], []
    for stripe in stripes:
        pixels = stripe[np.argsort(stripe[:, 0])]
        apart = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
        parts = np.concatenate([[0], np.cumsum(apart > 5.0)])
        points.append(pixels)
        segments.append(parts + len(segments) * 1000)
    pixels, segment = np.concatenate(points), np.concatenate(segments)
    number = np.unique(segment, return_inverse=True)[1]
    normals = np.zeros_like(pixels)
    for k in np.unique(number):
        own = np.flatnonzero(number == k)
        along = np.gradient(pixels[own], axis=0) if len(own) > 1 else np.array([[1.0, 0.0]])
        size = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        normals[own] = np.stack([-along[:, 1], along[:, 0]], axis=1) / size
    n = len(pixels)
    error = NOISE_PX * rng.standard_normal(n)
    error += np.where(rng.random(n) < OUTLIERS, 5.0 * rng.standard_normal(n), 0.0)
    return Profile(
        source=source,
        points_px=pixels + error[:, None] * normals,
        normals_px=normals,
        sigma_px=np.full(n, NOISE_PX),
        width_px=np.full(n, 3.0),
        intensity=np.full(n, 150.0),
        flags=np.zeros(n, dtype=np.int64),
        segment=number,
    )


def measured(
    recording: Recording,
    scanner: ScannerCalibration,
    pixels: Callable[[Profile], Profile] = lambda profile: profile,
) -> ScanReconstruction:
    """The scan, its stripes put where the extraction of images would give them."""

    def stripes_of(
        pair: tuple[Exposure, Exposure | None], camera: CameraModel, *_: object
    ) -> Profile:
        row = int(pair[0].image[0, 0]) * 256 + int(pair[0].image[0, 1])
        return pixels(recording.profiles[row])

    measure_module.extract_profile = stripes_of  # type: ignore[assignment]
    return measure_scan(recording, scanner, ScanOptions(has_normals=False))


@dataclass(frozen=True)
class Fault:
    """What is put in, and a word that its right name must hold."""

    name: str
    words: tuple[str, ...]
    recording: Recording
    scanner: ScannerCalibration
    pixels: Callable[[Profile], Profile] = lambda profile: profile


def faults(good: Recording, scanner: ScannerCalibration) -> Iterator[Fault]:
    """All faults in a scan of the ball."""
    for name, words, recording in (*_jumps(good), *_stuck(good), *_conventions(good)):
        yield Fault(name, words, recording, scanner)
    for name, words, recording in _clock(good):
        yield Fault(name, words, recording, scanner)
    yield from _instrument(good, scanner)


Changed = tuple[str, tuple[str, ...], Recording]


def _poses(good: Recording) -> tuple[FloatArray, FloatArray, int]:
    arm = good.arm
    return np.array(arm.rotations), np.array(arm.translations_mm), len(arm)


def _ids(good: Recording) -> IntArray:
    """Trigger ids of the twin's samples, -1 for none."""
    return cast(IntArray, good.arm.trigger_ids)


def _pauses(good: Recording) -> list[int]:
    return np.flatnonzero(np.diff(good.arm.t_ns) > 100_000_000).tolist()


def _jumps(good: Recording) -> Iterator[Changed]:
    rotations, translations, n = _poses(good)
    pauses = _pauses(good)
    start = (pauses[2] + pauses[3]) // 2
    direction = np.array([0.0, 0.6, 0.8])
    for size in (0.3, 3.0, 30.0, 1000.0):
        moved = translations + np.where(np.arange(n) > start, size, 0.0)[:, None] * direction
        words = ("jumps by",) if size > 1.0 else ("and all after it", "lies off the others")
        yield f"jump of {size:g} mm in a stroke", words, good.with_poses(rotations, moved)
    for size in (0.3, 3.0):
        later = np.arange(n) > pauses[3]
        moved = translations + np.where(later, size, 0.0)[:, None] * direction
        yield f"shift of {size:g} mm in a pause", ("all before",), good.with_poses(rotations, moved)
    ids = _ids(good)
    one = int(np.flatnonzero(ids >= 0)[30])
    moved = translations.copy()
    moved[one] += 1000.0 * direction
    yield "one sample 1 m off", ("off the track",), good.with_poses(rotations, moved)


def _stuck(good: Recording) -> Iterator[Changed]:
    _, _, n = _poses(good)
    pauses = _pauses(good)

    def held(first: int, last: int, source: int | None = None) -> Recording:
        rotations, translations, _ = _poses(good)
        rows = np.full(last - first, first if source is None else 0)
        if source is not None:
            rows = source + np.arange(last - first)
        rotations[first:last], translations[first:last] = rotations[rows], translations[rows]
        return good.with_poses(rotations, translations)

    words = ("stands still", "the pose of")
    start = (pauses[1] + pauses[2]) // 2
    yield "encoder stuck for 25 %", words, held(start, start + n // 4)
    yield "encoder stuck for 45 %", words, held(start, start + int(0.45 * n))
    yield "encoder stuck to a pause", words, held(pauses[0] + 30, pauses[1] + 1)
    yield "encoder stuck throughout", words, held(0, n)
    block = (pauses[2] - pauses[1]) // 2
    yield (
        "block of samples repeated",
        ("repeat others", "the pose of"),
        held(start, start + block // 2, start - block // 2),
    )


def _conventions(good: Recording) -> Iterator[Changed]:
    rotations, translations, _ = _poses(good)
    back = rotations.transpose(0, 2, 1)
    inverse = -np.einsum("nij,nj->ni", back, translations)
    yield "inverse poses", ("tool_from_base",), good.with_poses(back, inverse)
    yield "rotations transposed", ("transposed",), good.with_poses(back, translations)
    mirror = np.diag([1.0, -1.0, 1.0])
    left = mirror @ rotations @ mirror
    yield "left-handed poses", ("left-handed",), good.with_poses(left, translations @ mirror)
    numbers = Rotation.from_matrix(rotations).as_quat()
    for shift, name in ((1, "x y z w read as w x y z"), (-1, "w x y z read as x y z w")):
        other = Rotation.from_quat(np.roll(numbers, shift, axis=1)).as_matrix()
        yield f"quaternions {name}", ("scalar",), good.with_poses(other, translations)
    angles = Rotation.from_matrix(rotations).as_euler("XYZ")
    other = Rotation.from_euler("xyz", angles).as_matrix()
    yield "Euler angles of another order", ("angles",), good.with_poses(other, translations)
    yield "positions in inches", ("inches",), good.with_poses(rotations, translations / 25.4)


def _clock(good: Recording) -> Iterator[Changed]:
    free = replace(good, arm=replace(good.arm, trigger_ids=None))
    for lag_ms in (1.0, 5.0, -5.0, 50.0):
        rows = tuple(
            replace(row, t_ns=row.t_ns + round(1e6 * lag_ms), trigger_id=None) for row in good.rows
        )
        yield f"clock off by {lag_ms:g} ms", ("too late", "too early"), replace(free, rows=rows)
    for step in (1, -1, 2):
        order = np.clip(np.arange(len(good.rows)) + step, 0, len(good.rows) - 1)
        profiles = tuple(good.profiles[k] for k in order)
        yield f"images off by {step:+d}", ("off by",), replace(good, profiles=profiles)
    ids = _ids(good)
    later = np.where(ids >= 0, ids + 1, ids)
    session = replace(good.session, clock="separate")
    arm = replace(good.arm, trigger_ids=later)
    yield "trigger ids off by one", ("off by one",), replace(good, arm=arm, session=session)


def _instrument(good: Recording, scanner: ScannerCalibration) -> Iterator[Fault]:
    setup = good.session.cameras[0]
    size = (setup.width_px or 0, setup.height_px or 0)
    start = (setup.window.x_px, setup.window.y_px)
    for axis, name in enumerate("XY"):

        def mirrored(profile: Profile, axis: int = axis) -> Profile:
            points, normals = profile.points_px.copy(), profile.normals_px.copy()
            points[:, axis] = 2 * start[axis] + size[axis] - 1 - points[:, axis]
            normals[:, axis] *= -1.0
            return replace(profile, points_px=points, normals_px=normals)

        yield Fault(f"images mirrored in {name}", ("mirrored",), good, scanner, mirrored)
    yield Fault(
        "window of the camera 8 px off",
        ("window",),
        good,
        scanner,
        lambda profile: replace(profile, points_px=profile.points_px + np.array([0.0, 8.0])),
    )
    sensor, hand_eye = cast(SensorCalibration, scanner.sensor), scanner.hand_eye
    for shift in (0.2, 1.0):
        sheets = tuple(
            replace(one, sheet=replace(one.sheet, origin_mm=one.sheet.origin_mm + by_mm))
            for one in sensor.sheets
            for by_mm in (shift * one.sheet.axes[2],)
        )
        other = replace(scanner, sensor=replace(sensor, sheets=sheets))
        yield Fault(f"light sheet shifted by {shift:g} mm", ("light sheet",), good, other)
    camera = sensor.camera.camera
    longer = replace(camera, fx_px=1.02 * camera.fx_px, fy_px=1.02 * camera.fy_px)
    wrong = replace(sensor, camera=replace(sensor.camera, camera=longer))
    yield Fault("focal length 2 % wrong", ("focal",), good, replace(scanner, sensor=wrong))
    pose = hand_eye.tool_from_sensor
    for shift, turn_deg in ((0.5, 0.0), (0.0, 0.3)):
        turn = Rotation.from_rotvec([np.radians(turn_deg), 0.0, 0.0]).as_matrix()
        moved = Pose(turn @ pose.rotation, pose.translation_mm + np.array([shift, 0.0, 0.0]))
        other = replace(scanner, hand_eye=replace(hand_eye, tool_from_sensor=moved))
        name = f"head moved by {shift:g} mm, {turn_deg:g} deg"
        yield Fault(name, ("head that sits",), good, other)
    rows = tuple(replace(row, lasers=("B",)) for row in good.rows)
    yield Fault("unknown laser", ("of which the calibration",), replace(good, rows=rows), scanner)


def effect_sigmas(scan: ScanReconstruction, truth: ScanReconstruction) -> float:
    """95th percentile over points that both clouds hold of their distance over the stated sigma."""
    where = {row: k for k, row in enumerate(truth.image_rows)}
    found: list[FloatArray] = []
    for k, row in enumerate(scan.image_rows):
        mine = np.flatnonzero(scan.cloud.exposure == k)
        if row not in where:
            continue
        other = np.flatnonzero(truth.cloud.exposure == where[row])
        if not len(mine) or not len(other):
            continue
        n = min(len(mine), len(other))
        change = scan.cloud.points_mm[mine[:n]] - truth.cloud.points_mm[other[:n]]
        found.append(np.linalg.norm(change, axis=1) / scan.cloud.sigma_mm[mine[:n]])
    return float(np.percentile(np.concatenate(found), 95)) if found else 0.0


def run_faults(
    scanner: ScannerCalibration, seed: int, only: str, *, part: int = 0, of: int = 1
) -> None:
    good = recorded("ball", seed)
    truth = measured(good, scanner)
    print("| fault | left out | effect, sigma | verdict | verify | told |")
    print("|---|---|---|---|---|---|")
    count = {"named": 0, "warned": 0, "SILENT": 0, "no effect": 0}
    for number, fault in enumerate(faults(good, scanner)):
        if only not in fault.name or number % of != part:
            continue
        begun = time.perf_counter()
        try:
            scan = measured(fault.recording, fault.scanner, fault.pixels)
        except ArmscanError as error:
            told, effect, left, check = (str(error),), np.inf, "all", "refused"
            strong: tuple[str, ...] = told
        else:
            strong = scan.contradictions
            told = (*strong, *scan.warnings)
            effect = effect_sigmas(scan, truth)
            left = str(len(truth.images) - len(scan.images))
            check = _verified(scan, fault.scanner)
        text = " ".join(told)
        is_named = any(word in text for word in fault.words)
        is_warned = bool(strong) or check not in ("still valid", "no ball")
        verdict = "named" if is_named else "warned" if is_warned else "SILENT"
        if verdict == "SILENT" and effect < EXCEEDS:
            verdict = "no effect"
        count[verdict] += 1
        shown = next((one for one in told if any(w in one for w in fault.words)), "; ".join(told))
        seconds = time.perf_counter() - begun
        print(
            f"| {fault.name} | {left} | {effect:.3g} | {verdict} | {check} | {shown[:170]} |"
            f" <!-- {seconds:.0f} s -->",
            flush=True,
        )
    print(", ".join(f"{value} {key}" for key, value in count.items()))


def _verified(scan: ScanReconstruction, scanner: ScannerCalibration) -> str:
    try:
        found = verify_on_ball(Measured(scan.cloud, scan, scanner), BALL_DIAMETER_MM)
    except ArmscanError:
        return "no ball"
    return found.verdict


def resampled(recording: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """The recording as another arm's controller would have given it."""
    arm, kind = recording.arm, str(rng.choice(["as is", "by time", "sparse", "triggers", "late"]))
    ids = _ids(recording)
    kept = np.arange(len(arm))
    if kind == "by time":
        kept = kept[ids < 0]
    if kind == "sparse":
        kept = kept[(ids >= 0) | (np.arange(len(arm)) % 25 == 0)]
    if kind == "triggers":
        kept = kept[ids >= 0]
    decimals = int(rng.choice([9, 4, 3, 2]))
    places = arm.translations_mm + ADDED_MM * rng.standard_normal(arm.translations_mm.shape)
    angles = np.round(Rotation.from_matrix(arm.rotations).as_euler("XYZ", degrees=True), decimals)
    track = ArmTrack(
        t_ns=arm.t_ns[kept],
        rotations=Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()[kept],
        translations_mm=np.round(places, decimals)[kept],
        is_known=np.ones(len(kept), dtype=bool),
        trigger_ids=None if kind == "by time" else ids[kept],
    )
    rows = recording.rows
    if kind == "by time":
        rows = tuple(replace(row, trigger_id=None) for row in rows)
    if kind == "late":
        jitter = rng.integers(0, 1_500_000, len(track))
        times = np.maximum.accumulate(track.t_ns + jitter) + np.arange(len(track))
        track = replace(track, t_ns=times)
    return replace(recording, arm=track, rows=rows), f"{kind}, {decimals} decimals"


def run_clean(scanner: ScannerCalibration, runs: int, seed: int) -> None:
    told_of, not_valid, balls, ratios = 0, 0, 0, []
    for number in range(runs):
        rng = np.random.default_rng([seed, number])
        scene = SCENES[number % WALKS % len(SCENES)]
        walk = seed + number % WALKS
        recording, how = resampled(recorded(scene, walk, number), rng)
        scan = measured(recording, scanner)
        told_of += bool(scan.contradictions)
        check = ""
        if scene == "ball":
            check = _verified(scan, scanner)
            balls += 1
            not_valid += check != "still valid"
        found = scan.doubt.agreement
        figures = ""
        if found is not None:
            ratios.append((found.ratio, found.worst_ratio))
            figures = f"{found.ratio:.2f} {found.worst_ratio:.2f}"
        if scan.contradictions or check not in ("", "still valid"):
            print("  told:", scan.contradictions, check)
        print(f"{number}: {scene}, {how}: {figures} {check}", flush=True)
    table = np.array(ratios)
    print(f"{told_of} of {runs} clean recordings told of; {not_valid} of {balls} balls not valid")
    print(f"ratio: median {np.median(table[:, 0]):.2f}, largest {table.max(axis=0)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scanner", type=Path)
    parser.add_argument("what", choices=("faults", "clean"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--only", default="")
    parser.add_argument("--part", default="0/1", help="every OF-th fault from PART on: PART/OF")
    options = parser.parse_args()
    scanner = read_scanner_calibration(options.scanner)
    if options.what == "faults":
        part, of = (int(word) for word in options.part.split("/"))
        run_faults(scanner, options.seed, options.only, part=part, of=of)
    else:
        run_clean(scanner, options.runs, options.seed)


if __name__ == "__main__":
    main()
