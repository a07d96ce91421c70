# SPDX-License-Identifier: Apache-2.0
"""``armscan simulate``: a recording of the digital twin, its truth in a file beside it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.options import AsJson, progress_bar, show

EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan simulate thesis-single camera -o board\n"
    "  armscan simulate thesis-single ball -o ball --preset harsh --seed 3\n"
    "  armscan simulate thesis-multi markers -o markers"
)


class Scene(StrEnum):
    """What the head looks at."""

    CAMERA = "camera"
    LASER = "laser"
    HAND_EYE = "hand-eye"
    PLATE = "plate"
    BALL = "ball"
    STEPS = "steps"
    STILL_STEP = "still-step"
    PART = "part"
    WAVES = "waves"
    MARKERS = "markers"
    MARKERS_MOVED = "markers-moved"
    PROBING = "probing"
    STILL_PART = "still-part"


class PresetName(StrEnum):
    """How good the instrument is."""

    CLEAN = "clean"
    THESIS = "thesis"
    HARSH = "harsh"


def simulate(
    head: Annotated[
        str,
        typer.Argument(
            help="The head: thesis-single, thesis-cross, thesis-multi (11 lines, two cameras) or "
            "thesis-multi-5.",
            show_default=False,
        ),
    ],
    scene: Annotated[Scene, typer.Argument(help="What it looks at.", show_default=False)],
    *,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="Folder of the recording; new or empty.", show_default=False
        ),
    ],
    preset: Annotated[
        PresetName, typer.Option(help="How good the instrument, how kind the surroundings.")
    ] = PresetName.THESIS,
    seed: Annotated[int, typer.Option(min=0, help="Everything random follows from it.")] = 1,
    processes: Annotated[
        int, typer.Option(min=1, max=64, help="Processes that render; few images take one.")
    ] = 2,
    as_json: AsJson = False,
) -> None:
    """Render a recording of the digital twin; NAME.truth.json beside it says what it was made from.

    Scenes: camera and laser are images of a target for the head's calibration; hand-eye is the
    plate from many postures; plate, ball, steps, part and waves are scans by hand; still-step is
    one exposure; markers is a part with ring markers, place by place, and markers-moved the same
    part after the arm was put down elsewhere; probing is the plate touched with a tip.
    """
    from armscan.jobs.simulate import SimulateRequest, run_simulation
    from armscan.pipeline.simulate import SimulateOptions

    options = SimulateOptions(preset.value, seed, processes)
    with progress_bar() as progress:
        summary = run_simulation(SimulateRequest(head, scene.value, output, options), progress)
    show(summary, as_json=as_json)
