# SPDX-License-Identifier: Apache-2.0
"""What packages offer exists, and the page's programs run as they stand."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from armscan.storage import read_cloud

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "use-from-python.md"
INPUTS = ROOT / "tests" / "net" / "inputs"
DOORS = sorted((ROOT / "src" / "armscan").rglob("__init__.pyi"))
POINTS, BALL = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)


def ran(program: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Numbers that a program prints."""
    for name in ("left", "on", "off", "ball-scan", "documents"):
        shutil.copytree(INPUTS / name, folder / name)
    monkeypatch.chdir(folder)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(program, str(PAGE), "exec"), {})
    return [
        float(word) for word in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?", said.getvalue())
    ]


@pytest.mark.parametrize("door", DOORS, ids=lambda path: path.parent.name)
def test_every_name_that_a_package_lists_can_be_imported(door: Path) -> None:
    package = importlib.import_module(".".join(door.parent.relative_to(ROOT / "src").parts))
    names = re.findall(r"import (\w+) as \1", door.read_text("utf-8"))
    assert sorted(package.__all__) == sorted(names) != []
    assert all(getattr(package, name) is not None for name in names)
    with pytest.raises(AttributeError):
        _ = package.no_such_name


def test_ten_lines_from_photographs_to_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, worst_mm = ran(POINTS, tmp_path, monkeypatch)
    cloud = read_cloud(tmp_path / "points.ply")
    assert len(cloud) == count > 500
    assert np.isclose(cloud.sigma_mm.max(), worst_mm, rtol=1e-5)


def test_ten_lines_from_a_recording_to_an_inspected_ball(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diameter_mm, sigma_mm, *_, d95_mm = ran(BALL, tmp_path, monkeypatch)
    assert abs(diameter_mm - 30.0) < 4.0 * sigma_mm + 0.02
    assert d95_mm < 0.2
