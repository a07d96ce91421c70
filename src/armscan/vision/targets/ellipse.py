# SPDX-License-Identifier: Apache-2.0
"""Ellipses through edge points with the covariance of each conic, and the pixels along their rims.

A conic is a symmetric matrix Q with ``[u v 1] Q [u v 1]' = 0``. Each ellipse is fitted in its own
coordinates, shifted to ``origin`` and divided by ``scale``, where the conic's last element is -1;
this cannot fail for an ellipse, because the origin lies inside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, floats
from armscan.kernels.target_edges import collect_band, fit_conics
from armscan.vision.targets.saddle import RawGrey

_STEPS = 12
_AT_REST = 1e-10
_TERMS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2))
_TERM_MATRICES = np.zeros((5, 3, 3))
for _k, (_i, _j) in enumerate(_TERMS):
    _TERM_MATRICES[_k, _i, _j] = _TERM_MATRICES[_k, _j, _i] = 1.0
_TERM_MATRICES.setflags(write=False)


class Ellipses(RowRecord):
    """N fitted ellipses.

    ``origin_px``: (N, 2) origin of each ellipse's own coordinates. ``scale_px``: (N,) unit of each
    ellipse's own coordinates. ``terms``: (N, 5) elements 11, 12, 22, 13, 23 of Q in own
    coordinates; element 33 is -1. ``covariance``: (N, 5, 5) covariance of ``terms`` for the sigmas
    given, not scaled by ``chi2``. ``chi2``: (N,) sum of squared distances over sigma.
    ``degrees_of_freedom``: (N,) edge points minus 5.
    """

    origin_px: FloatArray = floats("N", 2, nan=True, infinite=True)
    scale_px: FloatArray = floats("N", nan=True, infinite=True)
    terms: FloatArray = floats("N", 5, nan=True, infinite=True)
    covariance: FloatArray = floats("N", 5, 5, nan=True, infinite=True)
    chi2: FloatArray = floats("N", nan=True, infinite=True)
    degrees_of_freedom: FloatArray = floats("N")

    @property
    def matrices(self) -> FloatArray:
        """(N, 3, 3) conics in own coordinates."""
        return _matrices(self.terms)

    @property
    def is_ellipse(self) -> BoolArray:
        """(N,) True where the conic is a real ellipse."""
        q = self.terms
        return np.asarray((q[:, 0] * q[:, 2] - q[:, 1] ** 2 > 0.0) & (q[:, 0] > 0.0))

    def pole(self, lines_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the poles of lines and their covariance.

        The pole of the line at infinity (0, 0, 1) is the ellipse's centre; the pole of the
        vanishing line of a circle's plane is the image of the circle's centre.

        ``lines_px``: (3,) or (N, 3) lines ``l . [u v 1] = 0``.

        Returns ``poles_px``: (N, 2) points ``Q^-1 l``. ``covariance_px2``: (N, 2, 2), the line
        taken as known.
        """
        own = self._own_lines(np.broadcast_to(lines_px, (len(self.terms), 3)))
        inverse = np.linalg.inv(self.matrices)
        pole = np.einsum("nij,nj->ni", inverse, own)
        dpole = np.zeros((len(own), 3, 5))
        for k, derivative in enumerate(_TERM_MATRICES):
            dpole[:, :, k] = -np.einsum("nij,jk,nk->ni", inverse, derivative, pole)
        xy = pole[:, :2] / pole[:, 2:]
        dxy = (dpole[:, :2] - xy[:, :, None] * dpole[:, 2:]) / pole[:, 2:, None]
        covariance = dxy @ self.covariance @ dxy.transpose(0, 2, 1)
        scale = self.scale_px
        return self.origin_px + scale[:, None] * xy, covariance * (scale**2)[:, None, None]

    def centres(self) -> tuple[FloatArray, FloatArray]:
        """(N, 2) centres and their (N, 2, 2) covariance, px."""
        return self.pole(np.array([0.0, 0.0, 1.0]))

    def axes(self) -> tuple[FloatArray, FloatArray]:
        """Half axes (N, 2), px, the shorter one first, and their directions (N, 2, 2), columns."""
        q = self.terms
        square = np.stack([q[:, [0, 1]], q[:, [1, 2]]], axis=1)
        linear = q[:, 3:5]
        offset = np.einsum("ni,nij,nj->n", linear, np.linalg.inv(square), linear)
        eigenvalues, directions = np.linalg.eigh(square)
        half = np.sqrt((1.0 + offset)[:, None] / eigenvalues) * self.scale_px[:, None]
        return half[:, ::-1], directions[:, :, ::-1]

    def distance_px(self, points_px: FloatArray) -> FloatArray:
        """Signed first-order distance (N, K) of points (N, K, 2) to their ellipses, px."""
        own = (points_px - self.origin_px[:, None]) / self.scale_px[:, None, None]
        return _sampson(own, self.terms) * self.scale_px[:, None]

    def conics_in(
        self, origin_px: FloatArray, unit_px: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Conics in coordinates shifted to (N, 2) origins and divided by (N,) units.

        Returns ``conics``: (N, 3, 3); positive outside the ellipse, negative inside. ``by_terms``:
        (N, 5, 3, 3) their derivative by ``terms``.
        """
        change = np.zeros((len(self.terms), 3, 3))
        change[:, 0, 0] = change[:, 1, 1] = unit_px / self.scale_px
        change[:, :2, 2] = (origin_px - self.origin_px) / self.scale_px[:, None]
        change[:, 2, 2] = 1.0
        turned = change.transpose(0, 2, 1)
        by_terms = turned[:, None] @ _TERM_MATRICES @ change[:, None]
        return turned @ self.matrices @ change, by_terms

    @staticmethod
    def circles(origin_px: FloatArray) -> Ellipses:
        """Circles of radius 1 px around (N, 2) places: stand-ins for what was not fitted."""
        n = len(origin_px)
        return Ellipses(
            origin_px=origin_px,
            scale_px=np.ones(n),
            terms=np.tile([1.0, 0.0, 1.0, 0.0, 0.0], (n, 1)),
            covariance=np.tile(np.eye(5), (n, 1, 1)),
            chi2=np.zeros(n),
            degrees_of_freedom=np.zeros(n),
        )

    def replaced(self, rows: IntArray, others: Ellipses) -> Ellipses:
        """Return a copy in which some rows hold others."""
        order = np.arange(len(self))
        order[rows] = len(self) + np.arange(len(rows))
        return Ellipses.concat([self, others]).select(order)

    def circles_where(self, replaced: BoolArray, origin_px: FloatArray) -> Ellipses:
        """Return a copy with unit circles at (N, 2) origins where a fit is to be replaced."""
        rows = np.flatnonzero(replaced)
        return self.replaced(rows, Ellipses.circles(origin_px[rows]))

    def _own_lines(self, lines_px: FloatArray) -> FloatArray:
        own = lines_px.copy()
        own[:, 2] += (lines_px[:, :2] * self.origin_px).sum(axis=1)
        own[:, :2] *= self.scale_px[:, None]
        return own


def fit_ellipses(points_px: FloatArray, weights_per_px2: FloatArray) -> Ellipses:
    """Fit ellipses to edge points by minimising the weighted Sampson distance.

    ``points_px``: (N, K, 2) edge points. ``weights_per_px2``: (N, K) inverse variance along the
    edge's normal; 0 leaves a point out.

    Returns the fits. Fewer than 5 points give a covariance that is meaningless: check
    ``degrees_of_freedom``.
    """
    has_weight = weights_per_px2 > 0.0
    count = np.maximum(has_weight.sum(axis=1), 1)
    used = np.where(has_weight[:, :, None], points_px, 0.0)
    origin = used.sum(axis=1) / count[:, None]
    offset = np.where(has_weight[:, :, None], points_px - origin[:, None], 0.0)
    scale = np.sqrt(np.maximum((offset**2).sum(axis=(1, 2)) / count, 1e-12))
    own = offset / scale[:, None, None]
    n = len(own)
    terms, covariance, chi2 = np.zeros((n, 5)), np.zeros((n, 25)), np.zeros(n)
    weights = np.ascontiguousarray(weights_per_px2 * (scale**2)[:, None])
    fit_conics(own.reshape(-1, 2), weights, _STEPS, _AT_REST, terms, covariance, chi2)
    return Ellipses(
        origin_px=origin,
        scale_px=scale,
        terms=terms,
        covariance=covariance.reshape(n, 5, 5),
        chi2=chi2,
        degrees_of_freedom=has_weight.sum(axis=1) - 5.0,
    )


def _sampson(own: FloatArray, terms: FloatArray) -> FloatArray:
    """Signed first-order distance (N, K) to the conic, own units."""
    x, y = own[..., 0], own[..., 1]
    a, b, c, d, e = (terms[:, k : k + 1] for k in range(5))
    value = a * x * x + 2.0 * b * x * y + c * y * y + 2.0 * (d * x + e * y) - 1.0
    norm = np.maximum(np.hypot(a * x + b * y + d, b * x + c * y + e), 1e-9)
    return np.asarray(0.5 * value / norm)


def _matrices(terms: FloatArray) -> FloatArray:
    matrices = np.full((len(terms), 3, 3), -1.0)
    for k, (i, j) in enumerate(_TERMS):
        matrices[:, i, j] = matrices[:, j, i] = terms[:, k]
    return matrices


@dataclass(frozen=True, slots=True, eq=False)
class Rims:
    """Ellipses by centre and axes.

    ``centres_px``: (N, 2) centres. ``half_px``: (N, 2) half axes, the shorter one first.
    ``directions``: (N, 2, 2) unit vectors of the two axes, as columns.
    """

    centres_px: FloatArray
    half_px: FloatArray
    directions: FloatArray

    def __len__(self) -> int:
        """Count of ellipses."""
        return len(self.centres_px)

    @staticmethod
    def from_shapes(centres_px: FloatArray, shapes_px2: FloatArray) -> Rims:
        """Build rims from centres and matrices S with ``d' S^-1 d = 1`` on the rim."""
        square, directions = np.linalg.eigh(shapes_px2)
        return Rims(centres_px, np.sqrt(square), directions)

    def points(self, angle_rad: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rim points (N, K, 2) at parametric angles (K,), outward normals and curvatures (N, K)."""
        p, q = self.half_px[:, :1], self.half_px[:, 1:]
        cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
        own = np.stack([p * cosine, q * sine], axis=-1)
        normal = np.stack([q * cosine, p * sine], axis=-1)
        speed = np.linalg.norm(normal, axis=-1)
        normal = normal / speed[..., None]
        turn = self.directions.transpose(0, 2, 1)
        return self.centres_px[:, None] + own @ turn, normal @ turn, p * q / speed**3


@dataclass(frozen=True, slots=True, eq=False)
class BandPixels:
    """Pixels of all bands in one list: levels, ellipse, distance (px, outward) and angle (rad)."""

    levels: FloatArray
    ellipse: IntArray
    distance_px: FloatArray
    angle_rad: FloatArray


def band_pixels(
    grey: RawGrey, rims: Rims, half_width_px: FloatArray, gradient: FloatArray
) -> BandPixels:
    """Collect the pixels along the rims.

    ``grey``: (H, W) raw levels. ``rims``: N ellipses. ``half_width_px``: (N,) largest distance from
    the rim. ``gradient``: (N, 2) relative slope of the illumination per px, divided out of the
    levels.
    """
    n_rows, n_columns = grey.shape
    table = np.column_stack(
        [rims.centres_px, rims.half_px, rims.directions[:, :, 0], rims.directions[:, :, 1]]
    )
    reach = np.sqrt((rims.directions**2 @ (rims.half_px**2)[:, :, None])[:, :, 0])
    sides = np.minimum(2.0 * (reach + half_width_px[:, None]) + 5.0, [n_columns, n_rows])
    most = int(np.nansum(sides.prod(axis=1)))
    place, ellipse, found = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros((3, most))
    n = collect_band(
        np.column_stack([table, gradient]), half_width_px, n_columns, n_rows, place, ellipse, found
    )
    levels = np.asarray(grey).reshape(-1)[place[:n]].astype(np.float64) / found[2, :n]
    return BandPixels(levels, ellipse[:n], found[0, :n], found[1, :n])
