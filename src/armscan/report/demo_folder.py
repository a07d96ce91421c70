# SPDX-License-Identifier: Apache-2.0
"""A demo's folder: used again if it holds an earlier demo, left alone if it holds anything else."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path

from armscan.errors import OutputError
from armscan.storage.simulated import are_simulated


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
    foreign = [name for name in found if not is_demo or name not in own_names]
    if foreign:
        raise OutputError(
            f"the folder holds other files than a demo's ({', '.join(foreign[:3])})",
            where=str(folder),
            remedy="name a new or an empty folder",
        )


def clear_demo_folder(folder: Path, own_names: Collection[str]) -> None:
    """Make the folder, without the earlier demo that it may hold.

    Raises
    ------
    OutputError
        As `check_demo_folder`, or if something cannot be removed or made.
    """
    check_demo_folder(folder, own_names, folder / "truth.json")
    try:
        for name in own_names:
            path = folder / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"the earlier demo cannot be replaced ({error.strerror})",
            where=str(folder),
            remedy="choose another folder",
        ) from error
