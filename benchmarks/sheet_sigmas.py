# SPDX-License-Identifier: Apache-2.0
"""Is a light sheet as far from the truth as its covariance says? Fresh instruments, feature level.

Command: ``python benchmarks/sheet_sigmas.py [first] [last] [scene ...]`` (seeds, default 1 to 100;
all scenes), simulated.

Every seed draws a single-line head around the thesis's printed numbers, its target with the places
that its circles missed (the same target for camera and sheets), the places where it is held,
noise of 0.005 px for the circles and of 0.08 px for stripe points, correlated over 11. The camera
is calibrated from its own views. Columns, over the seeds:

- *squared distance / 8*: of the sheet's parameters in their own covariance (`sheet_errors`), over
  their count, so that 1 is right: mean, its standard error, median, largest;
- *rms um*: distance of sheet and truth over the calibrated region, root mean square;
- *points*: the calibration's own stripes made with the stored document, against their boards:
  rms over the claimed one, and mean over its claimed sigma (root mean square over seeds);
- *left out*: the same ratio of rms with each board left out of the fit.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit
from armscan.geometry.arrays import FloatArray
from armscan.models.camera import CameraModel
from armscan.pipeline.cameras import camera_calibration
from armscan.pipeline.truth import sheet_errors
from armscan.simulation.head import sheet_points_mm
from armscan.simulation.instrument import Instrument
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.scenes import camera_shots, laser_shots
from armscan.simulation.station import RenderRequest, Target
from armscan.simulation.targets import PATTERN, made_target
from armscan.vision.targets.target import TargetView
from rigs.sheet_rig import PROVENANCE, make_profile

CIRCLE_PX, STRIPE_PX, CORRELATED, PER_STRIPE = 0.005, 0.08, 11, 900
CAMERA = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)


@dataclass(frozen=True, slots=True)
class Scene:
    """What differs from the preset: error of the target's circles, and how much the light bows."""

    target_mm: float = 0.0003
    bow: float = 1.0


SCENES = {
    "as the demo": Scene(),
    "exact target": Scene(target_mm=0.0),
    "flat sheet": Scene(bow=0.0),
    "target 0.001 mm": Scene(target_mm=0.001),
}


def instrument(scene: Scene, seed: int) -> Instrument:
    """One drawn instrument with the scene's target and bow."""
    drawn = Instrument.build("thesis-single", "thesis", seed)
    lasers = tuple(replace(x, skew_rad=scene.bow * x.skew_rad) for x in drawn.head.lasers)
    target = made_target(scene.target_mm, np.random.default_rng([seed, 4]))
    return replace(drawn, target=target, head=replace(drawn.head, lasers=lasers))


def targets_of(shots: Sequence[RenderRequest]) -> Iterator[tuple[str, Target]]:
    """Each place of the target once."""
    seen: set[int] = set()
    for shot in shots:
        target: Any = shot.station.target
        if id(target) not in seen:
            seen.add(id(target))
            yield shot.row.source, target


def view_of(made: Instrument, source: str, target: Target, rng: np.random.Generator) -> TargetView:
    """The target as a detector would find it; the board's points are those of an exact print."""
    camera, pose = made.head.camera, target.base_from_board
    q = camera.project(target.pattern.marks_board_mm @ pose.rotation.T + pose.translation_mm)
    q = q + rng.normal(0.0, CIRCLE_PX, q.shape)
    covariance = np.tile(CIRCLE_PX**2 * np.eye(2), (len(q), 1, 1))
    return TargetView(
        source=source,
        width_px=camera.width_px,
        height_px=camera.height_px,
        point_index=np.arange(len(q)),
        points_px=q,
        covariance_px2=covariance,
        points_board_mm=PATTERN.marks_board_mm,
    )


