# SPDX-License-Identifier: Apache-2.0
"""Clouds thinned to one point a voxel, with what averages out told apart from what does not.

A point's covariance C is that of its stripe's noise P, which is its own, and of all that it shares
with others: calibration, hand-eye, the arm's pose. Points of a voxel are averaged with weights
w = 1/trace C. The noise of the mean is the sum of w^2 L P over (sum w)^2, where L is the length
over which neighbours on a stripe share noise, and at most the mean of P. What is shared is the
weighted mean of C - P: that is the covariance of the mean if all points of the voxel share one
error, and an upper bound if they do not (a weighted mean of vectors never has a larger covariance
than the weighted mean of their covariances, however they correlate). So a fused point is never
more certain than its calibration, however many points it has.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.fusion.cell_sums import MOST_BYTES, CellSums
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.kernels.grids import BLOCK_BITS, MIDDLE, N_VALUES, PART_BITS, voxel_values
from armscan.records.cloud import FUSED, CalibrationMark, CloudFrame, PointCloud

AT_ONCE = 50_000
"""Points whose rows are made at a time: 11 MB."""
LEAST_AGREEMENT = 0.5
"""Normals of a voxel whose weighted sum is shorter than this part of its length if they agreed
belong to two sides of something thin: the voxel has no normal."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedPoints:
    """Some voxels of a map.

    Parameters
    ----------
    cloud
        One point each. ``covariance_mm2`` is the total, ``sigma_noise_mm`` what is left in it of
        the noise, ``noise_length`` more than 1 where a voxel holds fewer points than share theirs.
    n_points
        (N,) measured points of each voxel.
    common_mm2
        (N, 3, 3) the part of the covariance that does not average out.
    """

    cloud: PointCloud
    n_points: IntArray
    common_mm2: FloatArray


