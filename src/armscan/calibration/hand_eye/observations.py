# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration is given: stripes with poses, the plate, options.

Stripes on a plate are straight, stripes on a sphere are circles; what lies off them is left out.
The rest is condensed to some ten observations a stripe, so that dense covariances stay small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    ints,
)
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma, square_root
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.shapes import Plane, fit_circle, fit_plane

OUTLIER_SIGMAS = 5.0
"""Points further than this many robust sigmas from their line or circle are left out."""
MIN_POINTS = 20
"""Fewest points that make a stripe."""
LINE_TOLERANCE_MM = 0.5
"""Half width of the band about a line in which points belong together, before robust statistics
tighten it: more than the bow of any sheet."""
MIN_ARC_DEG = 20.0
"""Shortest arc that makes a section of a sphere: a shorter one hardly tells its radius."""
SAME_POSTURE_MM = 1.0
SAME_POSTURE_RAD = float(np.radians(0.5))
"""An arm that stands still reports its pose to some 0.02 mm and 0.002 degrees; one whose exposures
scatter by 0.06 mm, 30 mm from where its pose turns, is within it too. Other postures lie degrees
apart."""
STANDING_SIGMAS = 10.0
LEAST_STANDING, TYPICAL_MOVES, FAR_POSTURE = 3, 4.0, np.array([3.0, np.radians(1.0)])
"""So many postures of several exposures tell by their median what a standing arm scatters by; one
may move by so many times that, but no more than this, in mm and rad."""
TIP_SHARE = 0.4
"""What the tip's own calibration errs by, over what touches scatter by: the root of 3/20, as of a
centre (three unknowns) found by twenty touches. It is alike in all touches of the plate, which
shift together."""
N_PAIRS, MAX_COUNTED = 80, 400
"""Lines through so many pairs of points are tried, each counted on so many points."""
LEAST_SIGMA_MM = 1e-4
LARGEST_SECTION, SMALLEST_SECTION = 1.05, 0.05
"""Radius of a section over the sphere's: beyond them, something else was seen."""
METRES = 0.002
MAX_OBSERVATIONS, LEAST_A_STRIPE = 600, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class HandEyeOptions:
    """How stripes on a plate or a sphere become a hand-eye, and how much everything scatters.

    A standard deviation that is None is estimated from the data.

    Parameters
    ----------
    arm_position_mm
        Scatter of the arm's position at the origin of Tool, an axis, common to a posture.
    arm_rotation_rad
        Scatter of the arm's orientation about that origin, an axis, common to a posture. None has
        it estimated, about what moves a point at 100 mm by as much as the position scatters; it may
        turn about the scan point in part, then.
    exposure_position_mm, exposure_rotation_rad
        The parts of both that are new in every exposure. None: none if the arm's position is given;
        else estimated where a posture has several exposures.
    plate_flatness_mm
        Standard deviation of the plate's smooth flatness error.
    flatness_length_mm
        Length over which it stays alike; need not be exact.
    sheet_shape_mm
        Standard deviation of the light sheets' own shape, beyond what their parameters describe.
    stripe_noise_factor
        What the stripes' own noise is multiplied with.
    solve_plate
        Solve the plate's plane along, without regard to where it was probed.
    solve_diameter
        Solve the sphere's diameter along, without regard to the one given.
    solve_scale
        Solve a common scale of the sensor's points along.
    per_stripe
        Observations that a stripe is condensed to; None for 12 on a plate and 24 on a sphere.
    posture_sigmas
        Postures on a sphere whose pose errs by more than this many standard deviations lose weight.
    max_rms_mm
        Typical distance of a posture's points from the reference above which the data contradict
        each other and no hand-eye is returned, where the sensor's own error does not explain more.
    """

    arm_position_mm: float | None = None
    arm_rotation_rad: float | None = None
    exposure_position_mm: float | None = None
    exposure_rotation_rad: float | None = None
    plate_flatness_mm: float | None = None
    flatness_length_mm: float = 30.0
    sheet_shape_mm: float | None = None
    stripe_noise_factor: float | None = None
    solve_plate: bool = False
    solve_diameter: bool = False
    solve_scale: bool = False
    per_stripe: int | None = None
    posture_sigmas: float = 2.5
    max_rms_mm: float = 0.5

    def __post_init__(self) -> None:
        scatters = ("arm_position_mm", "exposure_position_mm", "plate_flatness_mm")
        for name in (*scatters, "sheet_shape_mm", "stripe_noise_factor"):
            remedy = "give 0 or more, below 1000, or leave it out to have it estimated"
            self._check(name, 0.0, 1000.0, remedy)
        for name in ("arm_rotation_rad", "exposure_rotation_rad"):
            self._check(name, 0.0, 0.1, "give 0 or more, below 0.1 rad (5.7 degrees)")
        self._check("flatness_length_mm", 1.0, 1000.0, "give 1 to 1000 mm")
        self._check("per_stripe", 4, 100, "give 4 to 100")
        self._check("posture_sigmas", 1.5, math.inf, "give at least 1.5")
        self._check("max_rms_mm", 1e-6, 1000.0, "give a positive length")

    def _check(self, name: str, least: float, below: float, remedy: str) -> None:
        value = getattr(self, name)
        if value is not None and not least <= value < below:
            fact = f"{name} is {value}"
            raise OptionError(fact, where="hand-eye options", remedy=remedy)


