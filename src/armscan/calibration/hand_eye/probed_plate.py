# SPDX-License-Identifier: Apache-2.0
"""A plate from touches of a ball probe: its plane, its side, touches that do not belong to it."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Literal, get_args

import numpy as np
from scipy.special import stdtrit

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, bools, floats, items
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.shapes import Plane, fit_plane, plane_from_coefficients
from armscan.models.arm import compensate_tip
from armscan.records.points import ProbedPoints

ProbeSide = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
"""Axis of Base along which the plate's face looks, roughly."""

DEFAULT_SIDE: ProbeSide = "+z"
TAKEN_FOR_GRANTED = "taken for granted: nobody said where the tool was"
CLEAR_SIDE = 0.26
"""Cosine of 75 degrees: a plate steeper than that towards an axis has no clear side along it."""
LEAST_HEIGHT_MM = 1.0
"""The tool must be further than that from the plate's plane to tell its side."""


def face_towards(
    plane: Plane,
    towards_mm: FloatArray | None,
    side: ProbeSide | None,
    *,
    is_sign_only: bool = False,
) -> tuple[Plane, str] | FitFailure:
    """Turn a plane's normal in Base to the side of the probe, and say how that was found.

    ``side`` is the user's word, which wins; None to follow the places (3,) or (M, 3) of the tool,
    or `DEFAULT_SIDE` where these are not known. With ``is_sign_only`` nothing but the normal's sign
    depends on the side: where nobody says it, the tool lies in the plane or `DEFAULT_SIDE` is not
    clear, the axis that the plate faces most will do.
    """
    if side is None and towards_mm is not None:
        heights = plane.distance_mm(np.atleast_2d(np.asarray(towards_mm, dtype=np.float64)))
        above = float(np.median(heights))
        if abs(above) >= LEAST_HEIGHT_MM:
            return _facing(plane, above), "where the tool was"
        if not is_sign_only:
            return FitFailure(
                "the tool lies in the plate's plane: the side of the probe is not clear",
                "say it with --side",
            )
    how = "as asked for" if side else TAKEN_FOR_GRANTED
    if side is None and is_sign_only and abs(plane.normal[2]) < CLEAR_SIDE:
        axis = int(np.argmax(np.abs(plane.normal)))
        return _facing(plane, float(plane.normal[axis])), f"+{'xyz'[axis]}, {how}"
    side = side or DEFAULT_SIDE
    cosine = float(plane.normal["xyz".index(side[1])]) * (1.0 if side[0] == "+" else -1.0)
    if abs(cosine) < CLEAR_SIDE:
        return FitFailure(
            f"the plate stands within {90.0 - np.degrees(np.arccos(CLEAR_SIDE)):.0f} degrees of "
            f"the axis {side[1]}: '{side}' does not say which side was touched",
            "say it with --side, along the axis that the plate faces",
        )
    return _facing(plane, cosine), f"{side}, {how}"


def _facing(plane: Plane, sign: float) -> Plane:
    """The same plane; its normal turned over, about the first axis, for a negative sign."""
    if sign > 0.0:
        return plane
    return Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))


OUTLIER_PROBABILITY = 0.01
"""Chance that good touches, all together, get one of them named."""
FEWEST_TO_JUDGE = 6
ROUNDING_MM = 1e-9
"""Residuals that small are the rounding of numbers, not touches."""


def find_outliers(points_mm: FloatArray) -> tuple[int, ...]:
    """Touches that do not fit the others: the worst first, each judged without itself.

    The externally studentised residual of the worst touch follows Student's t with n - 4 degrees
    of freedom if all are good; it is named if it is less probable than `OUTLIER_PROBABILITY` over
    n, and the rest is judged again. At most a quarter of the touches is named.
    """
    left = np.arange(len(points_mm))
    named: list[int] = []
    while len(left) >= FEWEST_TO_JUDGE and len(named) < len(points_mm) // 4:
        scores = _studentised(points_mm[left])
        worst = int(np.argmax(scores))
        limit = -stdtrit(len(left) - 4, OUTLIER_PROBABILITY / (2 * len(left)))
        if not scores[worst] > limit:
            break
        named.append(int(left[worst]))
        left = np.delete(left, worst)
    return tuple(named)


