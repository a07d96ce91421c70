# SPDX-License-Identifier: Apache-2.0
"""Left points on their sheets in the right image: residuals, and the right camera's drift."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, homogeneous
from armscan.geometry.least_squares import square_root
from armscan.kernels.rays import add_equations, combine_rows, join_equations
from armscan.models.calibration import SensorCalibration
from armscan.models.two_views import TwoViews
from armscan.reconstruction.triangulate import (
    DepthRange,
    intersect_with_jacobian,
    sensor_columns,
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
    dpoint_dpx, dpoint_dsensor
        (H, 3, 2) and (H, 3, 17) derivatives of the point by the left pixel, and by the left camera
        and the sheet.
    dq_dpoint, dq_dsecond
        (H, 2, 3) and (H, 2, 15) derivatives of the right pixel by the point, and by what the second
        camera adds, at a fixed point.
    """

    sheet: IntArray
    points_mm: FloatArray
    q_px: FloatArray
    is_met: BoolArray
    dpoint_dpx: FloatArray
    dpoint_dsensor: FloatArray
    dq_dpoint: FloatArray
    dq_dsecond: FloatArray

    def select(self, rows: BoolArray | IntArray) -> Projections:
        """Those that a mask or an index names."""
        return replace(self, **{one.name: getattr(self, one.name)[rows] for one in fields(self)})


def possible_sheets(
    points_px: FloatArray, sensor: SensorCalibration, depths: DepthRange
) -> tuple[IntArray, IntArray]:
    """Pairs of point and sheet whose planes meet within the depths accepted, widened for the bow.

    Returns
    -------
    point, sheet
        (H,) indices, ordered by point.
    """
    xy, is_valid = sensor.camera.camera.undistort(points_px)
    rays = homogeneous(xy)
    planes = np.stack([s.sheet.plane for s in sensor.sheets])
    slope = rays @ planes[:, :3].T
    depth = -planes[:, 3] / np.where(np.abs(slope) > 1e-9, slope, np.nan)
    low, high = np.array([depths.limits_mm(s) for s in sensor.sheets]).T
    with np.errstate(invalid="ignore"):
        inside = (depth >= low * (1.0 - BOW_DEPTH_SHARE)) & (
            depth <= high * (1.0 + BOW_DEPTH_SHARE)
        )
    point, sheet = np.nonzero(inside & is_valid[:, None])
    return point, sheet


def project_on_sheets(
    points_px: FloatArray, sheet: IntArray, sensor: SensorCalibration
) -> Projections:
    """Put each left pixel (H, 2) on its sheet (H,) and project it into the right camera."""
    met = intersect_with_jacobian(points_px, sheet, sensor)
    views = TwoViews.of_sensor(sensor)
    q, dq_dpoint, dq_dsecond = views.project_right_with_jacobian(met.points_mm)
    return Projections(
        sheet=sheet,
        points_mm=met.points_mm,
        q_px=q,
        is_met=met.is_met & np.isfinite(q).all(axis=1),
        dpoint_dpx=met.dpoint_dpx,
        dpoint_dsensor=met.dpoint_dsensor,
        dq_dpoint=dq_dpoint,
        dq_dsecond=dq_dsecond,
    )


