# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect line``, ``circle``, ``cylinder``, ``cone`` and ``relation``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import OF_INSPECTIONS, Work, job_command
from armscan.cli.inspect import CloudArgument
from armscan.cli.options import FeatureOption, PageOption, RegionOption, given, numbers

LINE_EXAMPLE = "\b\nExample:\n  armscan inspect line edge.ply --region=0,40,-1,1,9,11 -o edge.html"
CIRCLE_EXAMPLE = (
    "\b\nExample:\n  armscan inspect circle part.ply --diameter 12 --region=10,30,5,25,-5.2,-5 "
    "-o rim.html"
)
CYLINDER_EXAMPLE = (
    "\b\nExamples:\n  armscan inspect cylinder part.ply --diameter 20 -o boss.html\n"
    "  armscan inspect cylinder part.ply --seed=26,15,-5 --diameter-range 8,16"
)
CONE_EXAMPLE = "\b\nExample:\n  armscan inspect cone part.ply --half-angle 25 -o cone.html"
RELATION_EXAMPLE = (
    "\b\nExamples:\n"
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


@job_command(PageOption, None, also=OF_INSPECTIONS)
def line(
    cloud: CloudArgument,
    *,
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
) -> Work:
    """Fit a straight line to points along an edge or a wire."""
    return _inspect("line", cloud, feature_mm, axis=axis, seed_mm=seed, region=region)


@job_command(PageOption, None, also=OF_INSPECTIONS)
def circle(
    cloud: CloudArgument,
    *,
    diameter: Diameter = None,
    diameter_range: DiameterRange = "",
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
) -> Work:
    """Fit a circle to points of a rim or of a thin section."""
    return _inspect(
        "circle", cloud, feature_mm, axis=axis, seed_mm=seed, region=region,
        diameter_range_mm=diameter_range, diameter_mm=diameter,
    )  # fmt: skip


@job_command(PageOption, None, also=OF_INSPECTIONS)
def cylinder(
    cloud: CloudArgument,
    *,
    diameter: Diameter = None,
    diameter_range: DiameterRange = "",
    axis: Axis = "",
    seed: Seed = "",
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
) -> Work:
    """Find a cylinder, a bore or a boss, and fit it."""
    return _inspect(
        "cylinder", cloud, feature_mm, axis=axis, seed_mm=seed, region=region,
        diameter_range_mm=diameter_range, diameter_mm=diameter,
    )  # fmt: skip


@job_command(PageOption, None, also=OF_INSPECTIONS)
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
) -> Work:
    """Find a cone and fit it."""
    return _inspect(
        "cone", cloud, feature_mm, axis=axis, seed_mm=seed, region=region, half_angle_deg=half_angle
    )


@job_command(PageOption, None, also=OF_INSPECTIONS)
def relation(
    cloud: CloudArgument,
    first: Annotated[str, typer.Argument(help="One feature.", show_default=False)],
    second: Annotated[str, typer.Argument(help="The other.", show_default=False)],
    *,
    feature_mm: FeatureOption = None,
) -> Work:
    """Distance and angle of two features of one cloud."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspection.shapes import inspect_relation, parse_feature

    one, other = parse_feature(first, "the first feature"), parse_feature(second, "the second")
    options = given(InspectionOptions, feature_mm=feature_mm)
    return lambda job: inspect_relation(job, cloud, one, other, options=options)


def _inspect(kind: str, cloud: Path, feature_mm: float | None, **said: str | float | None) -> Work:
    """Work on one feature, of which each field was said as a number or as numbers in a text."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspection.shapes import inspect_feature, wanted_feature

    known: dict[str, object] = {
        name: numbers(value, OPTION_OF[name]) if isinstance(value, str) else value
        for name, value in said.items()
    }
    wanted = wanted_feature(kind, f"inspect {kind}", known)
    options = given(InspectionOptions, feature_mm=feature_mm)
    return lambda job: inspect_feature(job, cloud, wanted, options=options)


OPTION_OF = {
    "axis": "--axis",
    "seed_mm": "--seed",
    "region": "--region",
    "diameter_range_mm": "--diameter-range",
}
