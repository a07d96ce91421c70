# SPDX-License-Identifier: Apache-2.0
"""Drivers and the simulator, found by name among the installed entry points."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from armscan.errors import OptionError

GROUP = "armscan.drivers"


def driver_names() -> tuple[str, ...]:
    """Names of all installed drivers, sorted."""
    return tuple(sorted(entry_points(group=GROUP).names))


def load_driver(name: str) -> Any:
    """Return the object that the driver ``name`` registers.

    Raises
    ------
    OptionError
        If no installed package registers that name.
    """
    found = entry_points(group=GROUP, name=name)
    if not found:
        raise OptionError(
            f"no driver is called '{name}'",
            remedy=f"choose one of: {', '.join(driver_names()) or 'none is installed'}",
        )
    return next(iter(found)).load()
