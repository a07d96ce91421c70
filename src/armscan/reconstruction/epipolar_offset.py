# SPDX-License-Identifier: Apache-2.0
"""How far the right camera has drifted since its calibration, from the stripes themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.stereo_residuals import Crossings, Projections
from armscan.reconstruction.triangulate import sensor_columns

ROUNDS = 4
HUBER_SIGMAS = 2.0
CORRELATION = 3.0
"""Samples along a stripe err together: their sigma counts as this much larger."""
SLOPE_SHARE = 0.5
"""Drift from the image's middle to its rim, as a part of the drift in the middle."""
HALF_IMAGE = 0.5
CERTAIN_SIGMAS = 3.0
LEAST_SHARE = 0.05
"""A stripe along the epipolar line says nothing about the offset across it."""
LEAST_OFFSET_PX = 0.1
"""Offsets below this change no name and hardly a point: no warning."""


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
    n_samples
        Samples used.
    """

    parameter_step: FloatArray
    drift: FloatArray
    factor: FloatArray
    offset_px: float
    sigma_px: float
    allowed_px: float
    n_samples: int

    @property
    def is_beyond_calibration(self) -> bool:
        """True if the calibration's covariance does not explain the offset."""
        limit = CERTAIN_SIGMAS * float(np.hypot(self.allowed_px, self.sigma_px))
        return abs(self.offset_px) > max(limit, LEAST_OFFSET_PX)


def drift_directions(projected: Projections, sensor: SensorCalibration) -> FloatArray:
    """(H, 2, 3) how the drift's three numbers move the right picture of each point.

    The move is across the epipolar line, which is where the point's picture goes with its depth.
    """
    along = np.einsum("nij,nj->ni", projected.q_by_point, projected.points_mm)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    across *= np.where(across[:, 1] < 0.0, -1.0, 1.0)[:, None]
    second = sensor.second
    camera = sensor.camera.camera if second is None else second.camera.camera
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    place = (projected.q_px - 0.5 * size) / (HALF_IMAGE * size)
    basis = np.concatenate([np.ones((len(place), 1)), place], axis=1)
    return np.asarray(across[:, :, None] * basis[:, None, :])


def residual_derivatives(
    projected: Projections, crossings: Crossings, sensor: SensorCalibration
) -> FloatArray:
    """(H, P + 3) of the residuals by steps of the parameters and of the right picture.

    The true steps take the residuals to zero: what the calibration's errors made is undone by
    adding them to its parameters, what a drift made by shifting the projected points with it.
    """
    by_own = np.einsum("ni,nij->nj", crossings.normal, projected.q_by_sensor())
    n = len(projected.sheet)
    result = np.zeros((n, len(sensor.covariance) + 3))
    columns = np.stack([sensor_columns(sensor, k) for k in range(len(sensor.sheets))])
    result[np.arange(n)[:, None], columns[projected.sheet]] = by_own
    drift = drift_directions(projected, sensor)
    result[:, -3:] = np.einsum("ni,nij->nj", crossings.normal, drift)
    return result