@dataclass(slots=True, eq=False)
class VoxelMap:
    """Sums over voxels of a grid that begins at the frame's origin; the order of clouds is free.

    Parameters
    ----------
    size_mm
        Edge of a voxel.
    folder
        Where voxels go that do not fit into memory; None keeps all in memory.
    most_bytes
        Memory for voxels.

    Raises
    ------
    OptionError
        If the size is not a positive length.
    """

    size_mm: float
    folder: Path | None = None
    most_bytes: int = 4 * MOST_BYTES
    n_points: int = 0
    frame: CloudFrame | None = None
    has_normals: bool = False
    has_noise_length: bool = True
    is_simulated: bool = False
    forced: tuple[str, ...] = ()
    calibrations: tuple[CalibrationMark, ...] = ()
    _has_covariance: bool | None = None
    _sums: CellSums = field(init=False)

    def __post_init__(self) -> None:
        if not 1e-4 <= self.size_mm <= 1e4:
            raise OptionError(
                f"voxels of {self.size_mm:g} mm", remedy="give an edge in mm, from 0.0001 to 10000"
            )
        self._sums = CellSums(N_VALUES, self.folder, self.most_bytes)

    @property
    def has_covariance(self) -> bool:
        """False for points of other programs, which do not tell any."""
        return bool(self._has_covariance)

    @property
    def n_runs(self) -> int:
        """How often voxels went to disk."""
        return self._sums.n_runs

    def close(self) -> None:
        """Delete what is on disk."""
        self._sums.close()

    def add(self, cloud: PointCloud) -> None:
        """Add the points of a cloud.

        Raises
        ------
        InputError
            If it is fused already, in another frame than those before, if its points reach too far
            for voxels of this size, or if covariances are known of some points only.
        OutputError
            If the disk is full or refuses.
        """
        if cloud.is_fused:
            raise InputError(
                "the cloud is a fused one, whose points stand for many",
                remedy="fuse the clouds that it was made of",
            )
        if self.frame not in (None, cloud.frame):
            raise InputError(
                f"points in {cloud.frame} do not fuse with points in {self.frame}",
                remedy="bring them into one frame with `armscan register`",
            )
        self.frame = cloud.frame
        self.has_normals |= cloud.normals is not None
        self.has_noise_length &= cloud.noise_length is not None
        self.is_simulated |= cloud.is_simulated
        self.forced = tuple(dict.fromkeys((*self.forced, *cloud.forced)))
        self.calibrations = tuple(dict.fromkeys((*self.calibrations, *cloud.calibrations)))
        for first in range(0, len(cloud), AT_ONCE):
            self._add(cloud.select(slice(first, first + AT_ONCE)))
        self.n_points += len(cloud)

    def _add(self, cloud: PointCloud) -> None:
        n = len(cloud)
        is_known = np.trace(cloud.covariance_mm2, axis1=1, axis2=2) > 0.0
        if self._has_covariance is None:
            self._has_covariance = bool(is_known[0])
        if not (is_known == self._has_covariance).all():
            raise InputError(
                "the covariance is known of some points and zero, not known, of others",
                remedy="fuse clouds of armscan by themselves, and those of other programs too",
            )
        length = np.ones(n) if cloud.noise_length is None else cloud.noise_length
        noise = np.stack([cloud.sigma_noise_mm, np.maximum(length, 1.0), cloud.intensity], axis=1)
        normals = np.zeros((n, 3)) if cloud.normals is None else cloud.normals
        keys, values = np.zeros(n, dtype=np.int64), np.zeros((n, N_VALUES))
        covariance = np.ascontiguousarray(cloud.covariance_mm2.reshape(n, 9))
        done = voxel_values(cloud.points_mm, covariance, noise, normals, self.size_mm, keys, values)
        if done < n:
            reach = MIDDLE * self.size_mm
            raise InputError(
                f"a point lies beyond {reach:g} mm, where voxels of {self.size_mm:g} mm end",
                remedy="choose larger voxels, or cut away far points",
            )
        self._sums.add(keys, values)

    def fused(self) -> Iterator[FusedPoints]:
        """All voxels, block by block, as often as asked; ends the adding."""
        for keys, sums in self._sums.merged():
            yield self._fused(keys, sums)

    def _fused(self, keys: IntArray, sums: FloatArray) -> FusedPoints:
        n, weight = len(keys), sums[:, :1]
        places = self._centres(keys) + sums[:, 1:4] / weight
        total, own = (_symmetric(sums[:, k : k + 6] / weight) for k in (4, 10))
        averaged = _symmetric(sums[:, 16:22] / weight**2)
        most, given = (np.trace(part, axis1=1, axis2=2) for part in (own, averaged))
        # noise that all points of a voxel share is that of one of them
        private = np.where((given < most)[:, None, None], averaged, own)
        common = total - own
        zeros = np.zeros(n, dtype=np.int64)
        cloud = PointCloud(
            frame=self.frame or "Part",
            points_mm=places,
            covariance_mm2=common + private,
            sigma_noise_mm=np.sqrt(np.minimum(given, most)),
            sheet=zeros,
            sheet_names=(FUSED,),
            exposure=zeros,
            exposure_sources=(FUSED,),
            segment=zeros,
            intensity=sums[:, 27] / weight[:, 0],
            normals=_unit(sums[:, 22:25], sums[:, 25]) if self.has_normals else None,
            noise_length=np.maximum(given / np.where(most > 0.0, most, 1.0), 1.0)
            if self.has_noise_length
            else None,
            is_simulated=self.is_simulated,
            forced=self.forced,
            calibrations=self.calibrations,
        )
        return FusedPoints(cloud, np.rint(sums[:, 26]).astype(np.int64), common)

    def _centres(self, keys: IntArray) -> FloatArray:
        """(N, 3) middles of voxels by their numbers."""
        block, within = keys >> (3 * PART_BITS), keys & ((1 << 3 * PART_BITS) - 1)
        axes = []
        for axis in range(3):
            high = block >> (BLOCK_BITS * (2 - axis)) & ((1 << BLOCK_BITS) - 1)
            low = within >> (PART_BITS * (2 - axis)) & ((1 << PART_BITS) - 1)
            axes.append((high << PART_BITS | low) - MIDDLE)
        return np.asarray((np.stack(axes, axis=1) + 0.5) * self.size_mm)


def _symmetric(six: FloatArray) -> FloatArray:
    """(N, 3, 3) of (N, 6) xx, xy, xz, yy, yz, zz."""
    return np.asarray(six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))


def _unit(sums: FloatArray, weight: FloatArray) -> FloatArray:
    length = np.linalg.norm(sums, axis=1)
    agree = (length > 0.0) & (length >= LEAST_AGREEMENT * weight)
    return np.where(agree[:, None], sums / np.where(agree, length, 1.0)[:, None], 0.0)
