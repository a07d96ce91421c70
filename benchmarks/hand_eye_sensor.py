# SPDX-License-Identifier: Apache-2.0
"""Hand-eye and sensor moved together, beside the sensor as it was. Judged by points.

    python benchmarks/hand_eye_sensor.py [--runs 20] [--seed 0] [--cameras 0.1 0.3 1 3]

From features, without images: each run draws a camera's calibration (so many times 0.6 px of focal
length and what goes with it), calibrates the sheet on boards with it, the hand-eye over a plate
from 12 postures, and scans 12 others. Columns, um: root mean square error of the points along the
plate's normal, and what is stated; in all directions; of the hand-eye's translation, an axis, and
what is stated; and the mean of e' C^-1 e / 3 of the points and / 6 of the hand-eye (1 is right).

``moved`` is what `calibrate_on_plate` gives, hand-eye and sensor; ``given`` the hand-eye beside the
sensor that stands still, as it was stored before.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import HandEyeOptions
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import HandEyeCalibration, ScannerCalibration, SensorCalibration
from rigs.calibrated_head import CalibratedHead
from rigs.plate_rig import PLATE_NORMAL, TOOL_FROM_SENSOR
from rigs.sheet_rig import PROVENANCE

OPTIONS = HandEyeOptions()


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
    off = hand_eye.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    return [
        float(((error @ PLATE_NORMAL) ** 2).mean()),
        float(stated.mean()),
        float((error**2).sum(axis=1).mean()),
        float((off[3:] ** 2).mean()),
        float(np.diag(spread)[3:].mean()),
        float(points.mean()) / 3.0,
        float(off @ np.linalg.solve(spread, off)) / 6.0,
    ]


def show(name: str, rows: list[list[float]]) -> None:
    """One line of the table."""
    mean: FloatArray = np.mean(rows, axis=0)
    normal, stated, whole, shift, shift_stated = 1e3 * np.sqrt(mean[:5])
    print(
        f"  {name:6s} normal {normal:6.1f} stated {stated:6.1f}   all {whole:6.1f}   "
        f"hand-eye {shift:6.1f} stated {shift_stated:6.1f}   claims {mean[5]:.2f} {mean[6]:.2f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="hand-eyes and the sensors that they belong to")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cameras", type=float, nargs="+", default=[0.1, 0.3, 1.0, 3.0])
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    begun = time.perf_counter()
    for factor in arguments.cameras:
        rows: dict[str, list[list[float]]] = {"given": [], "moved": []}
        for run in range(arguments.runs):
            head = CalibratedHead(factor, 100_000 * arguments.seed + run)
            sensor = head.sensor()
            stripes, plate = head.stripes(sensor)
            fit = calibrate_on_plate(stripes, plate, OPTIONS, sensor_covariance=sensor.covariance)
            if not isinstance(fit, HandEyeFit):
                print(f"run {run}: {fit.reason}")
                continue
            moved = fit.sensor_after(sensor)
            rows["given"].append(figures(head, sensor, fit.beside_given_sensor))
            rows["moved"].append(figures(head, moved, fit.calibration))
        print(f"camera x {factor:g}: {len(rows['moved'])} of {arguments.runs} runs")
        for name, found in rows.items():
            show(name, found)
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
