# SPDX-License-Identifier: Apache-2.0
"""A laser's light sheet: a plane plus a low-order bow (eqs. 2.19 to 2.21, 2.42)."""

from __future__ import annotations

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, floats, homogeneous
from armscan.geometry.shapes import Plane

BOW_TERMS: tuple[tuple[int, int], ...] = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1))
"""Powers (i, j) of the bow's terms ``u^i v^j``, u along the stripe and v along the depth; the terms
of u alone follow the light's rays, see `LightSheet`."""

PLANE_PARAMETER_NAMES = ("tilt_u_mm", "tilt_v_mm", "offset_mm")
NEWTON_STEPS = 12
NEWTON_TOLERANCE_MM = 1e-6
"""A last step larger than this means that the ray does not meet the bowed sheet."""
SETTLED_MM = 1e-9
"""Steps double their digits: the one after this would change nothing."""
MAX_FAN = (2.0, 0.8)
"""Largest lean and spread that a bow may ask for; one that reaches it is not known."""
NEAREST_SOURCE = 0.2
"""Nearer to the light's source than this part of its distance the sheet is not followed."""


class LightSheet(ArrayRecord):
    """The surface ``n.(p - o) = bow(u, v)`` in the Sensor frame.

    With ``u = (p - o).e_u / scale`` and ``v = (p - o).e_v / scale`` the bow is
    ``sum(bow_mm[k] * u**i * v**j)`` over `BOW_TERMS`; a plane has ``bow_mm = 0``. The scale makes
    the coefficients lengths: each is the deviation from the plane at the edge of the calibrated
    region.

    Light spreads from its source in straight rays, so what bends the sheet along the stripe grows
    and widens with the distance from it. With ``fan = (lean, spread)`` the ray through ``(u0, 0)``
    runs along ``(lean + spread u0, 1)``; a point ``(u, v)`` lies on that of
    ``u0 = (u - lean v) / w``, ``w = 1 + spread v``, and the terms of u alone are ``w u0**3`` and
    ``w 2 a**2 u0**2 / (1 + a b + lean t)`` with the ray's slope ``t = lean + spread u0``,
    ``b = sqrt(1 + t**2)`` and ``a = sqrt(1 + lean**2)``: a cone, as a line lens that is tilted, or
    a grating, makes, less its tangent plane along the ray through the origin. A fan of zeros gives
    the powers of u.

    Parameters
    ----------
    origin_mm
        (3,) point o in the middle of the calibrated region.
    axes
        (3, 3) rows ``e_u, e_v, n``, right-handed and orthonormal: u along the stripe, v along the
        depth, n the sheet's normal.
    scale_mm
        Half size of the calibrated region.
    bow_mm
        (5,) coefficients.
    fan
        (2,) lean and spread of the light's rays, without unit; known, not fitted with the rest.
    """

    origin_mm: FloatArray = floats(3)
    axes: FloatArray = floats(3, 3)
    scale_mm: float
    bow_mm: FloatArray = floats(5)
    fan: FloatArray = floats(2, default=(0.0, 0.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if (
            np.abs(self.axes @ self.axes.T - np.eye(3)).max() > 1e-6
            or np.linalg.det(self.axes) < 0.0
        ):
            raise InputError("axes of the light sheet are not a right-handed orthonormal triad")
        if not self.scale_mm > 0.0:
            raise InputError(f"scale of the light sheet is {self.scale_mm} mm, not positive")

    @property
    def plane(self) -> FloatArray:
        """(4,) ``a b c D`` of eq. 2.19 with a unit normal and D in mm: the plane without bow."""
        normal = self.axes[2]
        return np.array([*normal, -float(normal @ self.origin_mm)])

    @property
    def is_bowed(self) -> bool:
        """True if any bow coefficient differs from zero."""
        return bool(np.any(self.bow_mm != 0.0))

    @property
    def numbers(self) -> FloatArray:
        """(20,) origin, axes row by row, scale, bow and fan, as compiled kernels read them."""
        return np.array([*self.origin_mm, *self.axes.flat, self.scale_mm, *self.bow_mm, *self.fan])

    def height_with_jacobian(
        self, points_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signed distance from the sheet along its normal, with derivatives.

        Parameters
        ----------
        points_mm
            (N, 3) points in the Sensor frame.

        Returns
        -------
        height_mm
            (N,) ``n.(p - o) - bow(u, v)``.
        dheight_dpoint
            (N, 3).
        dheight_dparameters
            (N, 3 + 5) by the slopes along u and v (in mm per unit of u and v: a parameter t adds
            ``t * u``, ``t * v`` to the surface), the offset and the bow coefficients; see
            `updated`.
        """
        local = (points_mm - self.origin_mm) @ self.axes.T
        u, v = local[:, 0] / self.scale_mm, local[:, 1] / self.scale_mm
        terms, dterms_du, dterms_dv = self._bow_terms(u, v)
        dbow_du, dbow_dv = dterms_du @ self.bow_mm, dterms_dv @ self.bow_mm
        height = local[:, 2] - terms @ self.bow_mm
        dheight_dpoint = (
            self.axes[2]
            - (dbow_du / self.scale_mm)[:, None] * self.axes[0]
            - (dbow_dv / self.scale_mm)[:, None] * self.axes[1]
        )
        dheight_dparameters = -np.column_stack([u, v, np.ones_like(u), terms])
        return height, dheight_dpoint, dheight_dparameters

    def _bow_terms(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(N, 5) values of the bow's terms, and their derivatives by u and by v."""
        powers_u, powers_v = _powers(u, 3), _powers(v, 2)
        terms, by_u, by_v = np.zeros((3, len(u), len(BOW_TERMS)))
        for k, (i, j) in enumerate(BOW_TERMS):
            terms[:, k] = powers_u[i] * powers_v[j]
            by_u[:, k] = i * powers_u[max(i - 1, 0)] * powers_v[j]
            by_v[:, k] = j * powers_u[i] * powers_v[max(j - 1, 0)]
        lean, spread = self.fan
        w = np.maximum(1.0 + spread * v, NEAREST_SOURCE)
        dw_dv = np.where(w > NEAREST_SOURCE, spread, 0.0)
        u0 = (u - lean * v) / w
        ray = lean + spread * u0
        middle, root = np.sqrt(1.0 + lean**2), np.sqrt(1.0 + ray**2)
        share = 2.0 * middle**2 * u0 / (root * (1.0 + middle * root + lean * ray))
        for k, (shape, slope) in {
            BOW_TERMS.index((2, 0)): (u0 * root * share, (middle + root) * share),
            BOW_TERMS.index((3, 0)): (u0 * u0 * u0, 3.0 * u0**2),
        }.items():
            terms[:, k] = w * shape
            by_u[:, k] = slope
            by_v[:, k] = dw_dv * (shape - u0 * slope) - lean * slope
        return terms, by_u, by_v

    def intersect(self, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Points where the rays ``(x, y, 1)`` through the camera's centre meet the sheet.

        Parameters
        ----------
        xy
            (N, 2) ideal normalised image coordinates.

        Returns
        -------
        points_mm
            (N, 3) in the Sensor frame (eq. 2.21, then Newton steps along the ray for the bow);
            zero where there is none.
        is_valid
            (N,) False where the ray is parallel to the sheet, meets it behind the camera, or passes
            by its bow without meeting it.
        """
        rays = homogeneous(xy)
        plane = self.plane
        slope = rays @ plane[:3]
        is_valid = np.abs(slope) > 1e-9 * np.linalg.norm(rays, axis=1)
        depth = -plane[3] / np.where(is_valid, slope, 1.0)
        step = np.zeros_like(depth)
        for _ in range(NEWTON_STEPS if self.is_bowed else 0):
            height, gradient, _ = self.height_with_jacobian(rays * depth[:, None])
            along = np.einsum("ni,ni->n", gradient, rays)
            is_valid &= np.abs(along) > 1e-9
            step = np.where(is_valid, height / np.where(is_valid, along, 1.0), 0.0)
            depth = depth - step
            if np.abs(step).max(initial=0.0) < SETTLED_MM:
                break
        is_valid &= np.isfinite(depth) & (depth > 0.0) & (np.abs(step) < NEWTON_TOLERANCE_MM)
        depth = np.where(is_valid, depth, 0.0)
        return rays * depth[:, None], is_valid

    def intersect_with_jacobian(
        self, xy: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """As `intersect`, with derivatives from the implicit function theorem.

        These are (N, 3, 2) by the normalised image coordinates and (N, 3, 8) by the sheet's
        parameters (tilts, offset, bow).
        """
        points, is_valid = self.intersect(xy)
        rays = homogeneous(xy)
        _, gradient, dh_dparameters = self.height_with_jacobian(points)
        along = np.einsum("ni,ni->n", gradient, rays)
        along = np.where(is_valid, along, 1.0)
        depth = points[:, 2]
        ddepth_dxy = -gradient[:, :2] * depth[:, None] / along[:, None]
        dpoint_dxy = rays[:, :, None] * ddepth_dxy[:, None, :]
        dpoint_dxy[:, 0, 0] += depth
        dpoint_dxy[:, 1, 1] += depth
        ddepth_dparameters = -dh_dparameters / along[:, None]
        return points, is_valid, dpoint_dxy, rays[:, :, None] * ddepth_dparameters[:, None, :]

    def in_frame(self, rotation: FloatArray, translation_mm: FloatArray) -> LightSheet:
        """The same sheet in another frame: ``p_there = R p_here + t``."""
        return LightSheet(
            origin_mm=rotation @ self.origin_mm + translation_mm,
            axes=self.axes @ rotation.T,
            scale_mm=self.scale_mm,
            bow_mm=self.bow_mm,
            fan=self.fan,
        )

    def updated(self, step: FloatArray) -> LightSheet:
        """Apply a step (8,) in (tilt_u, tilt_v, offset_mm, bow).

        To first order the step adds ``t_u u + t_v v + offset + bow_step`` to the surface's height
        over its plane: `Plane.tilted`.
        """
        slopes = step[0] / self.scale_mm, step[1] / self.scale_mm
        plane = Plane(self.origin_mm, self.axes).tilted(np.array([*slopes, step[2]]))
        return LightSheet(
            origin_mm=plane.point_mm,
            axes=plane.axes,
            scale_mm=self.scale_mm,
            bow_mm=self.bow_mm + step[3:],
            fan=self.fan,
        )


def _powers(values: FloatArray, highest: int) -> list[FloatArray]:
    """Values (N,) to the powers of 0, 1, ... ``highest``."""
    powers = [np.ones_like(values)]
    for _ in range(highest):
        powers.append(powers[-1] * values)
    return powers
