# SPDX-License-Identifier: Apache-2.0
"""Points of exposures in Base with covariance and normals: placed, joined, cut to a volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import (
    Box,
    FloatArray,
    IntArray,
)
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.rotations import skew
from armscan.models.calibration import ArmNoise, ScannerCalibration
from armscan.reconstruction.triangulate import StripePoints, noise_size_mm, sensor_columns
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile


@dataclass(frozen=True, slots=True, eq=False)
class BaseJacobian:
    """Points in Base with the derivatives that their covariance needs.

    Parameters
    ----------
    points_base_mm
        (N, 3).
    by_sensor_point
        (3, 3) by the point in the Sensor frame: one rotation for all points.
    by_hand_eye
        (N, 3, 6) by `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`.
    """

    points_base_mm: FloatArray
    by_sensor_point: FloatArray
    by_hand_eye: FloatArray


def place_with_jacobian(
    points_sensor_mm: FloatArray,
    base_from_tool: Pose[Base, Tool],
    tool_from_sensor: Pose[Tool, Sensor],
) -> BaseJacobian:
    """Map (N, 3) points from Sensor to Base and differentiate (eq. 2.53)."""
    turned = points_sensor_mm @ tool_from_sensor.rotation.T
    in_tool = turned + tool_from_sensor.translation_mm
    by_hand_eye = np.concatenate(
        [-skew(turned), np.broadcast_to(np.eye(3), (len(turned), 3, 3))], axis=2
    )
    return BaseJacobian(
        in_tool @ base_from_tool.rotation.T + base_from_tool.translation_mm,
        base_from_tool.rotation @ tool_from_sensor.rotation,
        base_from_tool.rotation @ by_hand_eye,
    )


def scan_point_mm(scanner: ScannerCalibration) -> FloatArray | None:
    """(3,) middle of the working range in Sensor, about which the arm's noise is given.

    The mean of the light sheets' origins; None for a sensor that delivers points itself.
    """
    if scanner.sensor is None:
        return None
    return np.asarray(np.mean([s.sheet.origin_mm for s in scanner.sensor.sheets], axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class BaseTransform:
    """What placing needs of a scanner, computed once for all exposures.

    Parameters
    ----------
    scanner
        The calibration.
    factors
        One (Q + 6, K) matrix F a sheet with ``F F'`` the joint covariance of what its points
        depend on (`sensor_columns`) and of the hand-eye; (6, K) where the sensor delivers points.
    scan_point_mm
        (3,) in Sensor; None to take the mean of each exposure's points.
    """

    scanner: ScannerCalibration
    factors: tuple[FloatArray, ...]
    scan_point_mm: FloatArray | None


def prepare_placing(scanner: ScannerCalibration) -> BaseTransform:
    """Factor the scanner's joint covariance sheet by sheet.

    Raises
    ------
    InputError
        If the covariance is not positive semi-definite.
    """
    joint = scanner.covariance
    if scanner.sensor is None:
        return BaseTransform(scanner, (_factor(joint),), None)
    n = len(scanner.sensor.parameter_names)
    hand_eye = np.arange(n, n + 6)
    factors = []
    for k in range(len(scanner.sensor.sheets)):
        places = np.concatenate([sensor_columns(scanner.sensor, k), hand_eye])
        factors.append(_factor(joint[np.ix_(places, places)]))
    return BaseTransform(scanner, tuple(factors), scan_point_mm(scanner))


def _factor(covariance: FloatArray) -> FloatArray:
    """F with F F' = covariance, in units that make its diagonal one, so that none is lost."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    if len(values) and float(values[0]) < -1e-6 * max(float(values[-1]), 1.0):
        raise InputError(
            "the scanner's covariance is not positive semi-definite",
            remedy="calibrate again: the document was changed or is damaged",
        )
    kept = values > 1e-15 * max(float(values[-1]), 0.0)
    return np.asarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def propagate_to_base(
    stripe: StripePoints, profile: Profile, base_from_tool: Pose[Base, Tool], placing: BaseTransform
) -> PointCloud:
    """Place the points of one exposure in Base.

    Parameters
    ----------
    stripe
        Points in Sensor with what their errors come from.
    profile
        The stripe points that they were triangulated from.
    base_from_tool
        The arm's pose at that exposure.
    placing
        Of the scanner whose sensor triangulated the points.

    Returns
    -------
    PointCloud
        In Base. The covariance holds the stripe's noise, that of sensor and hand-eye together
        (an error of the sensor that the hand-eye follows largely cancels), and the arm's: the
        part common to a posture and the part new in every exposure.

    Raises
    ------
    InputError
        If the scanner has no sensor.
    """
    scanner = placing.scanner
    if scanner.sensor is None:
        raise InputError("this scanner has no camera", remedy="place its profiles instead")
    placed = place_with_jacobian(
        stripe.points_mm, base_from_tool, scanner.hand_eye.tool_from_sensor
    )
    by_sensor = placed.by_sensor_point @ stripe.by_sensor
    by_all = np.concatenate([by_sensor, placed.by_hand_eye], axis=2)
    covariance = np.zeros((len(stripe.row), 3, 3))
    for k, factor in enumerate(placing.factors):
        own = np.flatnonzero(stripe.sheet == k)
        covariance[own] = _propagated(by_all[own], factor)
    covariance += _pose_and_noise(placed, stripe.noise_mm, base_from_tool, placing)
    return PointCloud(
        frame="Base",
        points_mm=placed.points_base_mm,
        covariance_mm2=0.5 * (covariance + covariance.transpose(0, 2, 1)),
        sigma_noise_mm=noise_size_mm(stripe.noise_mm),
        sheet=stripe.sheet,
        sheet_names=tuple(sheet.name for sheet in scanner.sensor.sheets),
        exposure=np.zeros(len(stripe.row), dtype=np.int64),
        exposure_sources=(profile.source,),
        segment=profile.segment[stripe.row],
        intensity=profile.intensity[stripe.row],
    )


