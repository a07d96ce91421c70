# SPDX-License-Identifier: Apache-2.0
"""Do the postures determine the hand-eye? Rank, condition and the weakest combination."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.least_squares import LEVER_MM
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

RANK_RATIO = 1e-4
"""Singular values below this part of the largest are taken as zero: a posture that was meant to
repeat another still turns by a hundredth of a degree."""
MAX_CONDITION = 100.0
GOOD_POSTURES = 6
LEAST_POSTURES = 3
NAMED_SHARE = 0.3
"""Parts of the weakest combination above this are named."""
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class Conditioning:
    """How well six parameters are determined.

    Parameters
    ----------
    singular_values
        (6,) of the whitened system, largest first, in 1/mm: turns are scaled by what they move at
        100 mm (`LEVER_MM`).
    rank, condition
        Of that system; the condition is infinite below rank 6.
    weakest
        The combination of parameters that is known least, in words.
    """

    singular_values: FloatArray
    rank: int
    condition: float
    weakest: str


def describe_conditioning(information: FloatArray) -> Conditioning:
    """Rank and condition from the (6, 6) inverse covariance of the hand-eye.

    Parameters
    ----------
    information
        ``A' C^-1 A`` in the order of `armscan.models.scanner.HAND_EYE_PARAMETER_NAMES`, other
        unknowns eliminated.
    """
    scale = np.array([1.0 / LEVER_MM] * 3 + [1.0] * 3)
    scaled = information * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    rank = int((singular > RANK_RATIO * singular[0]).sum()) if singular[0] > 0.0 else 0
    condition = float(singular[0] / singular[5]) if rank == 6 else float("inf")
    sigma_mm = 1.0 / float(singular[5]) if rank == 6 else float("inf")
    return Conditioning(singular, rank, condition, _in_words(vectors[:, 0], sigma_mm))


def _in_words(direction: FloatArray, sigma_mm: float) -> str:
    names = [f"turning about tool {axis}" for axis in _AXES]
    names += [f"shifting along tool {axis}" for axis in _AXES]
    order = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) >= NAMED_SHARE]
    parts = [f"{names[k]} ({abs(direction[k]):.2f})" for k in order]
    known = "not determined" if not np.isfinite(sigma_mm) else f"known to {sigma_mm:.3g} mm"
    return f"{' with '.join(parts)}: {known}, turns counted at {LEVER_MM:.0f} mm"


def refuse_open_hand_eye(conditioning: Conditioning, cause: str, remedy: str) -> FitFailure | None:
    """Refuse a system of rank below six; ``cause`` says what the postures have in common."""
    if conditioning.rank == 6:
        return None
    return FitFailure(
        f"the postures determine only {conditioning.rank} of the hand-eye's 6 parameters{cause} "
        f"(least known: {conditioning.weakest})",
        remedy,
    )


def refuse_few_postures(n_postures: int) -> FitFailure | None:
    """Refuse fewer postures than any solution needs."""
    if n_postures >= LEAST_POSTURES:
        return None
    return FitFailure(
        f"{n_postures} postures with a usable stripe; {LEAST_POSTURES} are the least for any "
        f"solution, {GOOD_POSTURES} for a checked one",
        "scan from 12 postures: tilts of 30 to 45 degrees in two or more directions, stand-off "
        "varied by 15 %",
    )


def conditioning_warnings(
    conditioning: Conditioning, n_postures: int, cause: str
) -> tuple[str, ...]:
    """What is weak about the postures of a solved hand-eye."""
    warnings = []
    if n_postures < GOOD_POSTURES:
        warnings.append(
            f"{n_postures} postures only: a wrong one would not be noticed, and the hand-eye is "
            f"several times less certain than from 12; use at least {GOOD_POSTURES}, better 12"
        )
    if conditioning.condition > MAX_CONDITION:
        warnings.append(
            f"the hand-eye is badly determined (condition {conditioning.condition:.0f}, good is "
            f"below {MAX_CONDITION:.0f}){cause}; least known: {conditioning.weakest}"
        )
    elif cause:
        warnings.append(
            f"the postures are less varied than they should be{cause}; least known: "
            f"{conditioning.weakest}"
        )
    return tuple(warnings)
