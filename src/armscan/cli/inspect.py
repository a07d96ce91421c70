# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect``: a plane, a ball or a step; ``armscan verify``: the daily check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import OF_INSPECTIONS, Work, job_command
from armscan.cli.options import (
    ArmFile,
    DefaultOf,
    FeatureOption,
    PageOption,
    RegionOption,
    SideOption,
    given,
    numbers,
)

PLANE_EXAMPLE = (
    "\b\nExample:\n  armscan inspect plane plate.ply --plate plate.csv -o plate-inspection.html"
)
SPHERE_EXAMPLE = (
    "\b\nExample:\n  armscan inspect sphere ball.ply --diameter 34.96 -o ball-inspection.html"
)
STEP_EXAMPLE = (
    "\b\nExample:\n  armscan inspect step blocks.ply --height 20 -o blocks-inspection.html\n\n"
    "\b\nPoints of one light sheet cannot tell how far it leans on the faces;\n"
    "without --normal it is taken to stand square."
)
VERIFY_EXAMPLE = (
    "\b\nExample:\n  armscan verify ball/ --scanner scanner.json --ball 34.96 -o verify.html\n\n"
    "\b\nExit code 0: still valid. 1: not valid, or inconclusive. 2: the input stood in the way."
)
EXIT_NOT_PASSED = 1

CloudArgument = Annotated[
    Path,
    typer.Argument(
        help="A cloud of `armscan reconstruct`, or any that `armscan convert` reads, in mm.",
        show_default=False,
    ),
]


@job_command(PageOption, None, also=OF_INSPECTIONS)
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
    feature_mm: FeatureOption = None,
) -> Work:
    """Distances of points to a plane, fitted or nominal."""
    from armscan.calibration.hand_eye.probed_plate import ProbeSide
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspection.shapes import inspect_plane

    box = numbers(region, "--region")
    options = given(InspectionOptions, feature_mm=feature_mm)
    axis: ProbeSide | None = None if side is None else side.value
    return lambda job: inspect_plane(
        job, cloud, plane=plane, plate=plate, side=axis, region=box, options=options
    )


@job_command(PageOption, None, also=OF_INSPECTIONS)
def sphere(
    cloud: CloudArgument,
    *,
    diameter: Annotated[
        float, typer.Option(help="Diameter of the standard ball, mm.", show_default=False)
    ],
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
) -> Work:
    """Find a ball in a cloud and compare it with the standard."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspection.shapes import inspect_sphere

    box = numbers(region, "--region")
    options = given(InspectionOptions, feature_mm=feature_mm)
    return lambda job: inspect_sphere(job, cloud, diameter, region=box, options=options)


@job_command(PageOption, None, also=OF_INSPECTIONS)
def step(
    cloud: CloudArgument,
    *,
    height: Annotated[float, typer.Option(help="Nominal height, mm.", show_default=False)],
    normal: Annotated[
        str,
        typer.Option(
            help="Normal x,y,z of the faces in the cloud's frame, for points of one light sheet.",
            show_default=False,
        ),
    ] = "",
    margin: Annotated[
        float | None,
        typer.Option(
            help="Leave out this much at the ends of the faces, mm.",
            show_default=DefaultOf("armscan.inspection.selection:StepOptions.margin_mm"),
        ),
    ] = None,
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
) -> Work:
    """Find two parallel faces and measure their distance."""
    from armscan.inspection.selection import InspectionOptions, StepOptions
    from armscan.jobs.inspection.shapes import inspect_step

    box = numbers(region, "--region")
    direction = numbers(normal, "--normal")
    options = given(InspectionOptions, feature_mm=feature_mm)
    steps = given(StepOptions, margin_mm=margin)
    return lambda job: inspect_step(
        job, cloud, height, normal=direction, region=box, options=options, step_options=steps
    )


@job_command(
    PageOption, None,
    code=lambda said: 0 if said.data["verdict"] == "still valid" else EXIT_NOT_PASSED,
)  # fmt: skip
def verify(
    scan: Annotated[
        Path,
        typer.Argument(
            help="A recording of a ball or plate (folder or .mcap), or a cloud of one in Base.",
            show_default=False,
        ),
    ],
    *,
    scanner: Annotated[
        Path | None,
        typer.Option(help="Calibration of the scanner; a recording needs it.", show_default=False),
    ] = None,
    ball: Annotated[
        float | None,
        typer.Option(help="Diameter of the standard ball, mm.", show_default=False),
    ] = None,
    plate: Annotated[
        Path | None,
        typer.Option(
            help="The plate: probed points (CSV), or A,B,C,D in a file.", show_default=False
        ),
    ] = None,
    plane: Annotated[
        str, typer.Option(help="The plate as A,B,C,D in Base, D in mm.", show_default=False)
    ] = "",
    mpe: Annotated[
        float | None,
        typer.Option(
            help="Limit of the error, mm; without it the calibration's own prediction.",
            show_default=False,
        ),
    ] = None,
    uncertainty: Annotated[
        float | None,
        typer.Option(
            help="Expanded uncertainty (k = 2) of the standard, mm.",
            show_default=DefaultOf("armscan.pipeline.verify:VerifyOptions.reference_u_mm"),
        ),
    ] = None,
    side: SideOption = None,
    arm: ArmFile = None,
    region: RegionOption = "",
    feature_mm: FeatureOption = None,
) -> Work:
    """Say whether a scanner is still as its calibration says."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.verify import Standard
    from armscan.jobs.verify import verify as verify_scanner
    from armscan.pipeline.verify import VerifyOptions

    box = numbers(region, "--region")
    options = given(VerifyOptions, mpe_mm=mpe, reference_u_mm=uncertainty)
    inspection = given(InspectionOptions, feature_mm=feature_mm)
    standard = Standard(ball, plate, None if side is None else side.value, plane)
    return lambda job: verify_scanner(
        job, scan, scanner, standard, arm=arm, region=box, options=options, inspection=inspection
    )
