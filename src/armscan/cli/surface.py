# SPDX-License-Identifier: Apache-2.0
"""``armscan clean`` and ``mesh``: points taken out of a cloud, and triangles over what is left."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import Work, job_command
from armscan.cli.inspect import CloudArgument
from armscan.cli.options import RegionOption, given, numbers

CLEAN_EXAMPLE = (
    "\b\nExamples:\n  armscan clean part.ply -o cleaned.ply --max-incidence 60 --isolated 0.5 "
    "--edge 0.3\n"
    "  armscan clean part.ply -o thin.ply --overlap 1 --line-to-line 0.2 --density 0.1"
)
MESH_EXAMPLE = "\b\nExample:\n  armscan mesh cloud.ply -o part.stl --cell 0.3"

CleanedCloud = Annotated[
    Path, typer.Option("-o", "--output", help="Cloud to write; a page goes beside it.")
]
MeshFile = Annotated[
    Path,
    typer.Option("-o", "--output", help="Mesh to write: .stl or .ply.", show_default=False),
]


@job_command(CleanedCloud)
def clean(
    cloud: CloudArgument,
    *,
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
) -> Work:
    """Take outliers, edges, overlap and excess out of a cloud."""
    from armscan.geometry.arrays import Box
    from armscan.inspection.cleaning import CleaningOptions
    from armscan.jobs.inspection.surface import clean as clean_file

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
    return lambda job: clean_file(job, cloud, options)


@job_command(MeshFile)
def mesh(
    cloud: Annotated[
        Path, typer.Argument(help="A cloud of `armscan reconstruct`.", show_default=False)
    ],
    *,
    cell: Annotated[
        float | None,
        typer.Option(
            help="Size of a cell, mm: what is smaller is smoothed. Without it, the distance within "
            "which 95 % of the points have one of another exposure.",
            show_default=False,
        ),
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option(
            help="No corner lies farther than this from a measured point, mm. Without it a cell.",
            show_default=False,
        ),
    ] = None,
    triangles: Annotated[
        int | None,
        typer.Option(
            help="Keep about so many triangles, fewest where it is flat.", show_default=False
        ),
    ] = None,
) -> Work:
    """Draw triangles where points were measured; holes stay open.

    The surface is smooth over a cell: edges are rounded by about one, and a round face of radius R
    lies (0.75 cell)²/R too high. For deviations, compare the points themselves, not the mesh.
    """
    from armscan.jobs.inspection.surface import draw_mesh
    from armscan.reconstruction.surface import SurfaceOptions

    options = given(SurfaceOptions, cell_mm=cell, reach_mm=reach)
    return lambda job: draw_mesh(job, cloud, options=options, n_triangles=triangles)