def _studentised(points: FloatArray) -> FloatArray:
    """(N,) size of each residual over its standard deviation as the others tell it."""
    fit = fit_plane(points)
    n = len(points)
    if isinstance(fit, FitFailure):
        return np.zeros(n)
    along = (points - fit.value.point_mm) @ fit.value.axes[:2].T
    leverage = 1.0 / n + (along**2 / np.maximum((along**2).sum(axis=0), 1e-300)).sum(axis=1)
    free = np.maximum(1.0 - leverage, 1e-12)
    squares = float(fit.residuals @ fit.residuals)
    if squares <= n * ROUNDING_MM**2:
        return np.zeros(n)
    others = np.maximum(squares - fit.residuals**2 / free, 1e-24 * squares)
    return np.asarray(np.abs(fit.residuals) / np.sqrt(others / (n - 4) * free))


LEAST_WIDTH = 0.05
"""Touches narrower than this part of their length leave the tilt about that length open."""
LARGEST_RMS_MM = 1.0
"""Touches that scatter more are not on one plane, or in another unit."""
PRIOR_FREEDOM = 4.0
"""Degrees of freedom that the touch's sigma known beforehand is worth against the residuals."""
GOOD_TOUCHES = 8
"""With fewer touches, sigma is mostly what was assumed of a touch."""


@dataclass(frozen=True, slots=True)
class ProbingOptions:
    """How touches become a plane.

    Parameters
    ----------
    side
        Side of the plate that was touched; None to take it from where the arm was, and where
        nobody knows that, ``+z``.
    leave_out_outliers
        Leave touches out that do not fit the others; else they are named only.
    feature
        Name of the points to use where the table names several features.
    touch_sigma_mm
        One standard deviation of a touch by arm and tip, as expected beforehand: it is worth
        `PRIOR_FREEDOM` degrees of freedom against the scatter of the touches, so that three touches
        have this sigma, and many have their own.
    """

    side: ProbeSide | None = None
    leave_out_outliers: bool = False
    feature: str = ""
    touch_sigma_mm: float = 0.01

    def __post_init__(self) -> None:
        if self.side is not None and self.side not in get_args(ProbeSide):
            raise OptionError(
                f"no side of a plate is called '{self.side}'",
                where="--side",
                remedy=f"choose one of: {', '.join(get_args(ProbeSide))}",
            )
        if not (self.touch_sigma_mm > 0.0 and isfinite(self.touch_sigma_mm)):
            raise OptionError(
                f"a touch's sigma of {self.touch_sigma_mm} mm", remedy="give a number above 0"
            )


class ProbedPlate(ArrayRecord):
    """A probed plate with its evidence.

    Parameters
    ----------
    reference
        The plane of the surface, its normal towards the probe.
    surface_mm
        (N, 3) points on the surface, all touches.
    residual_mm
        (N,) their signed distances from the plane.
    outliers
        Numbers of the touches that do not fit the others, from 0, worst first.
    is_used
        (N,) whether each touch took part.
    side_from
        How the side of the probe was found, in words.
    rows
        Row of each touch in the table it came from, counted from 1 below the header.
    """

    reference: PlateReference
    surface_mm: FloatArray = floats("N", 3)
    residual_mm: FloatArray = floats("N")
    outliers: tuple[int, ...]
    is_used: BoolArray = bools("N")
    side_from: str
    warnings: tuple[str, ...]
    rows: tuple[int, ...] = items()

    @property
    def flatness_mm(self) -> float:
        """Largest minus smallest distance of the touches that took part."""
        return float(np.ptp(self.residual_mm[self.is_used]))


def fit_probed_plate(
    probed: ProbedPoints,
    towards_mm: FloatArray | None = None,
    options: ProbingOptions | None = None,
) -> ProbedPlate | FitFailure:
    """Fit a plane to the touches by total least squares and compensate the tip's radius.

    Eq. 2.44's algebraic fit favours points near the origin; distances along the normal do not.

    ``towards_mm`` (3,) or (M, 3) are places of the arm's tool in Base while it probed or scanned:
    their side is the plate's face. None where not known. There is no plate of fewer than three
    points, points near one line or on no plane, or with an unclear side.

    Raises
    ------
    InputError
        If several features are named and none was chosen.
    """
    options = options or ProbingOptions()
    of_feature = _rows_of_feature(probed, options)
    points = probed.points_mm[of_feature]
    plane = _fit(points, options)
    if isinstance(plane, FitFailure):
        return plane
    outliers = find_outliers(points)
    is_used = np.ones(len(points), dtype=np.bool_)
    if outliers and options.leave_out_outliers:
        is_used[list(outliers)] = False
        plane = _fit(points[is_used], options)
        if isinstance(plane, FitFailure):
            return plane
    is_tip = probed.are_tip_centres
    oriented = face_towards(plane.value, towards_mm, options.side, is_sign_only=not is_tip)
    if isinstance(oriented, FitFailure):
        return oriented
    facing, side_from = oriented
    tip_mm = probed.tip_diameter_mm if is_tip else 0.0
    surface = compensate_tip(points, facing.normal, tip_mm)
    at = compensate_tip(facing.point_mm[None], facing.normal, tip_mm)[0]
    reference = PlateReference(
        plane=Plane(at, facing.axes),
        covariance=plane.covariance,
        rms_mm=float(np.sqrt(np.mean(plane.residuals**2))),
        n_points=int(is_used.sum()),
        tip_diameter_mm=probed.tip_diameter_mm,
    )
    residual = reference.plane.distance_mm(surface)
    rows = tuple(probed.rows[k] for k in np.flatnonzero(of_feature))
    named = tuple(f"{rows[k]} ({residual[k]:+.3f} mm)" for k in outliers)
    is_guessed = is_tip and TAKEN_FOR_GRANTED in side_from
    warnings = _warnings(reference.n_points, named, options, side_from if is_guessed else "")
    return ProbedPlate(
        reference=reference,
        surface_mm=surface,
        residual_mm=residual,
        outliers=outliers,
        is_used=is_used,
        side_from=side_from,
        warnings=warnings,
        rows=rows,
    )


