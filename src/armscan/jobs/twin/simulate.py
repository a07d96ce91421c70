# SPDX-License-Identifier: Apache-2.0
"""From scenes of the twin to folders with their recordings."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from armscan.devices.sources import TwinScene
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.simulate import SimulatedScene, SimulateOptions, simulate_scene
from armscan.report.quantity import Summary, fact, sentences

OF_TARGET = ("camera", "laser")
"""Scenes in which a calibration target stands."""


@dataclass(frozen=True, slots=True)
class SimulateRequest:
    """What to simulate."""

    head: str
    scene: TwinScene
    folder: Path
    options: SimulateOptions = field(default_factory=SimulateOptions)


def run_simulation(request: SimulateRequest, progress: Progress = silent) -> Summary:
    """Write the recording, and its truth beside it."""
    found = simulate_scene(request.folder, request.head, request.scene, request.options, progress)
    counts = [fact("images", str(found.n_images))] if found.n_images else []
    counts += [fact("arm samples", str(found.n_arm_samples))] if found.n_arm_samples else []
    target = found.target if request.scene in OF_TARGET else None
    counts += [fact("target", target)] if target else []
    return Summary(
        title=f"Simulated: head {request.head}, scene {request.scene}, preset "
        f"{request.options.preset}, seed {request.options.seed}",
        quantities=tuple(counts),
        warnings=sentences(found.notes),
        written=(found.folder, found.truth),
        next_step=_next_step(request.scene, found),
        extra={
            "kind": "simulate",
            "simulated": True,
            "head": request.head,
            "scene": request.scene,
            **asdict(request.options),
            "images": found.n_images,
            "arm_samples": found.n_arm_samples,
            "target": target,
            "folder": found.folder.as_posix(),
            "truth": found.truth.as_posix(),
        },
    )


def _next_step(scene: TwinScene, found: SimulatedScene) -> str:
    folder = found.folder
    if scene in OF_TARGET:
        return f"{_next_calibration(scene, found)} --target {found.target} -o " + (
            "sensor.json" if scene == "laser" else _cameras_document(found)
        )
    if scene == "probing":
        return f"armscan probe {folder} -o plate.csv"
    if scene == "hand-eye":
        return (
            f"armscan calibrate hand-eye {folder} --sensor sensor.json --plate plate.csv "
            "-o scanner.json"
        )
    if scene == "latency":
        return f"armscan calibrate latency {folder} --scanner scanner.json -o scanner-timed.json"
    if scene in ("markers", "markers-moved"):
        return _next_for_markers(found)
    return f"armscan reconstruct {folder} --scanner scanner.json -o cloud.ply"


def _next_calibration(scene: TwinScene, found: SimulatedScene) -> str:
    if scene == "camera":
        kind = "stereo" if found.n_cameras > 1 else "camera"
        return f"armscan calibrate {kind} --scan {found.folder}"
    return f"armscan calibrate laser --camera {_cameras_document(found)} --scan {found.folder}"


def _cameras_document(found: SimulatedScene) -> str:
    return "stereo.json" if found.n_cameras > 1 else "camera.json"


def _next_for_markers(found: SimulatedScene) -> str:
    images = found.folder / "images"
    if found.n_cameras == 1:
        return f"armscan markers {images} -o rings.html"
    left, right = (images / side / "0001.png" for side in ("left", "right"))
    return f"armscan markers {left} {right} --stereo stereo.json -o markers.csv"
