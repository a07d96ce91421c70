# SPDX-License-Identifier: Apache-2.0
"""Options on what images show and how they are read, which several commands have."""

from __future__ import annotations

from typing import Annotated

import typer

Target = Annotated[
    str,
    typer.Option(
        "--target",
        show_default=False,
        help="circle-grid:11x9:3.75, asymmetric-circle-grid:4x11:5, chessboard:11x6:13 (inner "
        "corners, mm) or charuco:10x7:4:3:DICT_4X4_50.",
    ),
]
BitsUsed = Annotated[
    int | None,
    typer.Option("--bits-used", help="Significant bits of 16-bit images, such as 10 or 12."),
]
BitsAlign = Annotated[
    str, typer.Option("--bits-align", help="Where they lie in 16 bits: low, or high.")
]
StripeMethodOption = Annotated[
    str,
    typer.Option(
        "--stripe-method", help="fit, or the thesis's threshold, centroid, template, hessian."
    ),
]
LaserColourOption = Annotated[
    str,
    typer.Option(
        "--laser-colour",
        help="What of colour images to use: auto; red, green, blue, grey; a difference (green-red) "
        "or an excess over the others (green-excess).",
    ),
]
