# SPDX-License-Identifier: Apache-2.0
"""Why points on a plate do not lie in it: arm, flatness, sheets and stripe, as covariances.

The arm's pose errs by a shift of the scan point and a turn about it, alike for all points of a
posture, and by a smaller part that is new in every exposure. The plate is uneven by a smooth
random function of the place on it, so that postures which look at the same place see the same
error. The light sheets are not quite what their parameters describe, by another smooth function, of
the place on the sheet, the same in all postures. Only the stripe's own noise is independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import N_PLANE, PlacedNodes
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.fitting import Plane
from armscan.models.calibration import SHEET_PARAMETER_NAMES
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES
from armscan.models.scanner import ArmNoise

ROTATION_LEVER_MM = 265.0
"""Scatter of the scan point over scatter of the orientation: 0.0053 mm and 0.00115 degrees for an
arm of 0.02 mm repeatability. Stands in where the orientation's scatter is not given: on stripes
of some tens of mm it hardly shows."""
TYPICAL_ARM_MM = 0.006
TYPICAL_EXPOSURE_MM = 0.001
TYPICAL_FLATNESS_MM = 0.003
TYPICAL_SHEET_SHAPE_MM = 0.001
"""What plane and bow leave of the sheets of simulated heads, root mean square."""
SHEET_SHAPE_LENGTH_MM = 15.0
"""Half a calibrated region and less: what is longer, plane and bow take up."""
WIDE = 1.0
"""Standard deviation of the logarithm of a scatter about its typical value: a factor of 2.7."""
LEAST_STRIPE_MM = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class NoiseComponent:
    """One cause of scatter.

    Parameters
    ----------
    name
        ``arm``, ``arm rotation``, ``exposure``, ``exposure rotation``, ``flatness``,
        ``sheet shape`` or ``stripe``.
    covariance
        (N, N) of the residuals when ``sigma`` is 1.
    sigma
        Given, or typical where it is to be estimated.
    is_estimated
        True if the data decide.
    log_width
        Standard deviation of the logarithm of ``sigma`` before the data were seen.
    """

    name: str
    covariance: FloatArray
    sigma: float
    is_estimated: bool = False
    log_width: float = WIDE


def noise_components(
    nodes: PlateNodes, placed: PlacedNodes, plate: Plane, options: HandEyeOptions
) -> tuple[NoiseComponent, ...]:
    """Build the causes of scatter at the given placing.

    Parameters
    ----------
    nodes, placed, plate
        Nodes, where they lie, and the plate whose axes the flatness is a function of.
    options
        Standard deviations given, or None for those to be estimated.
    """
    lever = np.cross(placed.points_base_mm - placed.scan_points_base_mm, plate.normal)
    turned = lever @ lever.T
    same_posture = _same(nodes.posture)
    components = _pose_components(
        "arm",
        (same_posture, same_posture * turned),
        (options.arm_position_mm, options.arm_rotation_rad),
        TYPICAL_ARM_MM,
    )
    if has_exposure_part(nodes, options):
        same_stripe = _same(nodes.stripe)
        components += _pose_components(
            "exposure",
            (same_stripe, same_stripe * turned),
            (options.exposure_position_mm, options.exposure_rotation_rad),
            TYPICAL_EXPOSURE_MM,
        )
    on_plate = (placed.points_base_mm - plate.point_mm) @ plate.axes[:2].T
    alike = _alike(on_plate, options.flatness_length_mm)
    own = np.diag(stripe_variance_mm2(nodes, placed))
    return (
        *components,
        _component("flatness", alike, options.plate_flatness_mm, TYPICAL_FLATNESS_MM),
        *_sheet_shape(nodes, placed, options),
        _component("stripe", own, options.stripe_noise_factor, 1.0),
    )


def has_exposure_part(nodes: PlateNodes, options: HandEyeOptions) -> bool:
    """True if a part that is new in every exposure was given, or can be told from the posture's."""
    if options.exposure_position_mm is not None or options.exposure_rotation_rad is not None:
        return True
    is_repeated = len(np.unique(nodes.stripe)) > len(nodes.used_postures)
    return is_repeated and options.arm_position_mm is None