def place_delivered_points(
    points_sensor_mm: FloatArray,
    noise_mm: FloatArray,
    base_from_tool: Pose[Base, Tool],
    placing: BaseTransform,
) -> tuple[FloatArray, FloatArray]:
    """Place points that the sensor itself delivered.

    Parameters
    ----------
    points_sensor_mm
        (N, 3).
    noise_mm
        (N, 3, J) one standard deviation of each of a point's own noises, as the vector in which it
        acts.
    base_from_tool, placing
        As for `propagate_to_base`.

    Returns
    -------
    points_base_mm, covariance_mm2
        (N, 3) and (N, 3, 3).

    Raises
    ------
    InputError
        If the scanner has a camera: its points depend on the camera's parameters too.
    """
    if placing.scanner.sensor is not None:
        raise InputError("this scanner has a camera", remedy="place its stripes instead")
    placed = place_with_jacobian(
        points_sensor_mm, base_from_tool, placing.scanner.hand_eye.tool_from_sensor
    )
    covariance = _propagated(placed.by_hand_eye, placing.factors[0])
    covariance += _pose_and_noise(placed, noise_mm, base_from_tool, placing)
    return placed.points_base_mm, 0.5 * (covariance + covariance.transpose(0, 2, 1))


def arm_covariance(
    points_base_mm: FloatArray, scan_point_base_mm: FloatArray, noise: ArmNoise
) -> FloatArray:
    """(N, 3, 3) what the arm's scatter adds: shifts, and turns about the scan point."""
    position = noise.position_mm**2 + noise.exposure_position_mm**2
    rotation = noise.rotation_rad**2 + noise.exposure_rotation_rad**2
    lever = points_base_mm - scan_point_base_mm
    square = np.einsum("ni,ni->n", lever, lever)
    turned = square[:, None, None] * np.eye(3) - lever[:, :, None] * lever[:, None, :]
    return np.asarray(position * np.eye(3) + rotation * turned)


def _propagated(jacobian: FloatArray, factor: FloatArray) -> FloatArray:
    """(N, 3, 3) J F F' J' of (N, 3, P) derivatives."""
    n_points, _, n_parameters = jacobian.shape
    moved = jacobian.reshape(3 * n_points, n_parameters) @ factor
    moved = moved.reshape(n_points, 3, factor.shape[1])
    return np.asarray(moved @ moved.transpose(0, 2, 1))


def _pose_and_noise(
    placed: BaseJacobian,
    noise_mm: FloatArray,
    base_from_tool: Pose[Base, Tool],
    placing: BaseTransform,
) -> FloatArray:
    """(N, 3, 3) of the points' own noise and of the arm."""
    hand_eye = placing.scanner.hand_eye
    if placing.scan_point_mm is None:
        middle = placed.points_base_mm.mean(axis=0) if len(noise_mm) else np.zeros(3)
    else:
        in_tool = (
            hand_eye.tool_from_sensor.rotation @ placing.scan_point_mm
            + hand_eye.tool_from_sensor.translation_mm
        )
        middle = base_from_tool.rotation @ in_tool + base_from_tool.translation_mm
    noise = placed.by_sensor_point @ noise_mm
    covariance = arm_covariance(placed.points_base_mm, middle, hand_eye.arm_noise)
    return np.asarray(covariance + noise @ noise.transpose(0, 2, 1))


