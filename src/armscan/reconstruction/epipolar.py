# SPDX-License-Identifier: Apache-2.0
"""Left points on their sheets in the right image: residuals, and the right camera's drift."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np
from scipy.linalg import blas, lapack

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import square_root
from armscan.kernels.naming import (
    combine_rows,
    cross_stripes,
    explain_residuals,
    find_nearest,
    join_equations,
    list_possible,
    predict_residuals,
    see_points,
    sum_moments,
)
from armscan.models.calibration import SensorCalibration
from armscan.models.two_views import TwoViews
from armscan.reconstruction.triangulate import (
    DepthRange,
    lens_numbers,
    meet,
    sensor_columns,
    sheet_numbers,
)
from armscan.records.profile import Profile

REACH_PX = 4.0
"""A right stripe farther from the projected point than this is not its picture."""
ALONG_PX = 2.0
"""A projected point farther than this beyond a stripe's end does not lie beside the stripe."""
SINE_OF_SAME_DIRECTION = 0.42
"""The projected stripe runs along the right one within 25 degrees."""
BOW_DEPTH_SHARE = 0.03
"""Part of the depth by which a bow may move a point from its place on the plane."""


@dataclass(frozen=True, slots=True, eq=False)
class Projections:
    """Left stripe points, each on one sheet, in the right image.

    Parameters
    ----------
    sheet
        (H,) index into the sensor's sheets.
    points_mm
        (H, 3) in the Sensor frame (eq. 4.11).
    q_px
        (H, 2) pixels of the right image (eqs. 4.17 and 4.18).
    is_met
        (H,) False where the ray does not meet the sheet in front of both cameras.
    """

    sheet: IntArray
    points_mm: FloatArray
    q_px: FloatArray
    is_met: BoolArray

    def select(self, rows: BoolArray | IntArray) -> Projections:
        """Those that a mask or an index names."""
        return replace(self, **{one.name: getattr(self, one.name)[rows] for one in fields(self)})


def possible_sheets(
    points_px: FloatArray, sensor: SensorCalibration, depths: DepthRange
) -> tuple[IntArray, IntArray]:
    """Pairs of point and sheet whose planes meet within the depths, widened for the bow.

    Those of all sheets together: one that was calibrated in few depths is looked for wherever its
    neighbours are, which else would have its name.

    Returns
    -------
    point, sheet
        (H,) indices, ordered by sheet.
    """
    sheets = sheet_numbers(sensor)
    limits = np.array(depths.of_all_mm(sensor)) * [1.0 - BOW_DEPTH_SHARE, 1.0 + BOW_DEPTH_SHARE]
    limits = np.tile(limits, (len(sheets), 1))
    point, sheet = np.zeros((2, len(points_px) * len(sheets)), np.int64)
    pixels = np.ascontiguousarray(points_px)
    count = list_possible(pixels, lens_numbers(sensor), sheets, limits, point, sheet)
    return point[:count], sheet[:count]


