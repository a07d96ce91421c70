# SPDX-License-Identifier: Apache-2.0
"""Stripes on the plate, condensed to mean points so that dense covariances stay small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.straight_points import find_straight_points
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray

MAX_NODES = 600
LEAST_NODES = 3


@dataclass(frozen=True, slots=True, eq=False)
class PlateNodes:
    """Mean points of short pieces of stripe; for a given pose they say what their points say.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame.
    noise_mm2
        (N, 3, 3) covariance by the stripe's own noise, points taken as independent.
    by_sensor
        (N, 3, P) derivative by the sensor's parameters; None where there is none.
    sheet
        (N,) light sheet.
    stripe
        (N,) index into ``sources``, ``rotations`` and ``translations_mm``.
    posture
        (N,) index into ``postures``.
    rotations, translations_mm
        (S, 3, 3) and (S, 3) ``base_from_tool`` of each stripe.
    sources, postures
        Names.
    sensor_covariance
        (P, P) of the sensor's parameters; None where it is taken as exact.
    """

    points_mm: FloatArray
    noise_mm2: FloatArray
    by_sensor: FloatArray | None
    sheet: IntArray
    stripe: IntArray
    posture: IntArray
    rotations: FloatArray
    translations_mm: FloatArray
    sources: tuple[str, ...]
    postures: tuple[str, ...]
    sensor_covariance: FloatArray | None = None

    def __len__(self) -> int:
        """Count of nodes."""
        return len(self.points_mm)

    def select(self, kept: BoolArray) -> PlateNodes:
        """Keep some nodes; stripes and postures keep their numbers."""
        return replace(
            self,
            points_mm=self.points_mm[kept],
            noise_mm2=self.noise_mm2[kept],
            by_sensor=None if self.by_sensor is None else self.by_sensor[kept],
            sheet=self.sheet[kept],
            stripe=self.stripe[kept],
            posture=self.posture[kept],
        )

    def moved(self, rotations: FloatArray, translations_mm: FloatArray) -> PlateNodes:
        """Give the stripes other poses, (S, 3, 3) and (S, 3)."""
        return replace(self, rotations=rotations, translations_mm=translations_mm)

    @property
    def used_postures(self) -> IntArray:
        """Numbers of the postures that have nodes."""
        return np.unique(self.posture)


def straight_stripes(
    stripes: Sequence[PosedStripe], options: HandEyeOptions
) -> tuple[BoolArray, ...]:
    """Mark, stripe by stripe, the points that lie on one straight line of their sheet."""
    marks = []
    for stripe in stripes:
        kept = np.zeros(len(stripe), dtype=np.bool_)
        for sheet in np.unique(stripe.sheet):
            own = np.flatnonzero(stripe.sheet == sheet)
            straight = find_straight_points(
                stripe.points_mm[own], options.line_tolerance_mm, options.outlier_sigma
            )
            if int(straight.sum()) >= options.min_points:
                kept[own] = straight
        marks.append(kept)
    return tuple(marks)


def condense(
    stripes: Sequence[PosedStripe], kept: Sequence[BoolArray], nodes_per_stripe: int
) -> PlateNodes:
    """Turn the marked points into nodes; at most about `MAX_NODES` of them."""
    n_pieces = sum(
        len(np.unique(stripe.sheet[mark])) for stripe, mark in zip(stripes, kept, strict=True)
    )
    n_nodes = max(LEAST_NODES, min(nodes_per_stripe, MAX_NODES // max(n_pieces, 1)))
    names = tuple(dict.fromkeys(stripe.posture for stripe in stripes))
    parts: list[tuple[FloatArray, FloatArray, FloatArray | None]] = []
    labels: list[tuple[int, int, int]] = []
    for number, (stripe, mark) in enumerate(zip(stripes, kept, strict=True)):
        for sheet in np.unique(stripe.sheet[mark]):
            own = np.flatnonzero(mark & (stripe.sheet == sheet))
            for piece in _pieces(stripe.points_mm[own], n_nodes):
                parts.append(_mean(stripe, own[piece]))
                labels.append((int(sheet), number, names.index(stripe.posture)))
    labelled = np.array(labels, dtype=np.int64).reshape(-1, 3)
    sensors = [part[2] for part in parts if part[2] is not None]
    return PlateNodes(
        np.array([part[0] for part in parts]).reshape(-1, 3),
        np.array([part[1] for part in parts]).reshape(-1, 3, 3),
        np.array(sensors) if sensors and len(sensors) == len(parts) else None,
        labelled[:, 0],
        labelled[:, 1],
        labelled[:, 2],
        np.array([stripe.base_from_tool.rotation for stripe in stripes]).reshape(-1, 3, 3),
        np.array([stripe.base_from_tool.translation_mm for stripe in stripes]).reshape(-1, 3),
        tuple(stripe.source for stripe in stripes),
        names,
    )


def _pieces(points_mm: FloatArray, n_nodes: int) -> list[IntArray]:
    """Places of the points in ``n_nodes`` pieces of equal length along the stripe."""
    centred = points_mm - points_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    along = centred @ axes[0]
    low, high = float(along.min()), float(along.max())
    piece = ((along - low) / max(high - low, 1e-12) * n_nodes).astype(np.int64)
    piece = np.minimum(piece, n_nodes - 1)
    return [np.flatnonzero(piece == k) for k in np.unique(piece)]


def _mean(stripe: PosedStripe, own: IntArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    noise = stripe.noise_mm[own]
    variance = (noise**2).sum(axis=(1, 2))
    floor = max(1e-2 * float(np.median(variance)), 1e-12)
    weights = 1.0 / np.maximum(variance, floor)
    weights /= weights.sum()
    spread = noise * weights[:, None, None]
    by_sensor = None
    if stripe.by_sensor is not None:
        by_sensor = np.tensordot(weights, stripe.by_sensor[own], axes=1)
    return weights @ stripe.points_mm[own], np.einsum("nij,nkj->ik", spread, spread), by_sensor
