# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect line``, ``circle``, ``cylinder``, ``cone`` and ``relation``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import run
from armscan.cli.inspect import CloudArgument
from armscan.cli.options import (
    AsJson,
    FeatureOption,
    Force,
    PageOption,
    RegionOption,
    given,
    numbers,
)

LINE_EXAMPLE = "\b\nExample:\n  armscan inspect line edge.ply --region=0,40,-1,1,9,11 -o edge.html"
CIRCLE_EXAMPLE = (
    "\b\nExample:\n  armscan inspect circle part.ply --diameter 12 --region=10,30,5,25,-5.2,-5 "
    "-o rim.html"
)
CYLINDER_EXAMPLE = (
    "\b\nExample:\n  armscan inspect cylinder part.ply --diameter 20 -o boss.html\n"
    "  armscan inspect cylinder part.ply --seed=26,15,-5 --diameter-range 8,16"
)
CONE_EXAMPLE = "\b\nExample:\n  armscan inspect cone part.ply --half-angle 25 -o cone.html"
RELATION_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan inspect relation part.ply cylinder:diameter=12 cylinder:diameter=20 -o bores.html\n"
    "  armscan inspect relation part.ply plane:seed=5,5,0 cone:half-angle=25\n\n"
    "\b\nA feature is KIND:WORD=VALUE:... with the kinds plane, line, circle, sphere, cylinder,\n"
    "cone and the words diameter, range, half-angle, axis, seed, region."
)

Diameter = Annotated[float | None, typer.Option(help="Nominal diameter, mm.", show_default=False)]
DiameterRange = Annotated[
    str,
    typer.Option(
        help="Least,largest diameter, mm; 10 % about the nominal one without it.",
        show_default=False,
    ),
]
Seed = Annotated[
    str,
    typer.Option(
        help="A point x,y,z on it, mm; only what hangs together with it counts.",
        show_default=False,
    ),
]
Axis = Annotated[
    str, typer.Option(help="Its rough direction x,y,z, to 20 degrees.", show_default=False)
]


def line(
    cloud: CloudArgument,
    *,
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Fit a straight line to points along an edge or a wire."""
    _inspect(
        "line",
        cloud,
        {"axis": axis, "seed_mm": seed, "region": region},
        feature_mm=feature_mm,
        output=output,
        force=force,
        as_json=as_json,
    )


def circle(
    cloud: CloudArgument,
    *,
    diameter: Diameter = None,
    diameter_range: DiameterRange = "",
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Fit a circle to points of a rim or of a thin section."""
    _inspect(
        "circle",
        cloud,
        {"axis": axis, "seed_mm": seed, "region": region, "diameter_range_mm": diameter_range},
        diameter=diameter,
        feature_mm=feature_mm,
        output=output,
        force=force,
        as_json=as_json,
    )


def cylinder(
    cloud: CloudArgument,
    *,
    diameter: Diameter = None,
    diameter_range: DiameterRange = "",
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find a cylinder, a bore or a boss, and fit it."""
    _inspect(
        "cylinder",
        cloud,
        {"axis": axis, "seed_mm": seed, "region": region, "diameter_range_mm": diameter_range},
        diameter=diameter,
        feature_mm=feature_mm,
        output=output,
        force=force,
        as_json=as_json,
    )


def cone(
    cloud: CloudArgument,
    *,
    half_angle: Annotated[
        float | None,
        typer.Option(help="Nominal angle from axis to surface, degrees.", show_default=False),
    ] = None,
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find a cone and fit it."""
    _inspect(
        "cone",
        cloud,
        {"axis": axis, "seed_mm": seed, "region": region},
        half_angle=half_angle,
        feature_mm=feature_mm,
        output=output,
        force=force,
        as_json=as_json,
    )


def relation(
    cloud: CloudArgument,
    first: Annotated[str, typer.Argument(help="One feature.", show_default=False)],
    second: Annotated[str, typer.Argument(help="The other.", show_default=False)],
    *,
    feature_mm: FeatureOption = None,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Distance and angle of two features of one cloud."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspection.features import inspect_relation, parse_feature

    one, other = parse_feature(first, "the first feature"), parse_feature(second, "the second")
    options = given(InspectionOptions, feature_mm=feature_mm)
    run(
        lambda job: inspect_relation(job, cloud, one, other, options=options),
        as_json=as_json,
        output=output,
        force=force,
    )


def _inspect(
    kind: str,
    cloud: Path,
    texts: dict[str, str],
    *,
    diameter: float | None = None,
    half_angle: float | None = None,
    feature_mm: float | None,
    output: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspection.features import inspect_feature, wanted_feature

    known = {name: numbers(text, OPTION_OF[name]) for name, text in texts.items()}
    sizes = {"diameter_mm": diameter, "half_angle_deg": half_angle}
    wanted = wanted_feature(kind, f"inspect {kind}", {**known, **sizes})
    options = given(InspectionOptions, feature_mm=feature_mm)
    run(
        lambda job: inspect_feature(job, cloud, wanted, options=options),
        as_json=as_json,
        output=output,
        force=force,
    )


OPTION_OF = {
    "axis": "--axis",
    "seed_mm": "--seed",
    "region": "--region",
    "diameter_range_mm": "--diameter-range",
}
