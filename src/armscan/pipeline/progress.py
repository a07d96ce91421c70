# SPDX-License-Identifier: Apache-2.0
"""Progress of long work, as events that any front end can show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class ProgressEvent:
    """``done`` of ``total`` steps of a stage are finished; ``item`` names the latest."""

    stage: str
    done: int
    total: int
    item: str = ""


Progress: TypeAlias = Callable[[ProgressEvent], None]


def silent(event: ProgressEvent) -> None:
    """Show nothing."""
