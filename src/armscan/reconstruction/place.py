# SPDX-License-Identifier: Apache-2.0
"""Points of exposures in Base with covariance and normals: placed, joined, cut to a volume."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import Box, FloatArray, IntArray, extents
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma, square_root
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.shapes import fit_plane
from armscan.kernels.faces import nearest_others, tangent_normals
from armscan.kernels.fusing import carry_fused
from armscan.kernels.grids import drop_hidden, sort_into_bins
from armscan.kernels.placing import carry_stripe, propagate_points
from armscan.models.calibration import (
    ArmNoise,
    HandEyeCalibration,
    ScannerCalibration,
    SensorCalibration,
)
from armscan.reconstruction.points import over_sheet
from armscan.reconstruction.triangulate import (
    StripePoints,
    lens_numbers,
    sensor_columns,
    sheet_numbers,
    sheet_rows,
    stripe_cloud,
)
from armscan.records.cloud import (
    DELIVERED,
    FIELD_POWERS,
    CalibrationErrors,
    PointCloud,
    direction_powers,
)
from armscan.records.profile import PointProfile, Profile

THIRD_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])
"""Blind to any parabola, so to the course of a profile over four points."""


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
    return BaseJacobian(
        base_from_tool.apply(tool_from_sensor.apply(points_sensor_mm)),
        base_from_tool.rotation @ tool_from_sensor.rotation,
        base_from_tool.rotation @ tool_from_sensor.jacobian(points_sensor_mm),
    )


@dataclass(frozen=True, eq=False)
class BaseTransform:
    """What carries points to Base with their covariance, computed once for all exposures.

    Parameters
    ----------
    scanner
        The calibration.
    factors
        One (Q + 6, K) matrix F a sheet with ``F F'`` the joint covariance of what its points
        depend on (`sensor_columns`) and of the hand-eye; (6, K) where the sensor delivers points.
    scan_point_mm
        (3,) middle of the working range in Sensor, one of the two points about which the arm's pose
        turns: the mean of the light sheets' origins. None to take the mean of each exposure's
        points, for a sensor that delivers points itself.
    """

    scanner: ScannerCalibration
    factors: tuple[FloatArray, ...]
    scan_point_mm: FloatArray | None

    @staticmethod
    def of(scanner: ScannerCalibration) -> BaseTransform:
        """Factor the scanner's joint covariance sheet by sheet.

        Raises
        ------
        InputError
            If the covariance is not positive semi-definite.
        """
        joint, sensor, name = scanner.covariance, scanner.sensor, "the scanner's covariance"
        if sensor is None:
            return BaseTransform(scanner, (square_root(joint, name),), None)
        hand_eye = np.arange(6) + len(sensor.parameter_names)
        places = [np.r_[sensor_columns(sensor, k), hand_eye] for k in range(len(sensor.sheets))]
        factors = tuple(square_root(joint[np.ix_(own, own)], name) for own in places)
        middle = np.mean([one.sheet.origin_mm for one in sensor.sheets], axis=0)
        return BaseTransform(scanner, factors, np.asarray(middle))

    @cached_property
    def errors_in_sensor(self) -> tuple[FloatArray, ...]:
        """The factors turned about, (K, Q + 6), one independent error a row, for all poses.

        The hand-eye's six errors are turned to Sensor. Row k is zero before column k: such a factor
        of the same covariance always exists, and half of the products with it need not be made.
        """
        back = self.scanner.hand_eye.tool_from_sensor.rotation.T
        turned = []
        for factor in self.factors:
            own = factor[-6:].reshape(2, 3, -1)
            whole = np.concatenate([factor[:-6], *(back @ own)])
            turned.append(np.ascontiguousarray(np.linalg.qr(whole.T, mode="r")))
        return tuple(turned)

    @cached_property
    def factors_in_sensor(self) -> tuple[FloatArray, ...]:
        """(Q + 6, K) the same, one error a column."""
        return tuple(np.ascontiguousarray(errors.T) for errors in self.errors_in_sensor)

    @cached_property
    def joint_errors(self) -> FloatArray:
        """(S (Q + 6), Q + 6) `errors_in_sensor` of all sheets, filled up with rows of zeros."""
        whole = np.zeros((len(self.factors), len(self.factors[0]), len(self.factors[0])))
        for one, errors in zip(whole, self.errors_in_sensor, strict=True):
            one[: len(errors)] = errors
        return whole.reshape(-1, whole.shape[2])

    @property
    def sheet_names(self) -> tuple[str, ...]:
        """Names of the light sheets."""
        sensor = self.scanner.sensor
        return (DELIVERED,) if sensor is None else tuple(one.name for one in sensor.sheets)


FIELD_GRID = 40
"""Pixels a side at which a calibration's errors are looked at, of the whole image."""
LEAST_MODE = 0.003
"""Part of the errors' variance that may be left out, of moves as a whole and of what bends."""
FAR_MOVES = 10.0
"""Over the median of what points move by."""
MOST_MODES = 22
"""Of a head of many sheets: three times as many numbers fit a header's line of 1024 characters,
which some readers take at most."""