@lru_cache(maxsize=8)
def _second_numbers(sensor: SensorCalibration) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The right camera as kernels read it (11,), its pose (12,), and half of its image (2,)."""
    views = TwoViews.of_sensor(sensor)
    camera, pose = views.right, views.right_from_left
    turn = np.column_stack([pose.rotation, pose.translation_mm]).ravel()
    half_px = 0.5 * np.array([camera.width_px, camera.height_px], dtype=np.float64)
    return camera.numbers, turn, half_px


def project_on_sheets(
    points_px: FloatArray, sheet: IntArray, sensor: SensorCalibration
) -> Projections:
    """Put each left pixel (H, 2) on its sheet (H,) and project it into the right camera."""
    own = np.ascontiguousarray(sheet, dtype=np.int64)
    points, is_met = meet(points_px, own, lens_numbers(sensor), sheet_numbers(sensor))
    camera, turn, _ = _second_numbers(sensor)
    q = np.zeros((len(points), 2))
    see_points(points, is_met.astype(np.int64), camera, turn, q)
    return Projections(own, points, q, np.asarray(np.isfinite(q).all(axis=1)))


@dataclass(frozen=True, slots=True, eq=False)
class RightStripes:
    """The right profile, ready for the search of the nearest stripe.

    Parameters
    ----------
    row
        (R,) its accepted points.
    table
        (R, 5) their pixels, normals and sigmas.
    low_px, high_px
        Corners of the rectangle in which they are; infinite and reversed where there is none.
    """

    row: IntArray
    table: FloatArray
    low_px: tuple[float, float]
    high_px: tuple[float, float]

    @staticmethod
    def of(profile: Profile) -> RightStripes:
        """Gather the accepted points."""
        row = np.flatnonzero(profile.is_accepted)
        columns = (profile.points_px, profile.normals_px, profile.sigma_px)
        table = np.column_stack([values.take(row, axis=0) for values in columns])
        x, y = table[:, 0], table[:, 1]
        low = float(x.min(initial=np.inf)), float(y.min(initial=np.inf))
        high = float(x.max(initial=-np.inf)), float(y.max(initial=-np.inf))
        return RightStripes(row, table, low, high)

    def spacing_px(self) -> float:
        """Mean distance between stripes: the picture's area over the stripes' length."""
        if len(self.row) < 2:
            return 1.0
        width, height = np.subtract(self.high_px, self.low_px)
        return max(float(width * height) / len(self.row), 1.0)

    def covers(self, q_px: FloatArray) -> BoolArray:
        """(H,) True within the rectangle in which there are right stripes."""
        x, y = q_px[:, 0], q_px[:, 1]
        inside = (x >= self.low_px[0]) & (x <= self.high_px[0])
        return np.asarray(inside & (y >= self.low_px[1]) & (y <= self.high_px[1]))


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Right stripes beside projected points.

    Parameters
    ----------
    at
        (F,) the projected points that have one, in their order.
    row
        (F,) index of the nearest point in the right profile.
    sheet
        (F,) index into the sensor's sheets.
    residual_px
        (F,) signed distance of the projected point across that stripe, along its normal.
    sigma_px
        (F,) standard deviation of the residual from the noise of both stripes alone.
    by_point
        (F, 3) derivative of the residual by the point in Sensor, px/mm.
    by_errors
        (F, Q + 3) by what the points of one sheet depend on (`sensor_columns`), the point lying on
        its sheet, and by the drift's three numbers: offset of the right picture across the epipolar
        line in the image's middle, and its change to the right and lower rim.
    """

    at: IntArray
    row: IntArray
    sheet: IntArray
    residual_px: FloatArray
    sigma_px: FloatArray
    by_point: FloatArray
    by_errors: FloatArray

    def select(self, rows: BoolArray | IntArray) -> Crossings:
        """Those that a mask or an index names."""
        return replace(self, **{one.name: getattr(self, one.name)[rows] for one in fields(self)})


def find_crossings(
    projected: Projections,
    normals_px: FloatArray,
    sigma_px: FloatArray,
    right: RightStripes,
    sensor: SensorCalibration,
    *,
    reach_px: float = REACH_PX,
) -> Crossings:
    """Find the right stripe that runs beside each projected point, and the distance across it.

    Parameters
    ----------
    projected
        (H,) left points on sheets.
    normals_px, sigma_px
        (H, 2) and (H,) of the left stripe.
    right
        The right profile.
    sensor
        Both cameras and all sheets.
    reach_px
        Largest distance.
    """
    n, (camera, turn, half_image) = len(projected.sheet), _second_numbers(sensor)
    nearest, at = np.zeros((2, n), np.int64)
    reach = float(np.hypot(reach_px, ALONG_PX))
    find_nearest(projected.q_px, np.ascontiguousarray(right.table[:, :2]), reach, nearest)
    n_near = int(np.count_nonzero(nearest >= 0))
    across, by_point = np.zeros((n_near, 4)), np.zeros((n_near, 3))
    by_errors = np.zeros((n_near, error_columns(sensor).shape[1]))
    count = cross_stripes(
        projected.points_mm,
        projected.sheet,
        projected.q_px,
        np.column_stack([normals_px, sigma_px]),
        nearest,
        right.table,
        lens_numbers(sensor),
        sheet_numbers(sensor),
        camera,
        turn,
        np.array([reach_px, ALONG_PX, SINE_OF_SAME_DIRECTION, *half_image]),
        at,
        across,
        by_point,
        by_errors,
    )
    at, across = at[:count], across[:count]
    return Crossings(
        at=at,
        row=right.row[nearest[at]],
        sheet=projected.sheet[at],
        residual_px=np.ascontiguousarray(across[:, 0]),
        sigma_px=np.ascontiguousarray(across[:, 1]),
        by_point=by_point[:count],
        by_errors=by_errors[:count],
    )


