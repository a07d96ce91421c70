# SPDX-License-Identifier: Apache-2.0
"""``armscan clean``: the cleaned cloud, its page, and refusals that write nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armscan.cli import main
from armscan.storage.clouds import read_cloud, write_cloud
from rigs.inspection_clouds import block_stripes, cloud_of


@pytest.fixture
def block(tmp_path: Path) -> Path:
    points, exposure = block_stripes(20.0, n_points=200)
    points = np.concatenate([points, [[0.0, 20.0, 60.0]]])
    path = tmp_path / "block.ply"
    write_cloud(path, cloud_of(points, np.append(exposure, 20)))
    return path


def test_a_cleaned_cloud_with_its_page(block: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = block.with_name("clean.e57")
    words = ["clean", str(block), "-o", str(output), "--isolated", "2", "--edge", "1", "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert [item["name"] for item in told["filters"]] == ["isolated points", "edges"]
    assert told["filters"][0]["n_taken"] == 1
    assert len(read_cloud(output)) == told["points"]["n_left"] < told["points"]["n_given"]
    text = output.with_suffix(".html").read_text(encoding="utf-8")
    assert "isolated points (1)" in text
    assert 'class="scene"' in text


def test_the_page_tells_what_the_terminal_does(
    block: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """How the cloud of another program was read, and what the new file does not hold."""
    path, output = block.with_name("named.txt"), block.with_name("left.ply")
    points = np.random.default_rng(1).normal(size=(30, 3)) * 9.0
    table = np.column_stack([np.arange(1, 31), points, np.ones(30)])
    np.savetxt(path, table, header="number X Y Z extra", fmt="%.6g")
    assert main(["clean", str(path), "-o", str(output), "--isolated", "50"]) == 0
    said = capsys.readouterr().out
    page = output.with_suffix(".html").read_text(encoding="utf-8")
    for words in ("y and z are columns 2, 3 and 4", "does not hold: the columns number, extra"):
        assert words in said
        assert words in page


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "no filter is given"),
        (["--edge", "0"], "--edge: 0 is not between"),
        (["--max-incidence", "50"], "no normals"),
        (["--isolated", "0.001"], "no point is left"),
        (["--region", "1,2,3"], "6 are needed"),
    ],
)
def test_refusals_write_nothing(
    block: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    before = sorted(block.parent.iterdir())
    assert main(["clean", str(block), "-o", str(block.with_name("out.ply")), *words]) == 2
    assert told in capsys.readouterr().err
    assert sorted(block.parent.iterdir()) == before
