# SPDX-License-Identifier: Apache-2.0
"""Circle grids, symmetric and asymmetric, of either tone, and where their centres are imaged.

The centre of the ellipse is not the image of the circle's centre (0.1 px at 45 degrees for a circle
of 69 px). The image of the centre is the pole of the plane's vanishing line in the conic: with the
homography H from board to image, line ``l = H^-T (0, 0, 1)'``, centre ``Q^-1 l``. H itself comes
from the centres, hence a few rounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, homogeneous
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import CameraModel
from armscan.records.exposure import Exposure
from armscan.vision.targets.circle_edges import MeasuredCircles, measure_circles
from armscan.vision.targets.circle_lattice import (
    BLOCK_FRACTIONS,
    Blobs,
    NumberedGrid,
    find_blobs,
    grow_lattices,
    lattice_size,
    number_grid,
)
from armscan.vision.targets.ellipse import Ellipses, fit_ellipses
from armscan.vision.targets.saddle import MIN_CONTRAST, grey_channels, to_grey8
from armscan.vision.targets.target import CircleEdges, CircleGrid, OtherCountSeen, TargetView

ROUNDS = 3
_MIN_CIRCLES = 4


def correct_centres(view: TargetView, camera: CameraModel | None = None) -> TargetView:
    """Recompute the circles' centres from their edge points.

    Parameters
    ----------
    view
        A view of a circle grid, with edges.
    camera
        Intrinsics: edge points are undistorted before ellipses are fitted, and the centres mapped
        back. None takes the pixels as they are, which leaves a bias where the lens distorts.

    Returns
    -------
    The view with new ``points_px`` and ``covariance_px2``.

    Raises
    ------
    InputError
        If the view has no edges, or an edge lies where the camera model cannot be inverted.
    """
    if view.edges is None:
        raise InputError(
            "the view has no circle edges", where=view.source, remedy="use a circle grid"
        )
    if camera is None:
        centres, covariance = _centres(view, view.edges.points_px, 1.0 / view.edges.sigma_px**2)
        return replace(view, points_px=centres, covariance_px2=covariance)
    ideal, weights = _undistorted(view.source, view.edges, camera)
    centres, covariance = _centres(view, ideal, weights)
    points, jacobian = _distorted(centres, camera)
    covariance = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return replace(view, points_px=points, covariance_px2=covariance)


def centres_of_circles(
    ellipses: Ellipses, points_board_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Images of the centres of coplanar circles, and their covariance.

    ``ellipses``: N conics, free of distortion. ``points_board_mm``: (N, 2) or (N, 3) centres on the
    board.

    Returns ``centres_px``, ``covariance_px2``: (N, 2) and (N, 2, 2); with fewer than four circles
    those of the ellipses.
    """
    centres, covariance = ellipses.centres()
    board = np.asarray(points_board_mm, dtype=np.float64)[:, :2]
    for _ in range(ROUNDS if len(centres) >= _MIN_CIRCLES else 0):
        homography, _ = cv2.findHomography(board, centres)
        if homography is None:
            break
        line = np.linalg.inv(homography).T @ np.array([0.0, 0.0, 1.0])
        centres, covariance = ellipses.pole(line / line[2])
    return centres, covariance


