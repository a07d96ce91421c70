# SPDX-License-Identifier: Apache-2.0
"""``armscan register``: scans joined by the markers that they share."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.options import AsJson, progress_bar, show

EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan register views/view1.csv views/view2.csv views/view3.csv -o joined\n"
    "  armscan register before.csv --moved after.csv --cloud after.ply -o joined"
)


def register(
    lists: Annotated[
        list[Path],
        typer.Argument(
            help="Lists of markers, x_mm,y_mm,z_mm[,id,cov...]: one for each view; with --moved "
            "the one of the old place. The cloud of view1.csv is view1.ply beside it.",
            show_default=False,
        ),
    ],
    *,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="New folder for clouds, registration.json and page."),
    ] = Path("registered"),
    moved: Annotated[
        Path | None,
        typer.Option(
            help="The arm was moved: markers measured from its new place.", show_default=False
        ),
    ] = None,
    cloud: Annotated[
        list[Path] | None,
        typer.Option(
            help="Cloud measured from the new place; repeatable. Without it, the cloud beside "
            "the list.",
            show_default=False,
        ),
    ] = None,
    sigma_mm: Annotated[
        float,
        typer.Option(
            "--sigma-mm", help="Standard deviation an axis of markers listed without covariance."
        ),
    ] = 0.02,
    least_common: Annotated[
        int, typer.Option("--least-common", help="Markers that two lists must share, 4 or more.")
    ] = 4,
    by_id: Annotated[
        bool,
        typer.Option("--by-id", help="With --moved: equal ids in both lists are one marker."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Join scans by markers: views of a handheld scanner, or an arm that moved to a new place.

    Markers carry no numbers: they are recognised by their distances, and what fits in more than
    one way is refused. Views are joined in the frame of the first one; an arm that moved goes on
    in its old frame.
    """
    from armscan.jobs.register import run_registration
    from armscan.markers.alignments import MarkerMatchOptions
    from armscan.pipeline.register import RegisterOptions
    from armscan.report.register import RegisterRequest

    request = RegisterRequest(
        lists=tuple(lists),
        output=output,
        moved=moved,
        clouds=tuple(cloud or ()),
        options=RegisterOptions(MarkerMatchOptions(least_common=least_common), sigma_mm, by_id),
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_registration(request, progress)
    show(summary, as_json=as_json)
