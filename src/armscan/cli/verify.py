# SPDX-License-Identifier: Apache-2.0
"""``armscan verify``: the daily check of a calibrated scanner."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.inspect_arguments import (
    FeatureOption,
    PageOption,
    RegionOption,
    SideOption,
    numbers,
)
from armscan.cli.options import AsJson, Force, progress_bar, show

EXAMPLE = (
    "\b\nExample:\n  armscan verify ball/ --scanner scanner.json --ball 34.96 -o verify.html\n\n"
    "\b\nExit code 0: still valid. 1: not valid, or inconclusive. 2: the input stood in the way."
)
EXIT_NOT_PASSED = 1


def verify(
    scan: Annotated[
        Path,
        typer.Argument(
            help="A recording of a ball or plate (folder), or a cloud of one in Base.",
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
        typer.Option(help="Probed points of the plate (CSV), or A,B,C,D.", show_default=False),
    ] = None,
    mpe: Annotated[
        float | None,
        typer.Option(
            help="Limit of the error, mm; without it the calibration's own prediction.",
            show_default=False,
        ),
    ] = None,
    uncertainty: Annotated[
        float, typer.Option(help="Expanded uncertainty (k = 2) of the standard, mm.")
    ] = 0.0,
    side: SideOption = None,
    region: RegionOption = "",
    feature_mm: FeatureOption = 1.0,
    output: PageOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> int:
    """Say whether a scanner still measures as its calibration predicts."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.verify import VerifyRequest, run_verification
    from armscan.pipeline.verify import VerifyOptions

    request = VerifyRequest(
        scan=scan,
        scanner=scanner,
        ball_mm=ball,
        plate=plate,
        region=numbers(region, "--region"),
        options=VerifyOptions(mpe_mm=mpe, reference_u_mm=uncertainty),
        output=output,
        inspection=InspectionOptions(feature_mm=feature_mm),
        is_overwriting=force,
        command=("armscan", *sys.argv[1:]),
        side=None if side is None else side.value,
    )
    with progress_bar() as progress:
        summary, verdict = run_verification(request, progress)
    show(summary, as_json=as_json)
    return 0 if verdict == "still valid" else EXIT_NOT_PASSED
