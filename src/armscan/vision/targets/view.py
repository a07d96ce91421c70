# SPDX-License-Identifier: Apache-2.0
"""What is known of a target in one exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.estimate import FitFailure


@dataclass(frozen=True, slots=True, eq=False)
class CircleEdges:
    """Sub-pixel edge points of circles, kept so that centres can be recomputed with intrinsics.

    Parameters
    ----------
    points_px
        (K, 2) edge points, full-sensor pixels.
    circle
        (K,) row of the `TargetView`'s arrays to which an edge point belongs.
    sigma_px
        (K,) standard deviation along the edge's normal.
    """

    points_px: FloatArray
    circle: IntArray
    sigma_px: FloatArray

    def __post_init__(self) -> None:
        k = len(self.points_px)
        object.__setattr__(self, "points_px", frozen_floats(self.points_px, (k, 2), "edges (px)"))
        object.__setattr__(self, "circle", frozen_ints(self.circle, (k,), "circle"))
        object.__setattr__(self, "sigma_px", frozen_floats(self.sigma_px, (k,), "sigma_px"))


@dataclass(frozen=True, slots=True, eq=False)
class TargetView:
    """Target points found in one exposure.

    Parameters
    ----------
    source
        The exposure's source name.
    width_px, height_px
        Size of the image, in full-sensor pixels.
    point_index
        (M,) index into the target's points.
    points_px
        (M, 2) image points, full-sensor pixels.
    covariance_px2
        (M, 2, 2) covariance of each image point.
    points_board_mm
        (M, 3) the same points in the Board frame.
    edges
        Edge points, for circle targets.
    is_ambiguous
        True if the target looks the same turned by half a turn, so that the numbering may be too.
    """

    source: str
    width_px: int
    height_px: int
    point_index: IntArray
    points_px: FloatArray
    covariance_px2: FloatArray
    points_board_mm: FloatArray
    edges: CircleEdges | None = None
    is_ambiguous: bool = False

    def __post_init__(self) -> None:
        m = len(self.points_px)
        object.__setattr__(self, "point_index", frozen_ints(self.point_index, (m,), "point_index"))
        object.__setattr__(self, "points_px", frozen_floats(self.points_px, (m, 2), "points_px"))
        object.__setattr__(
            self, "points_board_mm", frozen_floats(self.points_board_mm, (m, 3), "points_board_mm")
        )
        object.__setattr__(
            self, "covariance_px2", frozen_floats(self.covariance_px2, (m, 2, 2), "covariance_px2")
        )
        if m and float(np.linalg.eigvalsh(self.covariance_px2).min()) <= 0.0:
            raise InputError("covariance_px2 is not positive definite", where=self.source)

    def __len__(self) -> int:
        """Count of points found."""
        return len(self.points_px)


@dataclass(frozen=True, slots=True)
class OtherCountSeen(FitFailure):
    """No such target is in view, but a full lattice of another count: ``columns`` x ``rows``.

    It may be part of the target, the rest being hidden; where several images show the same one, the
    count that was asked for is wrong.
    """

    columns: int = 0
    rows: int = 0
