# SPDX-License-Identifier: Apache-2.0
"""``armscan demo``: the whole chain on rendered photographs, with the truth beside it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.output import AsJson, progress_bar, show

EXAMPLE = "\b\nExample:\n  armscan demo photos -o demo"


class Scene(StrEnum):
    """What can be shown."""

    PHOTOS = "photos"


def demo(
    scene: Annotated[
        Scene, typer.Argument(help="photos: a camera, a line laser, a board and a bust.")
    ] = Scene.PHOTOS,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for photographs, results and pages.")
    ] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Placement and noise of the photographs.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Render photographs, calibrate camera and laser, measure an object, state the errors."""
    from armscan.report.demo_job import DemoRequest, run_photo_demo

    jobs = {Scene.PHOTOS: run_photo_demo}
    with progress_bar() as progress:
        summary = jobs[scene](DemoRequest(output, seed), progress)
    show(summary, as_json=as_json)
