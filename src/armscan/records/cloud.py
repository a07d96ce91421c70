# SPDX-License-Identifier: Apache-2.0
"""Measured points with their uncertainty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Literal, Self

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import (
    ArrayRecord,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    ints,
)

CloudFrame = Literal["Sensor", "Base", "Part", "Cad"]

FUSED = "fused"
"""Name of the one sheet and the one exposure of a fused cloud: its points come from many."""
DELIVERED = "profile"
"""Name of the one light sheet of a sensor that delivers points itself."""
SMALLEST_EXTENT_MM = 2.0
"""Points that all lie this near to each other are taken for metres: nothing that small is measured,
probed to place a scanner or carries markers, and a plate in metres is not larger."""


@dataclass(frozen=True, slots=True)
class CalibrationMark:
    """The calibration that points were measured with: its document's id, and when it was made."""

    document_id: str
    created_utc: str = ""


FIELD_DEGREE = 4
"""Of the polynomials of `CalibrationErrors`: they follow a head's errors to 2 % of the variance."""
FIELD_POWERS = tuple(
    (i, total - i) for total in range(FIELD_DEGREE + 1) for i in range(total, -1, -1)
)
FIELD_REACH = 1.1
"""Half widths from the middle up to which a polynomial is taken; beyond, its value there."""
POINTS_AT_ONCE = 50_000
"""Whose products of powers and directions are held at a time: 18 MB."""


class PointsSeen(RowRecord):
    """Points of a scan, where the sensor stood at each, and of which exposure and sheet they are.

    Parameters
    ----------
    points_mm, seen_from_mm
        (N, 3) in the cloud's frame.
    exposure, sheet
        (N,) numbers.
    """

    points_mm: FloatArray = floats("N", 3)
    seen_from_mm: FloatArray = floats("N", 3)
    exposure: IntArray = ints("N")
    sheet: IntArray = ints("N")


