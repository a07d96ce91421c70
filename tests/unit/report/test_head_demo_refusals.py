# SPDX-License-Identifier: Apache-2.0
"""Demos of heads: what has none, and what is left of an old comparison when a head fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from armscan.errors import EstimationError, OptionError
from armscan.jobs.demo import (
    DATA,
    FOLDERS,
    PAGE,
    TRUTH,
    HeadDemoRequest,
    run_head_demo,
    run_three_heads,
)


def test_a_head_without_demo_is_refused_before_any_work(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    with pytest.raises(OptionError, match="no demo of the head 'thesis-multi-5'"):
        run_head_demo(HeadDemoRequest(folder, "thesis-multi-5"))
    assert not folder.exists()


def test_no_old_comparison_stands_beside_new_heads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    single = tmp_path / FOLDERS["thesis-single"]
    single.mkdir()
    (single / TRUTH).write_text('{"simulated": true}')
    for name in (PAGE, DATA):
        (tmp_path / name).write_text("old")

    def fail(request: HeadDemoRequest, progress: object) -> None:
        raise EstimationError(f"{request.head} failed")

    monkeypatch.setattr("armscan.jobs.demo.make_head_demo", fail)
    with pytest.raises(EstimationError, match="thesis-single failed"):
        run_three_heads(HeadDemoRequest(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == [single.name]
