# SPDX-License-Identifier: Apache-2.0
"""Files that appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
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