def stripe_of(
    made: Instrument, laser: LineLaser, target: Target, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Stripe centres (N, 2) with correlated noise across the stripe, and normals (N, 2)."""
    pose, board = target.base_from_board, PATTERN.marks_board_mm
    low, high = board.min(axis=0), board.max(axis=0)
    x = np.linspace(low[0], high[0], PER_STRIPE)
    y = np.full(PER_STRIPE, 0.5 * (low[1] + high[1]))

    def place(y_mm: FloatArray) -> FloatArray:
        on_board = np.column_stack([x, y_mm, np.zeros_like(x)])
        return np.asarray(on_board @ pose.rotation.T + pose.translation_mm)

    for _ in range(30):
        off = laser.offset_mm(place(y))
        y = y - off / ((laser.offset_mm(place(y + 1e-4)) - off) / 1e-4)
    q = made.head.camera.project(place(y))
    tangent = np.gradient(q, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    white = rng.normal(0.0, STRIPE_PX, PER_STRIPE + CORRELATED - 1)
    noise = np.convolve(white, np.full(CORRELATED, 1.0 / np.sqrt(CORRELATED)), "valid")
    inside = (y >= low[1]) & (y <= high[1])
    return (q + noise[:, None] * normal)[inside], normal[inside]


def calibrated(scene: Scene, seed: int) -> tuple[Instrument, LaserFit]:
    """Camera and sheet of one instrument."""
    made = instrument(scene, seed)
    rng = np.random.default_rng([seed, 99])
    views = [
        view_of(made, source, target, rng)
        for source, target in targets_of(camera_shots(made.head, made.target, rng))
    ]
    found = calibrate_camera(views, CAMERA)
    if not isinstance(found, CameraFit):
        raise SystemExit(f"seed {seed}: {found.reason}")
    camera = camera_calibration(found, PROVENANCE)
    boards = []
    places = list(targets_of(laser_shots(made.head, made.target, rng)))
    for source, target in places:
        view = view_of(made, source, target, rng)
        boards.append(board_stripes(made, view, target, camera.camera, rng))
    fit = calibrate_sheets(boards, camera)
    if not isinstance(fit, LaserFit):
        raise SystemExit(f"seed {seed}: {fit.reason}")
    return made, fit


def board_stripes(
    made: Instrument,
    view: TargetView,
    target: Target,
    camera: CameraModel,
    rng: np.random.Generator,
) -> BoardStripes:
    """The stripe on one board."""
    pose = estimate_board_pose(view, camera)
    if not pose:
        raise SystemExit(pose.reason)
    stripe = stripe_of(made, made.head.lasers[0], target, rng)
    return BoardStripes(make_profile(view.source, [stripe], STRIPE_PX), view, pose)


def row(scene: Scene, seed: int) -> tuple[float, ...]:
    """Figures of one seed, in the order of the columns."""
    made, fit = calibrated(scene, seed)
    sheet = fit.sheets[0]
    truth = sheet_points_mm(made.head)["A"]
    low, high = sheet.calibration.depth_range_mm
    inside = truth[(truth[:, 2] >= low) & (truth[:, 2] <= high)]
    errors = sheet_errors(sheet.calibration, sheet.covariance, inside)
    points = sheet.points
    return (
        errors.normalised**2 / errors.n_parameters,
        errors.rms_mm,
        points.fitted.rms_mm / points.fitted.claimed_rms_mm,
        points.fitted.mean_mm / points.fitted.sigma_mean_mm,
        points.left_out_rms_mm / points.left_out_claimed_mm,
    )


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt((values**2).mean()))


def main() -> None:
    """Print a row a scene."""
    cv2.setNumThreads(1)
    words = sys.argv[1:]
    first, last = (int(words[0]), int(words[1])) if len(words) > 1 else (1, 100)
    for name in words[2:] or SCENES:
        found = np.array([row(SCENES[name], seed) for seed in range(first, last + 1)])
        square = found[:, 0]
        error = square.std(ddof=1) / np.sqrt(len(square))
        print(
            f"{name}, seeds {first} to {last}: squared distance over its degrees of freedom "
            f"{square.mean():.2f} +- {error:.2f}, median {np.median(square):.2f}, "
            f"largest {square.max():.1f}; rms {1e3 * rms(found[:, 1]):.2f} um; points: rms over "
            f"claimed {rms(found[:, 2]):.2f}, mean in sigmas {rms(found[:, 3]):.2f}; "
            f"left out {rms(found[:, 4]):.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
