# SPDX-License-Identifier: Apache-2.0
"""Options that all inspections have."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from armscan.cli.probe import Side

if TYPE_CHECKING:
    from armscan.jobs.inspect import InspectRequest


CloudArgument = Annotated[
    Path,
    typer.Argument(
        help="A cloud of `armscan reconstruct`, or any .ply, .xyz, .csv with x y z in mm.",
        show_default=False,
    ),
]
RegionOption = Annotated[
    str,
    typer.Option(
        "--region", help="Look only inside xmin,xmax,ymin,ymax,zmin,zmax (mm).", show_default=False
    ),
]
FeatureOption = Annotated[
    float,
    typer.Option(
        "--feature-mm", help="Points this near to the surface belong to it, outliers included."
    ),
]
SideOption = Annotated[
    Side | None,
    typer.Option(
        "--side",
        help="Axis that the face of --plate looks along, for centres of the tip.",
        show_default=False,
    ),
]
PageOption = Annotated[
    Path | None,
    typer.Option("-o", "--output", help="Page to write, .html; without it none is written."),
]


def numbers(text: str, option: str) -> tuple[float, ...]:
    """Numbers between commas.

    Raises
    ------
    OptionError
        If a word is no number.
    """
    from armscan.errors import OptionError

    try:
        return tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError as error:
        raise OptionError(
            f"'{text}' is not a list of numbers", where=option, remedy="put commas between them"
        ) from error


def inspect_request(
    cloud: Path, *, region: str, feature_mm: float, output: Path | None, force: bool
) -> InspectRequest:
    """What all inspections ask for."""
    from armscan.inspection.selection import InspectionOptions
    from armscan.jobs.inspect import InspectRequest

    return InspectRequest(
        cloud=cloud,
        region=numbers(region, "--region"),
        output=output,
        options=InspectionOptions(feature_mm=feature_mm),
        is_overwriting=force,
        command=("armscan", *sys.argv[1:]),
    )
