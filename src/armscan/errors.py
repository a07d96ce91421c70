# SPDX-License-Identifier: Apache-2.0
"""Typed errors: each says what is wrong, where, and what to do."""

from __future__ import annotations

import re
from collections.abc import Sequence

MOST_CHARACTERS = 1000
"""Of a sentence about a file that quotes it: files may hold words of any length."""
NOT_SHOWN = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
"""Characters that move the cursor or cannot be written: names of files may hold them."""


def shown(text: str, most: int = MOST_CHARACTERS) -> str:
    """The text on one line that any terminal and file takes, its middle left out if it is long."""
    plain = NOT_SHOWN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
    half = most // 2 - 3
    return plain if len(plain) <= most else f"{plain[:half]} ... {plain[-half:]}"


def listed(names: Sequence[str], most: int) -> str:
    """The first names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def begun(names: Sequence[str], most: int) -> str:
    """The first names, and an ellipsis where there are more."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


class ArmscanError(Exception):
    """A failure that a person can act on.

    Parameters
    ----------
    what
        The fact: what is wrong, with the numbers that show it.
    where
        File, option or stage; empty when the fact already names it.
    remedy
        What to do about it, as an imperative.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what = shown(what)
        self.where = shown(where)
        self.remedy = remedy
        super().__init__(str(self))

    def __str__(self) -> str:
        """One sentence: ``where: what; remedy.``."""
        head = f"{self.where}: {self.what}" if self.where else self.what
        parts = [head.rstrip("."), self.remedy.rstrip(".")]
        return "; ".join(part for part in parts if part) + "."


class InputError(ArmscanError):
    """An input value or array is not usable: wrong shape, NaN, out of range."""


class FileFormatError(ArmscanError):
    """A file cannot be read, is cut short, or is not what its name or schema says."""


class OutputError(ArmscanError):
    """A result cannot be written: no folder, no permission, no space, or it would be replaced."""


class OptionError(ArmscanError):
    """A command-line option or a target specification is wrong."""


class DeviceError(ArmscanError):
    """A camera, arm or laser controller is not there, does not answer or says what cannot be."""


class DriverMissingError(DeviceError):
    """The driver of a device is known, but a package that it needs is not installed."""


class DeviceTakenError(DeviceError):
    """Another program, or this one, has the device open already."""


class DeviceStoppedError(DeviceError):
    """A device stopped for safety, and does nothing until a person has it started again."""


class EstimationError(ArmscanError):
    """The data do not determine what was asked for."""
