# SPDX-License-Identifier: Apache-2.0
"""A fan of sheets fitted to stripes: first without names, then with them.

Sheets that open from one source all but share a line, the fan's axis. In the frame of `FanLines`
the planes through a line are ``w = a u + b v + c`` with ``a = a0 + alpha c`` and
``b = b0 + beta c``: four numbers for the axis, and the height c for each sheet. Every stripe,
whatever its name, meets the axis, so that the four follow from all stripes before any is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.fan_lines import FanLines
from armscan.geometry.arrays import FloatArray, IntArray

PENCIL_SIGMA = np.array([0.5, 1.5, 0.02, 0.02])
"""How far a0, b0 (slopes) and alpha, beta (per mm) may be from zero: a source nearer than 50 mm to
the working volume, or sheets that the camera sees edge on, are no scanner."""
OWN_SLOPE_SIGMA = 0.01
"""By how much a sheet's slopes may differ from those of a plane through the axis: for bow, and for
sheets that miss the axis."""
SPACING_SHARE = 0.15
"""Neighbouring sheets are equally far apart up to this part of their distance."""
PENCIL_ITERATIONS = 40
FAN_ITERATIONS = 6
HUBER_SIGMA = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Pencil:
    """The axis of a fan, and where each stripe lies in it.

    Parameters
    ----------
    axis
        (4,) a0, b0, alpha, beta.
    covariance
        (4, 4) of these.
    height_mm
        (L,) c of the plane through the axis that is nearest to each stripe.
    """

    axis: FloatArray
    covariance: FloatArray
    height_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """Sheets of a fan fitted to named stripes.

    Parameters
    ----------
    slots
        (K,) numbers of the sheets, increasing.
    planes
        (K, 3) a, b, c of each.
    axis
        (4,) as in `Pencil`.
    chi2
        (L,) squares of each stripe's two ends over their variances; 0 where it has no name.
    cost
        Their sum, and what the fan's regularity adds.
    """

    slots: IntArray
    planes: FloatArray
    axis: FloatArray
    chi2: FloatArray
    cost: float


def heights_in_pencil(lines: FanLines, roots: FloatArray, axis: FloatArray) -> FloatArray:
    """(L,) c of the plane through an axis that is nearest to each stripe."""
    u, v, w = (lines.ends[:, :, k] for k in range(3))
    lever = np.einsum("lij,lj->li", roots, 1.0 + axis[2] * u + axis[3] * v)
    target = np.einsum("lij,lj->li", roots, w - axis[0] * u - axis[1] * v)
    return np.asarray((lever * target).sum(axis=1) / (lever**2).sum(axis=1))


def fit_pencil(lines: FanLines, roots: FloatArray) -> Pencil:
    """Find the axis that all stripes meet, without their names, by robust Gauss-Newton steps."""
    axis = np.zeros(4)
    u, v, w = (lines.ends[:, :, k] for k in range(3))
    for _ in range(PENCIL_ITERATIONS):
        c = heights_in_pencil(lines, roots, axis)[:, None]
        lever = 1.0 + axis[2] * u + axis[3] * v
        rest = np.einsum("lij,lj->li", roots, w - axis[0] * u - axis[1] * v - c * lever)
        design = np.einsum("lij,ljk->lik", roots, np.stack([u, v, c * u, c * v], axis=2))
        own = np.einsum("lij,lj->li", roots, lever)
        own = own / np.linalg.norm(own, axis=1)[:, None]
        # Each stripe's own height is free: what lies along it says nothing about the axis.
        design = design - own[:, :, None] * np.einsum("li,lik->lk", own, design)[:, None, :]
        size = np.linalg.norm(rest, axis=1)
        weight = HUBER_SIGMA / np.maximum(size, HUBER_SIGMA)
        weighted = design * weight[:, None, None]
        information = np.einsum("lik,lij->kj", weighted, design) + np.diag(PENCIL_SIGMA**-2)
        pull = np.einsum("lik,li->k", weighted, rest) - axis / PENCIL_SIGMA**2
        step = np.linalg.solve(information, pull)
        axis = axis + step
        if float(np.abs(step / PENCIL_SIGMA).max()) < 1e-6:
            break
    return Pencil(axis, np.linalg.inv(information), heights_in_pencil(lines, roots, axis))


def fit_fan(
    lines: FanLines, roots: FloatArray, slot: IntArray, spacing_mm: float, axis: FloatArray
) -> Fan:
    """Fit one plane a sheet, with the axis and the regularity of the fan as prior knowledge.

    Parameters
    ----------
    lines, roots
        The stripes and `FanLines.roots`.
    slot
        (L,) number of each stripe's sheet, -1 for none.
    spacing_mm
        Distance of neighbouring sheets.
    axis
        (4,) where the steps start.
    """
    named = np.flatnonzero(slot >= 0)
    slots, place = np.unique(slot[named], return_inverse=True)
    k = len(slots)
    heights = heights_in_pencil(lines, roots, axis)[named]
    c = np.array([float(np.median(heights[place == j])) for j in range(k)])
    x = np.concatenate([axis, axis[0] + axis[2] * c, axis[1] + axis[3] * c, c])
    design = np.zeros((2 * len(named), 4 + 3 * k))
    scaled = np.einsum("lij,ljk->lik", roots[named], _plane_terms(lines)[named])
    for term in range(3):
        columns = 4 + term * k + np.repeat(place, 2)
        design[np.arange(2 * len(named)), columns] = scaled[:, :, term].ravel()
    target = np.einsum("lij,lj->li", roots[named], lines.ends[named, :, 2]).ravel()
    for _ in range(FAN_ITERATIONS):
        prior, prior_rest = _prior(x, slots, spacing_mm)
        rest = np.concatenate([target - design @ x, prior_rest])
        x = x + np.linalg.lstsq(np.concatenate([design, prior]), rest, rcond=None)[0]
    rest = target - design @ x
    _, prior_rest = _prior(x, slots, spacing_mm)
    chi2 = np.zeros(len(lines))
    chi2[named] = (rest.reshape(-1, 2) ** 2).sum(axis=1)
    cost = float(chi2.sum() + prior_rest @ prior_rest)
    return Fan(slots, x[4:].reshape(3, k).T.copy(), x[:4], chi2, cost)


def misfits(lines: FanLines, roots: FloatArray, fan: Fan) -> FloatArray:
    """(L, K) squares of each stripe's ends over each plane of a fan."""
    over = lines.ends[:, None, :, 2] - np.einsum("lek,pk->lpe", _plane_terms(lines), fan.planes)
    return np.asarray((np.einsum("lij,lpj->lpi", roots, over) ** 2).sum(axis=2))