@lru_cache(maxsize=8)
def error_columns(sensor: SensorCalibration) -> IntArray:
    """(sheets, Q + 3) places of what each sheet's points depend on, and of the drift.

    They are places among the sensor's P parameters with the drift's three behind them.
    """
    n = len(sensor.covariance)
    return np.stack(
        [np.r_[sensor_columns(sensor, k), n : n + N_DRIFT] for k in range(len(sensor.sheets))]
    )


FLOOR_PX = 0.06
"""What is left of the residual's bias after the epipolar offset was found: calibration errors that
are not smooth, and the stripe's own."""
DRIFT_PX = 0.4
"""Standard deviation, before any data, of how far the two cameras have drifted apart since their
calibration."""
ROUNDS = 4
HUBER_SIGMAS = 2.0
CORRELATION = 3.0
"""Samples along a stripe err together: their sigma counts as this much larger."""
N_DRIFT = 3
SLOPE_SHARE = 0.5
"""Drift from the image's middle to its rim, as a part of the drift in the middle."""
CERTAIN_SIGMAS = 3.0
LEAST_SHARE = 0.05
"""A stripe along the epipolar line says nothing about the offset across it."""
LEAST_OFFSET_PX = 0.1
"""Offsets below this change no label and hardly a point: no warning."""


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarOffset:
    """What moves all residuals together.

    Errors within the calibration's covariance and a drift of the right picture across the
    epipolar lines (constant and linear over the image) are told apart by their priors alone; the
    residuals determine their sum.

    Parameters
    ----------
    parameter_step
        (P,) most likely errors of the calibration's parameters (what to add to them).
    drift
        (3,) offset in the image's middle and its change to the right and lower rim, px.
    factor
        (P + 3, K) with ``factor @ factor.T`` the covariance of both together.
    offset_px
        Mean distance by which the right picture lies off the epipolar lines, positive downwards.
    sigma_px
        Its standard deviation.
    allowed_px
        Standard deviation that the calibration's covariance allows for it.
    """

    parameter_step: FloatArray
    drift: FloatArray
    factor: FloatArray
    offset_px: float
    sigma_px: float
    allowed_px: float

    @property
    def is_beyond_calibration(self) -> bool:
        """True if the calibration's covariance does not explain the offset."""
        limit = CERTAIN_SIGMAS * float(np.hypot(self.allowed_px, self.sigma_px))
        return abs(self.offset_px) > max(limit, LEAST_OFFSET_PX)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should know of it."""
        if not self.is_beyond_calibration:
            return ()
        return (
            f"the right camera's picture lies {self.offset_px:+.2f} px off the epipolar lines, "
            f"more than the calibration's standard deviation of {self.allowed_px:.2f} px explains: "
            "calibrate the two cameras again",
        )


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Distances of projected points from the stripes beside them, and what moves them.

    The true steps take the residuals to zero: what the calibration's errors made is undone by
    adding them to its parameters, what a drift made by shifting the projected points with it.

    Parameters
    ----------
    px, sigma_px
        (H,) as in `Crossings`.
    sheet
        (H,) index into the sensor's sheets.
    by_errors
        (H, Q + 3) derivative by what the points of one sheet depend on (`sensor_columns`) and by
        the drift's three numbers; by all else it is zero.
    sensor
        Both cameras and all sheets.
    """

    px: FloatArray
    sigma_px: FloatArray
    sheet: IntArray
    by_errors: FloatArray
    sensor: SensorCalibration

    @property
    def columns(self) -> IntArray:
        """(sheets, Q + 3), from `error_columns`."""
        return error_columns(self.sensor)

    @staticmethod
    def of(crossings: Crossings, sensor: SensorCalibration) -> Residuals:
        """Of the stripes that were found."""
        return Residuals(
            px=crossings.residual_px,
            sigma_px=crossings.sigma_px,
            sheet=crossings.sheet,
            by_errors=crossings.by_errors,
            sensor=sensor,
        )

    def explained(self, step: FloatArray) -> FloatArray:
        """(H,) what a step (P + 3,) of all parameters and the drift adds to the residuals."""
        found = np.zeros(len(self.px))
        explain_residuals(self.by_errors, self.sheet, step[self.columns], found)
        return found

    def equations(
        self, weight: FloatArray, wanted: FloatArray, group: IntArray, n_groups: int
    ) -> tuple[FloatArray, FloatArray]:
        """Normal equations (G, Q + 3, Q + 3) and (G, Q + 3) of groups (H,) of one sheet each.

        ``weight``, ``wanted``: (H,).
        """
        q = self.by_errors.shape[1]
        matrix, vector = np.zeros((n_groups, q, q)), np.zeros((n_groups, q))
        rows = self.by_errors
        if (group[1:] < group[:-1]).any():
            order = np.argsort(group, kind="stable")
            rows, weight, wanted = rows[order], weight[order], wanted[order]
            group = group[order]
        weighted = rows * weight[:, None]
        bounds = np.searchsorted(group, np.arange(n_groups + 1)).tolist()
        for k, (first, last) in enumerate(pairwise(bounds)):
            if last > first:
                part = weighted[first:last].T
                matrix[k], vector[k] = part @ rows[first:last], part @ wanted[first:last]
        return matrix, vector

    def joined_equations(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations of all parameters, (P + 3, P + 3) and (P + 3,), to undo the residuals.

        ``weight``: (H,).
        """
        n = len(self.sensor.covariance) + N_DRIFT
        matrix, vector = self.equations(weight, -self.px, self.sheet, len(self.columns))
        whole, side = np.zeros((n, n)), np.zeros(n)
        join_equations(matrix.reshape(len(matrix), -1), vector, self.columns, whole, side)
        return whole, side

    def whitened(self, rows: IntArray, factor: FloatArray) -> FloatArray:
        """(M, K) derivatives of some residuals by the whitened errors of a factor (P + 3, K)."""
        combined = np.zeros((len(rows), factor.shape[1]))
        by_errors = np.ascontiguousarray(self.by_errors[rows])
        combine_rows(by_errors, self.sheet[rows], self.columns, factor, combined)
        return combined

    def weighted_sum(self, weight: FloatArray) -> FloatArray:
        """(P + 3,) derivative of the residuals' sum with weights (H,)."""
        of_sheet = np.arange(len(self.columns))[:, None] == self.sheet
        total = np.zeros(len(self.sensor.covariance) + N_DRIFT)
        np.add.at(total, self.columns, (of_sheet * weight) @ self.by_errors)
        return total


def no_offset(sensor: SensorCalibration) -> EpipolarOffset:
    """What is known before any data: nothing has moved, as far as the priors say."""
    n = len(sensor.covariance)
    root = square_root(sensor.covariance, "the sensor's covariance")
    factor = np.zeros((n + 3, root.shape[1] + 3))
    factor[:n, :-3] = root
    factor[n:, -3:] = np.diag([DRIFT_PX, SLOPE_SHARE * DRIFT_PX, SLOPE_SHARE * DRIFT_PX])
    return EpipolarOffset(
        parameter_step=np.zeros(n),
        drift=np.zeros(3),
        factor=factor,
        offset_px=0.0,
        sigma_px=DRIFT_PX,
        allowed_px=0.0,
    )


def estimate_offset(
    residuals: Residuals, sensor: SensorCalibration, equations: OffsetEquations
) -> EpipolarOffset:
    """Most likely errors of the calibration and drift, given the residuals of labelled samples.

    Robust (Huber's weights) and with the priors' covariance: few samples move little.

    Parameters
    ----------
    residuals
        (H,) of samples; those used are of a sheet that is certain.
    sensor
        Cameras and sheets.
    equations
        Of these residuals.
    """
    if not equations.is_used.any():
        return equations.prior
    step, n = equations.step, len(sensor.covariance)
    offset_px, sigma_px, allowed_px = _mean_offset(equations, residuals, sensor)
    return EpipolarOffset(
        parameter_step=step[:n],
        drift=step[n:],
        factor=equations.factor,
        offset_px=offset_px,
        sigma_px=sigma_px,
        allowed_px=allowed_px,
    )


@dataclass(frozen=True, slots=True, eq=False)
class OffsetEquations:
    """Weighted linear equations of the residuals in whitened errors, and their solution.

    Points of a sheet depend on few parameters: the sums are taken over these.

    Parameters
    ----------
    prior
        What is known without the residuals, from `no_offset`.
    is_used
        (H,) True for residuals that have a say.
    sigma, weight
        (H,) of the residuals; the weight is Huber's.
    step
        (P + 3,) most likely errors.
    missed
        (H,) what they leave.
    information
        (K, K) of all equations with the prior's unit matrix.
    factor
        (P + 3, K) of the covariance of all errors, the residuals being known.
    """

    prior: EpipolarOffset
    is_used: BoolArray
    sigma: FloatArray
    weight: FloatArray
    step: FloatArray
    missed: FloatArray
    information: FloatArray
    factor: FloatArray

    @staticmethod
    def of(residuals: Residuals, prior: EpipolarOffset, is_used: BoolArray) -> OffsetEquations:
        """Set up and solve them."""
        sigma = CORRELATION * np.hypot(residuals.sigma_px, FLOOR_PX)
        wanted, precision = -residuals.px, 1.0 / sigma**2
        weight = used = is_used.astype(np.float64)
        matrix, vector = residuals.joined_equations(weight * precision)
        information = prior.factor.T @ (matrix @ prior.factor)
        information[np.diag_indices_from(information)] += 1.0
        right_side = vector @ prior.factor
        for k in range(ROUNDS):
            lower, solved, defect = lapack.dposv(information, right_side, lower=1)
            if defect:
                raise np.linalg.LinAlgError("equations of the epipolar offset are not definite")
            step = prior.factor @ solved
            missed = wanted - residuals.explained(step)
            if k == ROUNDS - 1:
                break
            score = np.abs(missed) / sigma * CORRELATION
            next_weight = used * np.minimum(1.0, HUBER_SIGMAS / np.maximum(score, 1e-9))
            # few lie beyond the limit: only these change the sums
            rows = np.flatnonzero(next_weight != weight)
            if not len(rows):
                break
            design = residuals.whitened(rows, prior.factor)
            change = ((next_weight - weight) * precision)[rows]
            information = information + (design * change[:, None]).T @ design
            right_side = right_side + (change * wanted[rows]) @ design
            weight = next_weight
        factor = blas.dtrsm(1.0, lower, prior.factor, side=1, lower=1, trans_a=1)
        return OffsetEquations(
            prior=prior,
            is_used=is_used,
            sigma=sigma,
            weight=weight,
            step=step,
            missed=missed,
            information=information,
            factor=np.ascontiguousarray(factor),
        )


def left_out_scores(
    residuals: Residuals, equations: OffsetEquations, rows: IntArray, segment: IntArray
) -> FloatArray:
    """How badly each segment's residuals fit what all the others say of the offset.

    A stripe that lies on another sheet's right stripe by chance does so with an offset of its own,
    which the calibration's freedom would explain away were it asked about itself. With C the
    covariance of what a segment depends on, and A and b what it said itself, the others leave the
    covariance ``(I - C A)^-1 C``, and the step less that covariance times b.

    Parameters
    ----------
    residuals, equations
        (H,), and their equations; segments that are not used are asked but have no say.
    rows
        (M,) residuals of the segments that are asked.
    segment
        (M,) number of the segment of stripe, counted from 0; each lies on one sheet.

    Returns
    -------
    FloatArray
        (B,) chi-square of mean, slope and bend of the segment's residuals, over their count.
    """
    n = int(segment.max(initial=-1)) + 1
    if not n:
        return np.zeros(0)
    order = np.argsort(segment, kind="stable")
    bounds = np.searchsorted(segment[order], np.arange(n + 1))
    sheet = np.zeros(n, dtype=np.int64)
    sheet[segment] = residuals.sheet[rows]
    columns = residuals.columns
    factor = equations.factor[columns]
    # in units of what was known before, which all are near 1
    unit = np.linalg.norm(equations.prior.factor, axis=1)
    unit = np.where(unit > 0.0, unit, 1.0)[columns]
    factor /= unit[:, :, None]
    covariance = (factor @ factor.transpose(0, 2, 1))[sheet]
    variance, unit = equations.sigma**2, unit[sheet]
    own, n_errors = rows[order], columns.shape[1]
    weight = (equations.weight / variance)[own]
    chosen = replace(residuals, by_errors=residuals.by_errors[own])
    said, missed = chosen.equations(weight, equations.missed[own], segment[order], n)
    shapes, own_noise, by_shape = np.zeros((n, 3)), np.zeros((n, 9)), np.zeros((n, 3 * n_errors))
    moments = np.concatenate([_moments(count) for count in np.diff(bounds).tolist()])
    sum_moments(
        own,
        segment[order],
        moments,
        residuals.by_errors,
        equations.missed,
        variance,
        by_shape,
        shapes,
        own_noise,
    )
    noise = own_noise.reshape(n, 3, 3)
    asked = np.zeros((n, n_errors, 4))
    asked[:, :, :3] = by_shape.reshape(n, 3, n_errors).transpose(0, 2, 1)
    asked[:, :, 3] = missed
    asked *= unit[:, :, None]
    said *= unit[:, :, None] * unit[:, None, :]
    alone = np.eye(said.shape[1]) - covariance @ said
    left_out = np.linalg.solve(alone, covariance @ asked)
    by_moments = asked[:, :, :3].transpose(0, 2, 1) @ left_out
    noise += by_moments[:, :, :3]
    noise[:, 0, 0] += FLOOR_PX**2
    shapes += by_moments[:, :, 3]
    scores = np.zeros(n)
    count = np.minimum(np.diff(bounds), 3)
    for k in (1, 2, 3):
        own = np.flatnonzero(count == k)
        shape = shapes[own, :k]
        solved = np.linalg.solve(noise[own, :k, :k], shape[:, :, None])[:, :, 0]
        scores[own] = np.sum(shape * solved, axis=1) / k
    return scores


@cache
def _moments(n: int) -> FloatArray:
    """(n, 3): what takes (n,) to their mean, slope and bend; zero for what few do not show."""
    place = np.linspace(-1.0, 1.0, n)
    shape = np.stack([np.ones(n), place, place**2], axis=1)[:, : min(n, 3)]
    moments = np.zeros((n, 3))
    moments[:, : shape.shape[1]] = np.linalg.pinv(shape).T
    moments.setflags(write=False)
    return moments


def _mean_offset(
    equations: OffsetEquations, residuals: Residuals, sensor: SensorCalibration
) -> tuple[float, float, float]:
    """Weighted mean of the residuals across the epipolar lines, its sigma, and that allowed."""
    unit = residuals.by_errors[:, -N_DRIFT]
    weight = equations.weight / equations.sigma**2
    share = np.where(np.abs(unit) > LEAST_SHARE, unit, 0.0) * weight
    total = float(share @ unit)
    if total <= 0.0:
        return 0.0, float(np.inf), 0.0
    share = share / total
    dmean_dsensor = residuals.weighted_sum(share)[:-N_DRIFT]
    allowed = float(dmean_dsensor @ sensor.covariance @ dmean_dsensor)
    mean = -float(share @ residuals.px)
    return mean, float(np.sqrt(1.0 / total)), float(np.sqrt(max(allowed, 0.0)))


def residual_and_sigma(
    residuals: Residuals, offset: EpipolarOffset
) -> tuple[FloatArray, FloatArray]:
    """Residual (H,) beyond what calibration errors and drift explain, and its sigma (H,), px."""
    steps, covariances = _of_sheets(offset, residuals.sensor)
    found = np.zeros((len(residuals.px), 2))
    predict_residuals(residuals.by_errors, residuals.sheet, steps, covariances, found)
    variance = residuals.sigma_px**2 + np.maximum(found[:, 1], 0.0) + FLOOR_PX**2
    return residuals.px + found[:, 0], np.sqrt(variance)


@lru_cache(maxsize=4)
def _of_sheets(offset: EpipolarOffset, sensor: SensorCalibration) -> tuple[FloatArray, FloatArray]:
    """(S, Q + 3) errors that each sheet's points depend on, and their covariance, in a row."""
    columns = error_columns(sensor)
    factor = offset.factor[columns]
    covariance = (factor @ factor.transpose(0, 2, 1)).reshape(len(factor), -1)
    return np.concatenate([offset.parameter_step, offset.drift])[columns], covariance
