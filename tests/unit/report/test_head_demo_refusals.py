# SPDX-License-Identifier: Apache-2.0
"""Demos: heads without one, what is left when a head fails, what a calibration warned of."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armscan.errors import EstimationError, OptionError
from armscan.jobs.twin import demo, inspect_demo
from armscan.jobs.twin.demo import FILES, DemoRequest, run_all_heads, run_head_demo
from armscan.report.quantity import Summary


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


def test_the_demo_of_a_workpiece_is_named_and_tells_what_its_hand_eye_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[tuple[str, ...]] = []

    def calibrated(run: Any) -> SimpleNamespace:
        commands.append(run.command)
        return SimpleNamespace(warnings=("Hand-eye: it is shaky.",))

    laid = {"alignment": {"cad_from_part": np.eye(4).tolist()}, "faces": {"each": []}}
    judged = Summary("judged", warnings=("The part is shy.",), extra=laid)
    monkeypatch.setattr(demo._Run, "recording", lambda run, *scenes: nullcontext())
    monkeypatch.setattr(demo, "_calibrated", calibrated)
    monkeypatch.setattr(inspect_demo, "record_scenes", lambda *what, **how: {})
    monkeypatch.setattr(inspect_demo, "reconstruct", lambda *what: None)
    monkeypatch.setattr(inspect_demo, "inspect_cad", lambda *what, **how: judged)
    monkeypatch.setattr(inspect_demo, "read_cloud", lambda path: SimpleNamespace(points_mm=None))
    monkeypatch.setattr(inspect_demo, "_beside_truth", lambda *what: ())
    found = inspect_demo.run_workpiece_demo(DemoRequest(tmp_path / "demo"))
    assert found.warnings == ("Hand-eye: it is shaky.", "The part is shy.")
    assert [words[:3] for words in commands] == [("armscan", "demo", "workpiece")]