class CalibrationErrors(ArrayRecord):
    """What a calibration may err by: independent errors that move all points of a scan at once.

    Seen from the sensor, a point on a light sheet is told by the direction (x/z, y/z) in which it
    lies; it moves by a polynomial of that direction, and the sensor's turn carries the move along.

    Parameters
    ----------
    turns
        (E, 3, 3) rotation of the Sensor frame into the cloud's at each exposure.
    middle, half_width
        (S, 2) of the directions of each sheet.
    modes_mm
        (S, T, 3, K) move in Sensor by one standard deviation of each of K errors, as factors of the
        T products of powers `FIELD_POWERS` of the direction less its middle over the half width.
    arm_mm
        One standard deviation, along each axis of Sensor, of what the arm errs alike at the
        postures of a scan. A wrist errs by its angles, which the head carries along: at the
        calibration's postures the hand-eye took it up, at others it is new.
    """

    turns: FloatArray = floats("E", 3, 3)
    middle: FloatArray = floats("S", 2)
    half_width: FloatArray = floats("S", 2)
    modes_mm: FloatArray = floats("S", len(FIELD_POWERS), 3, "K")
    arm_mm: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.arm_mm < np.inf or not (self.half_width > 0.0).all():
            raise InputError("errors of a calibration have sizes of 0 or more, and a range above 0")

    def turned(self, rotation: FloatArray) -> Self:
        """The same in a frame into which ``rotation`` (3, 3) leads."""
        return replace(self, turns=rotation @ self.turns)

    def moves_along_mm(self, seen: PointsSeen, directions: FloatArray) -> FloatArray:
        """(K, N) moves of points along unit directions (N, 3) in the cloud's frame, by error."""
        found = np.zeros((self.modes_mm.shape[3], len(directions)))
        for rows, turn, powers, modes in self._parts(seen):
            along = np.einsum("nji,nj->ni", turn, directions[rows])
            products = (powers[:, :, None] * along[:, None, :]).reshape(len(rows), -1)
            found[:, rows] = modes.reshape(products.shape[1], len(found)).T @ products.T
        return found

    def covariance_mm2(self, seen: PointsSeen) -> FloatArray:
        """(N, 3, 3) covariances of points by all errors together, in the cloud's frame."""
        found = np.zeros((len(seen), 3, 3))
        for rows, turn, powers, modes in self._parts(seen):
            own = np.zeros((len(rows), 3, 3))
            for i, j in combinations_with_replacement(range(3), 2):
                both = np.einsum("nt,nt->n", powers @ (modes[:, i] @ modes[:, j].T), powers)
                own[:, i, j] = own[:, j, i] = both
            found[rows] = turn @ own @ turn.transpose(0, 2, 1)
        return found

    def _parts(
        self, seen: PointsSeen
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
        """Of a few points of one sheet at a time: rows, turns, powers (M, T), modes (T, 3, K)."""
        for sheet, modes in enumerate(self.modes_mm):
            of_sheet = np.flatnonzero(seen.sheet == sheet)
            for first in range(0, len(of_sheet), POINTS_AT_ONCE):
                rows = of_sheet[first : first + POINTS_AT_ONCE]
                turn = self.turns[seen.exposure[rows]]
                away = seen.points_mm[rows] - seen.seen_from_mm[rows]
                in_sensor = np.einsum("nji,nj->ni", turn, away)
                scale = self.middle[sheet], self.half_width[sheet]
                yield rows, turn, direction_powers(in_sensor, *scale), modes


def direction_powers(seen_mm: FloatArray, middle: FloatArray, half_width: FloatArray) -> FloatArray:
    """(N, T) products of powers of the directions of points (N, 3) in Sensor.

    ``middle`` and ``half_width`` are (2,) or (N, 2).
    """
    away = np.where(seen_mm[:, 2:] > 0.0, seen_mm[:, 2:], 1.0)
    u, v = np.clip((seen_mm[:, :2] / away - middle) / half_width, -FIELD_REACH, FIELD_REACH).T
    return np.stack([u**i * v**j for i, j in FIELD_POWERS], axis=1)


class PointCloud(RowRecord):
    """Points in one frame; every point carries its covariance from the first day.

    Parameters
    ----------
    points_mm
        (N, 3) positions.
    covariance_mm2
        (N, 3, 3) total covariance of each point by itself, in the cloud's frame. In Sensor: noise
        of the stripe or stripes, the light sheet's own shape, cameras and sheets as calibrated. In
        Base also the hand-eye, with what it shares with the sensor, and the arm's scatter. After a
        registration also that of the transform. What points share is in each one's covariance;
        how much two points share is not in the cloud.
    sigma_noise_mm
        (N,) the part of it that is the stripes' noise, as the root sum square of the standard
        deviations along the directions in which the stripes of one or two cameras err. Neighbours
        along a stripe share it as far as ``noise_length`` says.
    sheet
        (N,) index into ``sheet_names``.
    exposure
        (N,) index into ``exposure_sources``.
    segment
        (N,) stripe segment within the exposure.
    intensity
        (N,) peak grey level of the stripe.
    normals
        (N, 3) unit surface normals towards the sensor, or None where not estimated.
    noise_length
        (N,) correlation length of that noise along the stripe, in points of the full cloud: a sum
        over a stripe has the variance of independent points times this. None where it is not known.
    seen_from_mm
        (E, 3) where the sensor stood at each exposure, in the cloud's frame; None where unknown.
    calibration_errors
        What of the covariance all points share, as the calibration may err; None where unknown.
    is_simulated
        True if the points were measured on rendered images.
    forced
        Why the calibration that they were measured with was refused, if it was and was used all
        the same.
    calibrations
        The calibrations that they were measured with; empty where it is not known.
    """

    frame: CloudFrame
    points_mm: FloatArray = floats("N", 3)
    covariance_mm2: FloatArray = floats("N", 3, 3)
    sigma_noise_mm: FloatArray = floats("N")
    sheet: IntArray = ints("N")
    sheet_names: tuple[str, ...]
    exposure: IntArray = ints("N")
    exposure_sources: tuple[str, ...]
    segment: IntArray = ints("N")
    intensity: FloatArray = floats("N")
    normals: FloatArray | None = floats("N", 3, default=None)
    noise_length: FloatArray | None = floats("N", default=None)
    seen_from_mm: FloatArray | None = floats(None, 3, default=None)
    calibration_errors: CalibrationErrors | None = None
    is_simulated: bool = False
    forced: tuple[str, ...] = ()
    calibrations: tuple[CalibrationMark, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, index, names in (
            ("sheet", self.sheet, self.sheet_names),
            ("exposure", self.exposure, self.exposure_sources),
        ):
            if len(index) and not 0 <= index.min() <= index.max() < len(names):
                raise InputError(f"{name} points outside its list of {len(names)} names")

        if self.seen_from_mm is not None and len(self.seen_from_mm) != len(self.exposure_sources):
            raise InputError(
                f"{len(self.seen_from_mm)} places for {len(self.exposure_sources)} exposures"
            )
        common = self.calibration_errors
        if common is not None and (len(common.turns), len(common.middle)) != (
            len(self.exposure_sources),
            len(self.sheet_names),
        ):
            raise InputError(
                f"the calibration's errors are of {len(common.turns)} exposures and "
                f"{len(common.middle)} sheets, not of {len(self.exposure_sources)} and "
                f"{len(self.sheet_names)}"
            )

    @property
    def is_fused(self) -> bool:
        """Whether each point stands for measured ones of many stripes."""
        return FUSED in self.sheet_names and FUSED in self.exposure_sources

    @property
    def sigma_mm(self) -> FloatArray:
        """(N,) standard deviation along each point's worst direction."""
        return np.asarray(np.sqrt(np.maximum(largest_eigenvalue(self.covariance_mm2), 0.0)))


def largest_eigenvalue(matrices: FloatArray) -> FloatArray:
    """(N,) largest eigenvalue of symmetric matrices (N, 3, 3), by Cardano's formula (Smith 1961).

    It is right to 2e-8 of itself and takes a third of the time of a general solver.
    """
    xx, a, b, _, yy, c, _, _, zz = np.ascontiguousarray(matrices.reshape(-1, 9).T)
    middle = (xx + yy + zz) / 3.0
    x, y, z = xx - middle, yy - middle, zz - middle
    spread = np.sqrt((x * x + y * y + z * z + 2.0 * (a * a + b * b + c * c)) / 6.0)
    half_det = 0.5 * (x * (y * z - c * c) - a * (a * z - b * c) + b * (a * c - b * y))
    cosine = half_det / np.maximum(spread**3, np.finfo(np.float64).tiny)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) / 3.0
    return np.asarray(middle + 2.0 * spread * np.cos(angle))
