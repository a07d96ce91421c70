# SPDX-License-Identifier: Apache-2.0
"""The house rules that a machine can check: sizes, names, and commands that pages show."""

from __future__ import annotations

import ast
import re
import shlex
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from armscan.cli.app import command

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
FILES = [*SOURCES, *sorted((ROOT / "tests").rglob("*.py")), *(ROOT / "benchmarks").rglob("*.py")]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

MAX_MODULE_LINES = 700
MAX_CLI_LINES = 300
MAX_FILES_OF_A_FOLDER = 14
MAX_MODULES = 296
MAX_FUNCTION_LINES = 80
P90_FUNCTION_LINES = 40
SAYS_NOTHING = {"util", "utils", "helper", "helpers", "common", "misc", "manager", "managers"}


def lines_of(path: Path) -> int:
    return len(path.read_text("utf-8").splitlines())


def function_lines() -> list[tuple[int, str]]:
    """Lines of each function without its docstring; a kernel is one function by necessity."""
    found = []
    for path in SOURCES:
        if "kernels" in path.parts or path.stem.endswith("_kernel"):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or 0) - node.lineno + 1
                if ast.get_docstring(node) is not None:
                    text = node.body[0]
                    length -= (text.end_lineno or 0) - text.lineno + 1
                found.append((length, f"{path.stem}.{node.name}"))
    return sorted(found)


def test_modules_are_small() -> None:
    too_long = {str(path): n for path in FILES if (n := lines_of(path)) > MAX_MODULE_LINES}
    assert too_long == {}


def test_folders_can_be_read_at_a_glance() -> None:
    modules = [path for path in SOURCES if path.name != "__init__.py"]
    count = Counter(path.parent.relative_to(ROOT).as_posix() for path in modules)
    assert {folder: n for folder, n in count.items() if n > MAX_FILES_OF_A_FOLDER} == {}
    assert len(modules) <= MAX_MODULES


def test_functions_are_small() -> None:
    found = function_lines()
    assert [item for item in found if item[0] > MAX_FUNCTION_LINES] == []
    assert found[int(0.9 * len(found))][0] <= P90_FUNCTION_LINES


def test_names_say_something() -> None:
    words = {
        path: set(re.split(r"[_/]", str(path.relative_to(ROOT).with_suffix("")))) for path in FILES
    }
    assert [str(path) for path, found in words.items() if found & SAYS_NOTHING] == []


@pytest.mark.parametrize(
    "path", sorted((ROOT / "src/armscan/cli").rglob("*.py")), ids=lambda p: p.name
)
def test_command_files_are_thin(path: Path) -> None:
    text = path.read_text("utf-8")
    assert lines_of(path) <= MAX_CLI_LINES
    loops = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.For | ast.While)]
    assert loops == []


def test_files_carry_their_licence() -> None:
    first = {path: path.read_text("utf-8").partition("\n")[0] for path in FILES if lines_of(path)}
    mark = "# SPDX-License-Identifier: Apache-2.0"
    assert [str(path) for path, line in first.items() if line != mark] == []


def shown_commands() -> list[tuple[str, str]]:
    """(page, command line) of every ``armscan`` line in a code block; ``\\`` joins lines."""
    found = []
    for page in PAGES:
        for block in re.findall(r"```\w*\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = line.removeprefix("$ ").strip()
                if words.startswith("armscan ") and not set("|[…") & set(words):
                    found.append((page.name, words))
    return found


@pytest.mark.parametrize(("page", "line"), shown_commands())
def test_commands_that_pages_show_exist(page: str, line: str) -> None:
    """Each word of the path is a command, and each option one of its options."""
    node: Any = command()
    words = shlex.split(line, comments=True)[1:]
    while words and words[0] in getattr(node, "commands", {}):
        node = node.commands[words.pop(0)]
    known = {
        name for parameter in node.params for name in (*parameter.opts, *parameter.secondary_opts)
    }
    known |= {"-h", "--help"}
    options = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
    assert options <= known, f"{page} shows {line}"
    if getattr(node, "commands", None):
        assert options or not words, f"{page} shows the unknown command {words[0]}"


def unnamed_options(node: Any, named: set[str], path: str = "armscan") -> list[str]:
    """Options of a command and of those below it of which no name is among these."""
    names = [(*one.opts, *one.secondary_opts) for one in node.params if one.opts[0][0] == "-"]
    found = [f"{path} {' '.join(one)}" for one in names if not named & set(one)]
    for name, child in getattr(node, "commands", {}).items():
        found += unnamed_options(child, named, f"{path} {name}")
    return found


def test_the_commands_page_names_every_option() -> None:
    page = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
    named = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", page))
    assert (
        unnamed_options(command(), named | {"-o", "--help", "--version", "--show-completion"}) == []
    )
    assert "armscan verify --mpe" in unnamed_options(command(), named - {"--mpe"})
