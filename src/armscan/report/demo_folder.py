# SPDX-License-Identifier: Apache-2.0
"""A demo's folder: used again if it holds an earlier demo, left alone if it holds anything else."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from armscan.errors import OutputError
from armscan.storage.simulated import are_simulated

TEMPORARY = re.compile(r"(?<![^/])\.([^/]+)\.[0-9a-f]{32}\.part(?![^/])")
"""Name of a file or folder that was not complete when its writer was killed."""


def check_demo_folder(folder: Path, own_names: Collection[str], mark: Path) -> None:
    """Refuse to write between files that are not an earlier demo's.

    Parameters
    ----------
    folder
        Where the demo goes; need not exist.
    own_names
        What the demo writes.
    mark
        A file of an earlier demo that lies beside the simulator's mark, or below it.

    Raises
    ------
    OutputError
        If the folder holds something else.
    """
    found = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    is_demo = are_simulated((mark,))
    _refuse(folder, [name for name in found if not is_demo or name not in own_names])


@contextmanager
def replaced_demo(folder: Path, own_files: re.Pattern[str]) -> Iterator[Path]:
    """Give a folder of another name to write a demo into; it gets its name when all is written.

    Until then an earlier demo stays as it is, also if the block raises or is interrupted. What a
    killed run left beside the folder is removed first; so no two demos may be written to one
    folder at a time.

    Parameters
    ----------
    folder
        Where the demo goes; made if need be.
    own_files
        Paths, with ``/``, of all files that a demo may hold; ``truth.json`` is its mark.

    Raises
    ------
    OutputError
        If the folder holds anything else, now or at the end, or cannot be written.
    """
    target = folder.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _clean_up(target, own_files)
        _check_files(folder, own_files)
        partial = _beside(target, "part")
        partial.mkdir()
        try:
            yield partial
            _check_files(folder, own_files)
            _swap(partial, target)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise OutputError(
            f"the demo cannot be written ({error.strerror or error})",
            where=str(folder),
            remedy="free some space or choose another folder",
        ) from error


def _beside(target: Path, ending: str) -> Path:
    return target.with_name(f".{target.name}.{uuid4().hex}.{ending}")


def _swap(partial: Path, target: Path) -> None:
    """Two renames; the earlier demo is removed after them."""
    if not target.exists():
        partial.rename(target)
        return
    old = _beside(target, "old")
    target.rename(old)
    try:
        partial.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _clean_up(target: Path, own_files: re.Pattern[str]) -> None:
    """Bring back the demo of a run that was killed between its renames; remove all that is left."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{32}}\.(part|old)")
    left = [path for path in sorted(target.parent.iterdir()) if pattern.fullmatch(path.name)]
    for path in left:
        if path.suffix == ".old" and not target.exists():
            path.rename(target)
        elif not _foreign(path, own_files):
            shutil.rmtree(path)


def _check_files(folder: Path, own_files: re.Pattern[str]) -> None:
    found = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    if found and not are_simulated((folder / "truth.json",)):
        _refuse(folder, found)
    _refuse(folder, _foreign(folder, own_files))


def _foreign(folder: Path, own_files: re.Pattern[str]) -> list[str]:
    """Files and links, as paths in the folder, that no demo writes."""
    if not folder.is_dir():
        return []
    files = [p for p in sorted(folder.rglob("*")) if p.is_symlink() or not p.is_dir()]
    names = [path.relative_to(folder).as_posix() for path in files]
    return [name for name in names if not own_files.fullmatch(TEMPORARY.sub(r"\1", name))]


def _refuse(folder: Path, foreign: list[str]) -> None:
    if foreign:
        raise OutputError(
            f"the folder holds other files than a demo's ({', '.join(foreign[:3])})",
            where=str(folder),
            remedy="name a new or an empty folder",
        )