class PosedStripe(RowRecord):
    """Points of one image, with the pose that the arm reported for it.

    Parameters
    ----------
    posture
        Exposures of equal posture were taken without moving the arm.
    points_mm
        (N, 3) in the Sensor frame.
    noise_mm
        (N, 3, J) one standard deviation of each of a point's own noises, as the vector in which it
        acts: one of each camera that saw the point.
    sheet
        (N,) index of the light sheet that each point lies on.
    dpoint_dsensor
        (N, 3, P) derivative of the points by all the sensor's parameters, or None where the
        sensor delivered points.
    instant
        Name that the images of several cameras taken at once have in common; empty for one.
    """

    source: str
    posture: str
    base_from_tool: Pose[Base, Tool]
    points_mm: FloatArray = floats("N", 3)
    noise_mm: FloatArray = floats("N", 3, "J")
    sheet: IntArray = ints("N")
    dpoint_dsensor: FloatArray | None = floats("N", 3, "P", default=None)
    instant: str = ""

    def beside(self, sensor_step: FloatArray | None) -> PosedStripe:
        """The stripe as the sensor gives it that is moved by a step (P,); None leaves it."""
        if sensor_step is None or self.dpoint_dsensor is None:
            return self
        return replace(self, points_mm=self.points_mm + self.dpoint_dsensor @ sensor_step)


class PlateReference(ArrayRecord):
    """The flat plate in Base, as it was probed (eq. 2.55).

    Parameters
    ----------
    plane
        Plane in Base; its normal points to the side from which it was probed and is scanned.
    covariance
        (3, 3) of `armscan.geometry.shapes.PLANE_PARAMETERS` (rad, rad, mm) at ``plane.point_mm``,
        as touches scatter; None where it is not known, as of A, B, C, D alone.
    rms_mm
        Root mean square distance of the probed points from the plane; None where not known.
    n_points
        Count of probed points; 0 where only A, B, C, D are known.
    tip_diameter_mm
        Diameter of the probe's tip that was compensated for; 0 where not known.
    """

    plane: Plane
    covariance: FloatArray | None = floats(3, 3, default=None)
    rms_mm: float | None = None
    n_points: int = 0
    tip_diameter_mm: float = 0.0

    @property
    def touch_sigma_mm(self) -> float | None:
        """Standard deviation of one touch on which the covariance rests; None where not known.

        Of few touches it is mostly what was expected of one: their residuals say little of it, and
        those of three nothing.
        """
        if self.covariance is None or not self.n_points:
            return None
        return float(np.sqrt(self.n_points * self.covariance[2, 2]))

    @property
    def covariance_with_tip(self) -> FloatArray | None:
        """(3, 3) as ``covariance``, with what the tip shifts all touches by; None as that is.

        That is `TIP_SHARE` of `touch_sigma_mm`. What the arm errs alike in all touches is not in
        it.
        """
        if self.covariance is None:
            return None
        tip_mm = TIP_SHARE * (self.touch_sigma_mm or 0.0)
        return self.covariance + np.diag([0.0, 0.0, tip_mm**2])


