# SPDX-License-Identifier: Apache-2.0
"""Options that several commands have.

A default stands once, in the class that the option sets: an option that is not given is None here
and left to that class, and help reads it from there when it is printed.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from enum import StrEnum
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import typer

T = TypeVar("T")


class DefaultOf(str):
    """A default that help shows, as ``package.module:Class.field`` of a dataclass.

    Help formats it; only then is it read, from the text of the module: to import it would load the
    compiled loops for a page of help.
    """

    __slots__ = ()

    def __format__(self, spec: str) -> str:
        module, _, place = self.partition(":")
        owner, _, field = place.partition(".")
        return str(_written(module, field, owner))


def _written(module: str, name: str, owner: str = "") -> object:
    """The plain value that a name has in the text of a module, or a field in that of a class."""
    source = cast(ModuleSpec, find_spec(module)).origin
    body = ast.parse(Path(cast(str, source)).read_text(encoding="utf-8")).body
    classes = [one for one in body if isinstance(one, ast.ClassDef) and one.name == owner]
    values = {
        ast.unparse(target): line.value
        for line in (classes[0].body if owner else body)
        if isinstance(line, ast.Assign | ast.AnnAssign)
        for target in (line.targets if isinstance(line, ast.Assign) else [line.target])
    }
    value = values.get(name)
    if isinstance(value, ast.Name):
        return _written(module, value.id)
    if value is not None:
        return ast.literal_eval(value)
    imports = {
        alias.name: str(line.module)
        for line in body
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }
    return _written(imports[name], name)


ArmPosition = Annotated[
    float | None, typer.Option(help="Scatter of Tool's origin, mm an axis; left out, estimated.")
]
ArmRotation = Annotated[
    float | None,
    typer.Option(help="Scatter of its orientation about there; left out, estimated."),
]


class Side(StrEnum):
    """Axis of Base along which a plate's face looks."""

    PLUS_X = "+x"
    MINUS_X = "-x"
    PLUS_Y = "+y"
    MINUS_Y = "-y"
    PLUS_Z = "+z"
    MINUS_Z = "-z"


STRIPES = "armscan.vision.stripe.image:StripeOptions."
PIXELS = "armscan.storage.images:ImageOptions."
INSPECTION = "armscan.inspection.selection:InspectionOptions."

AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON, for programs.")]
Force = Annotated[bool, typer.Option("--force", help="Replace results that exist.")]
ForceBad = Annotated[
    bool,
    typer.Option(
        "--force-bad",
        help="Write a result that makes no sense, marked as such in all that uses it.",
    ),
]
Cache = Annotated[
    bool,
    typer.Option("--cache/--no-cache", help="Keep the points found in images beside the document."),
]
Document = Annotated[
    Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
]
TARGET = typer.Option(
    "--target",
    show_default=False,
    help="circle-grid:11x9:3.75, asymmetric-circle-grid:4x11:5, chessboard:11x6:13 (inner "
    "corners, mm), charuco:10x7:4:3:DICT_4X4_50 or aprilgrid:6x6:88:0.3; 13x13.1 if rows lie "
    "further apart.",
)
Target = Annotated[str, TARGET]
OptionalTarget = Annotated[str | None, TARGET]
BitsUsed = Annotated[
    int | None,
    typer.Option("--bits-used", help="Significant bits of 16-bit images, such as 10 or 12."),
]
BitsAlign = Annotated[
    str | None,
    typer.Option(
        "--bits-align",
        help="Where they lie in 16 bits: low, or high.",
        show_default=DefaultOf(PIXELS + "align"),
    ),
]


class Method(StrEnum):
    """Whose way a result is found beside armscan's own."""

    THESIS = "thesis"


AutoLeaveOut = Annotated[
    bool, typer.Option("--auto-leave-out", help="Leave out views that do not fit.")
]
Fixed = Annotated[
    list[str] | None, typer.Option(help="Hold 'aspect' (fx = fy) or 'centre'; repeatable.")
]
BoardWarp = Annotated[bool, typer.Option("--board-warp", help="Also solve a bow of the board.")]
SolvePrint = Annotated[
    bool,
    typer.Option(
        "--solve-print",
        help="Also solve where each point of the target is printed, if the views show that the "
        "print errs: for 12 different views and more of a target of 35 points and more.",
    ),
]
MethodOption = Annotated[
    Method | None,
    typer.Option("--method", help="thesis: as the thesis prints it, to set it beside armscan's."),
]
StripeMethodOption = Annotated[
    str | None,
    typer.Option(
        "--stripe-method",
        help="fit; fast, of lines in the dark, not on lit boards; or the thesis's threshold, "
        "centroid, template, hessian.",
        show_default=DefaultOf(STRIPES + "method"),
    ),
]
EulerAngles = Annotated[
    str | None,
    typer.Option(
        help="Angles in --poses: intrinsic-xyz, extrinsic-xyz (FANUC), intrinsic-zyx (KUKA), "
        "intrinsic-zxz, rotation-vector (UR).",
        show_default=DefaultOf("armscan.jobs.reconstruct:PoseTable.euler"),
    ),
]
BackgroundImages = Annotated[
    list[str] | None, typer.Option(help="The same views without laser; repeatable.")
]
LaserColourOption = Annotated[
    str | None,
    typer.Option(
        "--laser-colour",
        help="What of colour images to use: auto; red, green, blue, grey; a difference (green-red) "
        "or an excess over the others (green-excess).",
        show_default=DefaultOf(STRIPES + "laser_colour"),
    ),
]
ArmFile = Annotated[
    Path | None, typer.Option(help="arm.toml, for recordings of joint angles.", show_default=False)
]
RegionOption = Annotated[
    str,
    typer.Option(
        "--region", help="Look only inside xmin,xmax,ymin,ymax,zmin,zmax (mm).", show_default=False
    ),
]
FeatureOption = Annotated[
    float | None,
    typer.Option(
        "--feature-mm",
        help="Points this near to the surface belong to it, outliers included.",
        show_default=DefaultOf(INSPECTION + "feature_mm"),
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


def given(options: type[T], **values: Any) -> T:
    """Options of which only those that are not None were given."""
    return options(**{name: value for name, value in values.items() if value is not None})


def refuse_vain(options: Mapping[str, Any], what: str, remedy: str = "leave out") -> None:
    """Refuse options that are given (neither None, False nor empty) but without effect; say
    ``what``.
    """
    from armscan.errors import OptionError

    # zero is a value: `== False` would take it for one that was not given
    named = [
        name
        for name, value in options.items()
        if not (value is None or value is False or value in ("", [], ()))
    ]
    if named:
        names = ", ".join(named)
        raise OptionError(what, where=names, remedy=f"{remedy} {names}")


def refuse_given(context: typer.Context, names: str, what: str) -> None:
    """Refuse parameters of a command, named between blanks, that would be without effect here."""
    sources = {name: context.get_parameter_source(name) for name in names.split()}
    given_here = [
        parameter
        for parameter in context.command.params
        if (source := sources.get(parameter.name or "")) and source.name == "COMMANDLINE"
    ]
    is_off = [context.params[parameter.name or ""] is False for parameter in given_here]
    options = {
        (parameter.secondary_opts if off else parameter.opts)[0]: True
        for parameter, off in zip(given_here, is_off, strict=True)
    }
    refuse_vain(options, what)


def numbers(text: str, option: str) -> tuple[float, ...]:
    """Numbers between commas."""
    from armscan.errors import OptionError

    try:
        return tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError as error:
        raise OptionError(
            f"'{text}' is not a list of numbers", where=option, remedy="put commas between them"
        ) from error
