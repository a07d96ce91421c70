# SPDX-License-Identifier: Apache-2.0
"""Whoever gives a file that cannot be read is told what to do."""

from __future__ import annotations

import ast
from pathlib import Path

import armscan.storage

STORAGE = Path(armscan.storage.__file__).parent


def test_every_refusal_of_a_file_has_a_remedy() -> None:
    lacking = [
        f"{path.name}:{node.lineno}"
        for path in sorted(STORAGE.glob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "FileFormatError"
        and isinstance(node.args[0], ast.Constant | ast.JoinedStr)
        and "remedy" not in {word.arg for word in node.keywords}
    ]
    assert lacking == []
