# SPDX-License-Identifier: Apache-2.0
"""The demo of an inspection: a part with two faults, scanned, laid on its CAD model and judged."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np

from armscan.devices.sources import TwinTruth
from armscan.geometry.poses import Base, Cad, Part, Pose
from armscan.geometry.rotations import vector_from_rotation
from armscan.jobs.inspection.cad import inspect_cad
from armscan.jobs.job import Job
from armscan.jobs.reconstruct import StillPaths, reconstruct
from armscan.jobs.twin.demo import TRUTH, DemoRequest, calibrate_head, demo_folder, typed_commands
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.simulate import record_scenes
from armscan.report.quantity import Quantity, Summary
from armscan.storage.clouds import read_cloud
from armscan.storage.files import told_path, write_files

MODEL = "workpiece.step"
TOLERANCES = """default_mm = 0.05
[faces]
"cylinder 19" = 0.015
"""
"""Of the faces; that of the bore is a limit of its radius."""
MADE_MM: Mapping[str, float] = {"plane 3": 0.08, "cylinder 19": -0.025}
"""Faces that were not made as the model says: a pad too high, and a bore too large by 0.05 mm in
diameter, whose wall lies inside the model's material. Looked at when everything is decided."""


def run_workpiece_demo(request: DemoRequest, progress: Progress = silent) -> Summary:
    """Calibrate a simulated scanner, scan the workpiece with it, and compare it with its model.

    The cloud is laid on the model from its points alone; what is true is looked at afterwards.
    """
    with demo_folder(request.folder) as folder:
        command = request.command("workpiece")
        twin = request.twin.build()
        write_files({folder / TRUTH: twin.truth.document()})
        model, limits = folder / MODEL, folder / "tolerances.toml"
        source = files("armscan.simulation") / "workpiece" / MODEL
        write_files({model: source.read_bytes(), limits: TOLERANCES.encode()})
        instrument = calibrate_head(request, "workpiece", folder, progress)
        scan = folder / "recordings" / "workpiece"
        record_scenes(
            {"workpiece": scan}, request.twin, request.most_views,
            processes=request.processes, progress=progress,
        )  # fmt: skip
        cloud, page = folder / "cloud.ply", folder / "part.html"
        of_cloud = Job(cloud, command=command, progress=progress)
        reconstruct(of_cloud, folder / "scanner.json", StillPaths((str(scan),)))
        judged = inspect_cad(
            Job(page, command=command, progress=progress), cloud, model, tolerance=str(limits)
        )
        data = judged.data
        laid = np.array(data["alignment"]["cad_from_part"])
        place: Pose[Cad, Base] = Pose(laid[:3, :3], laid[:3, 3])
        truth = _beside_truth(data["faces"]["each"], place, read_cloud(cloud).points_mm, twin.truth)
        told = told_path(scan)
        return Summary(
            title="Demo of a simulated scanner: a workpiece with two faults against its CAD model",
            quantities=(*judged.quantities, *truth),
            tables=(
                *judged.tables[:1],
                typed_commands(
                    f"armscan reconstruct {told} --scanner scanner.json -o cloud.ply",
                    f"armscan inspect cad cloud.ply {MODEL} --tolerance tolerances.toml "
                    "-o part.html",
                ),
            ),
            warnings=(*instrument.warnings, *judged.warnings),
            written=tuple(map(told_path, (folder, page, cloud, model, limits))),
            next_step=f"open {told_path(page)} in a browser",
            extra={"kind": "demo", "simulated": True, "seed": request.seed, **judged.extra},
        )


def _beside_truth(
    faces: list[dict[str, Any]], cad_from_base: Pose[Cad, Base], points_mm: Any, truth: TwinTruth
) -> tuple[Quantity, ...]:
    """How far what was found is from what the twin was made from."""
    error: Pose[Cad, Part] = cad_from_base @ truth.base_from_workpiece
    middle = np.array([0.0, 0.0, 10.0])
    shift = float(np.linalg.norm(error.apply(middle) - middle))
    turn = float(np.degrees(np.linalg.norm(vector_from_rotation(error.rotation))))
    seen = [one for one in faces if one["n"] and one["decision"] != "not seen"]
    off = [abs(one["mean_mm"] - MADE_MM.get(one["face"], 0.0)) for one in seen]
    wrong = [one["face"] for one in seen if (one["decision"] == "fail") != (one["face"] in MADE_MM)]
    near = float(np.mean(truth.workpiece_distance_mm(points_mm) <= 0.05))
    return (
        Quantity("truth.shift_mm", "Error of the alignment", shift, unit="mm",
                 meaning=f"and {turn:.4f} degrees, beside the truth"),
        Quantity("truth.turn_deg", "", turn),
        Quantity("truth.within_50_um", "Points", 100.0 * near, unit="%",
                 meaning="within 0.05 mm of the surface as it was made"),
        Quantity("truth.largest_face_error_mm", "Means of faces", max(off), unit="mm",
                 meaning="from the face as made, at most"),
        Quantity("truth.wrongly_called", "Called wrong and sound, or the reverse", wrong,
                 shown=", ".join(wrong) or "none"),
    )  # fmt: skip