def _centres(
    view: TargetView, points: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    edges = view.edges
    if edges is None:
        raise InputError("the view has no circle edges", where=view.source)
    n = len(view)
    count = np.bincount(edges.circle, minlength=n)
    order = np.argsort(edges.circle, kind="stable")
    row = edges.circle[order]
    place = np.arange(len(row)) - (np.cumsum(count) - count)[row]
    padded = np.zeros((n, max(int(count.max(initial=0)), 1), 2))
    padded_weights = np.zeros(padded.shape[:2])
    padded[row, place] = points[order]
    padded_weights[row, place] = weights[order]
    return centres_of_circles(fit_ellipses(padded, padded_weights), view.points_board_mm)


def _undistorted(
    source: str, edges: CircleEdges, camera: CameraModel
) -> tuple[FloatArray, FloatArray]:
    """Edge points in pixels of the same camera without distortion, and weights there."""
    xy, is_valid, dxy_dq, _ = camera.undistort_with_jacobian(edges.points_px)
    if not is_valid.all():
        raise InputError(
            f"{int((~is_valid).sum())} edge points lie where the camera's distortion folds over",
            where=source,
            remedy="leave this view out, or calibrate with fewer distortion terms",
        )
    focal = np.array([camera.fx_px, camera.fy_px])
    ideal = xy * focal + [camera.cx_px, camera.cy_px]
    stretch = np.sqrt(np.abs(np.linalg.det(dxy_dq * focal[:, None])))
    return ideal, 1.0 / (edges.sigma_px * stretch) ** 2


def _distorted(ideal_px: FloatArray, camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of points given without distortion, and the derivative (N, 2, 2)."""
    focal = np.array([camera.fx_px, camera.fy_px])
    xy = (ideal_px - [camera.cx_px, camera.cy_px]) / focal
    rays = homogeneous(xy)
    points, dq_dray, _ = camera.project_with_jacobian(rays)
    return points, dq_dray[:, :, :2] / focal


MIN_CIRCLES_FRACTION = 0.8
"""Least fraction of a grid's circles that must be found; each border row must be among them."""
_LOOKS = ((BLOCK_FRACTIONS[1:2], 1.0), (BLOCK_FRACTIONS, MIN_CIRCLES_FRACTION))
"""Blocks of the threshold, and the fraction of circles that must be found and show good edges: one
size shows all of them in most photographs, where the others could add nothing."""
WHOLE_FRACTION = 0.95
"""Least filled fraction of a lattice that may be a whole grid."""


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A lattice of blobs; ``grid`` is None if it is not the target's."""

    blobs: Blobs
    grid: NumberedGrid | None
    n_seen: int
    size_seen: tuple[int, int]


def detect_circle_grid(exposure: Exposure, target: CircleGrid) -> TargetView | FitFailure:
    """Find a circle grid and measure its circles.

    Returns the view, centres corrected for eccentricity without intrinsics; or why there is none.
    """
    best_seen = (0, (0, 0))
    for grey in grey_channels(exposure):
        grey8 = to_grey8(grey, exposure.full_scale)
        for blocks, fraction in _LOOKS:
            least = fraction * len(target.points_board_mm)
            for candidate in _candidates(find_blobs(grey8, block_fractions=blocks), target):
                best_seen = max(best_seen, (candidate.n_seen, candidate.size_seen))
                if candidate.grid is None or len(candidate.grid.blob_index) < least:
                    continue
                index = candidate.grid.blob_index
                circles = measure_circles(
                    grey,
                    candidate.blobs.centres_px[index],
                    candidate.blobs.shapes_px2[index],
                    MIN_CONTRAST * exposure.full_scale,
                )
                if circles.is_good.mean() >= fraction:
                    return correct_centres(_view(exposure, target, candidate.grid, circles))
    return _failure(exposure, target, *best_seen)


def _candidates(blobs: Blobs, target: CircleGrid) -> list[_Candidate]:
    """Lattices among the dark and among the light blobs, the target's own and the largest first.

    The thresholds also outline the ground between circles: such a lattice fits as well, but its
    rims show no edge, so that measuring it tells.
    """
    found = []
    for is_light in (False, True):
        alike = blobs.select(blobs.is_light == is_light)
        for lattice in grow_lattices(alike):
            grid = number_grid(lattice, alike.centres_px, target, MIN_CIRCLES_FRACTION)
            size = lattice_size(lattice, target.is_asymmetric)
            found.append(_Candidate(alike, grid, len(lattice), size))
    return sorted(found, key=lambda c: (c.grid is None, -c.n_seen))


def _view(
    exposure: Exposure, target: CircleGrid, grid: NumberedGrid, circles: MeasuredCircles
) -> TargetView:
    good = np.flatnonzero(circles.is_good)
    used = np.isfinite(circles.sigma_px[good])
    centres, covariance = circles.ellipses.centres()
    number = grid.point_index[good]
    view = TargetView.of_image(exposure, target, number, centres[good], covariance[good])
    edges = CircleEdges(
        points_px=exposure.window.to_full_sensor(circles.points_px[good][used]),
        circle=np.repeat(np.arange(len(good)), used.sum(axis=1)),
        sigma_px=circles.sigma_px[good][used] * exposure.window.binning,
    )
    return replace(view, edges=edges)


def _failure(
    exposure: Exposure, target: CircleGrid, n_seen: int, size_seen: tuple[int, int]
) -> FitFailure:
    kind = "asymmetric circle grid" if target.is_asymmetric else "circle grid"
    wanted = f"{kind} of {target.columns} x {target.rows}"
    if n_seen == 0:
        return FitFailure(
            f"{exposure.source}: no {wanted} in view, no circles in rows were seen",
            "show the whole grid, sharp and evenly lit",
        )
    columns, rows = size_seen
    reason = (
        f"{exposure.source}: no {wanted} in view; {n_seen} circles in a lattice of "
        f"{columns} x {rows} were seen"
    )
    remedy = "check columns and rows, and show the whole grid"
    if n_seen >= WHOLE_FRACTION * columns * rows and min(size_seen) > 1:
        return OtherCountSeen(reason, remedy, columns=columns, rows=rows)
    return FitFailure(reason, remedy)
