# SPDX-License-Identifier: Apache-2.0
"""The refinement: generalised least squares in turn with the estimate of the scatter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import solve_triangular

from armscan.calibration.hand_eye.least_squares import (
    LinearSolution,
    Refined,
    design,
    refine,
    solve_linear,
)
from armscan.calibration.hand_eye.noise_model import (
    NoiseComponent,
    noise_components,
    plane_covariance,
    total_covariance,
)
from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import (
    N_HAND_EYE,
    PlacedNodes,
    PlateState,
    place_nodes,
    sensor_covariance,
)
from armscan.calibration.hand_eye.variance_components import (
    NoiseEstimate,
    covariance_over_noise,
    estimate_noise,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

MAX_ROUNDS = 4
SETTLED_LOG = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class PlateFit:
    """A refined hand-eye with its noise model.

    Parameters
    ----------
    refined
        Minimum; its plane is the probed one unless it was solved along.
    slopes
        (N, K) derivative of the residuals, K = 6 or 9.
    components, noise
        Causes of scatter and their standard deviations.
    total
        (N, N) covariance of the residuals, by the probed plane and, unless it is held
        (`hold_sensor`), by the sensor too.
    linear
        Solution linearised at the minimum.
    covariance
        (K, K) of the parameters, estimated scatter not taken as known, without the sensor's part.
    """

    refined: Refined
    slopes: FloatArray
    components: tuple[NoiseComponent, ...]
    noise: NoiseEstimate
    total: FloatArray
    linear: LinearSolution
    covariance: FloatArray

    @property
    def degrees_of_freedom(self) -> int:
        """Residuals less unknowns."""
        n_residuals, n_unknowns = self.slopes.shape
        return int(n_residuals - n_unknowns)


def fit_plate(
    nodes: PlateNodes,
    plate: PlateReference,
    start: PlateState,
    options: HandEyeOptions,
    sigmas: FloatArray | None = None,
    *,
    hold_noise: bool = False,
) -> PlateFit | FitFailure:
    """Refine a hand-eye.

    Parameters
    ----------
    nodes, plate
        Data and reference.
    start
        Close to the solution.
    options
        Noise model, and whether the plate is solved along.
    sigmas
        Standard deviations to begin with; typical ones if None.
    hold_noise
        Keep these standard deviations.
    """
    state = start
    placed = place_nodes(nodes, plate.plane, state)
    components = noise_components(nodes, placed, plate.plane, options)
    if sigmas is None:
        sigmas = np.array([component.sigma for component in components])
    for _ in range(MAX_ROUNDS):
        placed = place_nodes(nodes, plate.plane, state)
        components = noise_components(nodes, placed, plate.plane, options)
        fixed = known_covariance(nodes, placed, plate, options)
        total = total_covariance(components, sigmas) + fixed
        try:
            refined = refine(nodes, plate.plane, state, total, solve_plate=options.solve_plate)
        except LinAlgError:
            return _no_solution()
        slopes = design(refined.placed, options.solve_plate)
        noise = NoiseEstimate(sigmas, np.zeros((len(sigmas), len(sigmas))))
        if not hold_noise:
            noise = estimate_noise(refined.placed.residual_mm, slopes, components, fixed, sigmas)
        change = np.log((noise.sigmas + 1e-12) / (sigmas + 1e-12))
        state, sigmas = refined.state, noise.sigmas
        if float(np.abs(change).max()) < SETTLED_LOG:
            break
    total = total_covariance(components, sigmas) + fixed
    refined = refine(nodes, plate.plane, state, total, solve_plate=options.solve_plate)
    slopes, residual = design(refined.placed, options.solve_plate), refined.placed.residual_mm
    linear = solve_linear(residual, slopes, total)
    if linear is None:
        return _no_solution()
    covariance = covariance_over_noise(residual, slopes, components, fixed, noise)
    by_sensor = sensor_covariance(nodes, placed)
    if by_sensor is not None:
        covariance -= linear.gain @ by_sensor @ linear.gain.T
    return PlateFit(refined, slopes, components, noise, total, linear, covariance)


def known_covariance(
    nodes: PlateNodes, placed: PlacedNodes, plate: PlateReference, options: HandEyeOptions
) -> FloatArray:
    """(N, N) covariance of the residuals by the probed plane and by the sensor's calibration.

    Both err alike in all postures. The plane is left out where it is solved along or exact.
    """
    by_plane = _covariance_by_plane(placed, plate, options)
    by_sensor = sensor_covariance(nodes, placed)
    return by_plane if by_sensor is None else by_plane + by_sensor


def _covariance_by_plane(
    placed: PlacedNodes, plate: PlateReference, options: HandEyeOptions
) -> FloatArray:
    if options.solve_plate or plate.covariance is None:
        return np.zeros((len(placed.residual_mm), len(placed.residual_mm)))
    return plane_covariance(placed, plate.covariance)


def hold_sensor(
    nodes: PlateNodes, plate: PlateReference, fit: PlateFit, options: HandEyeOptions
) -> PlateFit | FitFailure:
    """The hand-eye that belongs to the sensor as it is stored, under the scatter of ``fit``.

    A fit that knows the sensor's covariance explains a part of the residuals by a sensor that is
    moved within it: its hand-eye is that of the moved sensor, and beside the stored one it makes
    wrong points. Here the sensor stands still and the hand-eye takes up what it can of the
    sensor's errors. Its ``total`` and ``covariance`` are without the sensor's part.
    """
    placed = fit.refined.placed
    by_sensor = sensor_covariance(nodes, placed)
    if by_sensor is None:
        return fit
    by_plane = _covariance_by_plane(placed, plate, options)
    total = total_covariance(fit.components, fit.noise.sigmas) + by_plane
    try:
        refined = refine(
            nodes, plate.plane, fit.refined.state, total, solve_plate=options.solve_plate
        )
    except LinAlgError:
        return _no_solution()
    slopes = design(refined.placed, options.solve_plate)
    linear = solve_linear(refined.placed.residual_mm, slopes, total)
    if linear is None:
        return _no_solution()
    # What the sensor's errors leave in the residuals is the coupling's part, not the scatter's.
    own = placed.residual_mm - by_sensor @ fit.linear.projected @ placed.residual_mm
    covariance = covariance_over_noise(own, slopes, fit.components, by_plane, fit.noise)
    return replace(
        fit, refined=refined, slopes=slopes, total=total, linear=linear, covariance=covariance
    )


def plane_after(fit: PlateFit, plate: PlateReference) -> FloatArray:
    """(3,) tilts and offset of the plate as the scan and the probing together give them."""
    if len(fit.linear.step) > N_HAND_EYE or plate.covariance is None:
        return fit.refined.state.plane
    explained = fit.linear.projected @ fit.refined.placed.residual_mm
    return np.asarray(-plate.covariance @ fit.refined.placed.by_plane.T @ explained)


def hand_eye_information(slopes: FloatArray, total: FloatArray) -> FloatArray:
    """(6, 6) inverse covariance of the hand-eye, a free plane eliminated; any rank.

    Raises
    ------
    LinAlgError
        If the covariance ``total`` is not positive definite.
    """
    whitened = solve_triangular(np.linalg.cholesky(total), slopes, lower=True)
    hand_eye, others = whitened[:, :N_HAND_EYE], whitened[:, N_HAND_EYE:]
    if others.shape[1]:
        basis, _ = np.linalg.qr(others)
        hand_eye = hand_eye - basis @ (basis.T @ hand_eye)
    return np.asarray(hand_eye.T @ hand_eye)


def _no_solution() -> FitFailure:
    return FitFailure(
        "the refinement found no minimum: the noise model or the data are degenerate",
        "check the standard deviations given, and the poses",
    )
