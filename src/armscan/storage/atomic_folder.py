# SPDX-License-Identifier: Apache-2.0
"""Folders that appear complete or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from armscan.errors import OutputError
from armscan.storage.atomic import write_files


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