def prior_factor(sensor: SensorCalibration, drift_px: float) -> FloatArray:
    """(P + 3, K) with ``F F'`` the covariance of the calibration and of the drift, before data."""
    n = len(sensor.covariance)
    scale = np.sqrt(np.maximum(np.diag(sensor.covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(sensor.covariance / np.outer(unit, unit))
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    factor = np.zeros((n + 3, int(kept.sum()) + 3))
    factor[:n, :-3] = unit[:, None] * vectors[:, kept] * np.sqrt(values[kept])
    factor[n:, -3:] = np.diag([drift_px, SLOPE_SHARE * drift_px, SLOPE_SHARE * drift_px])
    return factor


def no_offset(sensor: SensorCalibration, drift_px: float) -> EpipolarOffset:
    """What is known before any data: nothing has moved, as far as the priors say."""
    n = len(sensor.covariance)
    prior = prior_factor(sensor, drift_px)
    return EpipolarOffset(np.zeros(n), np.zeros(3), prior, 0.0, drift_px, 0.0, 0)


def estimate_offset(
    projected: Projections,
    crossings: Crossings,
    sensor: SensorCalibration,
    prior: EpipolarOffset,
    floor_px: float,
) -> EpipolarOffset:
    """Most likely errors of the calibration and drift, given the residuals of named samples.

    Robust (Huber's weights) and with the priors' covariance: few samples move little.

    Parameters
    ----------
    projected, crossings
        (H,) of samples whose sheet is certain.
    sensor
        Cameras and sheets.
    prior
        From `no_offset`.
    floor_px
        Noise of a residual beside that of the stripes.
    """
    if not len(projected.sheet):
        return prior
    equations = _Equations.of(projected, crossings, sensor, prior, floor_px=floor_px)
    information = equations.information()
    step = prior.factor @ equations.state
    n = len(sensor.covariance)
    return EpipolarOffset(
        step[:n],
        step[n:],
        prior.factor @ np.linalg.cholesky(np.linalg.inv(information)),
        *_mean_offset(equations, crossings, sensor),
        len(projected.sheet),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Weighted linear equations of the residuals in whitened errors, and their solution.

    ``by_all`` (H, P + 3) and ``design`` (H, K) are derivatives by the errors and by the whitened
    errors, ``wanted`` (H,) what undoes the residuals.
    """

    by_all: FloatArray
    design: FloatArray
    wanted: FloatArray
    sigma: FloatArray
    weight: FloatArray
    state: FloatArray

    @staticmethod
    def of(
        projected: Projections,
        crossings: Crossings,
        sensor: SensorCalibration,
        prior: EpipolarOffset,
        *,
        floor_px: float,
        is_used: BoolArray | None = None,
    ) -> _Equations:
        by_all = residual_derivatives(projected, crossings, sensor)
        design = by_all @ prior.factor
        sigma = CORRELATION * np.hypot(crossings.sigma_px, floor_px)
        wanted = -crossings.residual_px
        used = np.ones(len(wanted)) if is_used is None else is_used.astype(np.float64)
        weight = used
        state: FloatArray = np.zeros(design.shape[1])
        for _ in range(ROUNDS):
            found = _Equations(by_all, design, wanted, sigma, weight, state)
            state = np.asarray(np.linalg.solve(found.information(), found.right_side()))
            score = np.abs(wanted - design @ state) / sigma * CORRELATION
            weight = used * np.minimum(1.0, HUBER_SIGMAS / np.maximum(score, 1e-9))
        return _Equations(by_all, design, wanted, sigma, found.weight, state)

    def information(self) -> FloatArray:
        """(K, K) with the prior's unit matrix."""
        scaled = self.design * (self.weight / self.sigma**2)[:, None]
        return np.asarray(self.design.T @ scaled + np.eye(self.design.shape[1]))

    def right_side(self) -> FloatArray:
        """(K,)."""
        return np.asarray(self.design.T @ (self.wanted * self.weight / self.sigma**2))


def left_out_scores(
    projected: Projections,
    crossings: Crossings,
    stretch: IntArray,
    is_used: BoolArray,
    sensor: SensorCalibration,
    *,
    prior: EpipolarOffset,
    floor_px: float,
) -> FloatArray:
    """How badly each stretch's residuals fit what all the others say of the offset.

    A stripe that lies on another sheet's right stripe by chance does so with an offset of its own,
    which the calibration's freedom would explain away were it asked about itself.

    Parameters
    ----------
    projected, crossings
        (H,) as for `estimate_offset`.
    stretch
        (H,) number of the stretch of stripe, counted from 0.
    is_used
        (H,) False for stretches that are asked but have no say.
    sensor, prior, floor_px
        As for `estimate_offset`.

    Returns
    -------
    FloatArray
        (B,) chi-square of mean, slope and bend of the stretch's residuals, over their count.
    """
    equations = _Equations.of(
        projected, crossings, sensor, prior, floor_px=floor_px, is_used=is_used
    )
    information, right_side = equations.information(), equations.right_side()
    n_stretches = int(stretch.max()) + 1 if len(stretch) else 0
    scores = np.zeros(n_stretches)
    for b in range(n_stretches):
        own = np.flatnonzero(stretch == b)
        if not len(own):
            continue
        design, sigma = equations.design[own], equations.sigma[own]
        scaled = design * (equations.weight[own] / sigma**2)[:, None]
        others = information - design.T @ scaled
        state = np.linalg.solve(others, right_side - scaled.T @ equations.wanted[own])
        place = np.linspace(-1.0, 1.0, len(own))
        shape = np.stack([np.ones(len(own)), place, place**2], axis=1)[:, : min(len(own), 3)]
        moments = np.linalg.pinv(shape)
        gain = moments @ design
        missed = moments @ equations.wanted[own] - gain @ state
        spread = gain @ np.linalg.solve(others, gain.T) + (moments * sigma**2) @ moments.T
        spread[0, 0] += floor_px**2
        scores[b] = float(missed @ np.linalg.solve(spread, missed)) / len(missed)
    return scores


def _mean_offset(
    equations: _Equations, crossings: Crossings, sensor: SensorCalibration
) -> tuple[float, float, float]:
    """Weighted mean of the residuals across the epipolar lines, its sigma, and that allowed."""
    unit = equations.by_all[:, -3]
    weight = equations.weight / equations.sigma**2
    share = np.where(np.abs(unit) > LEAST_SHARE, unit, 0.0) * weight
    total = float(share @ unit)
    if total <= 0.0:
        return 0.0, float(np.inf), 0.0
    share = share / total
    by_parameters = share @ equations.by_all[:, :-3]
    allowed = float(by_parameters @ sensor.covariance @ by_parameters)
    mean = -float(share @ crossings.residual_px)
    return mean, float(np.sqrt(1.0 / total)), float(np.sqrt(max(allowed, 0.0)))


def predicted_residuals(
    projected: Projections, crossings: Crossings, sensor: SensorCalibration, offset: EpipolarOffset
) -> tuple[FloatArray, FloatArray]:
    """Residual (H,) that calibration errors and drift explain, and its standard deviation (H,)."""
    by_all = residual_derivatives(projected, crossings, sensor)
    step = np.concatenate([offset.parameter_step, offset.drift])
    spread = by_all @ offset.factor
    return -(by_all @ step), np.sqrt(np.sum(spread**2, axis=1))
