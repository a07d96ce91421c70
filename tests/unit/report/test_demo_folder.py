# SPDX-License-Identifier: Apache-2.0
"""A new demo takes the place of an earlier one, and never of anything else."""

from __future__ import annotations

from pathlib import Path

import pytest

from armscan.errors import OutputError
from armscan.jobs.demo import FILES, demo_folder

NAMES = (
    "truth.json",
    "report.html",
    "recordings/ball/session.toml",
    "recordings/laser/images/on/01.png",
    "recordings/part/images/0001.png",
)


def write(folder: Path, word: str) -> None:
    for name in NAMES:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(word)


def demo_at(folder: Path, word: str) -> Path:
    with demo_folder(folder):
        write(folder, word)
    return folder


def word_of(folder: Path) -> str:
    return (folder / "report.html").read_text()


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_new_demo_takes_the_place_of_the_whole_earlier_one(tmp_path: Path) -> None:
    with demo_folder(tmp_path / "demo"):
        write(tmp_path / "demo", "old")
        (tmp_path / "demo/recordings/part/images/0002.png").write_text("old")
    folder = demo_at(tmp_path / "demo", "new")
    assert word_of(folder) == "new"
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == {
        *NAMES,
        FILES,
    }
    assert names_in(tmp_path) == {"demo"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_a_run_that_ends_early_leaves_the_earlier_demo(
    tmp_path: Path, error: type[BaseException]
) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    with pytest.raises(error), demo_folder(folder):
        write(folder, "new")
        raise error
    assert word_of(folder) == "old"
    assert names_in(tmp_path) == {"demo"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_a_first_run_that_ends_early_leaves_nothing(
    tmp_path: Path, error: type[BaseException]
) -> None:
    with pytest.raises(error), demo_folder(tmp_path / "some/demo"):
        write(tmp_path / "some/demo", "new")
        raise error
    assert names_in(tmp_path / "some") == set()


@pytest.mark.parametrize(
    "mine", ["recordings/notes.txt", "recordings/ball/images/holiday.png", "recordings/own/a.csv"]
)
def test_own_files_deep_in_a_demo_are_refused_before_any_work(tmp_path: Path, mine: str) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    (folder / mine).parent.mkdir(parents=True, exist_ok=True)
    (folder / mine).write_text("mine")
    with pytest.raises(OutputError, match=mine), demo_folder(folder):
        pytest.fail("the work was begun")
    assert (folder / mine).read_text() == "mine"
    assert word_of(folder) == "old"


def test_a_link_is_no_file_of_a_demo(tmp_path: Path) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    (tmp_path / "precious").write_text("mine")
    (folder / "recordings/link").symlink_to(tmp_path / "precious")
    with pytest.raises(OutputError, match="recordings/link"), demo_folder(folder):
        pytest.fail("the work was begun")


def test_the_current_folder_can_be_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo_at(tmp_path / "demo", "old")
    monkeypatch.chdir(tmp_path / "demo")
    with demo_folder(Path()):
        write(tmp_path / "demo", "new")
    assert word_of(tmp_path / "demo") == "new"
