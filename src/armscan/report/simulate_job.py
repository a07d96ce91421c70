# SPDX-License-Identifier: Apache-2.0
"""A recording from the twin, and what to do with it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from armscan.devices.twin import TwinScene
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.simulate import SimulatedScene, SimulateOptions, simulate_scene
from armscan.report.summary import Summary


@dataclass(frozen=True, slots=True)
class SimulateRequest:
    """What to simulate.

    Parameters
    ----------
    head, scene
        Names of the head and of what it looks at.
    folder
        Of the recording.
    options
        Preset, seed, processes.
    """

    head: str
    scene: TwinScene
    folder: Path
    options: SimulateOptions = field(default_factory=SimulateOptions)


def run_simulation(request: SimulateRequest, progress: Progress = silent) -> Summary:
    """Write the recording, and its truth beside it.

    Raises
    ------
    ArmscanError
        As `simulate_scene`.
    """
    found = simulate_scene(request.folder, request.head, request.scene, request.options, progress)
    counts = [("images", str(found.n_images))] if found.n_images else []
    counts += [("arm samples", str(found.n_arm_samples))] if found.n_arm_samples else []
    return Summary(
        title=f"Simulated: head {request.head}, scene {request.scene}, preset "
        f"{request.options.preset}, seed {request.options.seed}",
        facts=(*counts, ("target", found.target)),
        written=(found.folder, found.truth),
        next_step=_next_step(request.scene, found),
        data={
            "kind": "simulate",
            "simulated": True,
            "head": request.head,
            "scene": request.scene,
            **asdict(request.options),
            "images": found.n_images,
            "arm_samples": found.n_arm_samples,
            "target": found.target,
            "folder": found.folder.as_posix(),
            "truth": found.truth.as_posix(),
        },
    )


def _next_step(scene: TwinScene, found: SimulatedScene) -> str:
    folder = found.folder
    if scene == "camera":
        return (
            f"armscan calibrate camera {folder / 'images'} --target {found.target} -o camera.json"
        )
    if scene == "laser":
        return (
            f"armscan calibrate laser --camera camera.json --on {folder / 'images' / 'on'} "
            f"--off {folder / 'images' / 'off'} --target {found.target} -o sensor.json"
        )
    if scene == "probing":
        return f"armscan probe {folder} -o plate.csv"
    if scene == "hand-eye":
        return (
            f"armscan calibrate hand-eye {folder} --sensor sensor.json --plate plate.csv "
            "-o scanner.json"
        )
    return f"armscan reconstruct {folder} --scanner scanner.json -o cloud.ply"
