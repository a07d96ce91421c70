# SPDX-License-Identifier: Apache-2.0
"""Circular sections of a sphere: the arcs that stripes on a ball hold, found robustly, and the
options of the calibration on a sphere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.errors import OptionError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane, fit_circle, fit_plane


@dataclass(frozen=True, slots=True)
class SphereOptions:
    """How stripes on a sphere become a hand-eye, and how much everything scatters.

    A standard deviation that is None is estimated from the data.

    Parameters
    ----------
    arm_position_mm
        Scatter of the scan point by the arm's pose, an axis, common to a posture.
    arm_rotation_rad
        Scatter of the arm's orientation, an axis, common to a posture; None follows the position.
    solve_diameter
        Solve the sphere's diameter along, without regard to the one given.
    solve_scale
        Solve a common scale of the sensor's points along.
    nodes_per_stripe
        Mean residuals that an exposure's stripe is condensed to.
    outlier_sigma
        Points further than this many robust sigmas from their section circle are rejected.
    posture_sigma
        Postures whose pose errs by more than this many standard deviations lose weight.
    min_points
        Fewest points that make a section of the sphere.
    min_arc_deg
        Shortest arc that makes a section of the sphere.
    same_rotation_deg
        Postures that turn by less against each other count as moved without turning.
    max_rms_mm
        Typical distance of the points from the sphere above which the data contradict each other
        and no hand-eye is returned.
    """

    arm_position_mm: float | None = None
    arm_rotation_rad: float | None = None
    solve_diameter: bool = False
    solve_scale: bool = False
    nodes_per_stripe: int = 24
    outlier_sigma: float = 5.0
    posture_sigma: float = 2.5
    min_points: int = 20
    min_arc_deg: float = 20.0
    same_rotation_deg: float = 0.1
    max_rms_mm: float = 0.5

    def __post_init__(self) -> None:
        for name in ("arm_position_mm", "arm_rotation_rad"):
            value = getattr(self, name)
            _require(
                value is None or (math.isfinite(value) and value >= 0.0),
                f"{name} is {value}",
                "give 0 or more, or leave it out to have it estimated",
            )
        rotation = self.arm_rotation_rad
        _require(
            rotation is None or rotation < 0.1,
            f"arm_rotation_rad is {rotation}",
            "an arm's orientation scatters by less than 0.1 rad: give rad, not degrees",
        )
        for name, least, most in (
            ("nodes_per_stripe", 6.0, 100.0),
            ("outlier_sigma", 2.0, 100.0),
            ("posture_sigma", 1.5, 1e6),
            ("min_points", 5.0, 1e6),
            ("min_arc_deg", 1.0, 180.0),
            ("same_rotation_deg", 1e-6, 5.0),
            ("max_rms_mm", 1e-6, 1000.0),
        ):
            value = getattr(self, name)
            _require(least <= value <= most, f"{name} is {value}", f"give {least:g} to {most:g}")


def check_diameter(diameter_mm: float) -> None:
    """Refuse a sphere that is none.

    Raises
    ------
    OptionError
        If the diameter is not between 1 and 1000 mm.
    """
    _require(
        1.0 <= diameter_mm <= 1000.0,
        f"a sphere of {diameter_mm} mm diameter",
        "give the diameter in mm, 1 to 1000",
    )


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="sphere hand-eye options", remedy=remedy)


DEFAULT_OPTIONS = SphereOptions()


LARGEST_SECTION = 1.05
"""Largest radius of a section over the sphere's: beyond it, something else was seen."""
SMALLEST_SECTION = 0.05
METRES = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """The part of one exposure's stripe that lies on the sphere.

    Parameters
    ----------
    stripe
        The exposure.
    rows
        Indices of the points used, ordered along the arc.
    off_circle_mm
        (n,) their distance from the section circle.
    centre_mm
        (3,) the circle's centre in the Sensor frame.
    normal
        (3,) unit normal of the light sheet, alike for all exposures of a sheet.
    radius_mm, radius_sigma_mm
        Of the circle.
    arc_deg
        Extent of the arc.
    n_rejected
        Count of the exposure's points off the circle.
    """

    stripe: PosedStripe
    rows: np.ndarray[tuple[int], np.dtype[np.int64]]
    off_circle_mm: FloatArray
    centre_mm: FloatArray
    normal: FloatArray
    radius_mm: float
    radius_sigma_mm: float
    arc_deg: float
    n_rejected: int

    @property
    def points_mm(self) -> FloatArray:
        """(n, 3) points used, in the Sensor frame."""
        return np.asarray(self.stripe.points_mm[self.rows])

    def thinned(self, n_points: int) -> Section:
        """About ``n_points`` of the points, evenly along the arc."""
        step = max(len(self.rows) // n_points, 1)
        return replace(self, rows=self.rows[::step], off_circle_mm=self.off_circle_mm[::step])

    def height_mm(self, sphere_radius_mm: float) -> float:
        """Distance of the sphere's centre from the sheet; zero where the circle is a great one."""
        return float(np.sqrt(max(sphere_radius_mm**2 - self.radius_mm**2, 0.0)))


def find_sections(
    stripes: Sequence[PosedStripe], radius_mm: float, options: SphereOptions
) -> tuple[tuple[Section, ...], tuple[str, ...]]:
    """Fit a section circle to the stripe of every exposure and sheet.

    Parameters
    ----------
    stripes
        Exposures of the sphere.
    radius_mm
        Of the sphere, to tell it from whatever else was seen.
    options
        Rejection of points and least size of a section.

    Returns
    -------
    sections
        One for each usable stripe.
    left_out
        Stripes that were not used, each with the reason, in words.
    """
    planes = _sheet_planes(stripes)
    sections, left_out = [], []
    for stripe in stripes:
        for sheet in np.unique(stripe.sheet).tolist():
            rows = np.flatnonzero(stripe.sheet == sheet)
            found = _find_section(stripe, rows, planes.get(sheet), radius_mm, options)
            if isinstance(found, Section):
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
    stripe: PosedStripe,
    rows: np.ndarray[tuple[int], np.dtype[np.int64]],
    plane: Plane | None,
    sphere_radius_mm: float,
    options: SphereOptions,
) -> Section | str:
    if len(rows) < options.min_points:
        return f"{len(rows)} points, fewer than {options.min_points}"
    if plane is None:
        return "its points and those of all others of the sheet lie on one line"
    flat = (stripe.points_mm[rows] - plane.point_mm) @ plane.axes[:2].T
    fit = fit_circle(flat, outlier_sigmas=options.outlier_sigma)
    if isinstance(fit, FitFailure):
        return fit.reason
    circle = fit.value
    unlike = _unlike_sphere(circle.radius_mm, sphere_radius_mm)
    if unlike:
        return unlike
    kept = _inliers(fit.residuals, fit.degrees_of_freedom + 3)
    turn, along = _along_arc(flat[kept], circle.centre_mm)
    if len(along) < options.min_points or turn < options.min_arc_deg:
        return f"an arc of {turn:.0f} degrees with {len(along)} points is too short"
    order = np.argsort(along)
    return Section(
        stripe,
        rows[kept][order],
        np.asarray(fit.residuals[kept][order]),
        plane.point_mm + circle.centre_mm @ plane.axes[:2],
        plane.normal,
        circle.radius_mm,
        float(fit.sigma[2]),
        turn,
        len(rows) - int(kept.sum()),
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


def _inliers(residuals: FloatArray, count: int) -> BoolArray:
    """The ``count`` points nearest to the circle: those that the fit used."""
    limit = np.sort(np.abs(residuals))[min(count, len(residuals)) - 1]
    return np.asarray(np.abs(residuals) <= limit)


def _along_arc(flat: FloatArray, centre: FloatArray) -> tuple[float, FloatArray]:
    """Extent of the arc in degrees and (n,) angle of each point from its middle."""
    towards = flat - centre
    middle = towards.mean(axis=0)
    cross = middle[0] * towards[:, 1] - middle[1] * towards[:, 0]
    angle = np.degrees(np.arctan2(cross, towards @ middle))
    low, high = np.percentile(angle, [1.0, 99.0])
    return float(high - low), np.asarray(angle)
