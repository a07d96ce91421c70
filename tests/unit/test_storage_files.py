# SPDX-License-Identifier: Apache-2.0
"""Results are complete or not there."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from armscan.errors import FileFormatError, OutputError
from armscan.storage.documents import fingerprint
from armscan.storage.files import (
    check_new_folder,
    check_outputs,
    locked,
    new_folder,
    path_text,
    read_bytes,
    set_aside,
    sha256_of,
    write_files,
)


def test_a_hash_needs_no_memory_for_the_file(tmp_path: Path) -> None:
    """The whole file was read."""
    path = tmp_path / "long.bin"
    path.write_bytes(bytes(20 * 2**20))
    tracemalloc.start()
    found = fingerprint(path).sha256
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2 * 2**20
    assert found == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("read", [read_bytes, sha256_of])
def test_what_cannot_be_read_is_told_alike(tmp_path: Path, read: Callable[[Path], object]) -> None:
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    for name, said in {
        "empty": "is empty",
        "none": "no such file",
        ".": "a folder",
        "pipe": "a pipe",
        "\0": "null",
    }.items():
        with pytest.raises(FileFormatError, match=said):
            read(tmp_path / name)


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
        write_files({tmp_path / "a": b"1", tmp_path / "b": b"2"}, is_overwriting=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1"}


def test_a_file_that_another_program_wrote_meanwhile_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = os.link

    def second_exists(part: Path, path: Path) -> None:
        if path.name == "b":
            path.write_bytes(b"theirs")
        link(part, path)

    monkeypatch.setattr(os, "link", second_exists)
    with pytest.raises(OutputError, match="b: the file exists"):
        write_files({tmp_path / "a": b"1", tmp_path / "b": b"2"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"b": b"theirs"}


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path: Path) -> None:
    """Killed between a folder's files, and with the whole result written but not named."""
    program = """
import os, signal, sys
from pathlib import Path
from armscan.storage.files import new_folder, write_files
folder = Path(sys.argv[1])
os.link = os.replace = lambda *names: os.kill(os.getpid(), signal.SIGKILL)
if sys.argv[2] == "folder":
    with new_folder(folder / "scan") as partial:
        (partial / "a").write_bytes(b"1")
        os.kill(os.getpid(), signal.SIGKILL)
write_files({folder / "x.ply": b"1", folder / "x.html": b"2"})
"""
    for what in ("folder", "files"):
        subprocess.run([sys.executable, "-c", program, str(tmp_path), what], check=False)
    assert len(list(tmp_path.iterdir())) == 3
    write_files({tmp_path / "x.ply": b"3", tmp_path / "x.html": b"4"})
    with new_folder(tmp_path / "scan") as partial:
        (partial / "b").write_bytes(b"2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scan", "x.html", "x.ply"]


def test_the_rest_of_a_run_that_still_writes_is_left_alone(tmp_path: Path) -> None:
    with new_folder(tmp_path / "scan") as first:
        (first / "a").write_bytes(b"1")
        with (
            pytest.raises(OutputError, match="nothing was written"),
            new_folder(tmp_path / "scan", {tmp_path / "truth": b"2"}) as second,
        ):
            (second / "a").write_bytes(b"2")
            (tmp_path / "scan").mkdir()
            (tmp_path / "scan" / "theirs").write_bytes(b"3")
            assert (first / "a").is_file()
        assert (first / "a").is_file() and not (tmp_path / "truth").exists()
        (tmp_path / "scan" / "theirs").unlink()
    assert (tmp_path / "scan" / "a").read_bytes() == b"1"


def test_the_loser_of_two_folders_leaves_the_winners_truth(tmp_path: Path) -> None:
    truth = tmp_path / "scan.truth.json"
    with (
        pytest.raises(OutputError, match="the file exists"),
        new_folder(tmp_path / "scan", {truth: b"second"}),
        new_folder(tmp_path / "scan", {truth: b"first"}) as partial,
    ):
        (partial / "a").write_bytes(b"1")
    assert truth.read_bytes() == b"first" and (tmp_path / "scan" / "a").is_file()


@pytest.mark.parametrize("name", ["x" * 250, "na\udcefve", "größe"])
def test_names_of_any_kind_are_written_and_read(tmp_path: Path, name: str) -> None:
    write_files({tmp_path / name: b"1"})
    assert read_bytes(tmp_path / name) == b"1"
    path_text(tmp_path / name).encode("utf-8")


@pytest.mark.skipif(os.name == "nt", reason="there are no such files")
def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path in (tmp_path / "pipe", tmp_path / "loop", Path("/dev/zero"), tmp_path / ("x" * 300)):
        with pytest.raises(FileFormatError):
            read_bytes(path)


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


@pytest.mark.skipif(os.name != "posix", reason="locks files")
def test_a_growing_file_is_known_where_exclusive_locks_need_the_right_to_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on NFS, by flock(2)."""
    import fcntl

    def flock(file: Any, how: int) -> None:
        handle = file if isinstance(file, int) else file.fileno()
        may_write = fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY
        if how & fcntl.LOCK_EX and not may_write:
            raise OSError(errno.EBADF, "Bad file descriptor")
        fcntl.flock(handle, how)

    nfs = {name: getattr(fcntl, name) for name in ("LOCK_EX", "LOCK_SH", "LOCK_NB")}
    monkeypatch.setattr("armscan.storage.files.fcntl", SimpleNamespace(flock=flock, **nfs))
    path = tmp_path / "scan.mcap"
    path.write_bytes(b"growing")
    with locked(path), pytest.raises(OutputError, match="another run writes this file"):
        set_aside(path, is_overwriting=True)
    assert path.read_bytes() == b"growing"


@pytest.mark.parametrize("is_other", [False, True])
def test_what_was_set_aside_and_grew_since_is_not_removed(tmp_path: Path, is_other: bool) -> None:
    path = tmp_path / "scan.mcap"
    path.write_bytes(b"an hour")
    aside = set_aside(path, is_overwriting=True)
    assert aside is not None and not path.exists()
    if is_other:
        aside.path.rename(tmp_path / "kept")
        aside.path.write_bytes(b"an hour")
    else:
        with aside.path.open("ab") as growing:
            growing.write(b" more")
    assert not aside.remove() and aside.path.exists()
    aside.path.unlink()
    assert aside.remove()
    path.write_bytes(b"an hour")
    again = set_aside(path, is_overwriting=True)
    assert again is not None and again.remove() and not again.path.exists()
