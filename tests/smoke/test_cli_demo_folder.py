# SPDX-License-Identifier: Apache-2.0
"""The demo does not write over what is not a demo's."""

from __future__ import annotations

from pathlib import Path

import pytest

from armscan.cli import main


@pytest.mark.parametrize("scene", ["photos", "single"])
@pytest.mark.parametrize("name", ["camera.json", "notes.txt", "photos", "recordings"])
def test_a_folder_with_own_files_is_left_alone(
    scene: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert main(["demo", scene, "-o", str(tmp_path)]) == 2
    assert f"other files than a demo's ({name})" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_file_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "demo").write_text("mine")
    assert main(["demo", "photos", "-o", str(tmp_path / "demo")]) == 2
    assert "demo: this is a file" in capsys.readouterr().err
    assert (tmp_path / "demo").read_text() == "mine"


def test_an_unknown_preset_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "single", "-o", str(tmp_path / "demo"), "--preset", "rosy"]) == 2
    assert "no preset is called 'rosy'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
