# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them."""

from __future__ import annotations

import math

SIGMA_NOTE = "± is one standard deviation."
"""Said once on every report: no other range is written with this sign."""


def with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """A value rounded to two digits of its standard deviation: ``1431.27 ± 0.85 px``.

    A standard deviation of zero or NaN means that none is known: six digits are shown.
    """
    tail = f" {unit}" if unit else ""
    if not math.isfinite(sigma) or sigma <= 0.0 or not math.isfinite(value):
        return f"{value:.6g}{tail}"
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}{tail}"


def significant(value: float, unit: str = "", digits: int = 3) -> str:
    """A value with a few digits, never in exponents between 1e-4 and 1e6."""
    tail = f" {unit}" if unit else ""
    if not math.isfinite(value):
        return "not known"
    if value == 0.0:
        return f"0{tail}"
    magnitude = math.floor(math.log10(abs(value)))
    if not -5 < magnitude < 6:
        return f"{value:.{digits - 1}e}{tail}"
    return f"{value:.{max(0, digits - 1 - magnitude)}f}{tail}"


def sentence(text: str) -> str:
    """Text with a capital at its start and a full stop at its end.

    A first word with a dot, digit or the like inside is a name, of a file or a coefficient, and
    stays as it is.
    """
    if not text:
        return ""
    first = text.split(maxsplit=1)[0].rstrip(".,:;").replace("-", "").replace("'", "")
    start = text[:1].upper() if first.isalpha() else text[:1]
    return f"{start}{text[1:].rstrip('.')}."


def without_source(source: str, reason: str) -> str:
    """A reason without the image's name in front, for places that show the name beside it."""
    return reason.removeprefix(f"{source}: ")
