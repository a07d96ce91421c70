# SPDX-License-Identifier: Apache-2.0
"""The Cramer-Rao bound of the hand-eye for the errors that `plate_rig` draws, and plain squares."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.noise import NoiseComponent
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.geometry.arrays import FloatArray
from rigs.plate_rig import (
    PLATE_CENTRE,
    PLATE_NORMAL,
    TOOL_FROM_SENSOR,
    PlateRig,
    Surface,
    draw_waves,
)

N_WAVES = 1500
EVERY = 6
"""Every so-manieth point of a stripe enters the bound, with its noise lowered accordingly."""


def cramer_rao(rig: PlateRig) -> FloatArray:
    """(6, 6) smallest covariance of the hand-eye, given the scan and the touches of the plate.

    The unknowns are the hand-eye and the plate's plane; the observations are the heights of the
    touched points and of the stripes' points, with the covariance that the rig draws from.
    """
    flat = Surface(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1))
    noise, touched = rig.noise, rig.probed_places
    rows = [np.column_stack([np.zeros((len(touched), 6)), _by_plane(touched)])]
    places, owner, levers, own = [touched], [np.full(len(touched), -1)], [], []
    for k in range(len(rig.postures)):
        points, _ = rig.stripe(k, flat)
        points = points[EVERY // 2 :: EVERY]
        rotation, origin = rig.sensor_pose(k)
        placed = points @ rotation.T + origin
        place = (placed - PLATE_CENTRE) @ rig.plate_axes[:2].T
        normal = rig.tool_from_sensor.rotation @ (rotation.T @ PLATE_NORMAL)
        turned = np.cross(points @ rig.tool_from_sensor.rotation.T, normal)
        hand_eye = np.column_stack([turned, np.tile(normal, (len(points), 1))])
        rows.append(np.column_stack([hand_eye, _by_plane(place)]))
        places.append(place)
        owner.append(np.full(len(points), k))
        in_sensor = rig.tool_from_sensor.inverse().apply(rig.turns_about_mm)
        levers.append(np.cross(placed - origin - rotation @ in_sensor, PLATE_NORMAL))
        own.append(np.full(len(points), _along_normal(rig, k) * noise.stripe_mm))
    owned, design = np.concatenate(owner), np.concatenate(rows)
    lever = np.concatenate([np.zeros((len(touched), 3)), *levers])
    repeats = rig.exposures_per_posture
    shift = noise.posture_mm**2 + noise.exposure_mm**2 / repeats
    turn = noise.posture_rad**2 + noise.exposure_rad**2 / repeats
    same = (owned[:, None] == owned[None, :]) & (owned[:, None] >= 0)
    covariance = _flatness(np.concatenate(places), noise.flatness_mm)
    covariance += same * (shift + turn * (lever @ lever.T))
    white = np.concatenate([np.full(len(touched), noise.probing_mm), *own])
    white[len(touched) :] /= np.sqrt(EVERY * repeats)
    covariance += np.diag(white**2)
    return np.asarray(np.linalg.inv(design.T @ np.linalg.solve(covariance, design))[:6, :6])


def plain_least_squares(
    stripes: Sequence[PosedStripe], plate: PlateReference
) -> tuple[FloatArray, FloatArray]:
    """Minimum of eq. 2.76 by SciPy: its (6,) error and the (6, 6) covariance it would state."""
    truth = TOOL_FROM_SENSOR
    turned = np.concatenate([s.points_mm @ truth.rotation.T for s in stripes])
    count = [len(s) for s in stripes]
    rotations = np.array([s.base_from_tool.rotation for s in stripes])
    normals = np.repeat(rotations.transpose(0, 2, 1) @ plate.plane.normal, count, axis=0)
    heights = [plate.plane.distance_mm(s.base_from_tool.translation_mm[None])[0] for s in stripes]
    height = np.repeat(heights, count)

    def residuals(x: FloatArray) -> FloatArray:
        moved = turned @ Rotation.from_rotvec(x[:3]).as_matrix().T + truth.translation_mm + x[3:]
        return np.asarray(np.einsum("ni,ni->n", moved, normals) + height)

    def slopes(x: FloatArray) -> FloatArray:
        return np.concatenate([np.cross(turned, normals), normals], axis=1)

    scale = np.array([1e-2] * 3 + [1.0] * 3)
    found = least_squares(residuals, np.zeros(6), jac=slopes, x_scale=scale, method="lm")
    variance = 2.0 * found.cost / (len(found.fun) - 6)
    return np.asarray(found.x), np.asarray(variance * np.linalg.inv(found.jac.T @ found.jac))


def _by_plane(places: FloatArray) -> FloatArray:
    return np.column_stack([places, np.ones(len(places))])


def _along_normal(rig: PlateRig, k: int) -> float:
    flat = Surface(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1))
    rotation, _ = rig.sensor_pose(k)
    _, across = rig.stripe(k, flat)
    return float(abs(PLATE_NORMAL @ rotation @ across))


def _flatness(places: FloatArray, sigma_mm: float) -> FloatArray:
    """(N, N) covariance of the surface's height over all surfaces that may be drawn."""
    waves = draw_waves(np.random.default_rng(12345), N_WAVES)
    angle = places @ waves.T
    features = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(sigma_mm**2 / N_WAVES * features @ features.T)


def scored_densely(
    residual: FloatArray,
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    known: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Fisher scoring of the restricted likelihood by full matrices: sigmas, covariance of logs.

    Every component is estimated; none follows another.
    """
    typical = np.array([one.sigma for one in components])
    precision = np.diag([one.log_width**-2.0 for one in components])
    logs = np.zeros(len(components))
    for _ in range(30):
        scatter = [
            (s * np.exp(x)) ** 2 * one.covariance
            for s, x, one in zip(typical, logs, components, strict=True)
        ]
        inverse = np.linalg.inv(known + sum(scatter))
        normal = slopes.T @ inverse @ slopes
        projected = inverse - inverse @ slopes @ np.linalg.solve(normal, slopes.T @ inverse)
        explained, products = projected @ residual, [projected @ v for v in scatter]
        score = np.array([explained @ v @ explained for v in scatter])
        score -= [np.trace(product) for product in products]
        information = 2.0 * np.array([[(p * q.T).sum() for q in products] for p in products])
        information += precision
        step = np.linalg.solve(information, score - precision @ logs)
        step *= min(1.0, 1.0 / np.abs(step).max())
        logs = logs + step
        if np.abs(step).max() < 1e-3:
            break
    return np.asarray(typical * np.exp(logs)), np.asarray(np.linalg.inv(information))
