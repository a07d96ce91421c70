# SPDX-License-Identifier: Apache-2.0
"""The part of space that is measured: points outside it are left out and counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, frozen_floats
from armscan.geometry.box import REMEDY, box_corners_mm
from armscan.records.cloud import PointCloud


@dataclass(frozen=True, slots=True, eq=False)
class BaseBox:
    """A box along the axes of Base from the corner ``low_mm`` (3,) to ``high_mm`` (3,)."""

    low_mm: FloatArray
    high_mm: FloatArray

    def __post_init__(self) -> None:
        for name in ("low_mm", "high_mm"):
            object.__setattr__(self, name, frozen_floats(getattr(self, name), (3,), name))
        if not bool((self.low_mm < self.high_mm).all()):
            raise OptionError(
                "a lower limit of the volume is not below its upper one",
                remedy=REMEDY,
            )

    def holds(self, points_base_mm: FloatArray) -> BoolArray:
        """(N,) True for those of (N, 3) points that lie inside or on the border."""
        points = np.asarray(points_base_mm)
        return np.asarray(((points >= self.low_mm) & (points <= self.high_mm)).all(axis=1))

    def __str__(self) -> str:
        """The limits as `parse_volume` reads them."""
        pairs = zip(self.low_mm.tolist(), self.high_mm.tolist(), strict=True)
        return ",".join(f"{low!r},{high!r}" for low, high in pairs)


def parse_volume(text: str, where: str = "--volume") -> BaseBox:
    """Read ``xmin,xmax,ymin,ymax,zmin,zmax`` in mm, in Base.

    Raises
    ------
    OptionError
        If these are not six finite numbers, each lower limit below its upper one.
    """
    values = []
    for word in text.split(","):
        try:
            values.append(float(word))
        except ValueError as error:
            raise OptionError(f"'{word}' is no number", where=where, remedy=REMEDY) from error
    return BaseBox(*box_corners_mm(values, where))


def cut_cloud(cloud: PointCloud, box: BaseBox) -> PointCloud:
    """The points of a cloud in Base that lie in the box; lists of names stay as they are.

    Raises
    ------
    InputError
        If the cloud is in another frame.
    """
    if cloud.frame != "Base":
        raise InputError(f"a volume of Base cannot cut a cloud in {cloud.frame}")
    return cloud.select(np.flatnonzero(box.holds(cloud.points_mm)))
