# SPDX-License-Identifier: Apache-2.0
"""A new demo takes the place of an earlier one when it is complete, and never of anything else."""

from __future__ import annotations

from pathlib import Path

import pytest

from armscan.errors import OutputError
from armscan.jobs.demo import OWN_FILES, replaced_demo

HEX = "0123456789abcdef0123456789abcdef"
FILES = (
    "truth.json",
    "report.html",
    "recordings/ball/session.toml",
    "recordings/laser/images/on/01.png",
    "recordings/part/images/0001.png",
)


def demo_at(folder: Path, word: str) -> Path:
    for name in FILES:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(word)
    (folder / "truth.json").write_text('{"simulated": true}')
    return folder


def word_of(folder: Path) -> str:
    return (folder / "report.html").read_text()


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_the_earlier_demo_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    (folder / "recordings/part/images/0002.png").write_text("old")
    with replaced_demo(folder, OWN_FILES) as place:
        demo_at(place, "new")
        assert place.parent == tmp_path
        assert word_of(folder) == "old"
    assert word_of(folder) == "new"
    assert not (folder / "recordings/part/images/0002.png").exists()
    assert names_in(tmp_path) == {"demo"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_a_run_that_ends_early_leaves_the_earlier_demo(
    tmp_path: Path, error: type[BaseException]
) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    with pytest.raises(error), replaced_demo(folder, OWN_FILES) as place:
        demo_at(place, "new")
        raise error
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == {*FILES}
    assert word_of(folder) == "old"
    assert names_in(tmp_path) == {"demo"}


@pytest.mark.parametrize(
    "mine", ["recordings/notes.txt", "recordings/ball/images/holiday.png", "recordings/own/a.csv"]
)
def test_own_files_deep_in_a_demo_are_refused_before_any_work(tmp_path: Path, mine: str) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    (folder / mine).parent.mkdir(parents=True, exist_ok=True)
    (folder / mine).write_text("mine")
    with pytest.raises(OutputError, match=mine), replaced_demo(folder, OWN_FILES):
        pytest.fail("the work was begun")
    assert (folder / mine).read_text() == "mine"
    assert word_of(folder) == "old"


def test_own_files_that_come_while_it_works_are_kept(tmp_path: Path) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    with pytest.raises(OutputError, match=r"late\.txt"), replaced_demo(folder, OWN_FILES) as place:
        demo_at(place, "new")
        (folder / "late.txt").write_text("mine")
    assert names_in(folder) == {"truth.json", "report.html", "recordings", "late.txt"}
    assert names_in(tmp_path) == {"demo"}


def test_what_a_killed_run_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    left = demo_at(tmp_path / f".demo.{HEX}.part", "killed")
    half = left / f"recordings/.part.{HEX}.part/images/0001.png"
    half.parent.mkdir(parents=True)
    half.write_text("half")
    (tmp_path / f".other.{HEX}.part").mkdir()
    mine = tmp_path / f".demo.{HEX[::-1]}.part"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    with replaced_demo(tmp_path / "demo", OWN_FILES) as place:
        demo_at(place, "new")
    assert names_in(tmp_path) == {"demo", f".other.{HEX}.part", mine.name}


def test_a_demo_that_was_moved_away_by_a_killed_run_comes_back(tmp_path: Path) -> None:
    demo_at(tmp_path / f".demo.{HEX}.old", "old")
    with pytest.raises(RuntimeError), replaced_demo(tmp_path / "demo", OWN_FILES):
        raise RuntimeError
    assert word_of(tmp_path / "demo") == "old"
    assert names_in(tmp_path) == {"demo"}
