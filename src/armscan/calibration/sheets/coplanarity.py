# SPDX-License-Identifier: Apache-2.0
"""Do lines on several boards lie in one plane, and do they determine it? The test of a common
plane and the geometry of boards that fixes it, with refusals and warnings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.sheets.stripes_on_board import StripeObservation
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane, fit_plane
from armscan.models.light_sheet import LightSheet

ROUNDS = 3
"""Gauss-Newton steps of a common plane: the second one is at rounding already."""
MIN_SPREAD_RATIO = 0.01
"""Spread across the stripes over that along them, below which there is only one line."""
MIN_SPREAD_SIGMAS = 5.0
"""Spread across the stripes over its own uncertainty, below which it is not known to be there: a
spread that is partly error makes the sheet look better known than it is."""
MAX_TILT_SIGMA_DEG = 2.0
"""A sheet known to less than that is nothing to measure with."""
MAX_PARALLEL_TILT_SIGMA_DEG = 0.4
"""For parallel boards. Beyond it they lie so close that small differences of their poses decide:
with simulated boards the errors were then several times the sigmas."""
WEAK_TILT_SIGMA_DEG = 0.2
PARALLEL_DEG = 2.0
"""Boards within this angle count as parallel."""


@dataclass(frozen=True, slots=True, eq=False)
class CommonPlane:
    """Plane through the ends of L stripes, each weighted by its covariance.

    ``chi2`` of what the ends miss it by has ``2 L - 3`` degrees of freedom: one for two stripes,
    because any two coplanar lines fit. ``largest_mm`` is the largest distance of an end.
    """

    plane: Plane
    chi2: float
    degrees_of_freedom: int
    largest_mm: float
    sigma_largest_mm: float


def fit_common_plane(stripes: Sequence[StripeObservation]) -> CommonPlane | FitFailure:
    """Fit one plane to two or more stripes by generalised least squares on their ends."""
    ends = np.concatenate([stripe.ends_mm for stripe in stripes])
    start = fit_plane(ends)
    if isinstance(start, FitFailure):
        return start
    plane = start.value
    dends_dcamera = np.concatenate([stripe.dends_dcamera for stripe in stripes])
    for _ in range(ROUNDS):
        local = (ends - plane.point_mm) @ plane.axes.T
        design = np.stack([local[:, 0], local[:, 1], np.ones(len(ends))], axis=1)
        # All boards share the camera's error, hence one full matrix.
        by_camera = np.einsum("i,eij->ej", plane.normal, dends_dcamera)
        covariance = by_camera @ stripes[0].camera_covariance @ by_camera.T
        for k, stripe in enumerate(stripes):
            block = slice(2 * k, 2 * k + 2)
            covariance[block, block] += stripe.own_covariance_mm2(plane.normal)
        weighted = np.linalg.solve(covariance, design)
        normal_matrix = design.T @ weighted
        step = np.linalg.solve(normal_matrix, weighted.T @ local[:, 2])
        missed = local[:, 2] - design @ step
        plane = plane.tilted(step)
    remaining = covariance - design @ np.linalg.solve(normal_matrix, design.T)
    worst = int(np.argmax(np.abs(missed)))
    return CommonPlane(
        plane,
        float(missed @ np.linalg.solve(covariance, missed)),
        len(ends) - 3,
        float(np.abs(missed[worst])),
        float(np.sqrt(max(remaining[worst, worst], 0.0))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class SheetGeometry:
    """How the boards of one sheet lie: the largest angle between two, smallest and largest Z of the
    points, and their ``spread_mm`` (2,), rms along the stripes and across them in the sheet.
    """

    n_boards: int
    board_angle_deg: float
    depth_range_mm: tuple[float, float]
    spread_mm: FloatArray

    @staticmethod
    def of(sheet: LightSheet, points_mm: FloatArray, board_normals: FloatArray) -> SheetGeometry:
        """How the (N, 3) points and the (M, 3) boards' normals spread over a sheet."""
        local = (points_mm - points_mm.mean(axis=0)) @ sheet.axes[:2].T
        cosine = np.clip(np.abs(board_normals @ board_normals.T), 0.0, 1.0)
        return SheetGeometry(
            len(board_normals),
            float(np.degrees(np.arccos(cosine.min()))),
            (float(points_mm[:, 2].min()), float(points_mm[:, 2].max())),
            np.sqrt((local**2).mean(axis=0)),
        )

    @property
    def facts(self) -> str:
        """The numbers, in words."""
        low, high = self.depth_range_mm
        return (
            f"{self.n_boards} boards, largest angle between them {self.board_angle_deg:.2f} deg, "
            f"depth {low:.1f} to {high:.1f} mm, points spread {self.spread_mm[0]:.2f} mm along "
            f"the stripes and {self.spread_mm[1]:.3f} mm across them"
        )


