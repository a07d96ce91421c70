# SPDX-License-Identifier: Apache-2.0
"""Instruments drawn at random, photographed, and taken through the command line.

    python benchmarks/random_images.py --first 5001 --count 40 -o results.jsonl
    python benchmarks/random_images.py --table -o results.jsonl

Each seed draws one instrument (`tests/rigs/photographed_instrument.py`), renders what its owner
would photograph, runs the commands that he would run, and compares what comes out with the truth,
which never lies beside the photographs. Of each stage it says

* right: the error is within 4 of its own sigma,
* refused: by the command, with its sentence; rightly if the set was degenerate by construction, or
  if the sentence says that the arm scatters too much and the drawn arm does,
* wrong: beyond 4 sigma, silently or with a warning of this or an earlier stage that bears on it.

Points are wrong if more than 2 % lie farther from the true surface than 4 of their own sigma. Any
warning bears on an error but those of `HARMLESS`, however many right results have it too: a laxer
rule than that of `benchmarks/random_instruments.py`.
A line of JSON is written for each instrument, with the commit; a seed that has its line at this
commit is not run again, and a tree with changes is refused. The table is of the commit of the last
line alone. An exception outside a command is a bug, too. Everything here is simulated.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from heads import commit_of_tree
from scipy.stats import chi2, norm

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.cli import main as armscan
from armscan.geometry.arrays import FloatArray
from armscan.jobs.inspection.shapes import read_plate
from armscan.models.calibration import CameraCalibration
from armscan.pipeline.truth import camera_errors, hand_eye_errors, normalised_length
from armscan.records.points import ProbedPoints
from armscan.simulation.optics.camera import RenderCamera
from armscan.storage.clouds import read_ply
from armscan.storage.documents import (
    read_camera_calibration,
    read_scanner_calibration,
    read_stereo_calibration,
)
from armscan.storage.points import read_points_or_plane
from rigs.photographed_instrument import DrawnInstrument, draw_instrument
from rigs.photographed_sets import (
    Held,
    Photographer,
    photograph_camera_set,
    photograph_laser_set,
    plate_distance_mm,
    record_ball,
    record_laser_set,
    record_plate,
    record_postures,
    write_touches,
)

LIMIT_SIGMAS = 4.0
MOST_BEYOND = 0.02
TAIL = 2.0 * float(norm.sf(LIMIT_SIGMAS))
REFUSED_BY = {
    "camera": {"parallel boards"},
    "laser": {"parallel boards", "boards at one depth"},
    "hand-eye": {"parallel boards", "boards at one depth", "parallel postures"},
}
HARMLESS = (
    "to the LEFT of the left one",
    "looks the same when it is turned",
    "too far outside the calibrated depths",
    "calibrated depth range",
    "have no normal",
    "did not see the target",
    "were not used",
    "gave no point",
)
"""Parts of warnings that say nothing of an error of what is written."""
ARM_SCATTERS = "the arm would have to scatter by"
LARGEST_SCATTER_MM = 0.25
"""Of a point that the head sees; the software refuses hand-eyes of arms beyond it, and says so."""
STAGES = ("camera", "laser", "sensor points", "probe", "hand-eye", "plate", "ball", "diameter")


@dataclass(slots=True)
class Stage:
    """Outcome of one stage."""

    name: str
    outcome: str
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    sentence: str = ""
    wall_s: float = 0.0


@dataclass(slots=True)
class Chain:
    """One instrument on its way through the commands."""

    drawn: DrawnInstrument
    folder: Path
    stages: list[Stage] = field(default_factory=list)

    def command(self, name: str, *words: str) -> tuple[Stage, dict[str, Any]]:
        """Run one command; its report as JSON, empty if it was refused."""
        out, err = io.StringIO(), io.StringIO()
        start = time.perf_counter()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = armscan([*words, "--json"])
        stage = Stage(name, "right", wall_s=round(time.perf_counter() - start, 2))
        self.stages.append(stage)
        if code != 0:
            stage.sentence = err.getvalue().strip().splitlines()[-1]
            stage.outcome = "bug" if code == 70 else refusal(self.drawn, name, stage.sentence)
            return stage, {}
        report = json.loads(out.getvalue())
        stage.warnings = [str(one) for one in report.get("warnings", [])]
        return stage, report

    @property
    def bits(self) -> list[str]:
        """How many bits photographs of more than eight have."""
        bits = self.drawn.head.imaging.detector.bits
        return ["--bits-used", str(bits)] if bits > 8 else []

    def path(self, name: str) -> str:
        """A place in the folder."""
        return str(self.folder / name)


def refusal(drawn: DrawnInstrument, name: str, sentence: str) -> str:
    """Whether a stage is rightly refused: degenerate, or an arm as bad as the sentence says."""
    is_so = drawn.arm_scatter_mm() > LARGEST_SCATTER_MM and ARM_SCATTERS in sentence
    rightly = is_so or drawn.degenerate in REFUSED_BY.get(name, set())
    return "rightly refused" if rightly else "wrongly refused"


def judge(chain: Chain, stage: Stage, ratio: float, limit: float) -> None:
    """Right or wrong by an error in units of its sigma; a stage before may have warned."""
    if not ratio <= limit:
        told = [word for one in chain.stages for word in one.warnings]
        told = [word for word in told if not any(part in word for part in HARMLESS)]
        stage.outcome = "wrong, warned" if told else "silently wrong"


def length_limit(n_parameters: int) -> float:
    """Length of an error in its own sigmas that is as rare as 4 sigma of one number."""
    return float(np.sqrt(chi2.isf(TAIL, n_parameters)))


def camera_figures(found: CameraCalibration, true: RenderCamera) -> dict[str, Any]:
    """Error of a camera's rays in their own sigmas; of its parameters too."""
    parameters = np.array(
        [getattr(true, name) for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")]
    )
    errors = camera_errors(found, parameters)
    ratio = ray_ratio(found, parameters)
    return {
        "rays": round(ratio, 2),
        "normalised": round(errors.normalised, 2),
        "parameters": errors.n_parameters,
        "focal_error": float(errors.focal_px / true.fx),
        "focal_sigma": float(errors.focal_sigma_px / true.fx),
        "rms_px": found.rms_px,
        "sigma_point_px": found.sigma_point_px,
    }


def ray_ratio(found: CameraCalibration, true_parameters: FloatArray) -> float:
    """Rms, over most of the image, of the rays' errors in their own sigmas."""
    camera = found.camera
    width, height = camera.width_px, camera.height_px
    u, v = np.meshgrid(np.linspace(0.12, 0.88, 9) * width, np.linspace(0.12, 0.88, 7) * height)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    base = camera.parameters
    rays = undistorted(pixels, base)
    error = rays - undistorted(pixels, true_parameters)
    jacobian = np.zeros((*error.shape, 9))
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-5 * max(abs(base[k]), 1e-2)
        jacobian[..., k] = (undistorted(pixels, base + step) - rays) / step[k]
    variance = np.einsum("nak,kl,nal->na", jacobian, found.covariance, jacobian)
    return float(np.sqrt(np.mean(error**2 / np.maximum(variance, 1e-18))))


def undistorted(pixels: FloatArray, parameters: FloatArray) -> FloatArray:
    """(N, 2) ideal coordinates of pixels under nine parameters, by OpenCV."""
    fx, fy, cx, cy, *distortion = parameters
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    found = cv2.undistortPoints(
        pixels[:, None], matrix, np.array(distortion), R=None, P=None, criteria=criteria
    )
    return np.asarray(found[:, 0])


def point_figures(distance: FloatArray, sigma: FloatArray, exposure: FloatArray) -> dict[str, Any]:
    """How the points' distances from the truth compare with their sigmas."""
    ratio = np.abs(distance) / sigma
    means = [
        float(np.mean(distance[exposure == k]) / np.sqrt(np.mean(sigma[exposure == k] ** 2)))
        for k in np.unique(exposure)
    ]
    return {
        "points": len(distance),
        "beyond": round(float(np.mean(ratio > LIMIT_SIGMAS)), 4),
        "rms_ratio": round(float(np.sqrt(np.mean(np.minimum(ratio, 100.0) ** 2))), 2),
        "median_mm": round(float(np.median(np.abs(distance))), 5),
        "rms_mm": round(float(np.sqrt(np.mean(distance**2))), 5),
        "sigma_mm": round(float(np.median(sigma)), 5),
        "worst_exposure": round(max(means, key=abs), 2),
    }


def calibrate_cameras(chain: Chain, shoot: Photographer, views: int) -> bool:
    """``calibrate camera`` or ``calibrate stereo`` of photographs."""
    drawn, folder = chain.drawn, chain.folder
    photograph_camera_set(shoot, folder / "camera", views)
    words = ["--target", drawn.target, *chain.bits]
    if len(drawn.head.cameras) == 1:
        stage, report = chain.command(
            "camera", "calibrate", "camera", chain.path("camera/left"), *words,
            "-o", chain.path("camera.json"),
        )  # fmt: skip
        if not report:
            return False
        found = read_camera_calibration(folder / "camera.json")
        stage.figures = camera_figures(found, drawn.head.camera)
        judge(chain, stage, stage.figures["rays"], LIMIT_SIGMAS)
        return True
    stage, report = chain.command(
        "camera", "calibrate", "stereo", chain.path("camera/left"), chain.path("camera/right"),
        *words, "-o", chain.path("camera.json"),
    )  # fmt: skip
    if not report:
        return False
    stereo = read_stereo_calibration(folder / "camera.json")
    both = [
        camera_figures(found, eye.camera)
        for found, eye in zip((stereo.left, stereo.right), drawn.head.cameras, strict=True)
    ]
    stage.figures = max(both, key=lambda one: one["rays"])
    judge(chain, stage, stage.figures["rays"], LIMIT_SIGMAS)
    truth = drawn.head.cameras[1].camera_from_sensor
    # a target's true pitch cannot be known: lengths are judged as if it were the one that is said
    truth = replace(truth, translation_mm=truth.translation_mm / (1.0 + drawn.facts["scale_error"]))
    error = stereo.right_from_left.step_from(truth)
    covariance = stereo.covariance[-6:, -6:]
    ratio = normalised_length(error, covariance, np.diag(covariance) > 0.0)
    stage.figures["pose"] = round(ratio, 2)
    judge(chain, stage, ratio, length_limit(6))
    return True


def calibrate_lasers(chain: Chain, shoot: Photographer, boards: int) -> bool:
    """``calibrate laser`` of photographs, or of a recording where several sources take turns."""
    drawn = chain.drawn
    words = ["--camera", chain.path("camera.json"), "--target", drawn.target]
    words += ["-o", chain.path("sensor.json")]
    if len(drawn.head.lasers) == 1 and len(drawn.head.cameras) == 1:
        photograph_laser_set(shoot, chain.folder, boards)
        words += ["--on", chain.path("on"), *chain.bits]
        if drawn.has_off:
            words += ["--off", chain.path("off")]
    else:
        record_laser_set(shoot, chain.folder / "boards", boards)
        words += ["--scan", chain.path("boards")]
        if len(drawn.head.sources) < len(drawn.head.lasers):
            words += ["--lines", str(len(drawn.head.lasers))]
    stage, report = chain.command("laser", "calibrate", "laser", *words)
    if report:
        document = json.loads((chain.folder / "sensor.json").read_text())
        stage.figures = {"sheets": len(document["sheets"])}
        if len(document["sheets"]) != len(drawn.head.lasers):
            judge(chain, stage, np.inf, 1.0)
    return bool(report)


def measure_in_sensor(chain: Chain, held: Held) -> None:
    """Points of the plate in the Sensor frame, where the plate truly was."""
    drawn = chain.drawn
    stage, report = chain.command(
        "sensor points", "reconstruct", chain.path("postures"), "--sensor",
        chain.path("sensor.json"), "-o", chain.path("points.ply"),
    )  # fmt: skip
    if not report:
        return
    cloud = read_ply(chain.folder / "points.ply")
    distance, sigma = np.zeros(len(cloud)), np.zeros(len(cloud))
    for k, name in enumerate(cloud.exposure_sources):
        on = cloud.exposure == k
        pose = held.base_from_sensor[Path(name.split(" ")[0]).name]
        distance[on] = plate_distance_mm(drawn, pose.apply(cloud.points_mm[on]))
        normal = pose.rotation.T @ drawn.base_from_plate.rotation[:, 2]
        sigma[on] = np.sqrt(np.einsum("i,nij,j->n", normal, cloud.covariance_mm2[on], normal))
    stage.figures = point_figures(distance, sigma, cloud.exposure)
    judge(chain, stage, stage.figures["beyond"], MOST_BEYOND)


@dataclass(frozen=True, slots=True)
class TouchedPlate:
    """The probed plane, beside that through the true face where it was touched.

    ``error``: (3,) slopes along the axes of the probed plane, and height at its point, of the true
    one over it.
    """

    drawn: DrawnInstrument
    probed: PlateReference
    error: FloatArray

    @staticmethod
    def read(chain: Chain) -> TouchedPlate:
        """As ``inspect plane`` and ``calibrate hand-eye`` read it."""
        path = chain.folder / "plate.csv"
        points = cast(ProbedPoints, read_points_or_plane(path)).points_mm
        probed, _ = read_plate(path, points.mean(axis=0))
        height = probed.plane.distance_mm(on_plate(chain.drawn, points))
        error = np.linalg.lstsq(slopes(probed, points), height, rcond=None)[0]
        return TouchedPlate(chain.drawn, probed, error)

    @property
    def ratio(self) -> float:
        """Length of the error in its own sigmas."""
        covariance = np.asarray(self.probed.covariance_with_tip, dtype=np.float64)
        return normalised_length(self.error, covariance, np.diag(covariance) > 0.0)

    def height_mm(self, points_mm: FloatArray) -> float:
        """Mean height of the true face at points (N, 3) over the true plane."""
        height = self.probed.plane.distance_mm(on_plate(self.drawn, points_mm))
        return float(np.mean(height - slopes(self.probed, points_mm) @ self.error))


def on_plate(drawn: DrawnInstrument, points_mm: FloatArray) -> FloatArray:
    """(N, 3) the true face of the plate under points."""
    normal = drawn.base_from_plate.rotation[:, 2]
    return np.asarray(points_mm - plate_distance_mm(drawn, points_mm)[:, None] * normal)


def slopes(probed: PlateReference, points_mm: FloatArray) -> FloatArray:
    """(N, 3) derivative of heights over the probed plane at points by its parameters."""
    along = (points_mm - probed.plane.point_mm) @ probed.plane.axes[:2].T
    return np.column_stack([along, np.ones(len(along))])


def calibrate_hand_eye(chain: Chain) -> bool:
    """``probe`` and ``calibrate hand-eye``."""
    drawn = chain.drawn
    stage, report = chain.command(
        "probe", "probe", chain.path("touches.csv"), "--side", "+z", "-o", chain.path("plate.csv")
    )
    if not report:
        return False
    stage.figures = {"normalised": round(TouchedPlate.read(chain).ratio, 2)}
    judge(chain, stage, stage.figures["normalised"], length_limit(3))
    stage, report = chain.command(
        "hand-eye", "calibrate", "hand-eye", chain.path("postures"), "--sensor",
        chain.path("sensor.json"), "--plate", chain.path("plate.csv"),
        "-o", chain.path("scanner.json"),
    )  # fmt: skip
    if not report:
        return False
    scanner = read_scanner_calibration(chain.folder / "scanner.json")
    errors = hand_eye_errors(scanner, drawn.head.tool_from_sensor)
    noise = scanner.hand_eye.arm_noise
    stage.figures = {
        "normalised": round(errors.normalised, 2),
        "translation_mm": round(errors.translation_mm, 4),
        "rotation_deg": round(errors.rotation_deg, 5),
        "arm_mm": round(float(np.hypot(noise.position_mm, noise.exposure_position_mm)), 4),
    }
    judge(chain, stage, errors.normalised, length_limit(6))
    return True


def measure_plate(chain: Chain) -> None:
    """``reconstruct`` and ``inspect plane`` of the plate."""
    drawn = chain.drawn
    stage, report = chain.command(
        "plate", "reconstruct", chain.path("plate"), "--scanner", chain.path("scanner.json"),
        "-o", chain.path("plate.ply"),
    )  # fmt: skip
    if not report:
        return
    cloud = read_ply(chain.folder / "plate.ply")
    normal = drawn.base_from_plate.rotation[:, 2]
    sigma = np.sqrt(np.einsum("i,nij,j->n", normal, cloud.covariance_mm2, normal))
    distance = plate_distance_mm(drawn, cloud.points_mm)
    stage.figures = point_figures(distance, sigma, cloud.exposure)
    judge(chain, stage, stage.figures["beyond"], MOST_BEYOND)
    stage, report = chain.command(
        "inspect plane", "inspect", "plane", chain.path("plate.ply"), "--plate",
        chain.path("plate.csv"), "-o", chain.path("plate-inspection.html"),
    )  # fmt: skip
    if report:
        offset = report["nominal"]["offset"]
        error = offset["value_mm"] - TouchedPlate.read(chain).height_mm(cloud.points_mm)
        stage.figures = {"error_mm": round(error, 5), "sigma_mm": round(offset["sigma_mm"], 5)}
        judge(chain, stage, abs(error) / offset["sigma_mm"], LIMIT_SIGMAS)


def measure_ball(chain: Chain) -> None:
    """``reconstruct`` and ``inspect sphere`` of the ball."""
    ball = chain.drawn.ball
    stage, report = chain.command(
        "ball", "reconstruct", chain.path("ball"), "--scanner", chain.path("scanner.json"),
        "-o", chain.path("ball.ply"),
    )  # fmt: skip
    if not report:
        return
    cloud = read_ply(chain.folder / "ball.ply")
    normal = ball.normals(cloud.points_mm)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, cloud.covariance_mm2, normal))
    stage.figures = point_figures(ball.distance_mm(cloud.points_mm), sigma, cloud.exposure)
    judge(chain, stage, stage.figures["beyond"], MOST_BEYOND)
    diameter = 2.0 * ball.radius_mm
    stage, report = chain.command(
        "diameter", "inspect", "sphere", chain.path("ball.ply"), "--diameter", f"{diameter:.6f}",
        "-o", chain.path("ball-inspection.html"),
    )  # fmt: skip
    if report:
        error, sigma_mm = diameter_error(report, diameter)
        stage.figures = {"error_mm": round(error, 5), "sigma_mm": round(sigma_mm, 5)}
        judge(chain, stage, abs(error) / sigma_mm, LIMIT_SIGMAS)


