# SPDX-License-Identifier: Apache-2.0
"""Postures that the others contradict: found, named and left out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.calibration.hand_eye.left_out import leave_each_out
from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, fit_plate
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_search import Start
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure

MAX_WRONG_SHARE = 0.34
LEAST_LEFT = 6
SUSPECT_PROBABILITY = 0.2
WRONG_PROBABILITY = 1e-5
"""Probability, among as many postures, of a shift and slope like those of the posture."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedFit:
    """A refined hand-eye, the nodes it rests on, and what is weak about it, in words.

    ``widening`` (6, 6) is added to the hand-eye's covariance for what contradicts it a little;
    ``plane_check`` says what the stripes alone say of the plate.
    """

    fit: PlateFit
    nodes: PlateNodes
    warnings: tuple[str, ...]
    widening: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    plane_check: str = ""


def fit_without_wrong_postures(
    nodes: PlateNodes,
    plate: PlateReference,
    start: Start,
    first: PlateFit,
    options: HandEyeOptions,
) -> CheckedFit | FitFailure:
    """Leave out postures whose pose is wrong.

    Gross ones are known from the start. Of the rest, the posture that the others predict worst is
    left out for trial; if the scatter of the others then makes its distance all but impossible, it
    stays out, and the next one is tried. ``first`` is the fit without the gross ones.
    """
    n_all = len(nodes.used_postures)
    wrong = start.is_wrong.copy()
    refusal = _refuse_many(nodes, wrong, n_all)
    if refusal is not None:
        return refusal
    gross = wrong.copy()
    fit = first
    while True:
        kept = nodes.select(~wrong[nodes.posture])
        suspect = _suspect(kept, fit)
        if suspect is None or len(kept.used_postures) <= LEAST_LEFT:
            break
        trial = wrong.copy()
        trial[suspect] = True
        without = fit_plate(nodes.select(~trial[nodes.posture]), plate, fit.refined.state, options)
        if isinstance(without, FitFailure) or not _is_contradicted(
            kept, plate, without, options, suspect
        ):
            break
        wrong, fit = trial, without
        refusal = _refuse_many(nodes, wrong, n_all)
        if refusal is not None:
            return refusal
    warnings = _in_words(nodes, wrong, gross, start.rms_mm)
    return CheckedFit(fit, nodes.select(~wrong[nodes.posture]), warnings)


def _suspect(nodes: PlateNodes, fit: PlateFit) -> int | None:
    left = leave_each_out(nodes, fit.refined.placed.residual_mm, fit.linear)
    worst = min(left, key=lambda number: left[number].probability)
    likely = left[worst].probability * len(left)
    return worst if likely < SUSPECT_PROBABILITY else None


def _is_contradicted(
    nodes: PlateNodes,
    plate: PlateReference,
    without: PlateFit,
    options: HandEyeOptions,
    suspect: int,
) -> bool:
    """Predict the suspect with the scatter that the other postures show."""
    judged = fit_plate(
        nodes, plate, without.refined.state, options, without.noise.sigmas, hold_noise=True
    )
    if isinstance(judged, FitFailure):
        return False
    left = leave_each_out(nodes, judged.refined.placed.residual_mm, judged.linear)
    return left[suspect].probability * len(left) < WRONG_PROBABILITY


def _refuse_many(nodes: PlateNodes, wrong: BoolArray, n_all: int) -> FitFailure | None:
    n_wrong = int(wrong[nodes.used_postures].sum())
    if n_wrong <= MAX_WRONG_SHARE * n_all:
        return None
    names = ", ".join(nodes.postures[k] for k in np.flatnonzero(wrong)[:8])
    return FitFailure(
        f"{n_wrong} of {n_all} postures contradict the others ({names})",
        "check that every exposure has its own pose (none missing, doubled or swapped) and that "
        "the plate did not move",
    )


def _in_words(
    nodes: PlateNodes, wrong: BoolArray, gross: BoolArray, rms_mm: FloatArray
) -> tuple[str, ...]:
    """Name the postures that were left out."""
    warnings = []
    if gross.any():
        named = ", ".join(
            f"{nodes.postures[k]} ({rms_mm[k]:.2f} mm)" for k in np.flatnonzero(gross)
        )
        warnings.append(
            f"left out {int(gross.sum())} postures whose stripes lie far from where the others "
            f"put the plate: {named}; a missing, doubled or swapped pose looks like this"
        )
    mild = wrong & ~gross
    if mild.any():
        named = ", ".join(f"{nodes.postures[k]} ({rms_mm[k]:.3f} mm)" for k in np.flatnonzero(mild))
        warnings.append(
            f"left out {int(mild.sum())} postures that fit the others worse than their scatter "
            f"allows: {named}; the arm may have moved during the exposure, or the plate was dirty"
        )
    return tuple(warnings)
