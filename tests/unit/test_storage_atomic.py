# SPDX-License-Identifier: Apache-2.0
"""Results are complete or not there."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from armscan.errors import OutputError
from armscan.storage.atomic import check_new_folder, check_outputs, new_folder, write_files


def test_files_are_written_together(tmp_path: Path) -> None:
    write_files({tmp_path / "a": b"1", tmp_path / "b": b"2"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1", "b": b"2"}


def test_nothing_is_replaced_without_being_asked(tmp_path: Path) -> None:
    (tmp_path / "b").write_bytes(b"old")
    with pytest.raises(OutputError, match="the file exists; choose another name or give --force"):
        write_files({tmp_path / "a": b"1", tmp_path / "b": b"new"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"b": b"old"}
    write_files({tmp_path / "b": b"new"}, is_overwriting=True)
    assert (tmp_path / "b").read_bytes() == b"new"


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_a_full_disk_or_an_interrupt_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    (tmp_path / "a").write_bytes(b"old")
    calls = []

    def sync(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 2:
            raise failure

    monkeypatch.setattr(os, "fsync", sync)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        write_files({tmp_path / "a": b"new", tmp_path / "b": b"2"}, is_overwriting=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"old"}


def test_a_refused_rename_says_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first file is in place, the second is held open by somebody: no temporary remains."""
    rename = Path.replace

    def refuse_b(path: Path, target: Path) -> Path:
        if target.name == "b":
            raise PermissionError(errno.EACCES, "Permission denied")
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", refuse_b)
    with pytest.raises(OutputError, match=r"only a was written \(Permission denied\)"):
        write_files({tmp_path / "a": b"1", tmp_path / "b": b"2"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1"}


def test_places_that_cannot_be_written_are_found_early(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no such folder"):
        check_outputs([tmp_path / "absent" / "a"])
    with pytest.raises(OutputError, match="this is a folder"):
        check_outputs([tmp_path], is_overwriting=True)


@pytest.mark.skipif(
    os.name == "nt" or os.access("/", os.W_OK), reason="this user may write everywhere"
)
def test_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="may not be written"):
        check_outputs([tmp_path / "a"])


def test_files_beside_a_folder_are_there_when_it_appears(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupt after they are written, before the rename, leaves neither."""
    seen = []
    rename = Path.rename

    def look(path: Path, target: Path) -> Path:
        seen.append((tmp_path / "scan.truth.json").read_bytes())
        if len(seen) == 1:
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", look)
    beside = {tmp_path / "scan.truth.json": b"true"}
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "scan", beside):
        pass
    assert seen == [b"true"] and list(tmp_path.iterdir()) == []
    with new_folder(tmp_path / "scan", beside) as partial:
        (partial / "a").write_bytes(b"1")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scan", "scan.truth.json"]


@pytest.mark.parametrize("name", [".", "", "sub/..", "/"])
def test_the_current_folder_and_a_root_are_not_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="name a new folder"):
        check_new_folder(Path(name))


def test_a_file_in_place_of_a_folder_is_called_a_file(tmp_path: Path) -> None:
    (tmp_path / "note").write_text("x")
    for check in (lambda path: check_outputs((path,)), check_new_folder):
        with pytest.raises(OutputError, match="this is a file, not a folder"):
            check(tmp_path / "note" / "plate.csv")