def diameter_error(report: dict[str, Any], diameter_mm: float) -> tuple[float, float]:
    """Error of the fitted diameter and its stated sigma, from the report of ``inspect sphere``."""
    size = report["fitted"]["diameter"]
    return float(size["value_mm"]) - diameter_mm, float(size["sigma_mm"])


def run_instrument(seed: int, folder: Path) -> dict[str, Any]:
    """All stages of one instrument, as far as they go."""
    start, cpu = time.perf_counter(), time.process_time()
    drawn = draw_instrument(seed)
    chain, shoot = Chain(drawn, folder), Photographer(drawn)
    views, boards, postures = (int(n) for n in shoot.rng.integers((8, 6, 6), (13, 9, 11)))
    steps: tuple[Callable[[], bool | None], ...] = (
        lambda: calibrate_cameras(chain, shoot, views),
        lambda: calibrate_lasers(chain, shoot, boards),
        lambda: after_sensor(chain, shoot, postures),
    )
    for step in steps:
        if step() is False:
            break
    return {
        "seed": seed,
        "facts": drawn.facts,
        "views": views,
        "boards": boards,
        "postures": postures,
        "stages": [vars_of(stage) for stage in chain.stages],
        "outcome": overall({stage.outcome for stage in chain.stages}),
        "images": shoot.n_images,
        "wall_s": round(time.perf_counter() - start, 1),
        "core_s": round(time.process_time() - cpu, 1),
    }


