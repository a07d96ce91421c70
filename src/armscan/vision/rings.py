# SPDX-License-Identifier: Apache-2.0
"""Ring markers in an exposure: nested blobs of the right size and shape (eqs. 4.19 to 4.21).

The thesis calls P "the contour circumference ... when the angle between the camera and the
non-coding point is 0", and it sets the limit of C to 1.7 for a tilt of about 50 degrees. Both fit
together only if P stays that of the untilted ring while A is the area as seen: the longer half axis
``a`` of the image does not shrink with tilt, so that ``P = 2 pi a``, ``A = pi a b`` and ``C = P^2 /
(4 pi A) = a / b``, which is 1.56 at 50 degrees and 1.7 at 54. With the ellipse's own circumference
C would be 1.10 at 50 degrees and reach 1.7 at 73.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.exposure import Exposure
from armscan.records.points import RingImages
from armscan.vision.ring_edges import MeasuredRims, common_centres, measure_rims, nearest_gaps_px
from armscan.vision.targets.circle_lattice import Blobs, find_blobs
from armscan.vision.targets.grey import grey_channels, to_grey8

THESIS_MAX_ROUNDNESS = 1.7
"""Limit of eq. 4.21: a tilt of 54 degrees by the convention of `armscan.vision.rings`."""

Disc = Literal["light", "dark"]


@dataclass(frozen=True, slots=True)
class RingOptions:
    """Which rings are looked for.

    Parameters
    ----------
    min_perimeter_px, max_perimeter_px
        Limits of the outer rim's circumference, as if the ring were not tilted (eq. 4.19);
        `perimeter_limits` derives them from a marker's size; the thesis has 200 to 350.
    max_roundness
        Largest C of eq. 4.20 (eq. 4.21).
    disc
        A light disc in a dark ring, as in figure 4.5, or a dark disc in a light ring.
    min_contrast
        Least contrast of either rim, as a fraction of full scale.
    """

    min_perimeter_px: float = 40.0
    max_perimeter_px: float = 1200.0
    max_roundness: float = THESIS_MAX_ROUNDNESS
    disc: Disc = "light"
    min_contrast: float = 0.04

    def __post_init__(self) -> None:
        if not 30.0 <= self.min_perimeter_px < self.max_perimeter_px:
            raise OptionError(
                f"perimeters of {self.min_perimeter_px:g} to {self.max_perimeter_px:g} px: the "
                "smallest must be at least 30 px and below the largest"
            )
        if not self.max_roundness > 1.0:
            raise OptionError(
                f"max_roundness = {self.max_roundness:g} lets no ring pass",
                remedy="give a number above 1; a ring tilted by 54 degrees has 1.7",
            )
        if self.disc not in ("light", "dark"):
            raise OptionError(f"disc = {self.disc} is not known", remedy="choose light or dark")
        if not 0.0 < self.min_contrast < 1.0:
            raise OptionError(f"min_contrast = {self.min_contrast:g} is not between 0 and 1")


def perimeter_limits(
    diameter_mm: float, focal_px: float, distances_mm: tuple[float, float], tolerance: float = 0.1
) -> tuple[float, float]:
    """Limits of eq. 4.19 for a ring of known size, ``P = pi D f / Z``.

    Parameters
    ----------
    diameter_mm
        Outer diameter D of the ring.
    focal_px
        Focal length f.
    distances_mm
        Nearest and farthest Z.
    tolerance
        Share by which the limits are widened: for the tilt's perspective and the print.

    Raises
    ------
    OptionError
        If a number is not positive, or the distances are not in order.
    """
    near, far = distances_mm
    if not (diameter_mm > 0.0 and focal_px > 0.0 and 0.0 < near <= far):
        raise OptionError(
            f"a ring of {diameter_mm:g} mm at {near:g} to {far:g} mm, focal length {focal_px:g} px",
            remedy="give positive numbers, the nearer distance first",
        )
    at_one_mm = float(np.pi * diameter_mm * focal_px)
    return (1.0 - tolerance) * at_one_mm / far, (1.0 + tolerance) * at_one_mm / near


def perimeters_px(half_px: FloatArray) -> FloatArray:
    """P (N,) of eq. 4.19 from half axes (N, 2), the shorter one first."""
    return np.asarray(2.0 * np.pi * half_px[:, 1])


def roundness(half_px: FloatArray) -> FloatArray:
    """C (N,) of eq. 4.20 from half axes (N, 2), the shorter one first."""
    area = np.pi * half_px[:, 0] * half_px[:, 1]
    return np.asarray(perimeters_px(half_px) ** 2 / (4.0 * np.pi * area))


MAX_CENTRE_SHIFT = 0.12
"""Largest distance between the centres of two nested outlines, over the outer's shorter half axis.

