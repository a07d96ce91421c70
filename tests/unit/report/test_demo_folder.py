# SPDX-License-Identifier: Apache-2.0
"""A new demo takes the place of an earlier one when it is complete, and never of anything else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from armscan.errors import OutputError
from armscan.jobs.twin.demo import FILES, demo_folder
from armscan.storage.documents import new_provenance
from armscan.storage.image_paths import are_simulated

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
    with demo_folder(folder) as place:
        write(place, word)
    return folder


def word_of(folder: Path) -> str:
    return (folder / "report.html").read_text()


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_new_demo_takes_the_place_of_the_whole_earlier_one(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    with demo_folder(folder) as place:
        write(place, "old")
        (place / "recordings/part/images/0002.png").write_text("old")
        assert not folder.exists()
    with demo_folder(folder) as place:
        write(place, "new")
        assert place.parent == tmp_path
        assert word_of(folder) == "old"
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
    with pytest.raises(error), demo_folder(folder) as place:
        write(place, "new")
        raise error
    assert word_of(folder) == "old"
    assert names_in(tmp_path) == {"demo"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_a_first_run_that_ends_early_leaves_nothing(
    tmp_path: Path, error: type[BaseException]
) -> None:
    with pytest.raises(error), demo_folder(tmp_path / "some/demo") as place:
        write(place, "new")
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
    with demo_folder(Path()) as place:
        write(place, "new")
    assert word_of(tmp_path / "demo") == "new"


def test_own_files_that_come_while_it_works_are_kept(tmp_path: Path) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    with pytest.raises(OutputError, match=r"late\.txt"), demo_folder(folder) as place:
        write(place, "new")
        (folder / "late.txt").write_text("mine")
    assert word_of(folder) == "old"
    assert (folder / "late.txt").read_text() == "mine"
    assert names_in(tmp_path) == {"demo"}


KILLED = """
import os, signal, sys
from pathlib import Path
from armscan.jobs.twin.demo import demo_folder
calls, rename = [], Path.rename
def killed(*_):
    os.kill(os.getpid(), signal.SIGKILL)
def counted(path, name):
    calls.append(path)
    if len(calls) > int(sys.argv[2]):
        killed()
    return rename(path, name)
Path.rename = counted
with demo_folder(Path(sys.argv[1])) as place:
    (place / "report.html").write_text("killed")
    (place / "recordings").mkdir()
killed()
"""


@pytest.mark.parametrize(
    ("n_renames", "left"),
    [(0, {"demo", ".part"}), (1, {".old", ".part"}), (2, {"demo", ".old"})],
)
def test_the_run_after_a_killed_one_finds_a_whole_demo(
    tmp_path: Path, n_renames: int, left: set[str]
) -> None:
    """Killed before the new demo takes the place, while it does, and just after."""
    folder = demo_at(tmp_path / "demo", "old")
    other = tmp_path / ".other.0123456789ab.0123456789ab.part"
    other.mkdir()
    subprocess.run([sys.executable, "-c", KILLED, str(folder), str(n_renames)], check=False)
    names = names_in(tmp_path) - {other.name}
    assert {Path(name).suffix or name for name in names} == left
    with pytest.raises(RuntimeError), demo_folder(folder):
        raise RuntimeError
    assert word_of(folder) == ("killed" if n_renames == 2 else "old")
    assert names_in(tmp_path) == {"demo", other.name}
    assert word_of(demo_at(folder, "new")) == "new"
    assert names_in(tmp_path) == {"demo", other.name}


def test_own_files_where_a_killed_run_left_no_demo_stay_beside_the_earlier(tmp_path: Path) -> None:
    folder = demo_at(tmp_path / "demo", "old")
    subprocess.run([sys.executable, "-c", KILLED, str(folder), "1"], check=False)
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"notes\.txt"), demo_folder(folder):
        pytest.fail("the work was begun")
    (folder / "notes.txt").unlink()
    with pytest.raises(RuntimeError), demo_folder(folder):
        raise RuntimeError
    assert word_of(folder) == "old"


def test_documents_name_files_where_they_will_lie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with demo_folder(Path("demo")) as place:
        (place / "truth.json").write_text('{"simulated": true}')
        (item,) = new_provenance((place / "truth.json",)).inputs
        assert item.path == "demo/truth.json"
        assert are_simulated((Path(item.path),)) and are_simulated((place / "a.json",))
    assert are_simulated((Path(item.path),))