def after_sensor(chain: Chain, shoot: Photographer, postures: int) -> bool:
    """The arm's part of the chain."""
    held = record_postures(shoot, chain.folder / "postures", postures)
    write_touches(shoot, chain.folder / "touches.csv", 16)
    measure_in_sensor(chain, held)
    if not calibrate_hand_eye(chain):
        return False
    record_plate(shoot, chain.folder / "plate", 8)
    measure_plate(chain)
    record_ball(shoot, chain.folder / "ball", 8)
    measure_ball(chain)
    return True


def vars_of(stage: Stage) -> dict[str, Any]:
    """A stage as JSON."""
    return {name: getattr(stage, name) for name in Stage.__slots__}


def overall(found: set[str]) -> str:
    """The worst outcome of all stages."""
    for outcome in ("bug", "silently wrong", "wrong, warned", "wrongly refused", "rightly refused"):
        if outcome in found:
            return outcome
    return "right"


def failed(seed: int, error: Exception, start: float, cpu: float) -> dict[str, Any]:
    """An instrument that an exception outside the commands ended, since these clock readings."""
    stage = Stage("outside a command", "bug", sentence=f"{type(error).__name__}: {error}")
    return {
        "seed": seed,
        "stages": [vars_of(stage)],
        "outcome": stage.outcome,
        "wall_s": round(time.perf_counter() - start, 1),
        "core_s": round(time.process_time() - cpu, 1),
    }


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Instruments that have their line already."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def print_table(lines: list[dict[str, Any]]) -> None:
    """Outcomes by stage, then each instrument that is not right; refusals are judged anew.

    Only of the commit of the last line.
    """
    n_all = len(lines)
    lines = [line for line in lines if line["commit"] == lines[-1]["commit"]]
    for line in lines:
        for stage in line["stages"]:
            if "refused" in stage["outcome"]:
                drawn = draw_instrument(line["seed"])
                stage["outcome"] = refusal(drawn, stage["name"], stage["sentence"])
        line["outcome"] = overall({stage["outcome"] for stage in line["stages"]})
    counts = {name: Counter[str]() for name in STAGES}
    for line in lines:
        for stage in line["stages"]:
            counts.setdefault(stage["name"], Counter())[stage["outcome"]] += 1
    outcomes = (
        "right",
        "rightly refused",
        "wrongly refused",
        "wrong, warned",
        "silently wrong",
        "bug",
    )
    print(" | ".join(("stage", *outcomes)))
    for name, count in counts.items():
        print(" | ".join((name, *(str(count[outcome]) for outcome in outcomes))))
    if not lines:
        return
    total = Counter(line["outcome"] for line in lines)
    print(" | ".join(("instruments", *(str(total[outcome]) for outcome in outcomes))))
    print(f"commit: {lines[0]['commit']}; {n_all - len(lines)} lines of other commits left out")
    cores = [line["core_s"] for line in lines]
    print(f"core-seconds: median {np.median(cores):.0f}, most {np.max(cores):.0f}")
    for line in lines:
        for stage in line["stages"]:
            if stage["outcome"] != "right":
                text = stage["sentence"] or json.dumps(stage["figures"])
                print(f"{line['seed']} {stage['name']}: {stage['outcome']}: {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=5001)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument("--keep", type=Path, help="folder in which the photographs stay")
    parser.add_argument("--table", action="store_true", help="only print the table")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.table:
        print_table(read_lines(options.o))
        return
    here = commit_of_tree()
    done = {line["seed"] for line in read_lines(options.o) if line["commit"] == here}
    for seed in range(options.first, options.first + options.count):
        if seed in done:
            continue
        start, cpu = time.perf_counter(), time.process_time()
        with contextlib.ExitStack() as stack:
            folder = options.keep and options.keep / str(seed)
            if folder is None:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            folder.mkdir(parents=True, exist_ok=True)
            try:
                line = run_instrument(seed, folder)
            except Exception as error:  # one of these must not end the study
                traceback.print_exc()
                line = failed(seed, error, start, cpu)
        line["commit"] = here
        with options.o.open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(seed, line["outcome"], line["core_s"], "s", flush=True)
    print_table(read_lines(options.o))


if __name__ == "__main__":
    main()