def errors_of_calibration(
    scanner: ScannerCalibration, turns: FloatArray
) -> CalibrationErrors | None:
    """What the calibration of a scanner may move points of a scan by.

    The joint covariance of cameras, sheets and hand-eye is carried to points all over the sheets;
    the largest independent errors there are kept as polynomials. Before two cameras they are those
    of points that both see, and points that one sees are taken to err alike: of a sheet that both
    hardly see, those of the first camera. None for a sensor that delivers points.

    Parameters
    ----------
    scanner
        The calibration.
    turns
        (E, 3, 3) rotation of Sensor into Base at each exposure.
    """
    sensor = scanner.sensor
    if sensor is None:
        return None
    factor = square_root(scanner.covariance, "the scanner's covariance")
    if not factor.shape[1]:  # a calibration that is known for certain
        factor = np.zeros((len(factor), 1))
    camera = sensor.camera.camera
    grid = np.meshgrid(
        np.linspace(0.0, camera.width_px - 1.0, FIELD_GRID),
        np.linspace(0.0, camera.height_px - 1.0, FIELD_GRID),
    )
    pixels = np.stack([axis.ravel() for axis in grid], axis=1)
    hand_eye = scanner.hand_eye.tool_from_sensor
    own = [_moves_of_sheet(sensor, k, pixels, hand_eye, factor) for k in range(len(sensor.sheets))]
    if any(len(seen) < len(FIELD_POWERS) for seen, _ in own):
        return None
    kept = _largest_errors(*(np.concatenate(parts) for parts in zip(*own, strict=True)))
    n_kept = kept.shape[1]
    middle, half, modes = [], [], []
    for seen, move in own:
        direction = seen[:, :2] / seen[:, 2:]
        low, high = direction.min(axis=0), direction.max(axis=0)
        middle.append((low + high) / 2.0)
        half.append(np.maximum((high - low) / 2.0, 1e-9))
        powers = direction_powers(seen, middle[-1], half[-1])
        found = np.linalg.lstsq(powers, (move @ kept).reshape(len(seen), 3 * n_kept), rcond=1e-9)[0]
        modes.append(found.reshape(powers.shape[1], 3, n_kept))
    return CalibrationErrors(
        turns=turns,
        middle=np.array(middle),
        half_width=np.array(half),
        modes_mm=np.array(modes),
        arm_mm=_of_postures_mm(scanner.hand_eye, np.concatenate([seen for seen, _ in own])),
    )


def _largest_errors(points_mm: FloatArray, moves_mm: FloatArray) -> FloatArray:
    """(K, L) unit combinations of K errors that move points (M, 3) by (M, 3, K), the largest ones.

    What shifts all points alike, as a hand-eye errs, may be many times what turns them, and that
    many times what bends a scan; but steps know no shift, and lengths no turn. So what is left of
    the moves without shift, and without shift and turn, counts by its part of its own sum, too.
    Points that err by far more than most, of a sheet that is seen edge-on, have no part in it.
    """
    far = np.sqrt((moves_mm**2).sum(axis=(1, 2)))
    is_usual = far <= FAR_MOVES * np.median(far)
    points_mm, moves_mm = points_mm[is_usual], moves_mm[is_usual]
    n, one = len(points_mm), np.eye(3)
    turns = np.cross(one, points_mm[:, None] - points_mm.mean(axis=0)).transpose(0, 2, 1)
    basis = np.linalg.qr(np.concatenate([np.tile(one, (n, 1, 1)), turns], axis=2).reshape(-1, 6))[0]
    moves = moves_mm.reshape(3 * n, -1)
    size = np.zeros((moves.shape[1],) * 2)
    for known in (basis[:, :0], basis[:, :3], basis):
        left_mm = moves - known @ (known.T @ moves)
        part = left_mm.T @ left_mm
        size += part / max(float(np.trace(part)), np.finfo(np.float64).tiny)
    values, vectors = np.linalg.eigh(size)
    left = np.cumsum(np.maximum(values, 0.0))
    return np.asarray(vectors[:, left > LEAST_MODE * left[-1]][:, -MOST_MODES:])