def merge_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Join clouds of one frame and one list of sheets, in the order given.

    The exposures of each cloud follow those of the one before; clouds with and without normals do
    not mix.

    Raises
    ------
    InputError
        If there is no cloud, or if frames, sheets or the presence of normals differ.
    """
    if not clouds:
        raise InputError("no clouds to merge")
    first = clouds[0]
    for cloud in clouds[1:]:
        if cloud.frame != first.frame or cloud.sheet_names != first.sheet_names:
            raise InputError(
                f"clouds in frames {first.frame} and {cloud.frame} with sheets "
                f"{', '.join(first.sheet_names)} and {', '.join(cloud.sheet_names)} do not merge"
            )
    normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
    if normals and len(normals) != len(clouds):
        raise InputError("clouds with and without normals do not merge")
    starts = np.cumsum([0, *(len(cloud.exposure_sources) for cloud in clouds)])
    return PointCloud(
        frame=first.frame,
        points_mm=np.concatenate([cloud.points_mm for cloud in clouds]),
        covariance_mm2=np.concatenate([cloud.covariance_mm2 for cloud in clouds]),
        sigma_noise_mm=np.concatenate([cloud.sigma_noise_mm for cloud in clouds]),
        sheet=np.concatenate([cloud.sheet for cloud in clouds]),
        sheet_names=first.sheet_names,
        exposure=np.concatenate(
            [c.exposure + start for c, start in zip(clouds, starts[:-1], strict=True)]
        ),
        exposure_sources=tuple(source for cloud in clouds for source in cloud.exposure_sources),
        segment=np.concatenate([cloud.segment for cloud in clouds]),
        intensity=np.concatenate([cloud.intensity for cloud in clouds]),
        normals=np.concatenate(normals) if normals else None,
    )


def cut_cloud(cloud: PointCloud, box: Box) -> PointCloud:
    """The points of a cloud in Base that lie in the box; lists of names stay as they are.

    Raises
    ------
    InputError
        If the cloud is in another frame.
    """
    if cloud.frame != "Base":
        raise InputError(f"a volume of Base cannot cut a cloud in {cloud.frame}")
    return cloud.select(np.flatnonzero(box.holds(cloud.points_mm)))


NEIGHBOURS = 32
"""Cells looked at around a point, at most: a full disc of four cells' radius holds 50."""
SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM = 2.0, 20.0
"""Limits of the radius chosen by itself."""
SPACINGS = 2.5
"""It reaches that many times as far as the next exposure's stripe usually is."""
SAMPLED, LOOKED_AT = 2000, 64
"""Points whose spacing is measured, and neighbouring cells among which another exposure is sought;
cells are a quarter of the smallest radius wide."""


@dataclass(frozen=True, slots=True)
class NormalOptions:
    """What counts as a neighbourhood.

    Parameters
    ----------
    radius_mm
        Points within this distance make a point's tangent plane; None to choose it from the
        distance between the stripes of different exposures.
    min_neighbours
        Fewest cells (a quarter of the radius wide) with points in that neighbourhood.
    min_width
        The neighbourhood must be at least this wide across its longest direction, as a standard
        deviation in parts of the radius: a single stripe has no normal.
    max_thickness
        Largest ratio of its standard deviation along the normal to that width: at an edge, or
        where surfaces lie close to each other, there is no tangent plane.
    """

    radius_mm: float | None = None
    min_neighbours: int = 6
    min_width: float = 0.15
    max_thickness: float = 0.5

    def __post_init__(self) -> None:
        if self.radius_mm is not None and not 0.0 < self.radius_mm < np.inf:
            raise OptionError(f"radius of the normals {self.radius_mm} mm", remedy="give some mm")
        if self.min_neighbours < 3 or not 0.0 < self.min_width < 1.0 or self.max_thickness <= 0.0:
            raise OptionError("the normals' neighbourhood needs 3 cells, a width and a thickness")


