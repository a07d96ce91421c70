# SPDX-License-Identifier: Apache-2.0
"""The Python of the README runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

README = Path(__file__).parents[2] / "README.md"
LINE_Y_PX = 60.3


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.arange(120.0)
    profile = 20.0 + 150.0 * np.exp(-0.5 * ((rows - LINE_Y_PX) / 2.5) ** 2)
    noise = np.random.default_rng(3).normal(0.0, 1.5, (120, 200))
    (tmp_path / "scan").mkdir()
    cv2.imwrite(str(tmp_path / "scan" / "0001.png"), np.rint(profile[:, None] + noise))
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"^```python\n(.*?)^```", README.read_text("utf-8"), re.M | re.S)
    names: dict[str, object] = {}
    exec(code, names)
    points = names["profile"].points_px  # type: ignore[attr-defined]
    sigma = names["profile"].sigma_px  # type: ignore[attr-defined]
    assert len(points) > 190
    normalised = (points[:, 1] - LINE_Y_PX) / sigma
    assert abs(normalised).mean() < 3.0
