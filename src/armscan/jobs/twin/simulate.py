# SPDX-License-Identifier: Apache-2.0
"""From scenes of the twin to folders with their recordings."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from armscan.devices.sources import TwinScene
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.simulate import SimulatedScene, SimulateOptions, simulate_scene
from armscan.report.quantity import Summary, fact, sentences

OF_TARGET = ("camera", "laser")
"""Scenes in which a calibration target stands."""


def run_simulation(
    head: str, scene: TwinScene, folder: Path, options: SimulateOptions, progress: Progress = silent
) -> Summary:
    """Write the recording into a folder, and its truth beside it."""
    found = simulate_scene(folder, head, scene, options, progress)
    counts = [fact("images", str(found.n_images))] if found.n_images else []
    counts += [fact("arm samples", str(found.n_arm_samples))] if found.n_arm_samples else []
    target = found.target if scene in OF_TARGET else None
    counts += [fact("target", target)] if target else []
    return Summary(
        title=f"Simulated: head {head}, scene {scene}, preset {options.preset}, "
        f"seed {options.seed}",
        quantities=tuple(counts),
        warnings=sentences(found.notes),
        written=(found.folder, found.truth),
        next_step=_next_step(scene, found),
        extra={
            "kind": "simulate",
            "simulated": True,
            "head": head,
            "scene": scene,
            **asdict(options),
            "images": found.n_images,
            "arm_samples": found.n_arm_samples,
            "target": target,
            "folder": found.folder.as_posix(),
            "truth": found.truth.as_posix(),
        },
    )


def _next_step(scene: TwinScene, found: SimulatedScene) -> str:
    folder, is_stereo = found.folder, found.n_cameras > 1
    cameras = "stereo" if is_stereo else "camera"
    if scene in OF_TARGET:
        is_laser = scene == "laser"
        how = f"laser --camera {cameras}.json" if is_laser else cameras
        document = "sensor" if is_laser else cameras
        return f"armscan calibrate {how} --scan {folder} --target {found.target} -o {document}.json"
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
        images = folder / "images"
        left, right = (images / side / "0001.png" for side in ("left", "right"))
        of_two = f"{left} {right} --stereo stereo.json -o markers.csv"
        return f"armscan markers {of_two if is_stereo else f'{images} -o rings.html'}"
    return f"armscan reconstruct {folder} --scanner scanner.json -o cloud.ply"