def _of_postures_mm(hand_eye: HandEyeCalibration, seen_mm: FloatArray) -> float:
    """What postures of the calibration scattered by, along an axis, in the middle of points (M, 3).

    It is a shift, and two thirds of the square of what a turn about the tool's origin moves: a turn
    about any axis moves a point along two.
    """
    noise, middle = hand_eye.arm_noise, seen_mm.mean(axis=0)[None]
    lever = float(np.linalg.norm(hand_eye.tool_from_sensor.apply(middle)))
    return math.hypot(noise.position_mm, math.sqrt(2.0 / 3.0) * noise.tool_rotation_rad * lever)


def _moves_of_sheet(
    sensor: SensorCalibration,
    sheet: int,
    pixels: FloatArray,
    hand_eye: Pose[Tool, Sensor],
    factor: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Points (M, 3) of a sheet in Sensor, and their moves (M, 3, K) by columns of the factor."""
    points, by_sensor = over_sheet(pixels, sheet, sensor)
    by_hand_eye = hand_eye.rotation.T @ hand_eye.jacobian(points)
    columns = np.r_[sensor_columns(sensor, sheet), np.arange(-6, 0)]
    return points, np.concatenate([by_sensor, by_hand_eye], axis=2) @ factor[columns]


def propagate_to_base(
    stripe: StripePoints,
    profile: Profile | PointProfile,
    base_from_tool: Pose[Base, Tool],
    transform: BaseTransform,
) -> PointCloud:
    """Place the points of one exposure in Base.

    Parameters
    ----------
    stripe
        Points in Sensor with what their errors come from; of a sensor that delivers points itself
        (`delivered_points`) the derivatives by the sensor are (M, 3, 0).
    profile
        The stripe points that they were triangulated from, or the points as delivered.
    base_from_tool
        The arm's pose at that exposure.
    transform
        Of the scanner whose sensor triangulated the points.

    Returns
    -------
    PointCloud
        In Base. The covariance holds the stripe's noise, the light sheet's own shape, that of
        sensor and hand-eye together
        (an error of the sensor that the hand-eye follows largely cancels), and the arm's: the
        part common to a posture and the part new in every exposure.

    Raises
    ------
    InputError
        If the points were triangulated but the scanner has no camera, or the other way round.
    """
    hand_eye = transform.scanner.hand_eye
    if isinstance(profile, Profile) == (transform.scanner.sensor is None):
        fact = "no camera" if transform.scanner.sensor is None else "a camera"
        raise InputError(f"this scanner has {fact}", remedy="give the scanner of these points")
    n, base_from_sensor = len(stripe), base_from_tool @ hand_eye.tool_from_sensor
    if transform.scan_point_mm is None:
        middle = base_from_sensor.apply(stripe.points_mm).mean(axis=0) if n else np.zeros(3)
    else:
        middle = base_from_sensor.apply(transform.scan_point_mm)
    arm = np.stack([hand_eye.arm_noise.variances, middle, base_from_tool.translation_mm])
    if stripe.dpoint_dsensor is None and stripe.sensor is not None and stripe.sensor.second is None:
        placed, covariance = _carried(stripe, stripe.sensor, base_from_sensor, arm, transform)
    elif stripe.gain is not None and stripe.by_distance is not None:
        placed, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
        carry_fused(
            stripe.points_mm,
            stripe.noise_mm.reshape(n, 3 * stripe.noise_mm.shape[2]),
            stripe.shape_mm,
            stripe.gain.reshape(n, 12),
            stripe.by_distance,
            stripe.sheet,
            transform.joint_errors,
            _carry_numbers(base_from_sensor, arm),
            placed.reshape(-1),
            covariance.reshape(-1),
        )
    else:
        placed, covariance = _propagated(stripe, base_from_sensor, arm, transform)
    for array in (placed, covariance):
        array.setflags(write=False)
    return stripe_cloud(
        "Base", stripe, profile, placed, covariance, sheet_names=transform.sheet_names
    )


def _carried(
    stripe: StripePoints,
    sensor: SensorCalibration,
    base_from_sensor: Pose[Base, Sensor],
    arm: FloatArray,
    transform: BaseTransform,
) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) of one camera on their sheets, with covariances (N, 3, 3); ``arm`` (3, 3)."""
    n = len(stripe)
    placed, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    carried = _carry_numbers(base_from_sensor, arm)
    lens, numbers = lens_numbers(sensor), sheet_numbers(sensor)
    for k, rows in sheet_rows(stripe.sheet):
        outputs = placed[rows], covariance[rows]
        carry_stripe(
            stripe.points_mm[rows].reshape(-1),
            stripe.noise_mm[rows].reshape(-1),
            stripe.shape_mm[rows].reshape(-1),
            lens,
            numbers[k],
            transform.errors_in_sensor[k],
            carried,
            outputs[0].reshape(-1),
            outputs[1].reshape(-1),
        )
        if not isinstance(rows, slice):
            placed[rows], covariance[rows] = outputs
    return placed, covariance


def _carry_numbers(base_from_sensor: Pose[Base, Sensor], arm: FloatArray) -> FloatArray:
    """(21,) the pose and what the arm errs, (3, 3), as `carry_stripe` takes them."""
    turn = np.column_stack([base_from_sensor.rotation, base_from_sensor.translation_mm])
    return np.concatenate([turn, arm], axis=None)


def _propagated(
    stripe: StripePoints,
    base_from_sensor: Pose[Base, Sensor],
    arm: FloatArray,
    transform: BaseTransform,
) -> tuple[FloatArray, FloatArray]:
    """As `_carried`, of points that come with their derivatives."""
    n, by_sensor = len(stripe), stripe.by_sensor
    placed, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    turn = np.column_stack([base_from_sensor.rotation, base_from_sensor.translation_mm])
    for k, factor in enumerate(transform.factors_in_sensor):
        propagate_points(
            stripe.points_mm,
            stripe.noise_mm.reshape(n, 3 * stripe.noise_mm.shape[2]),
            stripe.shape_mm,
            by_sensor.reshape(n, 3 * by_sensor.shape[2]),
            factor,
            turn,
            arm,
            np.flatnonzero(stripe.sheet == k),
            placed,
            covariance.reshape(n, 9),
        )
    return placed, covariance


def delivered_points(profile: PointProfile) -> StripePoints:
    """Points that a sensor delivered itself; their noise is their own scatter.

    It is taken from the third differences of neighbouring points, which neither a line nor a circle
    touches, and acts across the profile, within its plane; zero for a straight or short profile.
    """
    n = len(profile)
    noise = np.zeros((n, 3, 1))
    plane = fit_plane(profile.points_mm)
    if n >= 8 and not isinstance(plane, FitFailure):
        tangent = np.gradient(profile.points_mm, axis=0)
        length = np.linalg.norm(tangent, axis=1)
        across = np.cross(plane.value.normal, tangent / np.maximum(length, 1e-12)[:, None])
        rough = np.apply_along_axis(np.convolve, 0, profile.points_mm, THIRD_DIFFERENCE, "valid")
        size = np.abs(np.einsum("ni,ni->n", rough, across[1:-2]))
        noise[:, :, 0] = across * robust_sigma(size / np.linalg.norm(THIRD_DIFFERENCE))
    return StripePoints(
        row=np.arange(n),
        points_mm=profile.points_mm,
        noise_mm=noise,
        shape_mm=np.zeros((n, 3)),
        dpoint_dsensor=np.zeros((n, 3, 0)),
        sheet=np.zeros(n, dtype=np.int64),
    )


def arm_covariance(
    points_base_mm: FloatArray,
    scan_point_base_mm: FloatArray,
    tool_base_mm: FloatArray,
    noise: ArmNoise,
) -> FloatArray:
    """(N, 3, 3) what the arm's scatter adds at points (N, 3): a shift, and turns about two points.

    ``scan_point_base_mm`` and ``tool_base_mm``, the origin of Tool, are (3,).
    """
    position, at_scan_point, at_tool = noise.variances
    levers = np.stack([points_base_mm - scan_point_base_mm, points_base_mm - tool_base_mm], axis=2)
    scaled = levers * np.sqrt([at_scan_point, at_tool])
    covariance = -(scaled @ scaled.transpose(0, 2, 1))
    covariance[:, np.arange(3), np.arange(3)] += position + (scaled**2).sum(axis=(1, 2))[:, None]
    return np.asarray(covariance)


def merge_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Join clouds of one frame and one list of sheets, in the order given.

    The exposures of each cloud follow those of the one before; clouds with and without normals do
    not mix.

    Raises
    ------
    InputError
        If there is no cloud, or if frames, sheets or the presence of normals differ.
    """
    if clouds and len({cloud.normals is None for cloud in clouds}) > 1:
        raise InputError("clouds with and without normals do not merge")
    starts = np.cumsum([0, *(len(cloud.exposure_sources) for cloud in clouds)])
    return PointCloud.concat(
        clouds,
        exposure=np.concatenate(
            [np.zeros(0, np.int64)]
            + [cloud.exposure + start for cloud, start in zip(clouds, starts, strict=False)]
        ),
        exposure_sources=tuple(source for cloud in clouds for source in cloud.exposure_sources),
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
    return cloud.select(box.holds(cloud.points_mm))


AT_ONCE = 100_000
"""Points between two words of progress."""
NEIGHBOURS = 32
"""Cells that make a point's plane, the nearest; a full disc of four cells' radius holds 50."""
SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM = 2.0, 20.0
"""Limits of the radius chosen by itself."""
SPACINGS = 2.5
"""It reaches that many times as far as the next exposure's stripe usually is."""
SAMPLED, LOOKED_AT = 2000, 64
"""Points whose spacing is measured, and neighbouring cells among which another exposure is sought;
cells are a quarter of the smallest radius wide."""
MIN_NEIGHBOURS = 6
"""Fewest cells (a quarter of the radius wide) with points in a neighbourhood."""
MIN_WIDTH = 0.15
"""A neighbourhood must be at least this wide across its longest direction, as a standard deviation
in parts of the radius: a single stripe has no normal."""
MAX_THICKNESS = 0.5
"""Largest ratio of its standard deviation along the normal to that width: at an edge, or where
surfaces lie close to each other, there is no tangent plane."""


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
    if len(points_mm) == 0:
        return SMALLEST_RADIUS_MM
    # one mean of the points of each cell and exposure
    n_exposures = int(exposure.max()) + 1
    keys = cell_keys(points_mm, SMALLEST_RADIUS_MM / 4.0) * n_exposures + exposure
    cells = np.column_stack([cell_means(points_mm, keys), np.unique(keys) % n_exposures])
    asked = cells[:: max(1, len(cells) // SAMPLED)]
    own_first = cells[np.argsort(cells[:, 3], kind="stable")]
    return radius_of_spacings(spacings_mm(asked, [own_first], LOOKED_AT, LARGEST_RADIUS_MM))


RINGS = 4
"""Bins from a place to as far as the next stripe is sought."""


def spacings_mm(
    asked: FloatArray, parts: Iterable[FloatArray], looked_at: int, farthest_mm: float
) -> FloatArray:
    """(S,) distance of places to the next one of another exposure.

    Parameters
    ----------
    asked
        (S, 4) places and the numbers of their exposures.
    parts
        (M, 4) each, all places by rising number of their exposures, of which none is in two parts;
        gone through twice.
    looked_at
        Infinite is the distance of a place where the next one is not among so many that are
        nearest to it, itself counted.
    farthest_mm
        Told where nothing is nearer.
    """
    spacing = np.full(len(asked), farthest_mm)
    for places in parts:
        near = NeighbourBins.of(places, extents(places[:, :3])[0], farthest_mm / RINGS)
        bins = (near.low_mm, near.radius_mm, near.slots, near.keys, near.starts, near.cells)
        nearest_others(np.ascontiguousarray(asked), *bins, spacing)
    for places in parts:
        first = np.searchsorted(places[:, 3], asked[:, 3])
        stop = np.searchsorted(places[:, 3], asked[:, 3], "right")
        drop_hidden(np.ascontiguousarray(asked), first, stop, places, looked_at, spacing)
    return spacing


def radius_of_spacings(spacing: FloatArray) -> float:
    """Radius that fits distances (S,) in mm to the next exposure's stripe; infinite where none."""
    wanted = SPACINGS * float(np.percentile(np.minimum(spacing, LARGEST_RADIUS_MM), 75))
    return float(np.clip(wanted, SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM))


def estimate_normals(
    points_mm: FloatArray,
    towards_mm: FloatArray,
    radius_mm: float = SMALLEST_RADIUS_MM,
    *,
    told: Callable[[int], None] = lambda n_done: None,
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
    radius_mm
        Points within this distance make a point's tangent plane (see `choose_radius_mm`).
    told
        Called with the count of points done, now and then.

    Returns
    -------
    FloatArray
        (N, 3) unit normals; (0, 0, 0) where there is none: too few neighbours, all of them on one
        line, or no tangent plane.

    Raises
    ------
    InputError
        If the shapes differ.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    towards = np.asarray(towards_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or towards.shape != points.shape:
        raise InputError(f"points of shape {points.shape} seen from places {towards.shape}")
    normals = np.zeros_like(points)
    if len(points) == 0:
        return normals
    cells = cell_means(points, cell_keys(points, radius_mm / 4.0))
    bins = NeighbourBins.of(cells, points.min(axis=0), radius_mm)
    for first in range(0, len(points), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        normals[part] = bins.normals(points[part], towards[part])
        told(min(first + AT_ONCE, len(points)))
    return normals


@dataclass(frozen=True, slots=True, eq=False)
class NeighbourBins:
    """Means of cells, sorted into bins as wide as the radius, so that those near a point are found.

    Parameters
    ----------
    low_mm
        (3,) lowest coordinates of the points.
    radius_mm
        Means within this distance make a point's tangent plane.
    cells
        (M, 3) means, bin by bin, or (M, K) with more numbers behind them.
    slots, keys, starts
        As `armscan.kernels.grids.sort_into_bins` makes them.
    """

    low_mm: FloatArray
    radius_mm: float
    cells: FloatArray
    slots: IntArray
    keys: IntArray
    starts: IntArray

    @staticmethod
    def of(cells: FloatArray, low_mm: FloatArray, radius_mm: float) -> NeighbourBins:
        """Sort means (M, 3), which may lack those farther than the radius from all points asked."""
        slots, keys = np.full(free_slots(len(cells)), -1), np.zeros(len(cells), dtype=np.int64)
        starts, ordered = np.zeros(len(cells) + 1, dtype=np.int64), np.zeros_like(cells)
        sort_into_bins(cells, low_mm, radius_mm, slots, keys, starts, ordered)
        return NeighbourBins(low_mm, radius_mm, ordered, slots, keys, starts)

    def normals(self, points: FloatArray, towards: FloatArray) -> FloatArray:
        """(N, 3) unit normals, towards (N, 3), of the planes of the means near points (N, 3).

        A normal is zero where there is none.
        """
        normals = np.zeros((len(points), 3))
        tangent_normals(
            np.ascontiguousarray(points),
            np.ascontiguousarray(towards),
            self.low_mm,
            self.radius_mm,
            self.slots,
            self.keys,
            self.starts,
            self.cells,
            np.array([MIN_NEIGHBOURS, NEIGHBOURS, MIN_WIDTH, MAX_THICKNESS]),
            normals,
        )
        return normals


def free_slots(n: int) -> int:
    """Places of a hash table of ``n`` numbers: a power of two, so that half or more stay free."""
    return 1 << (2 * max(n, 1) - 1).bit_length()


def cell_keys(
    points: FloatArray, size_mm: float, corners_mm: tuple[FloatArray, FloatArray] | None = None
) -> IntArray:
    """(N,) number of the cubic cell that each point lies in.

    ``corners_mm`` are the lowest and highest coordinates of the cloud of which the points are a
    part; None if they are all of it.
    """
    low, high = corners_mm or (points.min(axis=0), points.max(axis=0))
    cell = np.floor((points - low) / size_mm).astype(np.int64)
    spans = np.floor((high - low) / size_mm).astype(np.int64) + 1
    return np.asarray((cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2])


def cell_means(points: FloatArray, keys: IntArray) -> FloatArray:
    """(M, 3) mean of the points of equal key, by rising key."""
    _, member = np.unique(keys, return_inverse=True)
    sums = [np.bincount(member, weights=points[:, k]) for k in range(3)]
    return np.stack(sums, axis=1) / np.bincount(member)[:, None]
