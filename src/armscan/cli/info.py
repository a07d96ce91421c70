# SPDX-License-Identifier: Apache-2.0
"""``armscan info``: what a file or folder is."""

from __future__ import annotations

from typing import Annotated

import typer

from armscan.cli.output import AsJson, show

EXAMPLE = "\b\nExample:\n  armscan info camera.json photos/ cloud.ply"


def info(
    files: Annotated[
        list[str],
        typer.Argument(help="Images, calibrations, clouds, folders.", show_default=False),
    ],
    as_json: AsJson = False,
) -> None:
    """Say what files are: image, calibration, cloud, observations or folder."""
    from armscan.report.file_info import describe_files

    show(describe_files(files), as_json=as_json)
