# SPDX-License-Identifier: Apache-2.0
"""``armscan demo``, ``simulate`` and ``reconstruct``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.options import (
    ArmFile,
    AsJson,
    BitsAlign,
    BitsUsed,
    Cache,
    DefaultOf,
    EulerAngles,
    Force,
    LaserColourOption,
    Method,
    MethodOption,
    StripeMethodOption,
    given,
    progress_bar,
    refuse_given,
    refuse_vain,
    run,
    show,
)

DEMO_EXAMPLE = "\b\nExample:\n  armscan demo single -o demo"
SIMULATE_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan simulate thesis-single camera -o board\n"
    "  armscan simulate thesis-single ball -o ball --preset harsh --seed 3\n"
    "  armscan simulate thesis-multi markers -o markers"
)
OF_IMAGES = (
    "background right right_background sheet depth_margin arm "
    "method stripe_method laser_colour bits_used bits_align cache"
)
RECONSTRUCT_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan reconstruct scan --scanner scanner.json -o cloud.ply\n"
    "  armscan reconstruct scan/laser.png --background scan/dark.png --sensor sensor.json \\\n"
    "      --sheet A -o cloud.ply\n"
    "  armscan reconstruct left.png --right right.png --sensor sensor.json -o cloud.ply\n"
    "  armscan reconstruct 'p*.yml' --poses RobPoses.rob --scanner scanner.json -o cloud.ply"
)
TWIN = "armscan.pipeline.simulate:SimulateOptions."


class DemoScene(StrEnum):
    """What can be shown."""

    SINGLE = "single"
    CROSS = "cross"
    MULTI = "multi"
    ALL = "all"
    PHOTOS = "photos"


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


def demo(
    scene: Annotated[
        DemoScene,
        typer.Argument(
            help="single, cross, multi: a scanner of one, two crossed or eleven lines on a "
            "measuring arm, with plate, ball, blocks and part; all: the three beside each other; "
            "photos: photographs as a laboratory without an arm has them."
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
    """Render images, calibrate from them, measure things, and state the errors."""
    from armscan.devices.sources import Preset
    from armscan.jobs.demo import DemoRequest, run_all_heads, run_head_demo, run_photo_demo

    is_head = scene not in (DemoScene.ALL, DemoScene.PHOTOS)
    head = f"thesis-{scene.value}" if is_head else "thesis-single"
    request = DemoRequest(output, head, seed, cast(Preset, preset))
    with progress_bar() as progress:
        if scene is DemoScene.PHOTOS:
            summary = run_photo_demo(request, progress)
        elif scene is DemoScene.ALL:
            summary = run_all_heads(request, progress)
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
            "-o", "--output", help="Folder of the recording; new or empty.", show_default=False
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
    as_json: AsJson = False,
) -> None:
    """Render a recording of the digital twin; NAME.truth.json beside it says what it was made from.

    Scenes: camera and laser are images of a target for the head's calibration; hand-eye is the
    plate from many postures; plate, ball, steps, part and waves are scans by hand; still-step is
    one exposure of the steps, and still-part one of the part, with the same view without laser;
    markers is a part with ring markers, place by place, and markers-moved the same
    part after the arm was put down elsewhere; probing is the plate touched with a tip.
    """
    from armscan.jobs.simulate import SimulateRequest, run_simulation
    from armscan.pipeline.simulate import SimulateOptions

    quality = None if preset is None else preset.value
    options = given(SimulateOptions, preset=quality, seed=seed, processes=processes)
    with progress_bar() as progress:
        summary = run_simulation(SimulateRequest(head, scene.value, output, options), progress)
    show(summary, as_json=as_json)


DepthMargin = Annotated[
    float | None,
    typer.Option(
        help="Widen the calibrated depth range by this part of its width at either end; "
        "points beyond are left out. Without it 0; with two cameras 0.5; points between are "
        "extrapolated.",
        show_default=False,
    ),
]
ProfilePoses = Annotated[
    Path | None,
    typer.Option(
        help="Table of the robot's poses, one a profile: the files are profiles of a sensor "
        "that delivers points.",
        show_default=False,
    ),
]


Volume = Annotated[
    str, typer.Option(help="Part of Base to measure: xmin,xmax,ymin,ymax,zmin,zmax in mm.")
]


def reconstruct(
    context: typer.Context,
    *,
    images: Annotated[
        list[str],
        typer.Argument(
            help="A recording's folder; or images with the laser on: files, folders, patterns.",
            show_default=False,
        ),
    ],
    sensor: Annotated[
        Path,
        typer.Option(
            "--sensor",
            "--scanner",
            help="Calibration: a recording with scanner.json is placed in Base, all else is in "
            "the Sensor frame.",
            show_default=False,
        ),
    ],
    background: Annotated[
        list[str] | None, typer.Option(help="The same views without laser; repeatable.")
    ] = None,
    right: Annotated[
        list[str] | None,
        typer.Option(help="Right camera's images of the same instants; of a stereo head."),
    ] = None,
    right_background: Annotated[
        list[str] | None, typer.Option(help="The right camera's without laser; repeatable.")
    ] = None,
    sheet: Annotated[str, typer.Option(help="Sheet that drew the stripes; empty finds it.")] = "",
    depth_margin: DepthMargin = None,
    volume: Volume = "",
    arm: ArmFile = None,
    poses: ProfilePoses = None,
    euler: EulerAngles = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Cloud to write: .ply, or as `convert`.")
    ] = Path("cloud.ply"),
    method: MethodOption = None,
    stripe_method: StripeMethodOption = None,
    laser_colour: LaserColourOption = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
    cache: Cache = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Measure points from a recording of a scan, or from images of laser lines on objects."""
    from armscan.jobs.reconstruct import PoseTable, StillPaths
    from armscan.jobs.reconstruct import reconstruct as reconstruct_points
    from armscan.pipeline.measure import MeasureOptions
    from armscan.reconstruction.triangulate import DepthRange
    from armscan.storage.images import ImageOptions
    from armscan.vision.stripe.image import StripeOptions

    names = (images, background, right, right_background)
    _check_poses(context, poses, euler)
    options = MeasureOptions(
        stripes=given(StripeOptions, method=stripe_method, laser_colour=laser_colour),
        depths=None if depth_margin is None else DepthRange(depth_margin),
        sheet=sheet,
        is_by_thesis=method is Method.THESIS,
    )
    run(
        lambda job: reconstruct_points(
            job,
            sensor,
            StillPaths(*(tuple(one or ()) for one in names)),
            volume=volume,
            arm=arm,
            poses=None if poses is None else given(PoseTable, path=poses, euler=euler),
            options=options,
            image_options=given(ImageOptions, bits_used=bits_used, align=bits_align),
        ),
        as_json=as_json,
        output=output,
        force=force,
        cache=cache,
    )


def _check_poses(context: typer.Context, poses: Path | None, euler: str | None) -> None:
    """Refuse options without effect on profiles, and angles of no table."""
    if poses is None:
        refuse_vain({"--euler": euler}, "there is no table of poses", "give --poses, or leave out")
    else:
        refuse_given(
            context, OF_IMAGES, "profiles with --poses are points already: no image is read"
        )
