# SPDX-License-Identifier: Apache-2.0
"""Stripes of one source on posed boards as lines in space, in a frame that its fan suggests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.coplanarity import PosedSighting
from armscan.geometry.arrays import FloatArray, IntArray

BOW_ALLOWANCE_MM = 0.1
"""By how much an end of a straight piece may miss its sheet's plane for the sheet's bow: a line
bowed by 0.4 mm over 72 mm leaves the common plane of pieces half as long by up to 0.2 mm."""


@dataclass(frozen=True, slots=True, eq=False)
class FanLines:
    """L stripes, each by its two ends.

    Parameters
    ----------
    image, sighting
        (L,) image, and number of the stripe in the image.
    ends
        (L, 2, 3) ends along the stripes (u), along the line of sight (v) and across both (w), mm
        from the middle of all ends; w runs from left to right in the image, or from top to bottom
        where stripes lie flatter than 45 degrees.
    axes
        (3, 3) rows u, v, w in the Sensor frame.
    posed
        The stripes with their covariances.
    """

    image: IntArray
    sighting: IntArray
    ends: FloatArray
    axes: FloatArray
    posed: tuple[PosedSighting, ...]

    def __len__(self) -> int:
        """Count of stripes."""
        return len(self.image)

    def roots(self, slopes: FloatArray) -> FloatArray:
        """(L, 2, 2) matrices that scale the ends' heights over planes to unit variance.

        Parameters
        ----------
        slopes
            (L, 2) slopes of each stripe's plane along u and v.
        """
        roots = np.zeros((len(self), 2, 2))
        for k, stripe in enumerate(self.posed):
            upward = self.axes[2] - slopes[k, 0] * self.axes[0] - slopes[k, 1] * self.axes[1]
            covariance = stripe.height_covariance_mm2(upward) + BOW_ALLOWANCE_MM**2 * np.eye(2)
            roots[k] = np.linalg.inv(np.linalg.cholesky(covariance))
        return roots


def gather_lines(posed: Sequence[Sequence[PosedSighting]]) -> FanLines:
    """Collect the stripes of all images; there must be one at least."""
    where = [(i, k) for i, stripes in enumerate(posed) for k in range(len(stripes))]
    flat = tuple(posed[i][k] for i, k in where)
    ends = np.stack([stripe.sighting.ends_mm for stripe in flat])
    middle = ends.reshape(-1, 3).mean(axis=0)
    steps = ends[:, 1] - ends[:, 0]
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    along = np.linalg.eigh(steps.T @ steps)[1][:, -1]
    across = np.cross(along, middle)
    across = across / np.linalg.norm(across)
    if not _runs_across(across, middle):
        across = -across
    depth = np.cross(across, along)
    axes = np.stack([along, depth, across])
    image, sighting = np.array(where, dtype=np.int64).T
    return FanLines(image, sighting, (ends - middle) @ axes.T, axes, flat)


def _runs_across(direction: FloatArray, middle_mm: FloatArray) -> bool:
    """True if a step along the direction is seen to the right, or down if mostly up or down."""
    seen = direction[:2] - middle_mm[:2] / middle_mm[2] * direction[2]
    return bool(seen[int(np.argmax(np.abs(seen)))] > 0.0)