def choose_radius_mm(points_mm: FloatArray, exposure: IntArray) -> float:
    """Radius that holds stripes of several exposures around most points.

    Parameters
    ----------
    points_mm
        (N, 3).
    exposure
        (N,) number of the exposure that each belongs to.

    Returns
    -------
    float
        `SPACINGS` times the distance to the next exposure's stripe, taken so that three points in
        four have it; within the limits above.
    """
    size = SMALLEST_RADIUS_MM / 4.0
    if len(points_mm) == 0:
        return SMALLEST_RADIUS_MM
    cells, owner = _cells_of_exposures(points_mm, exposure, size)
    sample = np.arange(0, len(cells), max(1, len(cells) // SAMPLED))
    count = min(LOOKED_AT, len(cells))
    distance, neighbour = cKDTree(cells).query(cells[sample], k=np.arange(1, count + 1))
    is_other = owner[neighbour] != owner[sample, None]
    spacing = np.where(is_other, distance, np.inf).min(axis=1)
    spacing = np.minimum(spacing, LARGEST_RADIUS_MM)
    wanted = SPACINGS * float(np.percentile(spacing, 75))
    return float(np.clip(wanted, SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM))


def estimate_normals(
    points_mm: FloatArray, towards_mm: FloatArray, options: NormalOptions | None = None
) -> FloatArray:
    """Fit a tangent plane around every point.

    Points lie much closer along a stripe than across stripes. So the cloud is thinned first, to
    one mean a cell of a quarter of the radius; each point's plane is that of the cells around it.

    Parameters
    ----------
    points_mm
        (N, 3) in one frame.
    towards_mm
        (N, 3) where each point was seen from, in that frame: its normal points to that side.
    options
        Defaults if None; without a radius the smallest one is taken (see `choose_radius_mm`).

    Returns
    -------
    FloatArray
        (N, 3) unit normals; (0, 0, 0) where there is none: too few neighbours, all of them on one
        line, or no tangent plane (see `NormalOptions`).

    Raises
    ------
    InputError
        If the shapes differ.
    """
    options = options or NormalOptions()
    points = np.asarray(points_mm, dtype=np.float64)
    towards = np.asarray(towards_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or towards.shape != points.shape:
        raise InputError(f"points of shape {points.shape} seen from places {towards.shape}")
    if len(points) == 0:
        return np.zeros((0, 3))
    radius = options.radius_mm or SMALLEST_RADIUS_MM
    cells = _cell_means(points, _cell_keys(points, radius / 4.0))
    distance, neighbour = cKDTree(cells).query(points, k=NEIGHBOURS, distance_upper_bound=radius)
    around = np.where(np.isfinite(distance), np.asarray(neighbour, np.int64), -1)
    normals = _tangent_normals(points, cells, around, radius, options)
    side = np.einsum("ni,ni->n", normals, towards - points)
    return np.where(side[:, None] < 0.0, -normals, normals)


def _cell_keys(points: FloatArray, size_mm: float) -> IntArray:
    """(N,) number of the cubic cell that each point lies in."""
    cell = np.floor((points - points.min(axis=0)) / size_mm).astype(np.int64)
    spans = cell.max(axis=0) + 1
    return np.asarray((cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2])


def _cell_means(points: FloatArray, keys: IntArray) -> FloatArray:
    """(M, 3) mean of the points of equal key, by rising key."""
    _, member = np.unique(keys, return_inverse=True)
    sums = [np.bincount(member, weights=points[:, k]) for k in range(3)]
    return np.stack(sums, axis=1) / np.bincount(member)[:, None]


def _cells_of_exposures(
    points: FloatArray, exposure: IntArray, size_mm: float
) -> tuple[FloatArray, IntArray]:
    """(M, 3) means of the points of one cell and one exposure, and (M,) their exposure."""
    keys = _cell_keys(points, size_mm) * (int(exposure.max()) + 1) + exposure
    return _cell_means(points, keys), np.unique(keys) % (int(exposure.max()) + 1)


def _tangent_normals(
    points: FloatArray,
    cells: FloatArray,
    neighbour: IntArray,
    radius_mm: float,
    options: NormalOptions,
) -> FloatArray:
    """(N, 3) direction of least spread of each neighbourhood, zero where it tells nothing.

    ``neighbour`` is (N, K), -1 for none.
    """
    weight = (neighbour >= 0).astype(np.float64)
    count = weight.sum(axis=1)
    around = cells[np.maximum(neighbour, 0)] - points[:, None]
    around *= weight[:, :, None]
    safe = np.maximum(count, 1.0)
    mean = around.sum(axis=1) / safe[:, None]
    spread = around.transpose(0, 2, 1) @ around / safe[:, None, None]
    spread -= mean[:, :, None] * mean[:, None, :]
    values, vectors = np.linalg.eigh(spread)
    thickness, width = np.sqrt(np.maximum(values[:, :2], 0.0)).T
    is_plane = (
        (count >= options.min_neighbours)
        & (width >= options.min_width * radius_mm)
        & (thickness <= options.max_thickness * width)
    )
    return np.where(is_plane[:, None], vectors[:, :, 0], 0.0)
