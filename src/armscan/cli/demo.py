# SPDX-License-Identifier: Apache-2.0
"""``armscan demo``: the whole chain on rendered images, with the truth beside it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.options import AsJson, progress_bar, show

EXAMPLE = "\b\nExample:\n  armscan demo single -o demo"


class Scene(StrEnum):
    """What can be shown."""

    SINGLE = "single"
    CROSS = "cross"
    MULTI = "multi"
    ALL = "all"
    PHOTOS = "photos"


def demo(
    scene: Annotated[
        Scene,
        typer.Argument(
            help="single, cross, multi: a scanner of one, two crossed or eleven lines on a "
            "measuring arm, with plate, ball, blocks and part; all: the three beside each other; "
            "photos: photographs as a laboratory without an arm has them."
        ),
    ] = Scene.SINGLE,
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

    is_head = scene not in (Scene.ALL, Scene.PHOTOS)
    head = f"thesis-{scene.value}" if is_head else "thesis-single"
    request = DemoRequest(output, head, seed, cast(Preset, preset))
    with progress_bar() as progress:
        if scene is Scene.PHOTOS:
            summary = run_photo_demo(request, progress)
        elif scene is Scene.ALL:
            summary = run_all_heads(request, progress)
        else:
            summary = run_head_demo(request, progress)
    show(summary, as_json=as_json)
