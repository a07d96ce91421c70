# SPDX-License-Identifier: Apache-2.0
"""Ring markers in an exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.records.exposure import Exposure
from armscan.records.markers import RingImages
from armscan.vision.rings.candidates import clusters, concentric_pairs
from armscan.vision.rings.concentric_centre import common_centres
from armscan.vision.rings.options import RingOptions
from armscan.vision.rings.rims import Rims, measure_rims, nearest_gaps_px
from armscan.vision.rings.shape import perimeters_px, roundness
from armscan.vision.targets.blobs import find_blobs
from armscan.vision.targets.grey import grey_channels, to_grey8
from armscan.vision.targets.options import TargetOptions

SAME_LOG_AREA = 0.2
"""Outlines whose radii differ by less than a tenth are one rim."""
MAX_MISMATCH, MAX_MISMATCH_PX = 0.1, 0.5
"""Largest mismatch of two rims' shapes (see `common_centres`), and what a blurred edge adds to it
when divided by the inner rim's shorter half axis."""
_MAX_CENTRE_SHIFT = 0.08
"""Largest distance between the centres of two measured rims, over the outer's shorter half axis;
0.05 in photographs by a wide lens of rings at hand's reach."""
_MIN_DIAMETER_PX = 6.0
_SMALLEST_DISC = 0.1
"""A disc is at least this share of its ring across."""
_REASONS = ("perimeter", "roundness", "rims not concentric")


@dataclass(frozen=True, slots=True, eq=False)
class RingDetection:
    """What was found in one exposure, and what was not taken.

    Parameters
    ----------
    rings
        The rings.
    dropped_px
        (M, 2) centres of candidates with two rims that failed a filter, full-sensor pixels.
    reasons
        (M,) which filter each of them failed.
    """

    rings: RingImages
    dropped_px: FloatArray
    reasons: tuple[str, ...]


def detect_rings(exposure: Exposure, options: RingOptions | None = None) -> RingDetection:
    """Find the rings in an exposure and measure their centres.

    A ring is an outline of one polarity with an outline of the other inside it, both edges on
    ellipses of one centre (figure 4.5 of the thesis). Where more outlines nest, as in coded rings,
    the outermost and the innermost count.
    """
    options = RingOptions() if options is None else options
    grey = grey_channels(exposure)[0]
    search = TargetOptions(
        min_circle_px=_MIN_DIAMETER_PX,
        max_circle_px=1.1 * options.max_perimeter_px / np.pi,
        min_contrast=options.min_contrast,
    )
    blobs = find_blobs(to_grey8(grey, exposure.full_scale), search, SAME_LOG_AREA)
    pairs = concentric_pairs(blobs)
    nested = np.zeros(len(blobs), np.bool_)
    nested[pairs[0]] = nested[pairs[1]] = True
    rims = measure_rims(
        grey,
        blobs.subset(nested),
        nearest_gaps_px(blobs, pairs)[nested],
        options.min_contrast * exposure.full_scale,
    )
    outer, inner = _chosen(rims, clusters(len(blobs), pairs)[nested], options)
    return _filtered(exposure, rims, outer, inner, options)


def _chosen(rims: Rims, cluster: IntArray, options: RingOptions) -> tuple[IntArray, IntArray]:
    """Rows of the outermost and innermost rim of each cluster that has both."""
    towards_disc = rims.contrast_levels if options.disc == "light" else -rims.contrast_levels
    rows = []
    for label in np.unique(cluster):
        own = np.flatnonzero((cluster == label) & rims.is_edge)
        dark = own[towards_disc[own] > 0.0]
        light = own[towards_disc[own] < 0.0]
        if not len(dark) or not len(light):
            continue
        outer = dark[rims.half_px[dark, 0].argmax()]
        inner = light[rims.half_px[light, 0].argmin()]
        if (rims.half_px[inner] < rims.half_px[outer]).all():
            rows.append((outer, inner))
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _filtered(
    exposure: Exposure, rims: Rims, outer: IntArray, inner: IntArray, options: RingOptions
) -> RingDetection:
    window = exposure.window
    half = rims.half_px * window.binning
    size, shape = perimeters_px(half[outer]), roundness(half[outer])
    centres, covariance, mismatch = common_centres(
        rims.ellipses.subset(outer), rims.ellipses.subset(inner)
    )
    shift = np.hypot(*(rims.centres_px[outer] - rims.centres_px[inner]).T)
    fails = np.stack(
        [
            (size < options.min_perimeter_px) | (size > options.max_perimeter_px),
            shape > options.max_roundness,
            (mismatch > MAX_MISMATCH + MAX_MISMATCH_PX / rims.half_px[inner, 0])
            | (shift > _MAX_CENTRE_SHIFT * rims.half_px[outer, 0])
            | (half[inner, 1] < _SMALLEST_DISC * half[outer, 1]),
        ]
    )
    kept = np.asarray(~fails.any(axis=0))
    centres = window.to_full_sensor(centres)
    long = rims.directions[outer, :, 1]
    rings = RingImages(
        exposure.source,
        centres[kept],
        covariance[kept] * window.binning**2,
        half[outer][kept],
        half[inner][kept],
        np.arctan2(long[:, 1], long[:, 0])[kept],
        _contrast(rims, inner, exposure)[kept],
        size[kept],
        shape[kept],
    )
    return RingDetection(rings, centres[~kept], _reasons(fails, kept))


def _contrast(rims: Rims, inner: IntArray, exposure: Exposure) -> FloatArray:
    """Level of the disc minus that of the ring, as a fraction of full scale."""
    return np.asarray(-rims.contrast_levels[inner] / exposure.full_scale)


def _reasons(fails: BoolArray, kept: BoolArray) -> tuple[str, ...]:
    first = fails.argmax(axis=0)[~kept]
    return tuple(_REASONS[k] for k in first)
