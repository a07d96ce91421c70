# SPDX-License-Identifier: Apache-2.0
"""Measured points with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray, frozen_floats, frozen_ints

CloudFrame = Literal["Sensor", "Base", "Part", "Cad"]


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points in one frame; every point carries its covariance from the first day.

    Parameters
    ----------
    frame
        Name of the coordinate frame.
    points_mm
        (N, 3) positions.
    covariance_mm2
        (N, 3, 3) total covariance of each point: stripe noise plus calibration.
    sigma_noise_mm
        (N,) the part that is independent from point to point: the stripe's noise, as the
        standard deviation along the direction in which it acts.
    sheet
        (N,) index into ``sheet_names``.
    sheet_names
        Names of the light sheets.
    exposure
        (N,) index into ``exposure_sources``.
    exposure_sources
        Source names of the exposures.
    segment
        (N,) stripe segment within the exposure.
    intensity
        (N,) peak grey level of the stripe.
    normals
        (N, 3) unit surface normals towards the sensor, or None where not estimated.
    is_simulated
        True if the points were measured on rendered images.
    forced
        Why the calibration that they were measured with was refused, if it was and was used all
        the same.
    """

    frame: CloudFrame
    points_mm: FloatArray
    covariance_mm2: FloatArray
    sigma_noise_mm: FloatArray
    sheet: IntArray
    sheet_names: tuple[str, ...]
    exposure: IntArray
    exposure_sources: tuple[str, ...]
    segment: IntArray
    intensity: FloatArray
    normals: FloatArray | None = None
    is_simulated: bool = False
    forced: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.points_mm))
        floats: list[tuple[str, tuple[int | None, ...]]] = [
            ("points_mm", (n, 3)),
            ("covariance_mm2", (n, 3, 3)),
            ("sigma_noise_mm", (n,)),
            ("intensity", (n,)),
        ]
        if self.normals is not None:
            floats.append(("normals", (n, 3)))
        for name, shape in floats:
            object.__setattr__(self, name, frozen_floats(getattr(self, name), shape, name))
        for name, names in (
            ("sheet", self.sheet_names),
            ("exposure", self.exposure_sources),
            ("segment", None),
        ):
            index = frozen_ints(getattr(self, name), (n,), name)
            object.__setattr__(self, name, index)
            if names is not None and n and not 0 <= index.min() <= index.max() < len(names):
                raise InputError(f"{name} points outside its list of {len(names)} names")

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points_mm)

    def select(self, rows: IntArray) -> PointCloud:
        """The points of these rows (M,); lists of names stay as they are."""
        return replace(
            self,
            points_mm=self.points_mm[rows],
            covariance_mm2=self.covariance_mm2[rows],
            sigma_noise_mm=self.sigma_noise_mm[rows],
            sheet=self.sheet[rows],
            exposure=self.exposure[rows],
            segment=self.segment[rows],
            intensity=self.intensity[rows],
            normals=None if self.normals is None else self.normals[rows],
        )

    @property
    def sigma_mm(self) -> FloatArray:
        """(N,) standard deviation along each point's worst direction."""
        if len(self) == 0:
            return np.zeros(0)
        largest = np.linalg.eigvalsh(self.covariance_mm2)[:, -1]
        return np.asarray(np.sqrt(np.maximum(largest, 0.0)))