@dataclass(frozen=True, slots=True, eq=False)
class RightStripes:
    """The right profile, ready for the search of the nearest stripe.

    Parameters
    ----------
    profile
        Stripe points of the right camera.
    row
        (R,) the accepted ones.
    tree
        Of their pixels.
    """

    profile: Profile
    row: IntArray
    tree: cKDTree

    @staticmethod
    def of(profile: Profile) -> RightStripes:
        """Index the accepted points."""
        row = np.flatnonzero(profile.is_accepted)
        return RightStripes(profile, row, cKDTree(profile.points_px[row]))

    def spacing_px(self) -> float:
        """Mean distance between stripes: the picture's area over the stripes' length."""
        if len(self.row) < 2:
            return 1.0
        size = np.ptp(self.profile.points_px[self.row], axis=0)
        return max(float(size[0] * size[1]) / len(self.row), 1.0)

    def covers(self, q_px: FloatArray) -> BoolArray:
        """(H,) True within the rectangle in which there are right stripes."""
        points = self.profile.points_px[self.row]
        if not len(points):
            return np.zeros(len(q_px), dtype=np.bool_)
        low, high = points.min(axis=0), points.max(axis=0)
        return np.asarray(((q_px >= low) & (q_px <= high)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """The right stripe beside each projected point.

    Parameters
    ----------
    row
        (H,) index of the nearest point in the right profile; -1 where no stripe is within reach.
    residual_px
        (H,) signed distance of the projected point across that stripe, along its normal.
    sigma_px
        (H,) standard deviation of the residual from the noise of both stripes alone.
    normal
        (H, 2) across the right stripe.
    """

    row: IntArray
    residual_px: FloatArray
    sigma_px: FloatArray
    normal: FloatArray

    @property
    def is_found(self) -> BoolArray:
        """(H,) True where there is a stripe within reach."""
        return np.asarray(self.row >= 0)

    def select(self, rows: BoolArray | IntArray) -> Crossings:
        """Those that a mask or an index names."""
        return replace(self, **{one.name: getattr(self, one.name)[rows] for one in fields(self)})


def find_crossings(
    projected: Projections,
    normals_px: FloatArray,
    sigma_px: FloatArray,
    right: RightStripes,
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
    reach_px
        Largest distance.
    """
    n = len(projected.sheet)
    row = np.full(n, -1)
    residual, sigma, normal = np.zeros(n), np.ones(n), np.zeros((n, 2))
    asked = np.flatnonzero(projected.is_met)
    if not len(right.row) or not len(asked):
        return Crossings(row, residual, sigma, normal)
    distance, nearest = right.tree.query(
        projected.q_px[asked], distance_upper_bound=float(np.hypot(reach_px, ALONG_PX))
    )
    is_near = np.isfinite(distance)
    asked, nearest = asked[is_near], np.asarray(nearest)[is_near]
    found = right.row[nearest]
    n_right = right.profile.normals_px[found]
    away = projected.q_px[asked] - right.profile.points_px[found]
    across = np.sum(away * n_right, axis=1)
    along = away[:, 0] * -n_right[:, 1] + away[:, 1] * n_right[:, 0]
    dq_dleft = projected.dq_dpoint[asked] @ projected.dpoint_dpx[asked]
    tangent = np.stack([-normals_px[asked, 1], normals_px[asked, 0]], axis=1)
    runs = np.einsum("nij,nj->ni", dq_dleft, tangent)
    sine = np.abs(np.sum(runs * n_right, axis=1)) / np.maximum(np.linalg.norm(runs, axis=1), 1e-12)
    good = (np.abs(along) <= ALONG_PX) & (np.abs(across) <= reach_px)
    good &= sine <= SINE_OF_SAME_DIRECTION
    gain = np.einsum("ni,nij,nj->n", n_right, dq_dleft, normals_px[asked])
    at = asked[good]
    row[at], residual[at], normal[at] = found[good], across[good], n_right[good]
    sigma[at] = np.hypot(gain * sigma_px[asked], right.profile.sigma_px[found])[good]
    return Crossings(row, residual, sigma, normal)


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
HALF_IMAGE = 0.5
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


def drift_directions(projected: Projections, sensor: SensorCalibration) -> FloatArray:
    """(H, 2, 3) how the drift's three numbers move the right picture of each point.

    The move is across the epipolar line, which is where the point's picture goes with its depth.
    """
    along = np.einsum("nij,nj->ni", projected.dq_dpoint, projected.points_mm)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    across *= np.where(across[:, 1] < 0.0, -1.0, 1.0)[:, None]
    camera = TwoViews.of_sensor(sensor).right
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    place = (projected.q_px - 0.5 * size) / (HALF_IMAGE * size)
    basis = np.concatenate([np.ones((len(place), 1)), place], axis=1)
    return np.asarray(across[:, :, None] * basis[:, None, :])


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
    columns
        (sheets, Q + 3) places of these among the sensor's P parameters and the drift.
    """

    px: FloatArray
    sigma_px: FloatArray
    sheet: IntArray
    by_errors: FloatArray
    columns: IntArray

    @staticmethod
    def of(projected: Projections, crossings: Crossings, sensor: SensorCalibration) -> Residuals:
        """Of the same (H,) points."""
        normal = crossings.normal[:, None, :]
        by_point = normal @ projected.dq_dpoint
        by_errors = [
            by_point @ projected.dpoint_dsensor,
            normal @ projected.dq_dsecond,
            normal @ drift_directions(projected, sensor),
        ]
        n = len(sensor.covariance)
        columns = [
            np.r_[sensor_columns(sensor, k), n : n + N_DRIFT] for k in range(len(sensor.sheets))
        ]
        return Residuals(
            px=crossings.residual_px,
            sigma_px=crossings.sigma_px,
            sheet=projected.sheet,
            by_errors=np.concatenate(by_errors, axis=2)[:, 0],
            columns=np.stack(columns),
        )

    def select(self, rows: BoolArray | IntArray) -> Residuals:
        """Those that a mask or an index names."""
        return replace(
            self,
            px=self.px[rows],
            sigma_px=self.sigma_px[rows],
            sheet=self.sheet[rows],
            by_errors=self.by_errors[rows],
        )

    def by_sheet(self) -> Iterator[tuple[IntArray, IntArray]]:
        """Rows of each sheet that has some, and its columns."""
        for k, columns in enumerate(self.columns):
            rows = np.flatnonzero(self.sheet == k)
            if len(rows):
                yield rows, columns

    def explained(self, step: FloatArray) -> FloatArray:
        """(H,) what a step (P + 3,) of all parameters and the drift adds to the residuals."""
        return np.asarray(np.einsum("hq,hq->h", self.by_errors, step[self.columns][self.sheet]))

    def equations(
        self, weight: FloatArray, wanted: FloatArray, group: IntArray, n_groups: int
    ) -> tuple[FloatArray, FloatArray]:
        """Normal equations (G, Q + 3, Q + 3) and (G, Q + 3) of groups (H,) of one sheet each.

        ``weight``, ``wanted``: (H,).
        """
        q = self.by_errors.shape[1]
        matrix, vector = np.zeros((n_groups, q * q)), np.zeros((n_groups, q))
        rows = np.ascontiguousarray(self.by_errors)
        add_equations(rows, group.astype(np.int64), weight, wanted, matrix, vector)
        return matrix.reshape(-1, q, q), vector

    def joined_equations(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations of all parameters, (P + 3, P + 3) and (P + 3,), to undo the residuals.

        ``weight``: (H,).
        """
        n = int(self.columns.max()) + 1
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
        total = np.zeros(int(self.columns.max()) + 1)
        for rows, columns in self.by_sheet():
            total[columns] += weight[rows] @ self.by_errors[rows]
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
    residuals: Residuals, sensor: SensorCalibration, prior: EpipolarOffset
) -> EpipolarOffset:
    """Most likely errors of the calibration and drift, given the residuals of labelled samples.

    Robust (Huber's weights) and with the priors' covariance: few samples move little.

    Parameters
    ----------
    residuals
        (H,) of samples whose sheet is certain.
    sensor
        Cameras and sheets.
    prior
        From `no_offset`.
    """
    if not len(residuals.px):
        return prior
    equations = _Equations.of(residuals, prior)
    step, n = equations.step, len(sensor.covariance)
    offset_px, sigma_px, allowed_px = _mean_offset(equations, residuals, sensor)
    return EpipolarOffset(
        parameter_step=step[:n],
        drift=step[n:],
        factor=equations.factor(prior),
        offset_px=offset_px,
        sigma_px=sigma_px,
        allowed_px=allowed_px,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Weighted linear equations of the residuals in whitened errors, and their solution.

    ``sigma``, ``weight``: (H,) of the residuals. ``step``: (P + 3,) of the errors themselves.
    ``missed``: (H,) what it leaves. ``information``: (K, K) that of all equations with the prior's
    unit matrix. Points of a sheet depend on few parameters: the sums are taken over these.
    """

    sigma: FloatArray
    weight: FloatArray
    step: FloatArray
    missed: FloatArray
    information: FloatArray

    @staticmethod
    def of(
        residuals: Residuals, prior: EpipolarOffset, is_used: BoolArray | None = None
    ) -> _Equations:
        sigma = CORRELATION * np.hypot(residuals.sigma_px, FLOOR_PX)
        wanted = -residuals.px
        used = np.ones(len(wanted)) if is_used is None else is_used.astype(np.float64)
        weight = used
        matrix, vector = residuals.joined_equations(weight / sigma**2)
        information = prior.factor.T @ (matrix @ prior.factor)
        information += np.eye(len(information))
        right_side = vector @ prior.factor
        for k in range(ROUNDS):
            step = prior.factor @ np.linalg.solve(information, right_side)
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
            change = (next_weight - weight)[rows] / sigma[rows] ** 2
            information += (design * change[:, None]).T @ design
            right_side += (change * wanted[rows]) @ design
            weight = next_weight
        return _Equations(sigma, weight, step, missed, information)

    def factor(self, prior: EpipolarOffset) -> FloatArray:
        """(P + 3, K) factor of the covariance of all errors, the residuals being known."""
        lower = np.linalg.cholesky(self.information)
        return np.asarray(solve_triangular(lower, prior.factor.T, lower=True, check_finite=False).T)


def left_out_scores(
    residuals: Residuals, prior: EpipolarOffset, segment: IntArray, is_used: BoolArray
) -> FloatArray:
    """How badly each segment's residuals fit what all the others say of the offset.

    A stripe that lies on another sheet's right stripe by chance does so with an offset of its own,
    which the calibration's freedom would explain away were it asked about itself. With C the
    covariance of what a segment depends on, and A and b what it said itself, the others leave the
    covariance ``(I - C A)^-1 C``, and the step less that covariance times b.

    Parameters
    ----------
    residuals, prior
        (H,), and what is known without them, as for `estimate_offset`.
    segment
        (H,) number of the segment of stripe, counted from 0; each lies on one sheet.
    is_used
        (H,) False for segments that are asked but have no say.

    Returns
    -------
    FloatArray
        (B,) chi-square of mean, slope and bend of the segment's residuals, over their count.
    """
    equations = _Equations.of(residuals, prior, is_used)
    n = int(segment.max(initial=-1)) + 1
    order = np.argsort(segment, kind="stable")
    bounds = np.searchsorted(segment[order], np.arange(n + 1))
    sheet = np.zeros(n, dtype=np.int64)
    sheet[segment] = residuals.sheet
    columns = residuals.columns
    factor = equations.factor(prior)[columns]
    # in units of what was known before, which all are near 1
    unit = np.linalg.norm(prior.factor, axis=1)
    unit = np.where(unit > 0.0, unit, 1.0)[columns]
    factor /= unit[:, :, None]
    covariance = (factor @ factor.transpose(0, 2, 1))[sheet]
    weight, unit = equations.weight / equations.sigma**2, unit[sheet]
    said, missed = residuals.equations(weight, equations.missed, segment, n)
    shapes, asked = np.zeros((n, 3)), np.zeros((n, columns.shape[1], 4))
    noise = np.zeros((n, 3, 3))
    for b, (first, last) in enumerate(pairwise(bounds)):
        rows, moments = order[first:last], _moments(last - first)
        k = len(moments)
        shapes[b, :k] = moments @ equations.missed[rows]
        asked[b, :, :k] = (moments @ residuals.by_errors[rows]).T
        noise[b, :k, :k] = (moments * equations.sigma[rows] ** 2) @ moments.T
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
        rows = np.flatnonzero(count == k)
        own = shapes[rows, :k]
        solved = np.linalg.solve(noise[rows, :k, :k], own[:, :, None])[:, :, 0]
        scores[rows] = np.sum(own * solved, axis=1) / k
    return scores


@cache
def _moments(n: int) -> FloatArray:
    """(3, n), or fewer rows of few samples: what takes (n,) to their mean, slope and bend."""
    place = np.linspace(-1.0, 1.0, n)
    shape = np.stack([np.ones(n), place, place**2], axis=1)[:, : min(n, 3)]
    moments = np.asarray(np.linalg.pinv(shape))
    moments.setflags(write=False)
    return moments


def _mean_offset(
    equations: _Equations, residuals: Residuals, sensor: SensorCalibration
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
    step = np.concatenate([offset.parameter_step, offset.drift])
    explained, variance = np.zeros((2, len(residuals.px)))
    for rows, columns in residuals.by_sheet():
        by_errors, factor = residuals.by_errors[rows], offset.factor[columns]
        explained[rows] = by_errors @ step[columns]
        variance[rows] = np.sum((by_errors @ (factor @ factor.T)) * by_errors, axis=1)
    sigma = np.sqrt(residuals.sigma_px**2 + np.maximum(variance, 0.0) + FLOOR_PX**2)
    return residuals.px + explained, sigma