class Posed(Protocol):
    """What was seen in one exposure, with the pose that the arm reported for it."""

    @property
    def source(self) -> str:
        """Name of its image."""

    @property
    def posture(self) -> str:
        """Exposures of equal posture were taken without moving the arm."""

    @property
    def base_from_tool(self) -> Pose[Base, Tool]:
        """As the arm reported it."""


def check_postures(exposures: Sequence[Posed], options: HandEyeOptions) -> None:
    """Refuse a posture's name that stands for different poses of the arm.

    An arm of which a larger scatter was given, or is seen in most postures, may move more.

    Raises
    ------
    InputError
        If two exposures of one posture are further apart than an arm that stands still.
    """
    given = [options.exposure_position_mm or 0.0, options.exposure_rotation_rad or 0.0]
    most = np.maximum([SAME_POSTURE_MM, SAME_POSTURE_RAD], STANDING_SIGMAS * np.array(given))
    first_of: dict[str, Posed] = {}
    firsts = [first_of.setdefault(exposure.posture, exposure) for exposure in exposures]
    moves = [_move(first, exposure) for first, exposure in zip(firsts, exposures, strict=True)]
    farthest: dict[str, FloatArray] = {}
    for first, exposure, move in zip(firsts, exposures, moves, strict=True):
        if first is not exposure:
            farthest[first.posture] = np.maximum(farthest.get(first.posture, 0.0), move)
    if len(farthest) >= LEAST_STANDING:
        typical = TYPICAL_MOVES * np.median(list(farthest.values()), axis=0)
        most = np.maximum(most, np.minimum(typical, FAR_POSTURE))
    for first, exposure, (shift_mm, turn_rad) in zip(firsts, exposures, moves, strict=True):
        if shift_mm > most[0] or turn_rad > most[1]:
            raise InputError(
                f"posture '{exposure.posture}' has different poses: the arm moved by "
                f"{shift_mm:.1f} mm and {np.degrees(turn_rad):.1f} deg from {first.source} to "
                f"{exposure.source}",
                remedy="give every posture of the arm a view of its own; if the arm stood still, "
                "check that both exposures have their own poses",
            )


def _move(first: Posed, second: Posed) -> FloatArray:
    """(2,) by how many mm and rad the arm moved."""
    change: Pose[Tool, Tool] = first.base_from_tool.inverse() @ second.base_from_tool
    parts = (change.translation_mm, change.rotation_vector_rad)
    return np.array([np.linalg.norm(part) for part in parts])


def check_diameter(diameter_mm: float) -> None:
    """Refuse a sphere that is none.

    Raises
    ------
    OptionError
        If the diameter is not between 1 and 1000 mm.
    """
    if not 1.0 <= diameter_mm <= 1000.0:
        raise OptionError(
            f"a sphere of {diameter_mm} mm diameter",
            where="sphere hand-eye options",
            remedy="give the diameter in mm, 1 to 1000",
        )


def straight_stripes(stripes: Sequence[PosedStripe]) -> tuple[BoolArray, ...]:
    """Mark, stripe by stripe, the points that lie on one straight line of their sheet."""
    marks = []
    for stripe in stripes:
        kept = np.zeros(len(stripe), dtype=np.bool_)
        for sheet in np.unique(stripe.sheet):
            of_sheet = np.flatnonzero(stripe.sheet == sheet)
            straight = find_straight_points(stripe.points_mm[of_sheet])
            if int(straight.sum()) >= MIN_POINTS:
                kept[of_sheet] = straight
        marks.append(kept)
    return tuple(marks)


def find_straight_points(points_mm: FloatArray) -> BoolArray:
    """Mark those of (N, 3) points that lie on one straight, slightly bowed stripe: the most common.

    A sheet of light may be bowed by a tenth of a millimetre, so the points are finally compared
    with a parabola; edges of the plate and whatever lies beyond it are left out.
    """
    if len(points_mm) < 3:
        return np.zeros(len(points_mm), dtype=np.bool_)
    kept = _most_common_line(points_mm)
    for _ in range(4):
        if int(kept.sum()) < 4:
            return kept
        off = _off_parabola_mm(points_mm, kept)
        sigma = max(robust_sigma(off[kept]), LEAST_SIGMA_MM)
        updated = off <= min(OUTLIER_SIGMAS * sigma, LINE_TOLERANCE_MM)
        if bool((updated == kept).all()):
            break
        kept = updated
    return kept


