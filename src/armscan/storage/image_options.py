# SPDX-License-Identifier: Apache-2.0
"""How the pixels of an image file are to be read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from armscan.errors import OptionError

Alignment = Literal["low", "high"]


@dataclass(frozen=True, slots=True)
class ImageOptions:
    """What a file does not say about its pixels.

    Parameters
    ----------
    bits_used
        Significant bits of a pixel; None takes what the file says (PGM), else all of its bits.
    align
        Where the significant bits lie in a 16-bit pixel; high-aligned pixels are shifted down.
    """

    bits_used: int | None = None
    align: Alignment = "low"

    def __post_init__(self) -> None:
        if self.bits_used is not None and not 1 <= self.bits_used <= 16:
            raise OptionError(f"bits used is {self.bits_used}", remedy="give 1 to 16")
        if self.align not in ("low", "high"):
            raise OptionError(f"align is {self.align!r}", remedy="choose low or high")
        if self.align == "high" and self.bits_used is None:
            raise OptionError(
                "high-aligned pixels need the count of bits used", remedy="give 10, 12 or 14"
            )

    def check_unused(self) -> None:
        """Raise `OptionError` if anything is said of pixels: a recording describes its own."""
        if self != ImageOptions():
            raise OptionError(
                "a recording says itself how its pixels are stored",
                where="--bits-used and --bits-align",
                remedy="leave them out, or correct bits_used and align under [[camera]] in "
                "session.toml",
            )
