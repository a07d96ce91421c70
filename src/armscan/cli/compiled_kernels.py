# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept when neither the installation nor the home may be written."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def give_kernels_a_folder(package: Path, temporary: Path | None = None) -> None:
    """Point numba at a folder of this user if it would find none, as in a container.

    Without one, numba refuses every kernel. What a folder holds is run as code, so that one that
    another user made, or may write, is not taken.

    Parameters
    ----------
    package
        The installed package, beside whose kernels numba keeps them where it can.
    temporary
        Folder for temporary files; that of the system if None.
    """
    if VARIABLE in os.environ:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    if _may_be_written(package / "kernels" / "__pycache__") or _may_be_written(
        Path(home) / "numba"
    ):
        return
    place = Path(tempfile.gettempdir()) if temporary is None else temporary
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = place / f"armscan-kernels-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == user
        if not is_own or status.st_mode & 0o022:
            folder = Path(tempfile.mkdtemp(prefix="armscan-kernels-", dir=place))
    except OSError:
        return
    os.environ[VARIABLE] = str(folder)


def _may_be_written(folder: Path) -> bool:
    """Whether a file can be made in a folder, tried as numba tries it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
