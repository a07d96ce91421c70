# SPDX-License-Identifier: Apache-2.0
"""``armscan info``, ``convert``, ``doctor`` and ``devices``: files, formats, what is installed."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import show
from armscan.cli.options import AsJson, Force, refuse_vain

INFO_EXAMPLE = "\b\nExample:\n  armscan info camera.json photos/ cloud.ply"
CONVERT_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan convert cloud.ply cloud.e57\n"
    "  armscan convert camera.json camera_info.yaml\n"
    "  armscan convert scan/ scan.mcap"
)
DEVICES_EXAMPLE = "\b\nExamples:\n  armscan devices\n  armscan devices --kind camera --json"
RECOVER_EXAMPLE = "\b\nExample:\n  armscan recover broken.mcap -o scan"
SUFFIX_OF_RECORDING = ".mcap"
DOCTOR_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan doctor --warm\n"
    "  armscan doctor --bundle question.zip --with scanner.json --with scan.mcap"
)


def info(
    files: Annotated[
        list[str],
        typer.Argument(
            help="Images, calibrations, clouds, recordings, folders.", show_default=False
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Say what files and folders are, and what is in them."""
    from armscan.errors import FileFormatError
    from armscan.jobs.info import describe_files

    summary = describe_files(files)
    show(summary, as_json=as_json)
    if n_failed := summary.data["n_failed"]:
        what = f"{n_failed} of {len(summary.data['items'])} items cannot be read"
        raise FileFormatError(what, remedy="see what is said of each, or leave them out")


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            help="A cloud: .ply, .e57, .laz, .las, .pcd, .csv, .xyz, .asc, .txt; vertices of .stl, "
            ".obj; a model of a part; a calibration; or a recording: its folder or .mcap.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Argument(
            help="A cloud: the same but .stl; of a model (.stl, .ply, .obj, .step) its triangles, "
            ".stl; of a camera's, sensor's or scanner's calibration .yaml (ROS camera_info of its "
            "left or only camera); of a recording .mcap or a new folder.",
            show_default=False,
        ),
    ],
    stripe_band: Annotated[
        bool,
        typer.Option(
            "--stripe-band",
            help="Of a recording to .mcap: pixels away from what could be a stripe become zero; "
            "the points stay the same, the file gets small.",
        ),
    ] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a cloud, model, scan or camera in another format."""
    from armscan.report.quantity import Summary
    from armscan.storage.clouds import convert_file

    if SUFFIX_OF_RECORDING in (source.suffix.lower(), output.suffix.lower()):
        from armscan.jobs.live.recordings import convert_recording

        done = convert_recording(source, output, is_overwriting=force, is_stripe_band=stripe_band)
        show(done, as_json=as_json)
        return
    refuse_vain({"--stripe-band": stripe_band}, "this is no recording")
    told = convert_file(source, output, is_overwriting=force)
    losses = (f"the new file does not hold: {', '.join(told.losses)}",) if told.losses else ()
    summary = Summary(
        title=f"Converted: {told.what}.",
        warnings=(*told.remarks, *losses),
        written=(output,),
        forced=told.forced,
        extra={"kind": "conversion", "what": told.what, "losses": list(told.losses)},
    )
    show(summary, as_json=as_json)


def recover(
    source: Annotated[Path, typer.Argument(help="A .mcap recording.", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="A new folder, or .mcap.", show_default=False)
    ],
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write what is whole of a recording that was damaged."""
    from armscan.jobs.live.recordings import recover_recording

    show(recover_recording(source, output, is_overwriting=force), as_json=as_json)


def doctor(
    warm: Annotated[
        bool, typer.Option("--warm", help="Compile ahead, so that the first scan starts at once.")
    ] = False,
    bundle: Annotated[
        Path | None,
        typer.Option(help="A .zip to send with a question to somebody else.", show_default=False),
    ] = None,
    having: Annotated[
        list[Path] | None,
        typer.Option(
            "--with",
            help="What goes into the bundle: scanner.json, rig.toml, a log; of a recording its "
            "beginning; repeatable.",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Check what is installed: packages, compiler, drivers."""
    from armscan.jobs.live.doctor import examine_installation, pack_bundle

    if bundle is not None:
        refuse_vain({"--warm": warm}, "nothing is compiled for a bundle")
        show(pack_bundle(bundle, having or (), is_overwriting=force), as_json=as_json)
        return
    vain = {"--with": having, "--force": force}
    refuse_vain(vain, "there is no bundle", "give --bundle, or leave out")
    summary = examine_installation(warm=warm)
    show(summary, as_json=as_json)
    if summary.warnings:
        raise typer.Exit(1)


class Kind(StrEnum):
    """Kind of a device."""

    CAMERA = "camera"
    ARM = "arm"
    LASERS = "lasers"


def devices(
    kind: Annotated[Kind | None, typer.Option(help="Only these.", show_default=False)] = None,
    as_json: AsJson = False,
) -> None:
    """List devices that are there, and drivers for others."""
    from armscan.devices.registry import survey_drivers
    from armscan.report.quantity import Summary, Table

    reports = [
        one for one in survey_drivers() if kind is None or not one.kinds or kind in one.kinds
    ]
    found = [one for report in reports for one in report.found if kind is None or one.kind == kind]
    listed = tuple((one.address, one.kind, one.label) for one in found)
    drivers = tuple((one.name, ", ".join(one.kinds), one.problem or "ready") for one in reports)
    summary = Summary(
        title=f"{len(found)} devices say that they are there; others are opened by their address.",
        tables=(
            *((Table(("device", "kind", "what it is"), listed, "", (1, 2)),) if listed else ()),
            Table(("driver", "opens", "state"), drivers, "", (1, 2)),
        ),
        extra={
            "kind": "devices",
            "devices": [asdict(one) for one in found],
            "drivers": [
                {"name": one.name, "kinds": list(one.kinds), "problem": one.problem}
                for one in reports
            ],
        },
    )
    show(summary, as_json=as_json)
