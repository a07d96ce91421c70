# SPDX-License-Identifier: Apache-2.0
"""Our side of `real_lasers.py`: the commands, in this process, with what the judge needs kept.

``python benchmarks/real_lasers_ours.py SET ROOT OUT FOLDS [CAMERA]`` runs ``armscan calibrate
camera`` (or takes CAMERA), ``calibrate laser`` and ``reconstruct``, then calibrates again without
one board at a time from the stripes found already. PYTHONPATH chooses the tree.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from laser_sets import SETS

import armscan.pipeline.laser
from armscan.calibration.sheets.result import LaserFit
from armscan.cli.run import main
from armscan.geometry.estimate import FitFailure
from armscan.storage.documents import sensor_document


class Kept:
    """What passed between the parts of the command."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.documents: list[tuple[Any, Any]] = []

    def listen(self) -> None:
        """Note the arguments of the estimator and of the document."""
        pipeline = armscan.pipeline.laser
        self.estimate, self.document = pipeline.calibrate_sheets, LaserFit.to_calibration

        def estimate(*arguments: Any, **options: Any) -> Any:
            self.calls.append((arguments, options))
            return self.estimate(*arguments, **options)

        def document(fit: Any, provenance: Any, *rest: Any) -> Any:
            self.documents.append((fit, provenance))
            return self.document(fit, provenance, *rest)

        pipeline.calibrate_sheets = estimate
        LaserFit.to_calibration = document  # type: ignore[method-assign]


def run(result: dict[str, Any], name: str, *arguments: str) -> bool:
    """One command; its processor time, exit code and what it said go into the result."""
    began, cpu = time.perf_counter(), time.process_time()
    code = main(arguments)
    result[name] = {
        "code": code,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - cpu,
    }
    return code == 0


def board_arrays(fit: Any) -> dict[str, Any]:
    """Boards and stripe points of a fit, flat."""
    images = fit.images
    from armscan.calibration.sheets.result import PointUse

    labels = np.concatenate([[PointUse(int(u)).name for u in image.use] for image in images])
    counts = [len(image.profile) for image in images]
    views = [len(image.view.points_px) for image in images]
    return {
        "source": [image.source for image in images],
        "point_image": np.repeat(np.arange(len(images)), counts),
        "points_px": np.concatenate([image.profile.points_px for image in images]),
        "sigma_px": np.concatenate([image.profile.sigma_px for image in images]),
        "use": labels,
        "sheet": np.concatenate([image.sheet for image in images]),
        "view_image": np.repeat(np.arange(len(images)), views),
        "view_px": np.concatenate([image.view.points_px for image in images]),
        "view_mm": np.concatenate([image.view.points_board_mm for image in images]),
    }


def leave_out(kept: Kept, n_folds: int) -> list[dict[str, Any]]:
    """Documents of calibrations without one board, or one group of boards, at a time."""
    (boards, *rest), options = kept.calls[-1]
    provenance = kept.documents[-1][1]
    places = sorted({board.place for board in boards})
    folds = []
    for k in range(min(n_folds, len(places))):
        left = set(places[k::n_folds])
        others = [board for board in boards if board.place not in left]
        again = kept.estimate(others, *rest, **options)
        entry: dict[str, Any] = {
            "sources": [board.profile.source for board in boards if board.place in left]
        }
        if isinstance(again, FitFailure):
            entry["failure"] = again.reason
        else:
            document = sensor_document(kept.document(again, provenance), ("x.npz", b""))
            text = document if isinstance(document, str) else document.decode()
            entry["document"] = json.loads(text)
        folds.append(entry)
    return folds


def compute(name: str, root: Path, out: Path, n_folds: int, camera: str) -> dict[str, Any]:
    """Run the commands on one set."""
    photos = SETS[name]
    result: dict[str, Any] = {"set": name}
    shutil.rmtree(out, ignore_errors=True)  # a kept cache would flatter the time
    out.mkdir(parents=True)
    kept = Kept()
    kept.listen()
    folder = root / photos.repository.split("/")[1]
    target = ("--target", photos.target, "--force")
    if not camera:
        camera = str(out / "camera.json")
        images = [f"{folder}/{part}" for part in photos.camera.split()]
        if not run(result, "camera", "calibrate", "camera", *images, *target, "-o", camera):
            return result
    lit = [f"{folder}/{part}" for part in photos.on.split()]
    dark = [f"{folder}/{part}" for part in photos.off.split()]
    off = [word for path in dark for word in ("--off", path)]
    on = [word for path in lit for word in ("--on", path)]
    lines = ("--sheets", str(photos.n_lines)) if photos.n_lines > 1 else ()
    sensor = str(out / "sensor.json")
    laser = ("--camera", camera, *on, *off, *lines)
    if not run(result, "laser", "calibrate", "laser", *laser, *target, "-o", sensor):
        return result
    fit = kept.documents[-1][0]
    np.savez(out / "boards.npz", **board_arrays(fit))
    result["skipped"] = {item.source: item.reason for item in fit.skipped}
    result["document"] = json.loads(Path(sensor).read_text(encoding="utf-8"))
    background = [word for path in dark for word in ("--background", path)]
    made = ("--sensor", sensor, "-o", str(out / "cloud.ply"), "--force")
    run(result, "reconstruct", "reconstruct", *lit, *background, *made)
    began = time.perf_counter()
    result["folds"] = leave_out(kept, n_folds)
    result["folds_seconds"] = time.perf_counter() - began
    return result


def command() -> None:
    name, root, out, folds = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])
    camera = sys.argv[5] if len(sys.argv) > 5 else ""
    result = compute(name, root, out, folds, camera)
    (out / "ours.json").write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    command()
