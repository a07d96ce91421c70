# SPDX-License-Identifier: Apache-2.0
"""``armscan convert``: one file format to another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.options import AsJson, Force, show

EXAMPLE = "\b\nExample:\n  armscan convert camera.json camera_info.yaml"


def convert(
    source: Annotated[Path, typer.Argument(help="Calibration, or cloud .ply.", show_default=False)],
    output: Annotated[
        Path,
        typer.Argument(help=".yaml (ROS camera_info) or .xyz.", show_default=False),
    ],
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a calibration's camera for ROS, or a cloud as plain XYZ."""
    from armscan.report.quantity import Summary
    from armscan.storage.clouds import convert_file

    done = convert_file(source, output, is_overwriting=force)
    losses = f"the new file does not hold: {', '.join(done.losses)}"
    show(
        Summary(
            title=f"Converted: {done.what}.",
            warnings=(losses,),
            written=(output,),
            forced=done.forced,
            data={"kind": "conversion", "what": done.what, "losses": list(done.losses)},
        ),
        as_json=as_json,
    )