def _plane_terms(lines: FanLines) -> FloatArray:
    """(L, 2, 3) u, v and 1 of the ends."""
    return np.concatenate([lines.ends[:, :, :2], np.ones((len(lines), 2, 1))], axis=2)


def _prior(x: FloatArray, slots: IntArray, spacing_mm: float) -> tuple[FloatArray, FloatArray]:
    """Rows (3 K + 3, 4 + 3 K) of what is known of a fan beforehand, and their residuals."""
    k = len(slots)
    c = x[4 + 2 * k :]
    rows = np.zeros((3 * k + 3, 4 + 3 * k))
    rest = np.zeros(3 * k + 3)
    j = np.arange(k)
    for term in range(2):
        own = rows[term * k : (term + 1) * k]
        own[j, 4 + term * k + j] = 1.0
        own[j, 4 + 2 * k + j] = -x[2 + term]
        own[:, term] = -1.0
        own[:, 2 + term] = -c
        slopes = x[4 + term * k : 4 + (term + 1) * k]
        rest[term * k : (term + 1) * k] = x[term] + x[2 + term] * c - slopes
    rows[: 2 * k] /= OWN_SLOPE_SIGMA
    rest[: 2 * k] /= OWN_SLOPE_SIGMA
    gaps = np.diff(slots)
    sigma = SPACING_SHARE * spacing_mm * gaps
    between = rows[2 * k : 3 * k - 1]
    between[j[:-1], 4 + 2 * k + j[1:]] = 1.0 / sigma
    between[j[:-1], 4 + 2 * k + j[:-1]] = -1.0 / sigma
    rest[2 * k : 3 * k - 1] = (spacing_mm * gaps - np.diff(c)) / sigma
    rows[3 * k - 1 : 3 * k + 3, :4] = np.diag(1.0 / PENCIL_SIGMA)
    rest[3 * k - 1 : 3 * k + 3] = -x[:4] / PENCIL_SIGMA
    return rows, rest
