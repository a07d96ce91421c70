# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect sphere``: a ball against the standard."""

from __future__ import annotations

from typing import Annotated

import typer

from armscan.cli.inspect_arguments import (
    CloudArgument,
    FeatureOption,
    PageOption,
    RegionOption,
    inspect_request,
)
from armscan.cli.options import AsJson, Force, show

EXAMPLE = "\b\nExample:\n  armscan inspect sphere ball.ply --diameter 34.96 -o ball-inspection.html"


def sphere(
    cloud: CloudArgument,
    *,
    diameter: Annotated[
        float, typer.Option(help="Diameter of the standard ball, mm.", show_default=False)
    ],
    region: RegionOption = "",
    feature_mm: FeatureOption = 1.0,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find a ball in a cloud; compare it with the standard, and with the fitted ball."""
    from armscan.jobs.inspect import run_sphere_inspection

    request = inspect_request(
        cloud, region=region, feature_mm=feature_mm, output=output, force=force
    )
    show(run_sphere_inspection(request, diameter), as_json=as_json)
