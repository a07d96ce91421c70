# SPDX-License-Identifier: Apache-2.0
"""What points' errors, own and common, do to an alignment and to means of deviations."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray, RowRecord, floats
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.uncertainty import (
    COARSE_BLOCKS,
    exposure_blocks,
    points_seen,
    without_noise,
)
from armscan.records.cloud import PointCloud

MOST_BLOCKS = 200
"""Neighbouring exposures beyond so many are taken together."""
REGIONS = 2
"""Along each axis, of a cloud of one exposure, whose points are taken to err together."""
LARGEST_TABLE = 5_000_000
"""Entries of a table of groups by blocks that are worked on at once: 40 MB an array."""


class PointErrors(RowRecord):
    """Errors of N points along the normals of a part.

    Parameters
    ----------
    normals
        (N, 3) unit, in Cad.
    private_mm2
        (N,) variance along the normal that each point has of its own, times the points along the
        stripe that share it.
    common_mm
        (K, N) move along the normal by each of K errors of the calibration, one sigma, which all
        points share. What the arm errs is not in it: a part is seen from several postures.
    covariance_mm2
        (N, 3, 3) the rest, in Cad, which points of a block share.
    blocks
        Ways of dividing the points into blocks that err together: (N,) numbers each. The larger
        result counts.
    """

    normals: FloatArray = floats("N", 3)
    private_mm2: FloatArray = floats("N")
    common_mm: FloatArray = floats("K", "N")
    covariance_mm2: FloatArray = floats("N", 3, 3)
    blocks: tuple[IntArray, ...]

    @staticmethod
    def of(
        cloud: PointCloud,
        pose: Pose[Cad, Part],
        normals: FloatArray,
        rows: IntArray | None = None,
        kept_share: float | None = None,
    ) -> PointErrors:
        """Errors of a cloud's points, or of some of its rows.

        Parameters
        ----------
        cloud
            The points.
        pose
            Where they lie on the part.
        normals
            (M, 3) of the part at each of the rows, in Cad.
        rows
            (M,) rows; None for all.
        kept_share
            Part of the cloud's points, where they are, that was kept when it was thinned; None for
            that of all rows.
        """
        chosen = np.arange(len(cloud)) if rows is None else rows
        covariance, axis, share = without_noise(cloud, chosen)
        along = share * np.einsum("ni,ni->n", pose.rotate(axis), normals) ** 2 + 1.0 - share
        shared = np.ones(len(chosen))
        if cloud.noise_length is not None:
            # of neighbours that share their noise, a thinned cloud keeps so many
            thinned = len(chosen) / max(len(cloud), 1) if kept_share is None else kept_share
            shared = 1.0 + np.maximum(cloud.noise_length[chosen] - 1.0, 0.0) * thinned
        common, told = np.zeros((0, len(chosen))), points_seen(cloud, chosen)
        if told is not None:
            calibration, seen = told
            common = calibration.moves_along_mm(seen, normals @ pose.rotation)
            covariance -= calibration.covariance_mm2(seen)
        return PointErrors(
            normals=normals,
            private_mm2=cloud.sigma_noise_mm[chosen] ** 2 * along * shared,
            common_mm=common,
            covariance_mm2=pose.rotate_covariance(covariance),
            blocks=tuple(_blocks(cloud, chosen)),
        )

    def covariance(self, influence: FloatArray) -> FloatArray:
        """(K, K) of K sums of the points' errors along their normals, (K, N) their weights."""
        private = influence * self.private_mm2 @ influence.T
        common = influence @ self.common_mm.T
        found = []
        for block in self.blocks:
            n = int(block.max()) + 1
            pulls = _pulls(influence, self.normals, block, n)
            mean = _block_means(self.covariance_mm2, block, n)
            found.append(np.einsum("kbi,bij,lbj->kl", pulls, mean, pulls))
        size = [float(np.trace(one)) for one in found]
        return np.asarray(private + common @ common.T + found[int(np.argmax(size))])

    def group_variances(
        self, label: IntArray, count: int, jacobian: FloatArray, influence: FloatArray
    ) -> FloatArray:
        """(count,) variances of the mean deviation of groups of points, after the alignment.

        A mean is of its points' own errors, less what the alignment took from all points.

        Parameters
        ----------
        label, count
            (N,) group of each point, -1 for none, and how many groups there are.
        jacobian
            (count, 6) derivative of each group's mean by a step of the alignment.
        influence
            (6, N) derivative of the step by each point's distance.
        """
        inside = np.flatnonzero(label >= 0)
        group = label[inside]
        n = np.maximum(np.bincount(group, minlength=count), 1)
        v = self.private_mm2
        own = np.bincount(group, v[inside], count) / n**2
        cross = np.stack(
            [np.bincount(group, influence[k, inside] * v[inside], count) / n for k in range(6)],
            axis=1,
        )
        both = influence * v @ influence.T
        private = own - 2.0 * np.einsum("fk,fk->f", jacobian, cross)
        private += np.einsum("fk,kl,fl->f", jacobian, both, jacobian)
        common = np.zeros(count)
        for move in self.common_mm:
            mean = np.bincount(group, move[inside], count) / n
            common += (mean - jacobian @ (influence @ move)) ** 2
        shared = self._shared_variances(label, count, jacobian, influence)
        return np.asarray(np.maximum(private, 0.0) + common + shared)

    def _shared_variances(
        self, label: IntArray, count: int, jacobian: FloatArray, influence: FloatArray
    ) -> FloatArray:
        """(count,) variances that blocks' common errors give to `group_variances`."""
        inside = np.flatnonzero(label >= 0)
        n = np.maximum(np.bincount(label[inside], minlength=count), 1)
        order = inside[np.argsort(label[inside], kind="stable")]
        largest = np.zeros(count)
        for block in self.blocks:
            b = int(block.max()) + 1
            pulls = _pulls(influence, self.normals, block, b)
            covariance = _block_means(self.covariance_mm2, block, b)
            chunk = max(1, LARGEST_TABLE // b)
            for first in range(0, count, chunk):
                last = min(first + chunk, count)
                low, high = np.searchsorted(label[order], [first, last])
                rows, size = order[low:high], last - first
                place = (label[rows] - first) * b + block[rows]
                sums = [
                    np.bincount(place, self.normals[rows, k], size * b).reshape(size, b)
                    for k in range(3)
                ]
                pull = np.stack(sums, axis=2) / n[first:last, None, None]
                pull -= np.einsum("fk,kbi->fbi", jacobian[first:last], pulls)
                shared = np.einsum("fbi,bij,fbj->f", pull, covariance, pull)
                largest[first:last] = np.maximum(largest[first:last], shared)
        return largest


def scatter_of_means(
    label: IntArray, count: int, deviations_mm: FloatArray, exposure: IntArray
) -> FloatArray:
    """(count,) standard deviations of groups' means, by how far exposures disagree.

    Delete-a-block jackknife over the exposures that saw a group, and over blocks of neighbouring
    ones; the largest. Zero for a group that one exposure saw, which tells nothing. That a face is
    not of its nominal form is in it, where exposures saw different places of the face.

    Parameters
    ----------
    label, count
        (N,) group of each point, -1 for none, and how many groups there are.
    deviations_mm, exposure
        (N,) of the points.
    """
    inside = np.flatnonzero(label >= 0)
    if len(inside) == 0:
        return np.zeros(count)
    width = int(exposure.max()) + 1
    pair, index = np.unique(label[inside] * width + exposure[inside], return_inverse=True)
    total = np.bincount(index, deviations_mm[inside]).astype(np.float64)
    size = np.bincount(index).astype(np.float64)
    group = pair // width
    seen = np.bincount(group, minlength=count)
    place = np.arange(len(pair)) - (np.cumsum(seen) - seen)[group]
    found = _jackknife(group, seen, total, size)
    for most in COARSE_BLOCKS:
        chosen = seen[group] >= 2 * most
        if chosen.any():
            key = group[chosen] * most + place[chosen] * most // seen[group[chosen]]
            used, block = np.unique(key, return_inverse=True)
            owner = used // most
            sums = [np.bincount(block, one[chosen]).astype(float) for one in (total, size)]
            blocks = np.bincount(owner, minlength=count)
            found = np.maximum(found, _jackknife(owner, blocks, sums[0], sums[1]))
    return found


def _jackknife(
    owner: IntArray, n_blocks: IntArray, total: FloatArray, size: FloatArray
) -> FloatArray:
    """(L,) of the means of L owners, from the sums and sizes of their blocks, (B,) each."""
    count = len(n_blocks)
    all_sum, all_size = (np.bincount(owner, one, count) for one in (total, size))
    rest = np.maximum(all_size[owner] - size, 1.0)
    without = np.where(n_blocks[owner] > 1, (all_sum[owner] - total) / rest, 0.0)
    divisor = np.maximum(n_blocks, 1)
    change = without - (np.bincount(owner, without, count) / divisor)[owner]
    squares = np.bincount(owner, change**2, count)
    return np.asarray(np.sqrt((divisor - 1) / divisor * squares))


def _blocks(cloud: PointCloud, rows: IntArray) -> list[IntArray]:
    """Exposures, blocks of neighbouring ones, or regions where there is one exposure only."""
    numbers = cloud.exposure[rows]
    n = len(np.unique(numbers))
    if n < 2:
        points = cloud.points_mm[rows]
        low, extent = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9)
        cell = np.minimum((REGIONS * (points - low) / extent).astype(np.int64), REGIONS - 1)
        return [np.unique(cell @ np.array([4, 2, 1]), return_inverse=True)[1].astype(np.int64)]
    found = [exposure_blocks(numbers, min(n, MOST_BLOCKS))[0]]
    found += [exposure_blocks(numbers, most)[0] for most in COARSE_BLOCKS if n >= 2 * most]
    return found


def _pulls(influence: FloatArray, normals: FloatArray, block: IntArray, n: int) -> FloatArray:
    """(K, B, 3) derivative of K sums by a shift of each block."""
    return np.stack(
        [
            np.stack([np.bincount(block, row * normals[:, k], n) for k in range(3)], axis=1)
            for row in influence
        ]
    )


def _block_means(covariance: FloatArray, block: IntArray, n: int) -> FloatArray:
    """(B, 3, 3) mean covariance of each block, along no way below zero.

    Less what polynomials tell of the calibration it may be, where nothing else is stated.
    """
    count = np.maximum(np.bincount(block, minlength=n), 1)
    mean = np.zeros((n, 3, 3))
    for i in range(3):
        for j in range(3):
            mean[:, i, j] = np.bincount(block, covariance[:, i, j], n) / count
    values, vectors = np.linalg.eigh(mean)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ vectors.transpose(0, 2, 1))
