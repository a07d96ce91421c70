# SPDX-License-Identifier: Apache-2.0
"""The demo does not write over what is not a demo's."""

from __future__ import annotations

from pathlib import Path

import pytest

from armscan.cli import main


@pytest.mark.parametrize("name", ["camera.json", "notes.txt", "photos"])
def test_a_folder_with_own_files_is_left_alone(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert main(["demo", "photos", "-o", str(tmp_path)]) == 2
    assert f"other files than a demo's ({name})" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"