def _most_common_line(points_mm: FloatArray) -> BoolArray:
    """Points within the tolerance of the line through two points that has most of them."""
    sample = points_mm[:: max(1, len(points_mm) // MAX_COUNTED)]
    draw = np.random.default_rng(0).integers(0, len(sample), (N_PAIRS, 2))
    start, chord = sample[draw[:, 0]], sample[draw[:, 1]] - sample[draw[:, 0]]
    length = np.linalg.norm(chord, axis=1)
    usable = length > 5.0 * LINE_TOLERANCE_MM
    if not bool(usable.any()):
        return np.ones(len(points_mm), dtype=np.bool_)
    start, direction = start[usable], chord[usable] / length[usable, None]

    def near(points: FloatArray, k: int) -> BoolArray:
        offset = points - start[k]
        across = offset - (offset @ direction[k])[:, None] * direction[k]
        return np.asarray(np.linalg.norm(across, axis=1) <= LINE_TOLERANCE_MM)

    counts = [int(near(sample, k).sum()) for k in range(len(start))]
    return near(points_mm, int(np.argmax(counts)))


def _off_parabola_mm(points_mm: FloatArray, kept: BoolArray) -> FloatArray:
    centre = points_mm[kept].mean(axis=0)
    _, _, axes = np.linalg.svd(points_mm[kept] - centre, full_matrices=False)
    local = (points_mm - centre) @ axes.T
    along = local[:, 0] / max(float(np.abs(local[kept, 0]).max()), 1e-12)
    basis = np.column_stack([np.ones(len(along)), along, along**2])
    fitted, *_ = np.linalg.lstsq(basis[kept], local[kept, 1:], rcond=None)
    return np.asarray(np.linalg.norm(local[:, 1:] - basis @ fitted, axis=1))


class CircleSection(ArrayRecord):
    """The part of one exposure's stripe that lies on a sphere: an arc of a circle.

    Parameters
    ----------
    rows
        Indices of the points used, ordered along the arc.
    off_circle_mm
        (n,) their distance from the section circle.
    centre_mm
        (3,) the circle's centre in the Sensor frame.
    normal
        (3,) unit normal of the light sheet, alike for all exposures of a sheet.
    n_rejected
        Count of the exposure's points off the circle.
    """

    stripe: PosedStripe
    rows: IntArray = ints("n")
    off_circle_mm: FloatArray = floats("n")
    centre_mm: FloatArray = floats(3)
    normal: FloatArray = floats(3)
    radius_mm: float
    arc_deg: float
    n_rejected: int

    @property
    def points_mm(self) -> FloatArray:
        """(n, 3) points used, in the Sensor frame."""
        return np.asarray(self.stripe.points_mm[self.rows])

    def thinned(self, n_points: int) -> CircleSection:
        """About ``n_points`` of the points, evenly along the arc."""
        step = max(len(self.rows) // n_points, 1)
        return replace(self, rows=self.rows[::step], off_circle_mm=self.off_circle_mm[::step])

    def height_mm(self, sphere_radius_mm: float) -> float:
        """Distance of the sphere's centre from the sheet; zero where the circle is a great one."""
        return float(np.sqrt(max(sphere_radius_mm**2 - self.radius_mm**2, 0.0)))


def find_sections(
    stripes: Sequence[PosedStripe], radius_mm: float
) -> tuple[tuple[CircleSection, ...], tuple[str, ...]]:
    """Fit a circle to the stripe of every exposure and sheet; those not used with the reason."""
    planes = _sheet_planes(stripes)
    sections, left_out = [], []
    for stripe in stripes:
        for sheet in np.unique(stripe.sheet).tolist():
            rows = np.flatnonzero(stripe.sheet == sheet)
            found = _find_section(stripe, rows, planes.get(sheet), radius_mm)
            if isinstance(found, CircleSection):
                sections.append(found)
            else:
                left_out.append(f"{stripe.source}: {found}")
        if len(stripe) == 0:
            left_out.append(f"{stripe.source}: no points")
    return tuple(sections), tuple(left_out)


def _sheet_planes(stripes: Sequence[PosedStripe]) -> dict[int, Plane]:
    """Plane of each sheet's points in the Sensor frame; the bow of a sheet is neglected here."""
    planes = {}
    for sheet in sorted({int(k) for stripe in stripes for k in stripe.sheet}):
        points = np.concatenate([stripe.points_mm[stripe.sheet == sheet] for stripe in stripes])
        fit = fit_plane(points)
        if not isinstance(fit, FitFailure):
            planes[sheet] = fit.value
    return planes


def _find_section(
    stripe: PosedStripe, rows: IntArray, plane: Plane | None, sphere_radius_mm: float
) -> CircleSection | str:
    if len(rows) < MIN_POINTS:
        return f"{len(rows)} points, fewer than {MIN_POINTS}"
    if plane is None:
        return "its points and those of all others of the sheet lie on one line"
    flat = (stripe.points_mm[rows] - plane.point_mm) @ plane.axes[:2].T
    fit = fit_circle(flat, outlier_sigmas=OUTLIER_SIGMAS)
    if isinstance(fit, FitFailure):
        return fit.reason
    circle = fit.value
    unlike = _unlike_sphere(circle.radius_mm, sphere_radius_mm)
    if unlike:
        return unlike
    # The points that the fit used: as many of the nearest as it has freedom for.
    size = np.abs(fit.residuals)
    kept = size <= np.sort(size)[min(fit.degrees_of_freedom + 3, len(size)) - 1]
    arc_deg, along = _along_arc(flat[kept], circle.centre_mm)
    if len(along) < MIN_POINTS or arc_deg < MIN_ARC_DEG:
        return f"an arc of {arc_deg:.0f} degrees with {len(along)} points is too short"
    order = np.argsort(along)
    return CircleSection(
        stripe=stripe,
        rows=rows[kept][order],
        off_circle_mm=fit.residuals[kept][order],
        centre_mm=plane.point_mm + circle.centre_mm @ plane.axes[:2],
        normal=plane.normal,
        radius_mm=circle.radius_mm,
        arc_deg=arc_deg,
        n_rejected=len(rows) - int(kept.sum()),
    )


def _unlike_sphere(radius_mm: float, sphere_radius_mm: float) -> str:
    """Why a circle of that radius is no section of the sphere, or nothing."""
    if radius_mm > LARGEST_SECTION * sphere_radius_mm:
        return (
            f"its section has a radius of {radius_mm:.2f} mm, more than the sphere's "
            f"{sphere_radius_mm:g} mm"
        )
    if radius_mm < METRES * sphere_radius_mm:
        return f"its section has a radius of {radius_mm:.3g} mm: are the points in metres?"
    if radius_mm < SMALLEST_SECTION * sphere_radius_mm:
        return f"its section has a radius of {radius_mm:.3g} mm only"
    return ""


def _along_arc(flat: FloatArray, centre: FloatArray) -> tuple[float, FloatArray]:
    """Extent of the arc in degrees and (n,) angle of each point from its middle."""
    towards = flat - centre
    middle = towards.mean(axis=0)
    cross = middle[0] * towards[:, 1] - middle[1] * towards[:, 0]
    angle = np.degrees(np.arctan2(cross, towards @ middle))
    low, high = np.percentile(angle, [1.0, 99.0])
    return float(high - low), np.asarray(angle)


class CondensedObservations(ArrayRecord):
    """Stripes condensed: each observation is the mean distance of some points from the reference.

    On a plate the mean of the distances is the distance of the mean point, so that one point stands
    for each piece of a stripe; on a curved stripe it is not, and the points stay.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame, the points of an observation one after another.
    first, count
        (M,) row of each observation's first point, and count of its points.
    noise_mm2
        (M, 3, 3) covariance by the stripe's own noise.
    sheet, stripe, exposure, posture
        (M,) light sheet; index into ``rotations``, ``translations_mm``; number of the
        exposure, which the images of one instant share; index into ``postures``.
    rotations, translations_mm
        (S, 3, 3) and (S, 3) ``base_from_tool`` of each stripe.
    dpoint_dsensor
        (N, 3, P) derivative of the points by the sensor's parameters; None where there is none.
    sensor_covariance
        (P, P) of the sensor's parameters; None where it is taken as exact.
    """

    points_mm: FloatArray = floats("N", 3)
    first: IntArray = ints("M")
    count: IntArray = ints("M")
    noise_mm2: FloatArray = floats("M", 3, 3)
    sheet: IntArray = ints("M")
    stripe: IntArray = ints("M")
    exposure: IntArray = ints("M")
    posture: IntArray = ints("M")
    rotations: FloatArray = floats("S", 3, 3)
    translations_mm: FloatArray = floats("S", 3)
    postures: tuple[str, ...]
    dpoint_dsensor: FloatArray | None = floats("N", 3, "P", default=None)
    sensor_covariance: FloatArray | None = floats("P", "P", default=None)

    def __len__(self) -> int:
        """Count of observations."""
        return len(self.first)

    def mean(self, values: FloatArray) -> FloatArray:
        """(M, ...) mean over each observation of (N, ...) values of its points."""
        if len(values) == len(self):
            return values
        sums = np.add.reduceat(values, self.first, axis=0)
        return np.asarray(sums / self.count.reshape(-1, *([1] * (values.ndim - 1))))

    def of_points(self, values: IntArray) -> IntArray:
        """(N,) values of the points from (M,) of their observations."""
        return np.repeat(values, self.count)

    def select(self, kept: BoolArray) -> CondensedObservations:
        """Keep some observations (M,); stripes and postures keep their numbers."""
        rows, count = np.repeat(kept, self.count), self.count[kept]
        by_sensor = self.dpoint_dsensor
        return replace(
            self,
            points_mm=self.points_mm[rows],
            first=np.cumsum(count) - count,
            count=count,
            noise_mm2=self.noise_mm2[kept],
            sheet=self.sheet[kept],
            stripe=self.stripe[kept],
            exposure=self.exposure[kept],
            posture=self.posture[kept],
            dpoint_dsensor=None if by_sensor is None else by_sensor[rows],
        )

    def sensor_numbers(self) -> tuple[FloatArray, FloatArray]:
        """What numbers of unit variance make of the sensor's parameters (P, R), and back (R, P).

        Of the parameters that move a point the first is a root of their covariance; the others
        follow as their covariance with these says. (0, 0) where the sensor is taken as exact.

        Raises
        ------
        InputError
            If that covariance has a negative eigenvalue.
        """
        covariance, by_sensor = self.sensor_covariance, self.dpoint_dsensor
        if covariance is None or by_sensor is None:
            return np.zeros((0, 0)), np.zeros((0, 0))
        is_open = np.diag(covariance) > 0.0
        moving = np.flatnonzero(by_sensor.any(axis=(0, 1)) & is_open)
        root = square_root(covariance[np.ix_(moving, moving)], "the sensor's covariance")
        sizes = np.linalg.norm(root, axis=1)[:, None]
        sizes[sizes == 0.0] = 1.0
        units = np.linalg.pinv(root / sizes) / sizes.T
        of_all, from_all = covariance[:, moving] @ units.T, np.zeros((len(units), len(covariance)))
        of_all[moving], from_all[:, moving] = root, units
        return of_all, from_all

    @property
    def used_postures(self) -> IntArray:
        """Numbers of the postures that have observations, ascending."""
        return np.unique(self.posture)


def condense_plate(
    stripes: Sequence[PosedStripe], kept: Sequence[BoolArray], per_stripe: int
) -> CondensedObservations:
    """Mean points of pieces of equal length of the marked points; about 600 of them at most."""
    n_lines = sum(
        len(np.unique(stripe.sheet[mark])) for stripe, mark in zip(stripes, kept, strict=True)
    )
    n_pieces = max(LEAST_A_STRIPE, min(per_stripe, MAX_OBSERVATIONS // max(n_lines, 1)))
    names = tuple(dict.fromkeys(stripe.posture for stripe in stripes))
    points, noises, by_sensor = [], [], []
    labels: list[tuple[int, int, int]] = []
    for number, (stripe, mark) in enumerate(zip(stripes, kept, strict=True)):
        for sheet in np.unique(stripe.sheet[mark]):
            line = np.flatnonzero(mark & (stripe.sheet == sheet))
            for piece in _pieces(stripe.points_mm[line], n_pieces):
                weights, noise = _mean_noise(stripe.noise_mm[line[piece]])
                points.append(weights @ stripe.points_mm[line[piece]])
                noises.append(noise)
                if stripe.dpoint_dsensor is not None:
                    by_sensor.append(np.tensordot(weights, stripe.dpoint_dsensor[line[piece]], 1))
                labels.append((int(sheet), number, names.index(stripe.posture)))
    labelled = np.array(labels, dtype=np.int64).reshape(-1, 3)
    return CondensedObservations(
        points_mm=np.array(points).reshape(-1, 3),
        first=np.arange(len(points)),
        count=np.ones(len(points), dtype=np.int64),
        noise_mm2=np.array(noises).reshape(-1, 3, 3),
        sheet=labelled[:, 0],
        stripe=labelled[:, 1],
        exposure=_exposures(stripes)[labelled[:, 1]],
        posture=labelled[:, 2],
        rotations=np.array([one.base_from_tool.rotation for one in stripes]).reshape(-1, 3, 3),
        translations_mm=np.array([o.base_from_tool.translation_mm for o in stripes]).reshape(-1, 3),
        postures=names,
        dpoint_dsensor=np.array(by_sensor) if 0 < len(by_sensor) == len(points) else None,
    )


def _exposures(stripes: Sequence[PosedStripe]) -> IntArray:
    """(S,) number of each stripe's exposure: images of one instant are one, with one pose."""
    keys = [(one.posture, one.instant or str(id(one))) for one in stripes]
    numbers = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.int64)


def _pieces(points_mm: FloatArray, n_pieces: int) -> list[IntArray]:
    """Rows of the points in ``n_pieces`` pieces of equal length along the stripe."""
    centred = points_mm - points_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    along = centred @ axes[0]
    low, high = float(along.min()), float(along.max())
    piece = ((along - low) / max(high - low, 1e-12) * n_pieces).astype(np.int64)
    piece = np.minimum(piece, n_pieces - 1)
    return [np.flatnonzero(piece == k) for k in np.unique(piece)]


def _mean_noise(noise_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (n,) of points by their noise (n, 3, J), and covariance (3, 3) of their mean."""
    variance = (noise_mm**2).sum(axis=(1, 2))
    floor = max(1e-2 * float(np.median(variance)), 1e-12)
    weights = 1.0 / np.maximum(variance, floor)
    weights /= weights.sum()
    shares = noise_mm * weights[:, None, None]
    return weights, np.einsum("nij,nkj->ik", shares, shares)


def condense_sphere(sections: Sequence[CircleSection], per_stripe: int) -> CondensedObservations:
    """Cut sections into observations of nearly equal count of points.

    Their own noise is taken from how the means leave the section circle: errors of neighbouring
    points are alike, so that dividing the scatter of single points by the root of their count would
    promise too much.
    """
    names = tuple(dict.fromkeys(section.stripe.posture for section in sections))
    firsts, counts, owners, variances = [], [], [], []
    start = 0
    for k, section in enumerate(sections):
        n = len(section.rows)
        n_pieces = min(per_stripe, n // 2)
        edges = np.linspace(0, n, n_pieces + 1).astype(np.int64)
        count = np.diff(edges)
        means = np.add.reduceat(section.off_circle_mm, edges[:-1]) / count
        form = float(means @ means) / max(n_pieces - 3, 1)
        noise = (section.stripe.noise_mm[section.rows] ** 2).sum(axis=(1, 2)).mean() / count
        firsts.append(edges[:-1] + start)
        counts.append(count)
        owners.append(np.full(n_pieces, k))
        variances.append(np.maximum(noise, max(form, 1e-12)))
        start += n
    owner = np.concatenate(owners)
    poses = [section.stripe.base_from_tool for section in sections]
    sheets = [section.stripe.sheet[section.rows[0]] for section in sections]
    posture_of = np.array([names.index(section.stripe.posture) for section in sections])
    by_sensor = [
        one.stripe.dpoint_dsensor[one.rows]
        for one in sections
        if one.stripe.dpoint_dsensor is not None
    ]
    return CondensedObservations(
        points_mm=np.concatenate([section.points_mm for section in sections]),
        first=np.concatenate(firsts),
        count=np.concatenate(counts),
        noise_mm2=np.concatenate(variances)[:, None, None] * np.eye(3),
        sheet=np.array(sheets)[owner],
        stripe=owner,
        exposure=_exposures([section.stripe for section in sections])[owner],
        posture=posture_of[owner],
        rotations=np.array([pose.rotation for pose in poses]),
        translations_mm=np.array([pose.translation_mm for pose in poses]),
        postures=names,
        dpoint_dsensor=np.concatenate(by_sensor) if len(by_sensor) == len(sections) else None,
    )
