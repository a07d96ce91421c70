# SPDX-License-Identifier: Apache-2.0
"""Arguments of ``armscan reconstruct``: which images, and which part of what they show."""

from __future__ import annotations

from typing import Annotated

import typer

Background = Annotated[
    list[str] | None, typer.Option(help="The same views without laser; repeatable.")
]
Right = Annotated[
    list[str] | None,
    typer.Option(help="Right camera's images of the same instants; of a stereo head."),
]
RightBackground = Annotated[
    list[str] | None, typer.Option(help="The right camera's without laser; repeatable.")
]
Sheet = Annotated[str, typer.Option(help="Sheet that drew the stripes; empty finds it.")]
DepthMargin = Annotated[
    float | None,
    typer.Option(
        help="Widen the calibrated depth range by this part of its width at either end; "
        "points beyond are left out. Without it 0; with two cameras 0.5; points between are "
        "extrapolated.",
        show_default=False,
    ),
]
Volume = Annotated[
    str,
    typer.Option(help="Part of Base to measure: xmin,xmax,ymin,ymax,zmin,zmax in mm."),
]