Perspective shifts them by less than a hundredth; the rest is for outlines found by a threshold."""
_SHIFT_PX = 1.5
_MAX_AXIS_MISMATCH = 0.3
_MIN_RADIUS_RATIO = 1.1


def concentric_pairs(blobs: Blobs) -> tuple[IntArray, IntArray]:
    """Rows of the blobs of each pair that nests, the outer one first, of any polarity.

    ``blobs``: N blobs.
    """
    if len(blobs) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    half = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2))
    reach = MAX_CENTRE_SHIFT * half[:, 0] + _SHIFT_PX
    tree = cKDTree(blobs.centres_px)
    near = [tree.query_ball_point(c, r) for c, r in zip(blobs.centres_px, reach, strict=True)]
    outer = np.repeat(np.arange(len(blobs)), [len(found) for found in near])
    inner = np.array([k for found in near for k in found], dtype=np.int64)
    nests = (half[outer] > _MIN_RADIUS_RATIO * half[inner]).all(axis=1)
    nests &= _axis_mismatch(blobs.shapes_px2, outer, inner) < _MAX_AXIS_MISMATCH
    return outer[nests], inner[nests]


def clusters(n: int, pairs: tuple[IntArray, IntArray]) -> IntArray:
    """Number (N,) of the cluster to which each of ``n`` blobs belongs."""
    links = coo_array((np.ones(len(pairs[0])), pairs), shape=(n, n))
    _, labels = connected_components(links, directed=False)
    return np.asarray(labels, dtype=np.int64)


def _axis_mismatch(shapes_px2: FloatArray, outer: IntArray, inner: IntArray) -> FloatArray:
    """How far two shapes are from scaled copies: half the log of one's axes' ratio in the other."""
    relative = np.linalg.solve(shapes_px2[outer], shapes_px2[inner])
    ratio = np.sort(np.linalg.eigvals(relative).real, axis=1)
    return np.asarray(0.5 * np.log(np.maximum(ratio[:, 1], 1e-9) / np.maximum(ratio[:, 0], 1e-9)))


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
    blobs = find_blobs(
        to_grey8(grey, exposure.full_scale),
        smallest_px=_MIN_DIAMETER_PX,
        largest_px=1.1 * options.max_perimeter_px / np.pi,
        min_contrast=options.min_contrast,
        same_log_area=SAME_LOG_AREA,
    )
    pairs = concentric_pairs(blobs)
    nested = np.zeros(len(blobs), np.bool_)
    nested[pairs[0]] = nested[pairs[1]] = True
    rims = measure_rims(
        grey,
        blobs.select(nested),
        nearest_gaps_px(blobs, pairs)[nested],
        options.min_contrast * exposure.full_scale,
    )
    outer, inner = _chosen(rims, clusters(len(blobs), pairs)[nested], options)
    return _filtered(exposure, rims, outer, inner, options)


def _chosen(
    rims: MeasuredRims, cluster: IntArray, options: RingOptions
) -> tuple[IntArray, IntArray]:
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
    exposure: Exposure, rims: MeasuredRims, outer: IntArray, inner: IntArray, options: RingOptions
) -> RingDetection:
    window = exposure.window
    half = rims.half_px * window.binning
    size, shape = perimeters_px(half[outer]), roundness(half[outer])
    centres, covariance, mismatch = common_centres(
        rims.ellipses.select(outer), rims.ellipses.select(inner)
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
        source=exposure.source,
        centres_px=centres[kept],
        covariance_px2=covariance[kept] * window.binning**2,
        outer_half_px=half[outer][kept],
        inner_half_px=half[inner][kept],
        direction_rad=np.arctan2(long[:, 1], long[:, 0])[kept],
        contrast=-rims.contrast_levels[inner][kept] / exposure.full_scale,
        perimeter_px=size[kept],
        roundness=shape[kept],
    )
    return RingDetection(
        rings, centres[~kept], tuple(_REASONS[k] for k in fails.argmax(axis=0)[~kept])
    )
