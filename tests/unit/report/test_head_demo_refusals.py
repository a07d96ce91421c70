# SPDX-License-Identifier: Apache-2.0
"""Demos of heads: what has none, and what is left when a head fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from armscan.errors import EstimationError, OptionError
from armscan.jobs.twin.demo import FILES, DemoRequest, run_all_heads, run_head_demo


def test_a_head_without_demo_is_refused_before_any_work(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    with pytest.raises(OptionError, match="thesis-multi-5"):
        run_head_demo(DemoRequest(folder, "thesis-multi-5"))
    assert not folder.exists()


def test_the_earlier_comparison_stays_whole_when_a_head_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("report.html", "single/truth.json", "summary.json")
    (tmp_path / "single").mkdir()
    for name in names:
        (tmp_path / name).write_text("old")
    (tmp_path / FILES).write_text("\n".join([*names, FILES]))

    def fail(request: DemoRequest, folder: Path, progress: object) -> None:
        (folder / "truth.json").write_text("new")
        raise EstimationError(f"{request.head} failed")

    monkeypatch.setattr("armscan.jobs.twin.demo.make_head_demo", fail)
    with pytest.raises(EstimationError, match="thesis-single failed"):
        run_all_heads(DemoRequest(tmp_path))
    assert {(tmp_path / name).read_text() for name in names} == {"old"}
    assert {path.name for path in tmp_path.iterdir()} == {*names, "single", FILES} - {names[1]}
