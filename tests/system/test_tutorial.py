# SPDX-License-Identifier: Apache-2.0
"""The tutorial's commands, typed as they stand on the page, on its photographs."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.storage.clouds import read_ply
from armscan.storage.documents import read_sensor_calibration
from rigs.photographs import DATA, needs

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "01-from-photographs-to-points.md"
pytestmark = needs("ciclop")

SAME_FIGURE = 0.02
"""Decoders and linear algebra of other versions change the figures by less than this part."""


def blocks() -> list[str]:
    return re.findall(r"^```\n(.*?)^```$", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL)


def steps() -> list[tuple[list[str], str]]:
    """Each command of the page with the output that the page shows for it."""
    found = []
    texts = blocks()
    for text, shown in zip(texts, [*texts[1:], ""], strict=True):
        if text.startswith("armscan ") and "wrong.json" not in text:
            line = text.replace("\\\n", " ").replace("$ARMSCAN_DATA", str(DATA))
            found.append((shlex.split(line)[1:], shown))
    return found


def figures(output: str) -> dict[str, float]:
    """First number of every line of facts, by the line's label."""
    lines = re.findall(r"^ +([A-Za-z][\w -]*?) {2,}(?:Z )?([+-]?[\d.]+)\b", output, re.MULTILINE)
    return {label: float(value) for label, value in lines}


def test_the_tutorial_runs_and_shows_what_comes_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(steps()) == 4
    for words, shown in steps():
        assert main(words) == 0
        output = capsys.readouterr().out
        expected, found = figures(shown), figures(output)
        checked = {"fx", "fy", "Images", "Points", "Y"} & expected.keys()
        checked |= {"Reprojection residual", "On images it has not seen"} & expected.keys()
        checked |= {"Target points", "Residual", "Depth covered"} & expected.keys()
        assert checked
        for label in checked:
            assert found[label] == pytest.approx(expected[label], rel=SAME_FIGURE), label
    check_sheets()
    check_bust()


def check_sheets() -> None:
    """Against what another program measured with the right-hand laser (Horus' own cloud)."""
    sensor = read_sensor_calibration(Path("sensor.json"))
    assert [sheet.name for sheet in sensor.sheets] == ["A", "B"]
    assert not any(sheet.is_redundant for sheet in sensor.sheets)
    content = (DATA / "ciclop/laser-pc.ply").read_bytes()
    start = content.index(b"end_header\n") + len(b"end_header\n")
    vertex = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    theirs = np.frombuffer(content, vertex, offset=start)["xyz"].astype(np.float64)
    normal = np.linalg.svd(theirs - theirs.mean(axis=0), full_matrices=False)[2][2]
    angles = [np.degrees(np.arccos(abs(normal @ sheet.sheet.axes[2]))) for sheet in sensor.sheets]
    # the sheets' direction is known to 0.5 deg, and the other camera calibration adds its own error
    assert angles[1] < 1.5
    assert angles[0] > 30.0
    heights, _, _ = sensor.sheets[1].sheet.height_with_jacobian(theirs)
    low, high = sensor.sheets[1].depth_range_mm
    is_inside = (theirs[:, 2] > low) & (theirs[:, 2] < high)
    assert abs(float(heights[is_inside].mean())) < 1.5


def check_bust() -> None:
    cloud = read_ply(Path("bust.ply"))
    assert len(cloud) > 800
    assert {cloud.sheet_names[k] for k in np.unique(cloud.sheet)} == {"B"}
    assert 200.0 < float(np.ptp(cloud.points_mm[:, 1])) < 220.0
    assert 220.0 < float(cloud.points_mm[:, 2].min()) < float(cloud.points_mm[:, 2].max()) < 300.0
