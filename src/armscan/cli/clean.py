# SPDX-License-Identifier: Apache-2.0
"""``armscan clean``: points taken out of a cloud by filters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.inspect import CloudArgument
from armscan.cli.options import AsJson, Force, RegionOption, numbers, run

CLEAN_EXAMPLE = (
    "\b\nExample:\n  armscan clean part.ply -o cleaned.ply --max-incidence 60 --isolated 0.5 "
    "--edge 0.3\n"
    "  armscan clean part.ply -o thin.ply --overlap 1 --line-to-line 0.2 --density 0.1"
)


def clean(
    cloud: CloudArgument,
    *,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Cloud to write; a page goes beside it."),
    ],
    region: RegionOption = "",
    max_incidence: Annotated[
        float | None,
        typer.Option(help="Largest angle of normal and view, degrees.", show_default=False),
    ] = None,
    isolated: Annotated[
        float | None,
        typer.Option(help="Take out points with fewer than 6 others this near, mm."),
    ] = None,
    hole: Annotated[
        float | None,
        typer.Option(help="A gap wider than this ends a piece of a stripe, mm; 1 without it."),
    ] = None,
    line_deviation: Annotated[
        float | None,
        typer.Option(help="Largest distance from the line through neighbours, mm."),
    ] = None,
    line_spacing: Annotated[
        float | None,
        typer.Option(help="Largest distance to a neighbour along the stripe, mm."),
    ] = None,
    edge: Annotated[
        float | None,
        typer.Option(help="Take out this much at the ends of pieces of stripes, mm."),
    ] = None,
    line_to_line: Annotated[
        float | None,
        typer.Option(help="Least distance between successive stripes, mm."),
    ] = None,
    overlap: Annotated[
        float | None,
        typer.Option(help="Keep the best pass only in cells of this size, mm."),
    ] = None,
    density: Annotated[
        float | None,
        typer.Option(help="Keep one point a cell of this size, mm."),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Take outliers, grazing points, edges, overlap and excess out of a cloud."""
    from armscan.geometry.arrays import Box
    from armscan.inspection.cleaning import CleaningOptions
    from armscan.jobs.inspection.cleaning import clean as clean_file

    options = CleaningOptions(
        region=Box.from_limits(numbers(region, "--region"), "--region") if region else None,
        max_incidence_deg=max_incidence,
        isolated_mm=isolated,
        hole_mm=hole,
        line_deviation_mm=line_deviation,
        line_spacing_mm=line_spacing,
        edge_mm=edge,
        line_to_line_mm=line_to_line,
        overlap_mm=overlap,
        density_mm=density,
    )
    run(lambda job: clean_file(job, cloud, options), as_json=as_json, output=output, force=force)