def stripe_variance_mm2(nodes: PlateNodes, placed: PlacedNodes) -> FloatArray:
    """(N,) variance of the residuals by the stripe's own noise: its part along the normal."""
    normals = placed.normals_sensor
    variance = np.einsum("ni,nij,nj->n", normals, nodes.noise_mm2, normals)
    return np.asarray(np.maximum(variance, LEAST_STRIPE_MM**2))


def _sheet_shape(
    nodes: PlateNodes, placed: PlacedNodes, options: HandEyeOptions
) -> tuple[NoiseComponent, ...]:
    """The sheets' own shape beyond their parameters; nothing where points came without a sheet.

    It moves a point as an offset of its sheet would that is a smooth function of the place on the
    sheet. Two stripes of one exposure share arm and plate: without this part, whatever their
    sheets' shapes set between them would count as a scatter of arm or plate.
    """
    offset = len(CAMERA_PARAMETER_NAMES) + SHEET_PARAMETER_NAMES.index("offset_mm")
    column = offset + len(SHEET_PARAMETER_NAMES) * nodes.sheet
    if nodes.by_sensor is None or not len(nodes) or column.max() >= nodes.by_sensor.shape[2]:
        return ()
    by_offset = nodes.by_sensor[np.arange(len(nodes)), :, column]
    moved = np.einsum("ni,ni->n", placed.normals_sensor, by_offset)
    alike = _same(nodes.sheet) * _alike(nodes.points_mm, SHEET_SHAPE_LENGTH_MM)
    covariance = alike * moved[:, None] * moved[None, :]
    return (_component("sheet shape", covariance, options.sheet_shape_mm, TYPICAL_SHEET_SHAPE_MM),)


def _same(labels: IntArray) -> FloatArray:
    return np.asarray(labels[:, None] == labels[None, :], dtype=np.float64)


def _alike(places_mm: FloatArray, length_mm: float) -> FloatArray:
    """Correlation (N, N) of a smooth error at (N, 2) or (N, 3) places: Matern's of order 5/2.

    Near zero it bends like ``exp(-d^2 / (2 length^2))``. A Gaussian supposes more smoothness than
    any plate or sheet has and, given too long a length, takes whatever else is smooth for exactly
    known.
    """
    apart = np.linalg.norm(places_mm[:, None] - places_mm[None, :], axis=2)
    scaled = apart * (np.sqrt(3.0) / length_mm)
    return np.asarray((1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled))


def _component(
    name: str, covariance: FloatArray, given: float | None, typical: float
) -> NoiseComponent:
    return NoiseComponent(name, covariance, typical if given is None else given, given is None)


def _pose_components(
    name: str,
    covariances: tuple[FloatArray, FloatArray],
    given: tuple[float | None, float | None],
    typical_mm: float,
) -> tuple[NoiseComponent, ...]:
    """Shift and turn of one pose; the turn follows the shift unless it is given."""
    position, rotation = given
    if rotation is None:
        tied = covariances[0] + covariances[1] / ROTATION_LEVER_MM**2
        return (_component(name, tied, position, typical_mm),)
    return (
        _component(name, covariances[0], position, typical_mm),
        NoiseComponent(f"{name} rotation", covariances[1], rotation),
    )


def plane_covariance(placed: PlacedNodes, prior: FloatArray) -> FloatArray:
    """(N, N) covariance of the residuals by the uncertainty (3, 3) of the probed plane."""
    return np.asarray(placed.by_plane @ prior.reshape(N_PLANE, N_PLANE) @ placed.by_plane.T)


def total_covariance(components: tuple[NoiseComponent, ...], sigmas: FloatArray) -> FloatArray:
    """Sum of all causes of scatter with the given standard deviations."""
    total = np.zeros_like(components[0].covariance)
    for component, sigma in zip(components, sigmas, strict=True):
        total += sigma**2 * component.covariance
    return total


def arm_noise(components: tuple[NoiseComponent, ...], sigmas: FloatArray) -> ArmNoise:
    """What the standard deviations say about the arm."""
    by_name = {
        component.name: float(sigma) for component, sigma in zip(components, sigmas, strict=True)
    }
    values = []
    for name in ("arm", "exposure"):
        position = by_name.get(name, 0.0)
        values += [position, by_name.get(f"{name} rotation", position / ROTATION_LEVER_MM)]
    return ArmNoise(*values)
