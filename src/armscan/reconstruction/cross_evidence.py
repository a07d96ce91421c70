# SPDX-License-Identifier: Apache-2.0
"""How well each sheet explains each piece of a profile, before and without any past."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.choose_sheet import DepthRange
from armscan.reconstruction.stretches import Pieces
from armscan.reconstruction.triangulate import meet_sheets

OUTSIDE = -4.0
"""Log-likelihood of a piece that lies outside the depths of a sheet, over one that is inside."""
DIRECTION_RAD = np.radians(25.0)
"""Standard deviation of a stripe's direction from that on a surface that faces the camera."""
ODD_DIRECTION = 0.1
"""Share of stripes that run in any direction: walls and edges."""
ALIKE_PIECES = 8
"""Over so many pieces of a stretch, some 5 mm, what misleads one of them misleads all."""
INDEPENDENT = 0.5
"""Of sharp predictions: neighbouring pieces share some of what they err by."""
TAKEN = -3.0
"""Log-likelihood of a piece whose place in the sheet's light is taken by another stretch."""
RAY_MM = 1.0
"""Along the sheet, light within this counts as one ray of the laser."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What the samples of a profile would be in space under each of H sheets.

    Parameters
    ----------
    sheets
        (H,) indices into the sensor's sheets.
    points_mm
        (H, S, 3) in Sensor.
    is_inside
        (S, H) True where the point exists, within the depths accepted.
    place_mm
        (H, S) coordinate along the sheet.
    """

    sheets: tuple[int, ...]
    points_mm: FloatArray
    is_inside: BoolArray
    place_mm: FloatArray


def hypothesise(
    points_px: FloatArray,
    sheets: tuple[int, ...],
    sensor: SensorCalibration,
    depths: DepthRange,
) -> Hypotheses:
    """Meet the rays of samples (S, 2) with each sheet."""
    points, inside, place = [], [], []
    for k in sheets:
        met, is_met = meet_sheets(points_px, np.full(len(points_px), k), sensor)
        low, high = depths.limits_mm(sensor.sheets[k])
        sheet = sensor.sheets[k].sheet
        points.append(met)
        inside.append(is_met & (met[:, 2] >= low) & (met[:, 2] <= high))
        place.append((met - sheet.origin_mm) @ sheet.axes[0])
    return Hypotheses(sheets, np.array(points), np.array(inside).T, np.array(place))


def still_evidence(pieces: Pieces, hypotheses: Hypotheses, sensor: SensorCalibration) -> FloatArray:
    """(P, H) log-likelihood of the pieces' depths and directions, in this exposure alone."""
    depth = OUTSIDE * pieces.mean((~hypotheses.is_inside).astype(np.float64))
    direction = _direction_evidence(pieces, hypotheses.sheets, sensor)
    return np.asarray(_vote(pieces) * (depth + direction))


def _vote(pieces: Pieces) -> FloatArray:
    """(P, 1) weights by which the pieces of a stretch do not count for more than they know."""
    count = np.bincount(pieces.stretch)[pieces.stretch]
    return np.asarray(np.minimum(1.0, 1.0 / count + 1.0 / ALIKE_PIECES)[:, None])


def _direction_evidence(
    pieces: Pieces, sheets: tuple[int, ...], sensor: SensorCalibration
) -> FloatArray:
    turn = np.stack(
        [_angle_between(pieces.direction, frontal_direction(sensor, k)) for k in sheets], axis=1
    )
    usual = np.exp(-0.5 * (turn / DIRECTION_RAD) ** 2)
    return np.asarray(np.log((1.0 - ODD_DIRECTION) * usual + ODD_DIRECTION))


def frontal_direction(sensor: SensorCalibration, sheet: int) -> FloatArray:
    """(2,) direction, in the image, of a sheet's stripe on a surface that faces the camera."""
    model = sensor.sheets[sheet].sheet
    along = np.cross(model.axes[2], [0.0, 0.0, 1.0])
    ends = model.origin_mm + np.array([[-1.0], [1.0]]) * along
    first, last = sensor.camera.camera.project(ends)
    return np.asarray((last - first) / np.linalg.norm(last - first))


def _angle_between(direction: FloatArray, line: FloatArray) -> FloatArray:
    """(P,) angles in 0 to 90 degrees between directions (P, 2) and a line."""
    return np.asarray(np.arccos(np.clip(np.abs(direction @ line), 0.0, 1.0)))


def past_evidence(pieces: Pieces, log_gain: FloatArray, sharpness: FloatArray) -> FloatArray:
    """(P, H) log-likelihood of the pieces, from how well their samples continue the past.

    Sharp predictions err apart from piece to piece, vague ones in common.

    Parameters
    ----------
    pieces
        Of the profile.
    log_gain, sharpness
        (S, H) from `armscan.reconstruction.surface_memory.SurfaceMemory.evidence`.
    """
    sharp = INDEPENDENT * pieces.mean(log_gain * sharpness)
    vague = _vote(pieces) * pieces.mean(log_gain * (1.0 - sharpness))
    return np.asarray(sharp + vague)


def taken_evidence(log_posterior: FloatArray, pieces: Pieces, hypotheses: Hypotheses) -> FloatArray:
    """(P, H) penalty where another stretch already holds the same rays of a sheet's light.

    A ray of a laser ends on the first thing that it meets, so it is seen once.

    Parameters
    ----------
    log_posterior
        (P, H) what is believed without this.
    pieces, hypotheses
        Of the profile.
    """
    of_sample = pieces.of_sample
    stretch = pieces.stretch[of_sample]
    penalty = np.zeros(hypotheses.is_inside.shape)
    for h in range(len(hypotheses.sheets)):
        belief = np.where(hypotheses.is_inside[:, h], np.exp(log_posterior[of_sample, h]), 0.0)
        ray = np.floor(hypotheses.place_mm[h] / RAY_MM).astype(np.int64)
        ray -= ray.min(initial=0)
        table = np.zeros((int(stretch.max(initial=0)) + 1, int(ray.max(initial=0)) + 1))
        np.maximum.at(table, (stretch, ray), belief)
        penalty[:, h] = TAKEN * _most_of_others(table)[stretch, ray]
    return np.asarray(_vote(pieces) * pieces.mean(penalty))


def _most_of_others(table: FloatArray) -> FloatArray:
    """Largest value of each column over the other rows."""
    if len(table) == 1:
        return np.zeros_like(table)
    order = np.sort(table, axis=0)
    is_most = np.arange(len(table))[:, None] == table.argmax(axis=0)
    return np.asarray(np.where(is_most, order[-2], order[-1]))
