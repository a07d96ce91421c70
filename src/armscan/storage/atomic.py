# SPDX-License-Identifier: Apache-2.0
"""Files and folders that appear complete or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from armscan.errors import OutputError


def check_outputs(paths: Iterable[Path], *, is_overwriting: bool = False) -> None:
    """Raise before long work if a result could not be written afterwards.

    Parameters
    ----------
    paths
        Files that will be written.
    is_overwriting
        Allow files that exist; folders are refused all the same.

    Raises
    ------
    OutputError
        If the folder does not exist or may not be written, or the file exists.
    """
    for path in paths:
        folder = path.parent
        if folder.exists() and not folder.is_dir():
            raise OutputError(
                "this is a file, not a folder to write to",
                where=str(folder),
                remedy="choose another folder",
            )
        if not folder.is_dir():
            raise OutputError(
                "there is no such folder to write to", where=str(folder), remedy="create it first"
            )
        if path.is_dir():
            raise OutputError("this is a folder", where=str(path), remedy="name a file to write")
        if path.exists() and not is_overwriting:
            raise OutputError(
                "the file exists", where=str(path), remedy="choose another name or give --force"
            )
        if not os.access(folder, os.W_OK):
            raise OutputError(
                "the folder may not be written", where=str(folder), remedy="choose another folder"
            )


def write_files(contents: Mapping[Path, bytes], *, is_overwriting: bool = False) -> None:
    """Write files that belong together, each of them complete.

    Each is written under a temporary name in its folder and all are renamed at the end, so that a
    full disk or an interrupt leaves what was there before.

    Raises
    ------
    OutputError
        As `check_outputs`, or if the disk is full or refuses; if it refuses one of the renames,
        the message names the files that were renamed before.
    """
    check_outputs(contents, is_overwriting=is_overwriting)
    written: dict[Path, Path] = {}
    done: list[str] = []
    try:
        for path, content in contents.items():
            written[path] = _write_temporary(path, content)
        for path in list(written):
            written[path].replace(path)
            del written[path]
            done.append(path.name)
    except OSError as error:
        what = f"only {', '.join(done)}" if done else "nothing"
        raise OutputError(
            f"{what} was written ({error.strerror})",
            where=", ".join(str(path) for path in contents),
            remedy="free some space or choose another folder",
        ) from error
    finally:
        for temporary in written.values():
            with suppress(OSError):
                temporary.unlink()


def _write_temporary(path: Path, content: bytes) -> Path:
    temporary = path.with_name(f".{path.name}.{uuid4().hex}.part")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    return temporary


def check_new_folder(folder: Path) -> None:
    """Raise before long work if a folder could not be written afterwards.

    Raises
    ------
    OutputError
        If it holds something, is the current folder or a root, or the one above does not exist.
    """
    target = folder.resolve()
    if target in (Path.cwd(), Path(target.anchor)):
        raise OutputError(
            "this is the current folder or a root, which cannot be made anew",
            where=str(folder),
            remedy="name a new folder, as scan",
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(
            "this exists and is not empty", where=str(folder), remedy="name a new folder"
        )
    parent = target.parent
    if parent.exists() and not parent.is_dir():
        raise OutputError(
            "this is a file, not a folder to write to",
            where=str(parent),
            remedy="choose another folder",
        )
    if not parent.is_dir():
        raise OutputError(
            "there is no such folder to write to", where=str(parent), remedy="create it first"
        )


@contextmanager
def new_folder(folder: Path, beside: Mapping[Path, bytes] | None = None) -> Iterator[Path]:
    """Give a folder of another name to write into; it gets its name when the block has ended.

    If the block raises or is interrupted, nothing is left of it.

    Parameters
    ----------
    folder
        Must not exist, or be empty.
    beside
        Files outside the folder that belong to it; written when it is complete, just before it
        gets its name, so that it is never seen without them.

    Raises
    ------
    OutputError
        As `check_new_folder`, or if the disk is full or refuses.
    """
    check_new_folder(folder)
    target = folder.resolve()
    partial = target.with_name(f".{target.name}.{uuid4().hex}.part")
    try:
        partial.mkdir()
        yield partial
        write_files(beside or {})
        try:
            if target.exists():
                target.rmdir()
            partial.rename(target)
        except BaseException:
            _remove(beside or {})
            raise
    except OSError as error:
        raise OutputError(
            f"nothing was written ({error.strerror or error})",
            where=str(folder),
            remedy="free some space or choose another folder",
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _remove(files: Iterable[Path]) -> None:
    for path in files:
        with suppress(OSError):
            path.unlink()
