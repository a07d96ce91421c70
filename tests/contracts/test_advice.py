# SPDX-License-Identifier: Apache-2.0
"""Options that messages name exist, in the command that a person has just typed."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from armscan.cli.app import command

SOURCE = Path(__file__).parents[2] / "src" / "armscan"
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")

CAMERA, STEREO, LASER = ("calibrate", "camera"), ("calibrate", "stereo"), ("calibrate", "laser")
HAND_EYE, VERIFY, RECONSTRUCT = ("calibrate", "hand-eye"), ("verify",), ("reconstruct",)
TARGET = ("calibrate", "hand-eye-target")
PLANE, SPHERE, STEP = ("inspect", "plane"), ("inspect", "sphere"), ("inspect", "step")

SHOWN_BY: dict[str, tuple[tuple[str, ...], ...]] = {
    "calibration/cameras/calibrate_stereo": (STEREO,),
    "calibration/cameras/joint": (STEREO,),
    "calibration/cameras/relate": (STEREO,),
    "calibration/cameras/pairs": (STEREO,),
    "calibration/sheets/": (LASER,),
    "calibration/hand_eye/probed": (("probe",), HAND_EYE, VERIFY, PLANE),
    "calibration/hand_eye/board": (TARGET,),
    "calibration/hand_eye/on_board": (TARGET,),
    "calibration/hand_eye/": (HAND_EYE,),
    "inspection/plane": (PLANE, VERIFY),
    "inspection/sphere": (SPHERE, VERIFY),
    "inspection/step": (STEP,),
    "inspection/conformity": (VERIFY,),
    "inspection/doubts": (SPHERE, STEP, VERIFY),
    "jobs/camera": (CAMERA,),
    "jobs/stereo": (STEREO,),
    "jobs/sheets": (LASER,),
    "jobs/hand_eye": (HAND_EYE,),
    "jobs/board_hand_eye": (TARGET,),
    "jobs/verify": (VERIFY,),
    "jobs/photographs": (("markers",), ("stripes",)),
    "jobs/register": (("register",),),
    "jobs/probe": (("probe",),),
    "pipeline/register": (("register",),),
    "pipeline/measure": (RECONSTRUCT,),
}
"""Commands that can show the messages of a module; the first entry that fits a path holds."""


@cache
def options_of(path: tuple[str, ...]) -> set[str]:
    node: Any = root()
    for word in path:
        node = node.commands[word]
    pairs = ((*parameter.opts, *parameter.secondary_opts) for parameter in node.params)
    return {name for pair in pairs for name in pair} | {"--help"}


@cache
def root() -> Any:
    return command()


def every_path(node: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    node = node or root()
    yield path
    for name, child in getattr(node, "commands", {}).items():
        yield from every_path(child, (*path, name))


def texts() -> list[tuple[str, int, str]]:
    """(module, line, text) of each text that names an option; an f-string is one text."""
    found = []
    for path in sorted(SOURCE.rglob("*.py")):
        if path.parent.name == "cli":
            continue
        for text, line in _texts(ast.parse(path.read_text("utf-8"))):
            if OPTION.search(text):
                found.append((path.relative_to(SOURCE).as_posix(), line, text))
    return found


def _texts(node: ast.AST) -> Iterator[tuple[str, int]]:
    if isinstance(node, ast.JoinedStr):
        parts = [p.value if isinstance(p, ast.Constant) else "{}" for p in node.values]
        yield "".join(map(str, parts)), node.lineno
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value, node.lineno
    for child in ast.iter_child_nodes(node):
        yield from _texts(child)


def commands_in(text: str) -> list[tuple[str, ...]]:
    """Commands that the text itself names: ``armscan probe --side``."""
    known = set(every_path()) - {()}
    named = []
    for match in re.findall(r"armscan ((?:[a-z-]+ ?)+)", text):
        words = tuple(match.split())
        named += [words[:n] for n in (2, 1) if words[:n] in known][:1]
    return named


@pytest.mark.parametrize(("module", "line", "text"), texts())
def test_options_that_a_message_names_exist(module: str, line: int, text: str) -> None:
    where = f"{module}:{line}"
    of_named = set().union(*(options_of(path) for path in commands_in(text)))
    options = set(OPTION.findall(text)) - of_named
    fitting = next((paths for part, paths in SHOWN_BY.items() if module.startswith(part)), ())
    for path in fitting:
        assert options <= options_of(path), f"{where}: {' '.join(path)} has no {options}"
    known = set().union(*(options_of(path) for path in every_path()))
    assert options <= known, f"{where} names {options}"


def test_refusals_of_the_sheet_rules_can_be_followed() -> None:
    """Whatever measures points with a sensor may be asked to name the sheet."""
    assert "--sheet" in options_of(RECONSTRUCT)
