# SPDX-License-Identifier: Apache-2.0
"""A command without options does what the library does without options.

A default stands once, in the class that the option sets: an option that is not given is None on
the command line, and help reads the default from that class.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import MISSING, fields
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from armscan.cli.app import command
from armscan.cli.options import DefaultOf
from armscan.jobs.twin.demo import DemoRequest
from armscan.reconstruction.triangulate import CALIBRATED_DEPTHS, LABEL_DEPTHS


def commands(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All commands with their paths."""
    if getattr(node, "commands", None):
        for name, child in node.commands.items():
            yield from commands(child, (*path, name))
    else:
        yield path, node


COMMANDS = dict(commands(command()))


def read_by_help(path: tuple[str, ...]) -> dict[str, Any]:
    """Options whose default help reads from a class."""
    return {
        option.name: option
        for option in COMMANDS[path].params
        if isinstance(getattr(option, "show_default", None), DefaultOf)
    }


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_help_shows_the_default_of_the_class(path: tuple[str, ...]) -> None:
    context = typer.Context(COMMANDS[path], info_name=" ".join(path))
    shown = "".join(COMMANDS[path].get_help(context).split())
    for name, option in read_by_help(path).items():
        module, _, place = str(option.show_default).partition(":")
        owner, _, field = place.partition(".")
        known = {item.name: item for item in fields(getattr(import_module(module), owner))}
        assert option.default is None, name
        assert known[field].default not in (None, MISSING), name
        assert f"({known[field].default})" in shown, name


def test_no_option_with_a_default_of_its_own_is_a_field_of_a_class() -> None:
    """What a command decides by itself is listed here; all else is read from a class."""
    known = {
        ("demo", "scene"), ("demo", "output"), ("demo", "seed"), ("demo", "preset"),
        ("calibrate stereo", "intrinsics"), ("calibrate hand-eye", "method"),
        ("register", "method"),
    }  # fmt: skip
    own = {
        (" ".join(path), option.name)
        for path, node in COMMANDS.items()
        for option in node.params
        if option.default not in (None, False, "", ()) and option.name != "cache"
    }
    assert {item for item in own if item[1] != "output" and not _is_required(*item)} <= known


def _is_required(path: str, name: str) -> bool:
    return any(p.name == name and p.required for p in COMMANDS[tuple(path.split())].params)


def test_the_demo_without_options_is_the_library_s() -> None:
    options = {option.name: option for option in COMMANDS["demo",].params}
    defaults = {item.name: item.default for item in fields(DemoRequest)}
    for name in ("seed", "preset"):
        assert options[name].default == defaults[name]


def test_the_depth_margin_that_texts_name_is_the_default() -> None:
    text = f"{CALIBRATED_DEPTHS.margin:g}"
    option = {item.name: item for item in COMMANDS["reconstruct",].params}["depth_margin"]
    assert option.default is None
    stereo = f"{LABEL_DEPTHS.margin:g}"
    assert f"Without it {text}; with two cameras {stereo};" in option.help
    page = Path(__file__).parents[2] / "docs" / "reference" / "commands.md"
    words = " ".join(page.read_text().split())
    assert f"up to X times its width at either end ({text} unless said)" in words


def test_help_loads_no_compiled_loops() -> None:
    """With nothing compiled yet, a page of help would take a minute of compilation."""
    paths = [" ".join(path) for path in COMMANDS]
    program = (
        "import sys\n"
        "from armscan.cli import main\n"
        "for words in sys.argv[1:]:\n"
        "    main([*words.split(), '-h'])\n"
        "sys.exit(len({'numba', 'numpy', 'cv2', 'scipy'} & set(sys.modules)))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program, *paths], capture_output=True, check=False, text=True
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("Show this message and exit") == len(paths)