def refuse_few_boards(name: str, n_boards: int) -> FitFailure | None:
    """Refuse fewer than two boards."""
    if n_boards >= 2:
        return None
    return FitFailure(
        f"sheet {name}: {n_boards or 'no'} board placement shows its stripe, and one stripe is a "
        "line through which any number of planes pass",
        "photograph the stripe on the board in at least two placements, better six, tilted "
        "differently and at different distances",
    )


def refuse_lost_spread(
    name: str, geometry: SheetGeometry, across_sigma_mm: float
) -> FitFailure | None:
    """Refuse stripes that are nearly one line in space, or spread little more than their errors.

    ``across_sigma_mm`` is the sigma of a point's place across the stripes by its board's pose.
    """
    along, across = (float(value) for value in geometry.spread_mm)
    if across <= MIN_SPREAD_RATIO * along:
        return FitFailure(
            f"sheet {name}: all stripes lie on nearly one line in space, so that the sheet may "
            f"turn about it ({geometry.facts}; ratio {across / max(along, 1e-12):.2g}, need "
            f"{MIN_SPREAD_RATIO})",
            "move the board in depth or tilt it between the images",
        )
    if across >= MIN_SPREAD_SIGMAS * across_sigma_mm:
        return None
    return FitFailure(
        f"sheet {name}: its stripes spread {across:.3f} mm across each other, and the boards' "
        f"poses are known to {across_sigma_mm:.3f} mm there: the spread must be "
        f"{MIN_SPREAD_SIGMAS:.0f} times as large to tell the sheet's direction ({geometry.facts})",
        "move the board further in depth, tilt it more, or show more of the target",
    )


def refuse_underdetermined_tilt(
    name: str, geometry: SheetGeometry, tilt_sigma_deg: float
) -> FitFailure | None:
    """Refuse a sheet whose direction the boards' own errors leave open."""
    is_parallel = geometry.board_angle_deg < PARALLEL_DEG
    limit = MAX_PARALLEL_TILT_SIGMA_DEG if is_parallel else MAX_TILT_SIGMA_DEG
    if tilt_sigma_deg <= limit:
        return None
    return FitFailure(
        f"sheet {name}: its direction is known to {tilt_sigma_deg:.2f} deg only, need "
        f"{limit} ({geometry.facts})",
        "move the board further in depth, tilt it more, or show more of the target",
    )


def geometry_warnings(
    geometry: SheetGeometry, common: CommonPlane | None, fitted_deg: float, stated_deg: float
) -> tuple[str, ...]:
    """What is weak about the boards of a solved sheet.

    ``fitted_deg`` is what the boards' places leave its direction open by, which more depth mends;
    ``stated_deg`` what is told of it everywhere.
    """
    warnings = []
    if geometry.n_boards == 2 and common is not None:
        sigmas = common.largest_mm / max(common.sigma_largest_mm, 1e-12)
        warnings.append(
            "two boards only: nothing is redundant but that their two stripes must lie in one "
            f"plane (they miss it by {common.largest_mm:.3f} mm, {sigmas:.1f} sigma); a wrong "
            "board pose that keeps the stripes in one plane, or a bow, would not be noticed: use "
            "three boards or more"
        )
    if geometry.board_angle_deg < PARALLEL_DEG:
        warnings.append(
            f"the boards are parallel (largest angle {geometry.board_angle_deg:.2f} deg): the "
            "sheet rests on their distances alone, and stripes given to the wrong sheet would be "
            "coplanar all the same: tilt the board by 20 deg or more between images"
        )
    if fitted_deg > WEAK_TILT_SIGMA_DEG:
        warnings.append(
            f"the sheet's direction is known to {stated_deg:#.3g} deg only: spread the boards "
            "over more depth"
        )
    return tuple(warnings)
