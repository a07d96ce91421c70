# SPDX-License-Identifier: Apache-2.0
"""Which hand-eye belongs beside the stored sensor? Judged by points of other postures.

    python benchmarks/hand_eye_sensor.py [--runs 20] [--seed 0] [--cameras 0.1 0.3 1 3]

From features, without images: each run draws a camera's calibration (so many times 0.6 px of focal
length and what goes with it), calibrates the sheet on boards with it, the hand-eye over a plate
from 12 postures, and scans 12 others. Columns, um: root mean square error of the points along the
plate's normal, and what is stated; in all directions; of the hand-eye's translation, an axis, and
what is stated; and the mean of e' C^-1 e / 3 of the points and / 6 of the hand-eye (1 is right).

``stored`` is what `calibrate_on_plate` gives; ``moved`` the hand-eye of a sensor that is moved
within its covariance, beside the sensor that is not; ``both`` the same beside the moved sensor.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import cv2
import numpy as np

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.estimate import Problem, estimate
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateReference,
    PosedStripe,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import (
    PlateSurface,
    hand_eye_difference,
)
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import HandEyeCalibration, ScannerCalibration, SensorCalibration
from armscan.models.camera import CameraModel
from rigs.calibrated_head import CalibratedHead
from rigs.plate_rig import PLATE_NORMAL, TOOL_FROM_SENSOR
from rigs.sheet_rig import PROVENANCE

OPTIONS = HandEyeOptions()
N_CAMERA = 9


def moved_pair(
    stripes: list[PosedStripe],
    plate: PlateReference,
    sensor: SensorCalibration,
    stored: HandEyeCalibration,
) -> tuple[HandEyeCalibration, SensorCalibration]:
    """Hand-eye and sensor of one least squares in which the sensor may move."""
    nodes = condense_plate(stripes, straight_stripes(stripes), 12)
    nodes = replace(nodes, sensor_covariance=sensor.covariance)
    problem = Problem(nodes, PlateSurface(plate), OPTIONS)
    fit = estimate(problem, problem.start(stored.tool_from_sensor))
    if fit is None:
        raise EstimationError("the stripes do not determine the hand-eye")
    by_sensor = fit.placed.by_sensor
    if by_sensor is None:
        raise EstimationError("the stripes do not say how they follow the sensor")
    hand_eye = replace(
        stored,
        tool_from_sensor=fit.state.tool_from_sensor,
        covariance=fit.covariance[:6, :6],
        dhand_eye_dsensor=-fit.linear.gain[:6] @ by_sensor,
    )
    step = -sensor.covariance @ by_sensor.T @ fit.explained
    model, sheet = sensor.camera.camera, sensor.sheets[0]
    camera = CameraModel.from_parameters(
        model.parameters + step[:N_CAMERA], model.width_px, model.height_px
    )
    other = replace(
        sensor,
        camera=replace(sensor.camera, camera=camera),
        sheets=(replace(sheet, sheet=sheet.sheet.updated(step[N_CAMERA:])),),
    )
    return hand_eye, other


def figures(
    head: CalibratedHead, sensor: SensorCalibration, hand_eye: HandEyeCalibration
) -> list[float]:
    """Squares of the errors and of what is stated, in the order of the columns, in mm^2."""
    error, covariance = head.scan(sensor, hand_eye)
    stated = np.einsum("i,nij,j->n", PLATE_NORMAL, covariance, PLATE_NORMAL)
    points = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    spread = ScannerCalibration(sensor=sensor, hand_eye=hand_eye, provenance=PROVENANCE).covariance[
        -6:, -6:
    ]
    off = hand_eye_difference(hand_eye.tool_from_sensor, TOOL_FROM_SENSOR)
    return [
        float(((error @ PLATE_NORMAL) ** 2).mean()),
        float(stated.mean()),
        float((error**2).sum(axis=1).mean()),
        float((off[3:] ** 2).mean()),
        float(np.diag(spread)[3:].mean()),
        float(points.mean()) / 3.0,
        float(off @ np.linalg.solve(spread, off)) / 6.0,
    ]


def show(name: str, rows: list[list[float]], *, has_claims: bool = True) -> None:
    """One line of the table; a pair whose covariance is not computed has no claims."""
    mean: FloatArray = np.mean(rows, axis=0)
    normal, stated, whole, shift, shift_stated = 1e3 * np.sqrt(mean[:5])
    claims = f"stated {stated:6.1f}" if has_claims else 13 * " "
    line = f"  {name:8s} normal {normal:6.1f} {claims}   all {whole:6.1f}"
    if has_claims:
        line += f"   hand-eye {shift:6.1f} stated {shift_stated:6.1f}"
        line += f"   claims {mean[5]:.2f} {mean[6]:.2f}"
    print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="hand-eyes beside the sensor that is stored")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cameras", type=float, nargs="+", default=[0.1, 0.3, 1.0, 3.0])
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    begun = time.perf_counter()
    for factor in arguments.cameras:
        rows: dict[str, list[list[float]]] = {"stored": [], "moved": [], "both": []}
        for run in range(arguments.runs):
            head = CalibratedHead(factor, 100_000 * arguments.seed + run)
            sensor = head.sensor()
            stripes, plate = head.stripes(sensor)
            fit = calibrate_on_plate(stripes, plate, OPTIONS, sensor_covariance=sensor.covariance)
            if not isinstance(fit, HandEyeFit):
                print(f"run {run}: {fit.reason}")
                continue
            moved, other = moved_pair(stripes, plate, sensor, fit.calibration)
            rows["stored"].append(figures(head, sensor, fit.calibration))
            rows["moved"].append(figures(head, sensor, moved))
            rows["both"].append(figures(head, other, moved))
        print(f"camera x {factor:g}: {len(rows['stored'])} of {arguments.runs} runs")
        for name, found in rows.items():
            show(name, found, has_claims=name != "both")
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
