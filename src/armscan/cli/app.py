# SPDX-License-Identifier: Apache-2.0
"""The tree of commands."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated, Any

import typer
import typer.main

from armscan.cli import (
    calibrate_cameras,
    calibrate_sensor,
    files,
    inspect,
    inspect_cad,
    inspect_features,
    points,
    surface,
    twin,
)
from armscan.cli import reconstruct as reconstruct_command
from armscan.cli.live.rig import CONSOLE_EXAMPLE, RECORD_EXAMPLE, console, record

EXIT_INPUT = 2
HELP_OPTIONS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
HELP_ORDER = (
    *("demo", "simulate", "probe", "calibrate", "reconstruct", "fuse"),
    *("stripes", "markers", "register", "clean", "inspect", "verify", "mesh"),
    *("record", "console"),
    *("convert", "recover", "info", "devices", "doctor"),
)
"""The chain, then what looks at files; left to itself the library lists groups last."""


def _help_unless_a_command_follows(context: typer.Context) -> None:
    """Print the help of a group that is given no command; nothing was done, so exit code 2."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(EXIT_INPUT)


app = typer.Typer(
    name="armscan",
    help="Cameras and line lasers as a calibrated 3-D scanner: calibrate, then measure.",
    epilog=(
        "\b\nFirst steps:\n"
        "  armscan doctor                is everything installed?\n"
        "  armscan demo single -o demo   a simulated arm scanner: calibrate, scan, inspect\n"
        "  armscan calibrate camera 'photos/*.png' --target chessboard:11x6:13 -o camera.json\n"
        "  armscan COMMAND -h            options, and an example that works"
    ),
    context_settings=HELP_OPTIONS,
    invoke_without_command=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
calibrate = typer.Typer(
    help="Calibrate cameras, light sheets and their place on the arm.",
    epilog=(
        "\b\nExample:\n"
        "  armscan calibrate camera 'photos/*.png' --target chessboard:11x6:13 -o camera.json"
    ),
    context_settings=HELP_OPTIONS,
    invoke_without_command=True,
    callback=_help_unless_a_command_follows,
    rich_markup_mode=None,
)
calibrate.command("camera", epilog=calibrate_cameras.CAMERA_EXAMPLE)(calibrate_cameras.camera)
calibrate.command("stereo", epilog=calibrate_cameras.STEREO_EXAMPLE)(calibrate_cameras.stereo)
calibrate.command("laser", epilog=calibrate_sensor.LASER_EXAMPLE)(calibrate_sensor.laser)
calibrate.command("hand-eye", epilog=calibrate_sensor.HAND_EYE_EXAMPLE)(calibrate_sensor.hand_eye)
calibrate.command("hand-eye-target", epilog=calibrate_cameras.HAND_EYE_TARGET_EXAMPLE)(
    calibrate_cameras.hand_eye_target
)
calibrate.command("latency", epilog=calibrate_cameras.LATENCY_EXAMPLE)(calibrate_cameras.latency)
inspect_group = typer.Typer(
    help="Compare measured points with what they should be.",
    epilog=inspect.SPHERE_EXAMPLE,
    context_settings=HELP_OPTIONS,
    invoke_without_command=True,
    callback=_help_unless_a_command_follows,
    rich_markup_mode=None,
)
inspect_group.command("plane", epilog=inspect.PLANE_EXAMPLE)(inspect.plane)
inspect_group.command("sphere", epilog=inspect.SPHERE_EXAMPLE)(inspect.sphere)
inspect_group.command("step", epilog=inspect.STEP_EXAMPLE)(inspect.step)
inspect_group.command("cad", epilog=inspect_cad.CAD_EXAMPLE)(inspect_cad.cad)
inspect_group.command("recipe", epilog=inspect_cad.RECIPE_EXAMPLE)(inspect_cad.recipe)
inspect_group.command("line", epilog=inspect_features.LINE_EXAMPLE)(inspect_features.line)
inspect_group.command("circle", epilog=inspect_features.CIRCLE_EXAMPLE)(inspect_features.circle)
inspect_group.command("cylinder", epilog=inspect_features.CYLINDER_EXAMPLE)(
    inspect_features.cylinder
)
inspect_group.command("cone", epilog=inspect_features.CONE_EXAMPLE)(inspect_features.cone)
inspect_group.command("relation", epilog=inspect_features.RELATION_EXAMPLE)(
    inspect_features.relation
)
app.add_typer(calibrate, name="calibrate")
app.add_typer(inspect_group, name="inspect")
app.command("demo", epilog=twin.DEMO_EXAMPLE)(twin.demo)
app.command("simulate", epilog=twin.SIMULATE_EXAMPLE)(twin.simulate)
app.command("probe", epilog=points.PROBE_EXAMPLE)(points.probe)
app.command("reconstruct", epilog=reconstruct_command.RECONSTRUCT_EXAMPLE)(
    reconstruct_command.reconstruct
)
app.command("fuse", epilog=reconstruct_command.FUSE_EXAMPLE)(reconstruct_command.fuse)
app.command("stripes", epilog=points.STRIPES_EXAMPLE)(points.stripes)
app.command("markers", epilog=points.MARKERS_EXAMPLE)(points.markers)
app.command("register", epilog=points.REGISTER_EXAMPLE)(points.register)
app.command("clean", epilog=surface.CLEAN_EXAMPLE)(surface.clean)
app.command("verify", epilog=inspect.VERIFY_EXAMPLE)(inspect.verify)
app.command("mesh", epilog=surface.MESH_EXAMPLE)(surface.mesh)
app.command(
    "record", epilog=RECORD_EXAMPLE, short_help="Record cameras, arm and lasers to one file."
)(record)
app.command(
    "console", epilog=CONSOLE_EXAMPLE, short_help="Calibrate, scan and inspect in a browser."
)(console)
app.command("convert", epilog=files.CONVERT_EXAMPLE)(files.convert)
app.command("recover", epilog=files.RECOVER_EXAMPLE)(files.recover)
app.command("info", epilog=files.INFO_EXAMPLE)(files.info)
app.command("devices", epilog=files.DEVICES_EXAMPLE)(files.devices)
app.command("doctor", epilog=files.DOCTOR_EXAMPLE)(files.doctor)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"armscan {version('armscan')}")
        raise typer.Exit


@app.callback()
def root(
    context: typer.Context,
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Cameras and line lasers as a calibrated 3-D scanner: calibrate, then measure."""
    _help_unless_a_command_follows(context)


def command() -> Any:
    """Return the whole tree as one callable command."""
    tree: Any = typer.main.get_command(app)
    tree.commands = {name: tree.commands[name] for name in HELP_ORDER}
    return tree