def plate_from_coefficients(
    coefficients: FloatArray,
    towards_mm: FloatArray | None = None,
    side: ProbeSide | None = None,
    source: str = "",
) -> PlateReference | FitFailure:
    """The plate from ``A B C D`` of eq. 2.55, of any scale and sign.

    The plane's own point is the foot of the mean of ``towards_mm``, or of Base's origin.

    Raises
    ------
    InputError
        If these are not four finite numbers or the normal is zero.
    """
    near = np.zeros(3) if towards_mm is None else np.atleast_2d(towards_mm).mean(axis=0)
    plane = plane_from_coefficients(coefficients, near, source)
    oriented = face_towards(plane, towards_mm, side)
    if isinstance(oriented, FitFailure):
        return oriented
    return PlateReference(plane=oriented[0])


def _fit(points: FloatArray, options: ProbingOptions) -> Estimate[Plane] | FitFailure:
    fit = fit_plane(points, prior_sigma_mm=options.touch_sigma_mm, prior_freedom=PRIOR_FREEDOM)
    if isinstance(fit, FitFailure):
        return fit
    along = (points - fit.value.point_mm) @ fit.value.axes[:2].T
    length, width = np.sqrt(np.mean(along**2, axis=0))
    if width < LEAST_WIDTH * length:
        return FitFailure(
            f"the touches lie nearly on one line ({length:.1f} mm long, {width:.2f} mm wide)",
            "touch the plate over its whole face",
        )
    rms = float(np.sqrt(np.mean(fit.residuals**2)))
    if rms > LARGEST_RMS_MM:
        return FitFailure(
            f"the touches scatter by {rms:.3g} mm about their plane",
            "give points of one flat face, in mm",
        )
    return fit


def _rows_of_feature(probed: ProbedPoints, options: ProbingOptions) -> BoolArray:
    names = sorted({name for name in probed.features if name})
    if not options.feature and len(names) <= 1:
        return np.ones(len(probed), dtype=np.bool_)
    if not names:
        raise InputError(
            f"no point names a feature, so there is none called '{options.feature}'",
            where=probed.source,
            remedy="name no feature, or give the table a column feature",
        )
    if options.feature not in names:
        raise InputError(
            f"the points belong to the features {', '.join(names)}",
            where=probed.source,
            remedy="take the one that is the plate: armscan probe POINTS --feature NAME "
            "-o plate.csv",
        )
    return np.array([name == options.feature for name in probed.features], dtype=np.bool_)


def _warnings(
    n_touches: int, named: tuple[str, ...], options: ProbingOptions, guessed_side: str
) -> tuple[str, ...]:
    warnings = []
    if n_touches < GOOD_TOUCHES:
        unchecked = ", and nothing checks the plane" if n_touches == 3 else ""
        warnings.append(
            f"{n_touches} touches: the plate's sigma rests on the {options.touch_sigma_mm:g} mm "
            f"that is taken for a touch{unchecked}; touch {GOOD_TOUCHES} places or more"
        )
    if named:
        what = "was left out" if options.leave_out_outliers else "took part: touch again there"
        warnings.append(f"a touch does not fit the others and {what}: row {', '.join(named)}")
    if guessed_side:
        warnings.append(f"the side that was touched is {guessed_side}; --side says it")
    return tuple(warnings)
