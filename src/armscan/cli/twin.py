# SPDX-License-Identifier: Apache-2.0
"""``armscan demo`` and ``simulate``: the digital twin."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.delivery import progress_bar, show
from armscan.cli.inspect_cad import UnitOption
from armscan.cli.options import AsJson, DefaultOf, given

DEMO_EXAMPLE = "\b\nExample:\n  armscan demo single -o demo"
SIMULATE_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan simulate thesis-single camera -o board\n"
    "  armscan simulate thesis-single ball -o ball --preset harsh --seed 3\n"
    "  armscan simulate thesis-multi markers -o markers\n"
    "  armscan simulate thesis-single workpiece --part my.stl -o part"
)
TWIN = "armscan.pipeline.simulate:SimulateOptions."


class DemoScene(StrEnum):
    """What can be shown."""

    SINGLE = "single"
    CROSS = "cross"
    MULTI = "multi"
    ALL = "all"
    PHOTOS = "photos"
    WORKPIECE = "workpiece"


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
    WORKPIECE = "workpiece"
    LATENCY = "latency"


class PresetName(StrEnum):
    """How good the instrument is."""

    CLEAN = "clean"
    THESIS = "thesis"
    HARSH = "harsh"


def demo(
    scene: Annotated[
        DemoScene,
        typer.Argument(
            help="single, cross, multi: a scanner of one, two crossed or eleven lines on a "
            "measuring arm, with plate, ball, blocks and part; all: the three beside each other; "
            "photos: photographs as a laboratory without an arm has them; workpiece: a part with "
            "two faults against its CAD model (needs the extra cad)."
        ),
    ] = DemoScene.SINGLE,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for images, results and pages.")
    ] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Everything random follows from it.")] = 1,
    preset: Annotated[
        str, typer.Option(help="Of the arm scanner: clean, thesis or harsh.")
    ] = "thesis",
    as_json: AsJson = False,
) -> None:
    """Show the whole chain on simulated images.

    Images are rendered, calibrated from and measured in, and the errors are stated.
    """
    from armscan.devices.sources import Preset
    from armscan.jobs.twin.demo import DemoRequest, run_all_heads, run_head_demo, run_photo_demo
    from armscan.jobs.twin.inspect_demo import run_workpiece_demo

    is_head = scene not in (DemoScene.ALL, DemoScene.PHOTOS, DemoScene.WORKPIECE)
    head = f"thesis-{scene.value}" if is_head else "thesis-single"
    request = DemoRequest(output, head, seed, cast(Preset, preset))
    with progress_bar() as progress:
        if scene is DemoScene.PHOTOS:
            summary = run_photo_demo(request, progress)
        elif scene is DemoScene.ALL:
            summary = run_all_heads(request, progress)
        elif scene is DemoScene.WORKPIECE:
            summary = run_workpiece_demo(request, progress)
        else:
            summary = run_head_demo(request, progress)
    show(summary, as_json=as_json)


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
            "-o",
            "--output",
            help="Folder of the recording, new or empty; or a new .mcap.",
            show_default=False,
        ),
    ],
    preset: Annotated[
        PresetName | None,
        typer.Option(
            help="How good the instrument, how kind the surroundings.",
            show_default=DefaultOf(TWIN + "preset"),
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Everything random follows from it.",
            show_default=DefaultOf(TWIN + "seed"),
        ),
    ] = None,
    processes: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=64,
            help="Processes that render; few images take one.",
            show_default=DefaultOf(TWIN + "processes"),
        ),
    ] = None,
    part: Annotated[
        str,
        typer.Option(
            help="Scene workpiece: scan this .stl, .ply or .obj instead.", show_default=False
        ),
    ] = "",
    unit: Annotated[
        UnitOption | None,
        typer.Option(help="Unit of its numbers.", show_default=DefaultOf(TWIN + "unit")),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Render a recording of the digital twin.

    NAME.truth.json beside it says what it was made from.

    Scenes: camera and laser are images of a target for the head's calibration; hand-eye is the
    plate from many postures; plate, ball, steps, part and waves are scans by hand; still-step is
    one exposure of the steps, and still-part one of the part, with the same view without laser;
    markers is a part with ring markers, place by place, and markers-moved the same
    part after the arm was put down elsewhere; probing is the plate touched with a tip; workpiece is
    a part with two faults, whose CAD model comes with armscan, or --part; latency is the plate with
    the head moved nearer and away, and an arm with a clock of its own.
    """
    from armscan.jobs.twin.simulate import run_simulation
    from armscan.pipeline.simulate import SimulateOptions

    quality = None if preset is None else preset.value
    options = given(
        SimulateOptions,
        preset=quality,
        seed=seed,
        processes=processes,
        part=part,
        unit=None if unit is None else unit.value,
    )
    with progress_bar() as progress:
        summary = run_simulation(head, scene.value, output, options, progress)
    show(summary, as_json=as_json)
