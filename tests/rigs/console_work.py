# SPDX-License-Identifier: Apache-2.0
"""Work that another process finds by its module's name."""

from __future__ import annotations

import time
from pathlib import Path

from armscan.errors import OptionError
from armscan.pipeline.progress import Progress, ProgressEvent


def halves(number: int, *, progress: Progress) -> float:
    progress(ProgressEvent("halve", 1, 1))
    return number / 2


def refuse(*, progress: Progress) -> None:
    raise OptionError("no such thing", remedy="take another")


def fail(*, progress: Progress) -> None:
    raise ZeroDivisionError("here")


def wait_for(mark: Path, *, progress: Progress) -> None:
    progress(ProgressEvent("wait", 0, 1))
    time.sleep(60.0)
    mark.write_text("done")
