# SPDX-License-Identifier: Apache-2.0
"""``armscan mesh``: triangles over a cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.options import AsJson, Force, given, run

MESH_EXAMPLE = "\b\nExample:\n  armscan mesh cloud.ply -o part.stl --cell 0.3"


def mesh(
    cloud: Annotated[
        Path, typer.Argument(help="A cloud of `armscan reconstruct`.", show_default=False)
    ],
    *,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Mesh to write: .stl or .ply.", show_default=False),
    ],
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
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Draw triangles where points were measured; holes stay open.

    The surface is smooth over a cell: edges are rounded by about one, and a round face of radius R
    lies (0.75 cell)²/R too high. For deviations, compare the points themselves, not the mesh.
    """
    from armscan.jobs.inspection.mesh import draw_mesh
    from armscan.reconstruction.surface import SurfaceOptions

    options = given(SurfaceOptions, cell_mm=cell, reach_mm=reach)
    run(
        lambda job: draw_mesh(job, cloud, options=options, n_triangles=triangles),
        as_json=as_json,
        output=output,
        force=force,
    )
