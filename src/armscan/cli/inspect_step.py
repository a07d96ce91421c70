# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect step``: the height between two parallel faces."""

from __future__ import annotations

from typing import Annotated

import typer

from armscan.cli.inspect_arguments import (
    CloudArgument,
    FeatureOption,
    PageOption,
    RegionOption,
    inspect_request,
    numbers,
)
from armscan.cli.options import AsJson, Force, show

EXAMPLE = (
    "\b\nExample:\n  armscan inspect step blocks.ply --height 20 -o blocks-inspection.html\n\n"
    "\b\nA cloud of one exposure cannot tell how far its light sheet leans on the faces;\n"
    "without --normal it is taken to stand square."
)


def step(
    cloud: CloudArgument,
    *,
    height: Annotated[float, typer.Option(help="Nominal height, mm.", show_default=False)],
    normal: Annotated[
        str,
        typer.Option(
            help="Normal x,y,z of the faces in the cloud's frame, for a single exposure.",
            show_default=False,
        ),
    ] = "",
    margin: Annotated[
        float, typer.Option(help="Leave out this much at the ends of the faces, mm.")
    ] = 1.0,
    region: RegionOption = "",
    feature_mm: FeatureOption = 1.0,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find two parallel faces in a cloud and measure the distance between them."""
    from armscan.inspection.selection import StepOptions
    from armscan.jobs.inspect import run_step_inspection

    request = inspect_request(
        cloud, region=region, feature_mm=feature_mm, output=output, force=force
    )
    summary = run_step_inspection(
        request, height, numbers(normal, "--normal"), StepOptions(margin_mm=margin)
    )
    show(summary, as_json=as_json)
