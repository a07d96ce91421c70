# SPDX-License-Identifier: Apache-2.0
"""The reference surface of a hand-eye calibration: a plate or a sphere.

The distance of placed points from it, with its derivatives, is all that tells one from the other;
the estimator is the same (`armscan.calibration.hand_eye.estimate`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from armscan.calibration.hand_eye.observations import (
    CondensedObservations,
    HandEyeOptions,
    PlateReference,
)
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.shapes import Plane
from armscan.models.calibration import HandEyeMethod

N_HAND_EYE = 6
OWN_CENTRE_STEPS = 3
NOISE_OVER_SHIFT = 0.01
"""Of a stripe on a sphere: its noise over what arm and sensor shift it by; a direction in which it
tells its own centre less well is left to the common one. Where the noise is the larger of both, the
distances are nearly linear anyway."""
LEVER_MM = 100.0
"""Turns are compared with shifts by what they move at this distance."""
RANK_RATIO = 1e-4
"""Singular values below this part of the largest are taken as zero: a posture that was meant to
repeat another still turns by a hundredth of a degree."""
NAMED_SHARE = 0.3
"""Parts of the weakest combination above this are named."""
LEAST_BENT = 5
"""Observations of a line of which a parabola leaves some for their errors."""


@dataclass(frozen=True, eq=False)
class PlateSurface:
    """A flat plate: two tilts (rad) and an offset (mm) from the probed plane.

    These are its K = 3 parameters, `armscan.geometry.shapes.PLANE_PARAMETERS`; ``start`` is what
    they are as given. A stripe is condensed to ``per_stripe`` observations.
    """

    reference: PlateReference
    method: HandEyeMethod = "plate"
    per_stripe: int = 12
    start: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def plane(self) -> Plane:
        """The probed plane."""
        return self.reference.plane

    def distance(
        self, points_mm: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signed distance (..., N) of points (..., N, 3) for parameters (..., K): eq. 2.74.

        With its gradient (..., N, 3) and its derivative (..., N, K) by the parameters.
        """
        local = (points_mm - self.plane.point_mm) @ self.plane.axes.T
        tilt_1, tilt_2, offset = (parameters[..., k, None] for k in range(3))
        scale = np.sqrt(1.0 + tilt_1**2 + tilt_2**2)
        height = (local[..., 2] - tilt_1 * local[..., 0] - tilt_2 * local[..., 1]) / scale
        by_parameters = -np.stack(
            [
                local[..., 0] / scale + height * tilt_1 / scale**2,
                local[..., 1] / scale + height * tilt_2 / scale**2,
                np.ones(height.shape),
            ],
            axis=-1,
        )
        raised = np.stack([-tilt_1, -tilt_2, np.ones_like(scale)], axis=-1) / scale[..., None]
        return (
            height - offset,
            np.broadcast_to(raised @ self.plane.axes, local.shape),
            by_parameters,
        )

    def distance_of_stripes(
        self, points_mm: FloatArray, parameters: FloatArray, stripe: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As `distance`, of points (N, 3) that belong to stripes (N,), one after another."""
        return self.distance(points_mm, parameters)

    def scan_points(
        self,
        observations: CondensedObservations,
        points_base_mm: FloatArray,
        tool_from_sensor: Pose[Tool, Sensor],
    ) -> FloatArray:
        """(N, 3) scan point of each placed point: the middle of the sensor's working range."""
        stripe = observations.of_points(observations.stripe)
        middle = tool_from_sensor.apply(observations.points_mm.mean(axis=0))
        return (observations.rotations @ middle + observations.translations_mm)[stripe]

    def free_parameters(self, options: HandEyeOptions) -> tuple[int, ...]:
        """Which of the parameters are solved along: all or none."""
        return (0, 1, 2) if options.solve_plate else ()

    def prior(self, options: HandEyeOptions) -> FloatArray | None:
        """(K, K) covariance of parameters that are held; None where they are exact or solved.

        Of probed ones that of the touches and of the tip.
        """
        return None if options.solve_plate else self.reference.covariance_with_tip

    def plane_at(self, parameters: FloatArray) -> Plane:
        """The plane of two tilts and an offset (3,)."""
        plane = self.plane
        raised = np.array([-parameters[0], -parameters[1], 1.0]) @ plane.axes
        normal = raised / np.linalg.norm(raised)
        across = np.cross(normal, plane.axes[0])
        across /= np.linalg.norm(across)
        axes = np.stack([np.cross(across, normal), across, normal])
        return Plane(plane.point_mm + parameters[2] * normal, axes)


@dataclass(frozen=True, eq=False)
class SphereSurface:
    """A sphere: centre in Base (mm) and radius (mm), K = 4, of which the centre is always solved.

    Its members are those of `PlateSurface`. Without ``has_own_centres`` distances are those from
    the common centre, as a sum of squares without a noise model takes them.
    """

    radius_mm: float
    has_own_centres: bool = True
    method: HandEyeMethod = "sphere"
    per_stripe: int = 24

    @property
    def start(self) -> FloatArray:
        """(4,) about the origin, of the radius given."""
        return np.array([0.0, 0.0, 0.0, self.radius_mm])

    def distance(
        self, points_mm: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As of `PlateSurface`, positive outside."""
        towards = points_mm - parameters[..., None, :3]
        length = np.linalg.norm(towards, axis=-1)
        normals = towards / np.maximum(length, 1e-12)[..., None]
        by_parameters = -np.concatenate([normals, np.ones((*length.shape, 1))], axis=-1)
        return length - parameters[..., 3, None], normals, by_parameters

    def distance_of_stripes(
        self, points_mm: FloatArray, parameters: FloatArray, stripe: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As of `PlateSurface`, linearised about the centre that each stripe itself asks for.

        An arm throws a stripe by many times its noise: by 0.6 mm on a ball of 20 mm radius the
        distances from the common centre are 0.01 mm from linear, which no cause of scatter
        explains. About the stripe's own centre they are linear in what the arm and the sensor shift
        it by. The derivatives are those for held own centres: under a covariance that holds the
        shifts they make the gradient of a least squares that has the shifts among its unknowns.
        """
        if not self.has_own_centres:
            return self.distance(points_mm, parameters)
        starts = np.flatnonzero(np.diff(stripe, prepend=-1))
        count = np.diff(starts, append=len(stripe))
        shift_mm: FloatArray = np.zeros((len(starts), 3))
        for _ in range(OWN_CENTRE_STEPS):
            residual, normals, _ = self._about(
                points_mm, parameters, shift_mm.repeat(count, axis=0)
            )
            pairs = normals[:, :, None] * normals[:, None, :]
            matrix = np.add.reduceat(pairs, starts)
            matrix += count[:, None, None] * (NOISE_OVER_SHIFT**2 * np.eye(3))
            right = np.add.reduceat(normals * residual[:, None], starts)
            shift_mm = np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0])
        return self._about(points_mm, parameters, shift_mm.repeat(count, axis=0))

    def _about(
        self, points_mm: FloatArray, parameters: FloatArray, shift_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`distance` of points (N, 3), linearised about a centre shifted by (N, 3) for each."""
        residual, normals, by_parameters = self.distance(points_mm - shift_mm, parameters)
        return residual + np.einsum("ni,ni->n", normals, shift_mm), normals, by_parameters

    def scan_points(
        self,
        observations: CondensedObservations,
        points_base_mm: FloatArray,
        tool_from_sensor: Pose[Tool, Sensor],
    ) -> FloatArray:
        """The middle of each posture's points."""
        posture = observations.of_points(observations.posture)
        sums = np.zeros((len(observations.postures), 3))
        np.add.at(sums, posture, points_base_mm)
        count = np.bincount(posture, minlength=len(sums))
        return np.asarray((sums / np.maximum(count, 1)[:, None])[posture])

    def free_parameters(self, options: HandEyeOptions) -> tuple[int, ...]:
        """The centre, and the radius if it is asked for."""
        return (0, 1, 2, 3) if options.solve_diameter else (0, 1, 2)

    def prior(self, options: HandEyeOptions) -> FloatArray | None:
        """None: the radius is exact where it is held."""
        return None


ReferenceSurface: TypeAlias = PlateSurface | SphereSurface
"""What the points should lie on; the estimator knows no difference but these members."""


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeState:
    """Unknowns: hand-eye, parameters (K,) of the surface, scale of the sensor's points.

    ``sensor`` (P,) is by what the sensor's parameters err; None where it stands as it is stored.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    surface: FloatArray
    scale: float = 1.0
    sensor: FloatArray | None = None

    def retract(self, step: FloatArray) -> HandEyeState:
        """The state after a step (6 + K + 1,): `Pose.retract`, surface, scale."""
        return replace(
            self,
            tool_from_sensor=self.tool_from_sensor.retract(step[:N_HAND_EYE]),
            surface=self.surface + step[N_HAND_EYE:-1],
            scale=self.scale + float(step[-1]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Condensed observations placed in Base, and what their distances depend on.

    Parameters
    ----------
    points_base_mm
        (N, 3) all points.
    dresidual_dpoint
        (N, 3) gradient of the points' distances in the Sensor frame.
    residual_mm
        (M,) distance of the observations from the surface, of the sensor as it is stored: what its
        error moves them by is taken back.
    by_sensor
        (M, P) its derivative by the sensor's parameters; None where the points do not carry it.
    moved_mm
        (M,) what the state's error of the sensor moves them by.
    jacobian
        (M, 6 + K + 1) its derivative by a step of `HandEyeState.retract`.
    dresidual_dpose
        (M, 9) its derivative by a shift of the arm's pose in Base, by its turn about the origin of
        Tool, and by its turn about `PlateSurface.scan_points`.
    """

    points_base_mm: FloatArray
    dresidual_dpoint: FloatArray
    residual_mm: FloatArray
    by_sensor: FloatArray | None
    moved_mm: FloatArray
    jacobian: FloatArray
    dresidual_dpose: FloatArray

    @property
    def by_surface(self) -> FloatArray:
        """(M, K) derivative of the residuals by the surface's parameters."""
        return np.asarray(self.jacobian[:, N_HAND_EYE:-1])


def place(
    observations: CondensedObservations, surface: ReferenceSurface, state: HandEyeState
) -> Placed:
    """Place the observations with a hand-eye (eq. 2.46) and compare them with the surface.

    All is linearised where the state's error of the sensor puts the points.
    """
    stripe = observations.of_points(observations.stripe)
    rotations = observations.rotations[stripe]
    hand_eye, points_mm = state.tool_from_sensor, observations.points_mm
    if state.sensor is not None and observations.dpoint_dsensor is not None:
        points_mm = points_mm + observations.dpoint_dsensor @ state.sensor
    turned = state.scale * points_mm @ hand_eye.rotation.T
    in_tool = turned + hand_eye.translation_mm
    base = np.einsum("nij,nj->ni", rotations, in_tool) + observations.translations_mm[stripe]
    residual, normals, by_surface = surface.distance_of_stripes(base, state.surface, stripe)
    in_tool_normals = np.einsum("nij,ni->nj", rotations, normals)
    by_scale = np.einsum("ni,ni->n", in_tool_normals, turned) / state.scale
    jacobian = np.column_stack(
        [np.cross(turned, in_tool_normals), in_tool_normals, by_surface, by_scale]
    )
    from_tool = base - observations.translations_mm[stripe]
    from_scan_point = base - surface.scan_points(observations, base, hand_eye)
    by_pose = np.column_stack(
        [normals, np.cross(from_tool, normals), np.cross(from_scan_point, normals)]
    )
    by_point = state.scale * in_tool_normals @ hand_eye.rotation
    residual_mm, by_sensor = observations.mean(residual), None
    moved_mm = np.zeros_like(residual_mm)
    if observations.dpoint_dsensor is not None:
        by_points = np.einsum("ni,nip->np", by_point, observations.dpoint_dsensor)
        by_sensor = observations.mean(by_points)
        if state.sensor is not None:
            moved_mm = by_sensor @ state.sensor
    return Placed(
        points_base_mm=base,
        dresidual_dpoint=by_point,
        residual_mm=residual_mm - moved_mm,
        by_sensor=by_sensor,
        moved_mm=moved_mm,
        jacobian=observations.mean(jacobian),
        dresidual_dpose=observations.mean(by_pose),
    )


def smooth_along_stripes(observations: CondensedObservations, values: FloatArray) -> FloatArray:
    """(M, F) values on a plate, each line's replaced by their parabola along it.

    Fewer than five by their straight line. Observations of a line stand side by side, the first at
    an end, as they are condensed.

    A distance's derivative holds the error of its point: with it, a large turn moves the points'
    errors out of the distances, as if the plate were the light sheet, in which all points lie
    whatever they err by. Along a line the derivatives of points without errors are smooth.
    """
    points = observations.points_mm
    lines = np.column_stack([observations.stripe, observations.sheet])
    is_first = np.ones(len(lines), dtype=np.bool_)
    is_first[1:] = (np.diff(lines, axis=0) != 0).any(axis=1)
    starts, line = np.flatnonzero(is_first), np.cumsum(is_first) - 1
    along = np.linalg.norm(points - points[starts][line], axis=1)
    along /= np.maximum(np.maximum.reduceat(along, starts), 1e-12)[line]
    is_bent = (np.diff(starts, append=len(along)) >= LEAST_BENT)[line]
    basis = np.column_stack([np.ones(len(along)), along, along**2 * is_bent])
    squares = np.add.reduceat(basis[:, :, None] * basis[:, None, :], starts)
    products = np.add.reduceat(basis[:, :, None] * values[:, None, :], starts)
    parabolas = np.linalg.pinv(squares, rcond=1e-10, hermitian=True) @ products
    return np.asarray(np.einsum("mi,mif->mf", basis, parabolas[line]))


def free_columns(surface: ReferenceSurface, options: HandEyeOptions) -> IntArray:
    """Which entries of a step are solved for."""
    last = N_HAND_EYE + len(surface.start)
    extra = [N_HAND_EYE + k for k in surface.free_parameters(options)]
    return np.array([*range(N_HAND_EYE), *extra, *[last] * options.solve_scale], dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Conditioning:
    """How well the hand-eye's six parameters are determined.

    Parameters
    ----------
    singular_values
        (6,) of the whitened system, largest first, in 1/mm: turns are scaled by what they move at
        100 mm (`LEVER_MM`).
    rank, condition
        Of that system; the condition is infinite below rank 6.
    weakest
        The combination of parameters that is known least, in words.
    """

    singular_values: FloatArray
    rank: int
    condition: float
    weakest: str

    def under(self, covariance: FloatArray) -> Conditioning:
        """With the least known combination by a covariance (6, 6) of the hand-eye.

        The system is whitened by the likeliest scatter and knows no sensor that errs; what is
        stated of a hand-eye is its covariance, and no parameter may be known worse than the worst
        combination.
        """
        scale = np.array([LEVER_MM] * 3 + [1.0] * 3)
        values, vectors = np.linalg.eigh(covariance * scale[:, None] * scale)
        sigma_mm = float(np.sqrt(max(values[-1], 0.0)))
        return replace(self, weakest=_weakest(vectors[:, -1], sigma_mm))


def conditioning_of(hand_eye: FloatArray, others: FloatArray) -> Conditioning:
    """From whitened derivatives (M, 6) by the hand-eye and (M, K) by unknowns to eliminate."""
    if others.shape[1]:
        basis, _ = np.linalg.qr(others)
        hand_eye = hand_eye - basis @ (basis.T @ hand_eye)
    scaled = hand_eye / np.array([LEVER_MM] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    rank = int((singular > RANK_RATIO * singular[0]).sum()) if singular[0] > 0.0 else 0
    is_full = rank == N_HAND_EYE
    condition = float(singular[0] / singular[-1]) if is_full else float("inf")
    sigma_mm = 1.0 / float(singular[-1]) if is_full else float("inf")
    return Conditioning(
        singular_values=singular,
        rank=rank,
        condition=condition,
        weakest=_weakest(vectors[:, 0], sigma_mm),
    )


def _weakest(direction: FloatArray, sigma_mm: float) -> str:
    names = [f"turning about tool {axis}" for axis in "xyz"]
    names += [f"shifting along tool {axis}" for axis in "xyz"]
    order = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) >= NAMED_SHARE]
    parts = [f"{names[k]} ({abs(direction[k]):.2f})" for k in order]
    known = "not determined" if not np.isfinite(sigma_mm) else f"known to {sigma_mm:.3g} mm"
    return f"{' with '.join(parts)}: {known}, turns counted at {LEVER_MM:.0f} mm"
