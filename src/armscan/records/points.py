# SPDX-License-Identifier: Apache-2.0
"""Ring markers, as images and in space, and points touched with the arm's probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import (
    ArrayRecord,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    frozen_floats,
    ints,
)
from armscan.geometry.rotations import skew


class RingImages(RowRecord):
    """Images of N ring markers in one exposure.

    Parameters
    ----------
    centres_px
        (N, 2) images of the rings' centres, full-sensor pixels; these are not the centres of the
        ellipses.
    covariance_px2
        (N, 2, 2) their covariance.
    outer_half_px, inner_half_px
        (N, 2) half axes of the ring's outer and inner rim, the shorter one first.
    direction_rad
        (N,) direction of the outer rim's longer axis, from x towards y.
    contrast
        (N,) level of the disc minus level of the ring, as a fraction of full scale.
    perimeter_px
        (N,) circumference of the outer rim if the ring were not tilted (P of eq. 4.19).
    roundness
        (N,) C of eq. 4.20; 1 for a ring that is not tilted.
    """

    source: str
    centres_px: FloatArray = floats("N", 2)
    covariance_px2: FloatArray = floats("N", 2, 2)
    outer_half_px: FloatArray = floats("N", 2)
    inner_half_px: FloatArray = floats("N", 2)
    direction_rad: FloatArray = floats("N")
    contrast: FloatArray = floats("N")
    perimeter_px: FloatArray = floats("N")
    roundness: FloatArray = floats("N")

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_covariances(self.covariance_px2, "covariance_px2", self.source)


class CommonErrors(ArrayRecord):
    """Errors that markers have in common because an arm was moved before they were measured.

    Parameters
    ----------
    groups
        Of each of G moves, the ids of the markers that it carried to the frame of their list.
    covariance
        (6 G, 6 G) of all moves together: of each a rotation vector about the frame's origin (rad)
        and a shift (mm).
    """

    groups: tuple[tuple[int, ...], ...]
    covariance: FloatArray = floats("P", "P")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.covariance) != 6 * len(self.groups):
            raise InputError(
                f"a covariance of {len(self.covariance)} numbers for {len(self.groups)} moves"
            )

    def jacobian(self, ids: IntArray, points_mm: FloatArray) -> FloatArray:
        """(N, 3, 6 G) derivative of markers' places by these errors; zero for others' markers."""
        shift = np.broadcast_to(np.eye(3), (len(ids), 3, 3))
        own = np.concatenate([-skew(points_mm), shift], axis=2)
        parts = [own * np.isin(ids, group)[:, None, None] for group in self.groups]
        return np.concatenate(parts, axis=2)


class MarkerSet(RowRecord):
    """Markers as points in space; they carry no code, so an id says nothing outside its set.

    Parameters
    ----------
    ids
        (N,) numbers of the markers in this set, each once.
    points_mm
        (N, 3) centres in ``frame``.
    covariance_mm2
        (N, 3, 3) covariance of each centre, independent between markers: that of measuring its
        images. What a calibration adds is common to all markers and not in here.
    common
        What parts of these covariances are common to several markers, where that is known.
    frame
        Name of the coordinate frame, for example ``Sensor`` or ``Base``.
    source
        Where they came from, for messages.
    """

    ids: IntArray = ints("N")
    points_mm: FloatArray = floats("N", 3)
    covariance_mm2: FloatArray = floats("N", 3, 3)
    frame: str = "Sensor"
    source: str = ""
    common: CommonErrors | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(np.unique(self.ids)) != len(self):
            raise InputError("a marker's id occurs twice", where=self.source)
        _check_covariances(self.covariance_mm2, "markers' covariance (mm2)", self.source)


def _check_covariances(covariance: FloatArray, name: str, where: str) -> None:
    if len(covariance) and float(np.linalg.eigvalsh(covariance).min()) <= 0.0:
        raise InputError(f"{name} is not positive definite", where=where)


@dataclass(frozen=True, slots=True, eq=False)
class ProbedPoints:
    """Points in Base that a probe touched.

    Parameters
    ----------
    points_mm
        (N, 3) in Base: on the surface, or the tip's centres.
    tip_diameter_mm
        Diameter of the tip that touched; 0 where not known, for points on the surface.
    features
        (N,) name of the feature that each point belongs to; empty where nobody said.
    is_compensated
        True if the tip's radius was taken off already: the points are on the surface.
    rows
        (N,) row of each point in its table, from 1; all rows in turn if empty.
    """

    points_mm: FloatArray
    tip_diameter_mm: float = 0.0
    features: tuple[str, ...] = ()
    source: str = ""
    is_compensated: bool = False
    rows: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_mm, (None, 3), "probed points (mm)")
        object.__setattr__(self, "points_mm", points)
        if not 0.0 <= self.tip_diameter_mm < 1000.0:
            raise InputError(
                f"a tip of {self.tip_diameter_mm:g} mm diameter",
                where=self.source,
                remedy="give the tip's diameter in mm, below 1000",
            )
        if self.features and len(self.features) != len(points):
            raise InputError(
                f"{len(self.features)} features for {len(points)} points", where=self.source
            )
        rows = self.rows or tuple(range(1, len(points) + 1))
        if len(rows) != len(points):
            raise InputError(f"{len(rows)} rows for {len(points)} points", where=self.source)
        object.__setattr__(self, "rows", rows)

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points_mm)

    @property
    def are_tip_centres(self) -> bool:
        """True if the points still have to be compensated for the tip's radius."""
        return self.tip_diameter_mm > 0.0 and not self.is_compensated
