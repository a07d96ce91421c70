# SPDX-License-Identifier: Apache-2.0
"""Whether images were rendered, so that results on them are called simulated."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

LEVELS = 3


def are_simulated(paths: Iterable[Path]) -> bool:
    """True if any file lies, up to three folders deep, beside a mark of the simulator.

    The mark is ``simulated = true`` in a recording's ``session.toml``, or ``"simulated": true`` in
    the ``truth.json`` of rendered photographs; the truth itself is never read.
    """
    folders = {folder for path in paths for folder in islice(path.resolve().parents, LEVELS)}
    return any(
        _has_mark(folder / "truth.json") or _says_simulated(folder / "session.toml")
        for folder in folders
    )


def _has_mark(path: Path) -> bool:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("simulated") is True


def _says_simulated(path: Path) -> bool:
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return False
    return content.get("simulated") is True
