# SPDX-License-Identifier: Apache-2.0
"""``armscan info``: what a file or folder is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from armscan.cli.options import AsJson, show

if TYPE_CHECKING:
    from armscan.report.quantity import Summary


EXAMPLE = "\b\nExample:\n  armscan info camera.json photos/ cloud.ply"


def info(
    files: Annotated[
        list[str],
        typer.Argument(
            help="Images, calibrations, clouds, recordings, folders.", show_default=False
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Say what files are: image, calibration, cloud, observations, recording or folder."""
    show(describe(files), as_json=as_json)


def describe(files: list[str]) -> Summary:
    """Load the heavy libraries only now, and describe."""
    from armscan.jobs.info import describe_files

    return describe_files(files)
