# SPDX-License-Identifier: Apache-2.0
"""Ring markers in one image: candidates, their edges to a fraction of a pixel, centres with
covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from armscan.errors import OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.records.exposure import Exposure
from armscan.records.points import RingImages
from armscan.vision.targets.circle_edges import measure_circles
from armscan.vision.targets.circle_lattice import Blobs, find_blobs
from armscan.vision.targets.ellipse import Ellipses
from armscan.vision.targets.saddle import RawGrey, grey_channels, to_grey8

_MIN_BAND_PX = 1.5
_GAP_SHARE = 0.5
_MAX_MISFIT_SHARE, _MAX_MISFIT_PX = 0.02, 0.2
"""Largest rms distance of edge points from their ellipse: a share of the radius, and pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRims:
    """N measured rims.

    ``ellipses``: The fits. ``centres_px``: (N, 2) centres of the ellipses. ``half_px``: (N, 2) half
    axes, the shorter one first. ``directions``: (N, 2, 2) unit vectors of the two axes, as columns.
    ``contrast_levels``: (N,) level outside minus level inside. ``is_edge``: (N,) True where an edge
    goes round on an ellipse.
    """

    ellipses: Ellipses
    centres_px: FloatArray
    half_px: FloatArray
    directions: FloatArray
    contrast_levels: FloatArray
    is_edge: BoolArray

    def __len__(self) -> int:
        """Count of rims."""
        return len(self.centres_px)


def measure_rims(
    grey: RawGrey, blobs: Blobs, gaps_px: FloatArray, min_contrast_levels: float
) -> MeasuredRims:
    """Measure the outlines of blobs.

    ``grey``: (H, W) raw levels. ``blobs``: N blobs. ``gaps_px``: (N,) distance to the nearest other
    rim: the band of pixels reaches half of it. ``min_contrast_levels``: Rims with less contrast are
    no edges.
    """
    n = len(blobs)
    sizes = np.log2(np.sqrt(np.maximum(np.linalg.det(blobs.shapes_px2), 1.0)))
    octave = np.rint(sizes).astype(np.int64)
    ellipses = Ellipses.circles(np.zeros((n, 2)))
    contrast, is_edge = np.zeros(n), np.zeros(n, np.bool_)
    # Circles measured together share the count of sectors, so that they should be alike in size.
    for value in np.unique(octave):
        rows = np.flatnonzero(octave == value)
        band = np.maximum(_GAP_SHARE * gaps_px[rows], _MIN_BAND_PX)
        circles = measure_circles(
            grey, blobs.centres_px[rows], blobs.shapes_px2[rows], min_contrast_levels, band
        )
        good = circles.is_good & (circles.ellipses.degrees_of_freedom > 0.0)
        good &= _misfit(circles.ellipses, circles.points_px, circles.sigma_px) < 1.0
        ellipses = ellipses.replaced(rows, circles.ellipses)
        contrast[rows], is_edge[rows] = circles.contrast_levels, good
    safe = ellipses.circles_where(~is_edge, blobs.centres_px)
    half, directions = safe.axes()
    is_edge &= _is_near(safe, half, blobs)
    return MeasuredRims(safe, safe.centres()[0], half, directions, contrast, is_edge)


def _misfit(ellipses: Ellipses, points_px: FloatArray, sigma_px: FloatArray) -> FloatArray:
    """Rms distance (N,) of the edge points from their ellipse, over what is allowed."""
    used = np.isfinite(sigma_px)
    distance = np.where(used, ellipses.distance_px(points_px), 0.0)
    rms = np.sqrt((distance**2).sum(axis=1) / np.maximum(used.sum(axis=1), 1))
    return np.asarray(rms / (_MAX_MISFIT_SHARE * ellipses.scale_px + _MAX_MISFIT_PX))


def _is_near(ellipses: Ellipses, half: FloatArray, blobs: Blobs) -> BoolArray:
    """True where the rim is still that of the blob, not one that the fit slid to."""
    before = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2))
    change = np.abs(half - before).max(axis=1)
    return np.asarray(change < np.maximum(2.5, 0.25 * before[:, 0]))


def nearest_gaps_px(blobs: Blobs, partners: tuple[IntArray, IntArray]) -> FloatArray:
    """Distance (N,) from each blob's outline to that of its nearest concentric neighbour.

    ``blobs``: N blobs. ``partners``: Rows of the two blobs of each concentric pair, either way
    round.
    """
    half = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2)[:, 0])
    gaps = np.full(len(blobs), np.inf)
    first, second = partners
    distance = np.abs(half[first] - half[second])
    np.minimum.at(gaps, first, distance)
    np.minimum.at(gaps, second, distance)
    return gaps


def common_centres(outer: Ellipses, inner: Ellipses) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Images of the centres of N rings.

    ``outer``, ``inner``: N conics each; row by row two concentric circles seen in perspective.

    Returns ``centres_px``: (N, 2). ``covariance_px2``: (N, 2, 2), the two rims' noise taken as
    independent. ``mismatch``: (N,) half the difference of the two eigenvalues that should be equal,
    over their mean: how far the rims' shapes are from those of concentric circles.
    """
    origin, unit = outer.origin_px, outer.scale_px
    first, dfirst = outer.conics_in(origin, unit)
    second, dsecond = inner.conics_in(origin, unit)
    pencil = np.linalg.solve(second, first)
    eigenvalues, eigenvectors = np.linalg.eig(pencil)
    rows = np.arange(len(pencil))
    single = eigenvalues.real.argmax(axis=1)
    value = eigenvalues[rows, single].real
    vector = eigenvectors[rows, :, single].real
    vector = vector / vector[:, 2:]
    pair = np.stack([eigenvalues[rows, (single + k) % 3] for k in (1, 2)], axis=1)
    mismatch = np.abs(pair[:, 0] - pair[:, 1]) / np.abs(pair.sum(axis=1))
    # (M - e) v = 0 with v_3 = 1, differentiated: three equations for dv_1, dv_2 and de.
    system = pencil - value[:, None, None] * np.eye(3)
    system[:, :, 2] = -vector
    change = np.concatenate([dfirst, -value[:, None, None, None] * dsecond], axis=1)
    changed = np.linalg.solve(second[:, None], change @ vector[:, None, :, None])[..., 0]
    derivative = -np.linalg.solve(system, changed.transpose(0, 2, 1))[:, :2]
    covariance = np.zeros((len(rows), 10, 10))
    covariance[:, :5, :5] = outer.covariance
    covariance[:, 5:, 5:] = inner.covariance
    own_covariance = derivative @ covariance @ derivative.transpose(0, 2, 1)
    centres = origin + unit[:, None] * vector[:, :2]
    return centres, own_covariance * (unit**2)[:, None, None], np.asarray(mismatch)


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
