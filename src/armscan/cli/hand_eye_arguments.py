# SPDX-License-Identifier: Apache-2.0
"""Options of ``armscan calibrate hand-eye``: what was looked at, and how much it scatters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.probe import Side

Scans = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Folders of recordings; several are calibrated one by one and together.",
        show_default=False,
    ),
]
Sensor = Annotated[
    Path | None, typer.Option(help="Calibration of camera and sheets.", show_default=False)
]
Plate = Annotated[
    Path | None,
    typer.Option(help="Probed points of the plate, or its A,B,C,D.", show_default=False),
]
PlaneText = Annotated[
    str, typer.Option(help="The plate as A,B,C,D in Base, mm, in place of --plate.")
]
PlateSide = Annotated[
    Side | None,
    typer.Option(help="Where the plate's face looks, roughly; left out, to the arm's tool."),
]
SolvePlate = Annotated[
    bool,
    typer.Option("--solve-plate", help="Solve the plate along; a rough plane is enough then."),
]
SphereDiameter = Annotated[
    float | None,
    typer.Option(help="A sphere of this diameter, mm, in place of a plate.", show_default=False),
]
Profiles = Annotated[
    list[str] | None,
    typer.Option(help="Profiles of a sensor that delivers points, one a posture; repeatable."),
]
Poses = Annotated[
    Path | None,
    typer.Option(help="Table of the robot's poses, one a profile.", show_default=False),
]
Euler = Annotated[
    str,
    typer.Option(help="Angles in --poses: intrinsic-xyz, extrinsic-xyz (FANUC), intrinsic-zxz."),
]
Arm = Annotated[
    Path | None,
    typer.Option(help="arm.toml, for recordings of joint angles.", show_default=False),
]
ArmPosition = Annotated[
    float | None, typer.Option(help="Scatter of the arm, mm an axis; left out, estimated.")
]
ArmRotation = Annotated[
    float | None, typer.Option(help="Scatter of its orientation; left out, from the position.")
]
PlateFlatness = Annotated[
    float | None, typer.Option(help="Scatter of the plate's surface; left out, estimated.")
]
