# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect plane``: a flat face against a plane."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.inspect_arguments import (
    CloudArgument,
    FeatureOption,
    PageOption,
    RegionOption,
    SideOption,
    inspect_request,
)
from armscan.cli.options import AsJson, Force, show

EXAMPLE = (
    "\b\nExample:\n  armscan inspect plane plate.ply --plate plate.csv -o plate-inspection.html"
)


def plane(
    cloud: CloudArgument,
    *,
    plane: Annotated[
        str,
        typer.Option(
            help="Nominal plane A,B,C,D in the cloud's frame, D in mm.", show_default=False
        ),
    ] = "",
    plate: Annotated[
        Path | None, typer.Option(help="Nominal plane: probed points (CSV), or A,B,C,D in a file.")
    ] = None,
    side: SideOption = None,
    region: RegionOption = "",
    feature_mm: FeatureOption = 1.0,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Distances of points to a plane: fitted to them, and nominal if one is given."""
    from armscan.jobs.inspect import run_plane_inspection

    request = inspect_request(
        cloud, region=region, feature_mm=feature_mm, output=output, force=force
    )
    summary = run_plane_inspection(request, plane, plate, None if side is None else side.value)
    show(summary, as_json=as_json)
