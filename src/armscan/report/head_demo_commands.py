# SPDX-License-Identifier: Apache-2.0
"""The demo of a head once more by hand, command by command."""

from __future__ import annotations

from pathlib import Path

from armscan.devices.twin import Twin
from armscan.pipeline.head_demo import HeadDemo
from armscan.pipeline.head_measurements import STILL_MARGIN
from armscan.report.summary import Table


def head_demo_commands(recordings: Path, twin: Twin, demo: HeadDemo) -> Table:
    """Each step on the demo's recordings; results go to the current folder."""
    normal = ",".join(f"{value:.6f}" for value in demo.still_normal)
    truth, still = twin.truth, demo.still_step.nominal_height_mm
    lines = [
        *_calibrated(recordings, twin, demo),
        f"armscan probe {recordings / 'probing'} -o plate.csv",
        f"armscan calibrate hand-eye {recordings / 'hand-eye'} --sensor sensor.json "
        "--plate plate.csv -o scanner.json",
        *_measured(recordings, "plate", "plane plate.ply --plate plate.csv"),
        *_measured(recordings, "ball", f"sphere ball.ply --diameter {truth.ball_diameter_mm:g}"),
        f"armscan verify {recordings / 'ball'} --scanner scanner.json "
        f"--ball {truth.ball_diameter_mm:g}",
    ]
    for k, height in enumerate(truth.step_heights_mm):
        found = _measured(recordings, "steps", f"step steps.ply --height {height:g}")
        lines += found if k == 0 else found[1:]
    lines += [
        f"armscan reconstruct {recordings / 'still-step'} --sensor sensor.json "
        f"--depth-margin {STILL_MARGIN:g} -o still.ply",
        f"armscan inspect step still.ply --height {still:g} --normal={normal}",
        f"armscan reconstruct {recordings / 'part'} --scanner scanner.json -o part.ply",
    ]
    columns = ("The same, command by command",)
    return Table(columns, tuple((line,) for line in lines), "", (0,))


def _calibrated(recordings: Path, twin: Twin, demo: HeadDemo) -> list[str]:
    """Cameras and sheets."""
    target, laser = twin.target, recordings / "laser"
    kind = "camera" if demo.instrument.sensor.second is None else "stereo"
    return [
        f"armscan calibrate {kind} --scan {recordings / 'camera'} --target {target} -o {kind}.json",
        f"armscan calibrate laser --camera {kind}.json --scan {laser} --target {target} "
        "-o sensor.json",
    ]


def _measured(recordings: Path, scene: str, inspection: str) -> list[str]:
    return [
        f"armscan reconstruct {recordings / scene} --scanner scanner.json -o {scene}.ply",
        f"armscan inspect {inspection}",
    ]
