# SPDX-License-Identifier: Apache-2.0
"""The hand-eye as printed: the plate's equations (2.53 to 2.76), the sphere in two steps (to 2.52).

For points of one flat light sheet the 12 unknowns of eq. 2.73 are not determined by eq. 2.72,
however many postures there are: the points satisfy ``a x + b y + c z + D = 0`` (eq. 2.19), which
makes three combinations of the columns of `design_rows` vanish. The rank is 9 at most.

On a sphere each stripe's section circle gives the centre in the Sensor frame; postures that only
shift give the rotation, turned postures then give the translation. The sheet says how far the
centre lies from it, not on which side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.observations import (
    CircleSection,
    PlateReference,
    PosedStripe,
    check_diameter,
    find_sections,
)
from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, homogeneous
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import levenberg_marquardt
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.rotations import vector_from_rotation


def plane_in_tool(plane_base: FloatArray, base_from_tool: Pose[Base, Tool]) -> FloatArray:
    """Bring the plate into Tool (eqs. 2.57 and 2.58).

    Parameters
    ----------
    plane_base
        (4,) ``A B C D`` of eq. 2.55 in Base, D in mm.
    base_from_tool
        Pose of the arm; the thesis writes its inverse, ``tool_from_base``.

    Returns
    -------
    plane_tool
        (4,) of eq. 2.56: ``D_t = D_b - [A_t B_t C_t] T`` with T of ``tool_from_base``.
    """
    tool_from_base = base_from_tool.inverse()
    normal = tool_from_base.rotation @ plane_base[:3]
    return np.array([*normal, plane_base[3] - normal @ tool_from_base.translation_mm])


def design_rows(plane_tool: FloatArray, points_mm: FloatArray) -> FloatArray:
    """Rows H_ij (N, 12) of eqs. 2.72 and 2.75, of the plate (4,) in Tool and points (N, 3) in
    Sensor.
    """
    points = homogeneous(points_mm)
    rows = plane_tool[None, :3, None] * points[:, None, :]
    return np.asarray(rows.reshape(len(points_mm), 12))


def hand_eye_unknowns(tool_from_sensor: Pose[Tool, Sensor]) -> FloatArray:
    """X (12,) of eq. 2.73: r1 r2 r3 t_x r4 r5 r6 t_y r7 r8 r9 t_z."""
    return np.column_stack([tool_from_sensor.rotation, tool_from_sensor.translation_mm]).ravel()


def rotation_from_angles(theta_rad: float, gamma_rad: float, phi_rad: float) -> FloatArray:
    """R (3, 3) of eq. 2.69: Rx(theta) Ry(gamma) Rz(phi)."""
    ct, st = np.cos(theta_rad), np.sin(theta_rad)
    cg, sg = np.cos(gamma_rad), np.sin(gamma_rad)
    cp, sp = np.cos(phi_rad), np.sin(phi_rad)
    return np.array(
        [
            [cg * cp, -cg * sp, sg],
            [ct * sp + st * sg * cp, ct * cp - st * sg * sp, -st * cg],
            [st * sp - ct * sg * cp, st * cp + ct * sg * sp, ct * cg],
        ]
    )


def objective(
    plane_base: FloatArray,
    poses: list[Pose[Base, Tool]],
    points_mm: list[FloatArray],
    tool_from_sensor: Pose[Tool, Sensor],
) -> float:
    """F of eq. 2.76 in mm^2: the sum of squared distances of all points from the plate.

    ``plane_base``: (4,) ``A B C D`` with a unit normal. ``points_mm``: (N, 3) points of each scan
    in the Sensor frame.
    """
    unknowns = hand_eye_unknowns(tool_from_sensor)
    total = 0.0
    for pose, points in zip(poses, points_mm, strict=True):
        plane_tool = plane_in_tool(plane_base, pose)
        misclosure = design_rows(plane_tool, points) @ unknowns + plane_tool[3]  # eq. 2.74
        total += float(misclosure @ misclosure)
    return total


def minimise_objective(
    plane_base: FloatArray,
    poses: list[Pose[Base, Tool]],
    points_mm: list[FloatArray],
    start: Pose[Tool, Sensor],
) -> tuple[Pose[Tool, Sensor], float] | FitFailure:
    """Minimise F of eq. 2.76 over the six parameters of eqs. 2.69 and 2.70; arguments as there.

    Every point counts alike and the plate is exact: pose errors, the plate's flatness and the
    probed plane's uncertainty, which are common to many points, have no place in it.

    Returns
    -------
    tool_from_sensor, rms_mm
        Where F is least, and the root mean square distance of the points from the plate there.
    """
    planes = [plane_in_tool(plane_base, pose) for pose in poses]
    normals = np.repeat([plane[:3] for plane in planes], [len(p) for p in points_mm], axis=0)
    offsets = np.repeat([plane[3] for plane in planes], [len(p) for p in points_mm])
    points = np.concatenate(points_mm)

    def linearise(pose: Pose[Tool, Sensor]) -> tuple[FloatArray, FloatArray]:
        turned = pose.rotate(points)
        misclosure = np.einsum("ni,ni->n", turned + pose.translation_mm, normals) + offsets
        return misclosure, np.hstack([np.cross(turned, normals), normals])

    found = levenberg_marquardt(start, linearise, lambda pose, step: pose.retract(step))
    if found is None or found.system.covariance is None:
        return FitFailure(
            "the postures do not determine the minimum of eq. 2.76",
            "turn the tool more, about two or three axes",
        )
    return found.state, float(np.sqrt(found.chi2 / len(points)))


SAME_ROTATION_DEG = 0.1
"""Postures that turn by less against each other count as moved without turning."""


class PrintedHandEye(ArrayRecord):
    """A hand-eye by the printed equations, to set beside ours; it has no covariance.

    ``rms_mm`` is the root mean square of what its own equations leave.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    rms_mm: float
    equations: str


def as_printed(
    stripes: Sequence[PosedStripe],
    reference: PlateReference | float,
    start: Pose[Tool, Sensor],
) -> PrintedHandEye | FitFailure:
    """The hand-eye of the same stripes by the printed equations.

    Parameters
    ----------
    stripes
        One entry an exposure.
    reference
        The plate in Base, or the diameter of a sphere in mm.
    start
        Where the minimum of eq. 2.76 is looked for; the two steps on a sphere need none.
    """
    if not isinstance(reference, PlateReference):
        two = calibrate_in_two_steps(stripes, reference)
        if isinstance(two, FitFailure):
            return two
        rms_mm = float(np.sqrt(np.mean(two.centre_misfit_mm**2)))
        return PrintedHandEye(
            tool_from_sensor=two.tool_from_sensor, rms_mm=rms_mm, equations="eqs. 2.45 to 2.52"
        )
    found = minimise_objective(
        reference.plane.coefficients,
        [stripe.base_from_tool for stripe in stripes],
        [stripe.points_mm for stripe in stripes],
        start,
    )
    if isinstance(found, FitFailure):
        return found
    return PrintedHandEye(tool_from_sensor=found[0], rms_mm=found[1], equations="eq. 2.76")


RANK_RATIO = 1e-3
"""A direction that is weaker than the strongest by more is taken as missing."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoStepHandEye:
    """What the two steps give; a baseline without covariance.

    Parameters
    ----------
    side
        1 if the centre lies where the sheet's normal points, -1 if on the other side.
    shifted
        Names of the exposures from which the rotation came.
    centre_misfit_mm
        (n,) distance of each exposure's placed centre from the mean one.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    side: int
    shifted: tuple[str, ...]
    centre_misfit_mm: FloatArray


def calibrate_in_two_steps(
    stripes: Sequence[PosedStripe],
    diameter_mm: float,
    side: int | None = None,
) -> TwoStepHandEye | FitFailure:
    """Solve rotation (eqs. 2.49, 2.50), then translation (eq. 2.52).

    Parameters
    ----------
    stripes
        Exposures; at least four of them from one orientation of the tool, shifted in two or more
        directions, and three orientations that turn about different axes.
    diameter_mm
        Of the sphere.
    side
        On which side of the sheet the sphere's centre lies, 1 or -1 along the sheet's normal, the
        same for all exposures; None tries both and takes the one that contradicts less.
    """
    check_diameter(diameter_mm)
    sections, _ = find_sections(stripes, 0.5 * diameter_mm)
    if len(sections) < 4:
        return FitFailure(
            f"{len(sections)} usable sections of the sphere, two steps need more", "scan more"
        )
    sides = (1, -1) if side is None else (1 if side > 0 else -1,)
    solved = [_solve(sections, 0.5 * diameter_mm, s) for s in sides]
    good = [one for one in solved if isinstance(one, TwoStepHandEye)]
    if not good:
        return solved[0]
    return min(good, key=lambda one: float(one.centre_misfit_mm @ one.centre_misfit_mm))


def group_by_rotation(poses: Sequence[Pose[Base, Tool]], tolerance_deg: float) -> IntArray:
    """(n,) number of the orientation of each pose: equal within the tolerance of its group's first.

    Groups are numbered by size, largest first.
    """
    first: list[FloatArray] = []
    label = np.zeros(len(poses), dtype=np.int64)
    for k, pose in enumerate(poses):
        turns = [
            float(np.degrees(np.linalg.norm(vector_from_rotation(one.T @ pose.rotation))))
            for one in first
        ]
        near = int(np.argmin(turns)) if turns else 0
        if not turns or turns[near] > tolerance_deg:
            near = len(first)
            first.append(pose.rotation)
        label[k] = near
    order = np.argsort(-np.bincount(label, minlength=1), kind="stable")
    rank = np.zeros(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return rank[label]


def sphere_centres(sections: Sequence[CircleSection], radius_mm: float, side: int) -> FloatArray:
    """(n, 3) the sphere's centre in the Sensor frame, from the section circle and the sheet."""
    return np.array(
        [one.centre_mm + side * one.height_mm(radius_mm) * one.normal for one in sections]
    )


def _solve(
    sections: tuple[CircleSection, ...],
    radius_mm: float,
    side: int,
) -> TwoStepHandEye | FitFailure:
    centres = sphere_centres(sections, radius_mm, side)
    poses = [section.stripe.base_from_tool for section in sections]
    shifted = np.flatnonzero(group_by_rotation(poses, SAME_ROTATION_DEG) == 0)
    first = rotation_from_shifts([poses[k] for k in shifted], centres[shifted])
    if isinstance(first, FitFailure):
        return first
    rotation, _ = first
    second = translation_from_turns(poses, centres @ rotation.T)
    if isinstance(second, FitFailure):
        return second
    pose: Pose[Tool, Sensor] = Pose(rotation, second)
    placed = np.array([
        one.rotation @ (rotation @ centre + second) + one.translation_mm
        for one, centre in zip(poses, centres, strict=True)
    ])  # fmt: skip
    middle = placed.mean(axis=0)
    return TwoStepHandEye(
        pose,
        side,
        tuple(sections[k].stripe.source for k in shifted),
        np.asarray(np.linalg.norm(placed - middle, axis=1)),
    )


def rotation_from_shifts(
    poses: Sequence[Pose[Base, Tool]], centres_mm: FloatArray
) -> tuple[FloatArray, float] | FitFailure:
    """Rotation from postures that only shift (eqs. 2.48 to 2.50).

    Differences are taken from the mean of all postures, not from the first one, whose error would
    enter every column. With ``H = A b' = U S V'`` the rotation is ``V diag(1, 1, det(V U')) U'``;
    the print of eq. 2.50 lacks transpose and determinant.

    Parameters
    ----------
    poses
        ``base_from_tool`` of equal rotation.
    centres_mm
        (n, 3) the sphere's centre in the Sensor frame.

    Returns
    -------
    rotation
        (3, 3) of ``tool_from_sensor``.
    misfit_mm
        Root mean square of what eq. 2.49 leaves.
    """
    if len(poses) < 3:
        return FitFailure(
            f"only {len(poses)} postures share one orientation; the rotation needs three or more "
            "that shift without turning",
            "use the one-step solution, which needs no such postures",
        )
    shifts = -np.array([pose.rotation.T @ pose.translation_mm for pose in poses])
    target = shifts - shifts.mean(axis=0)
    seen = centres_mm - centres_mm.mean(axis=0)
    left, strength, right = np.linalg.svd(seen.T @ target)
    if strength[1] <= RANK_RATIO * strength[0]:
        return FitFailure(
            "the postures that share one orientation shift along one line",
            "shift the tool in two or three directions",
        )
    sign = np.linalg.det(right.T @ left.T)
    rotation = right.T @ np.diag([1.0, 1.0, sign]) @ left.T
    misfit = seen @ rotation.T - target
    return rotation, float(np.sqrt((misfit**2).sum(axis=1).mean()))


def translation_from_turns(
    poses: Sequence[Pose[Base, Tool]], turned_mm: FloatArray
) -> FloatArray | FitFailure:
    """Translation from turned postures (eq. 2.51), all stacked, with the centre in Base.

    Eq. 2.52 inverts ``R02 - R01``, which is always singular: its null space is the axis between
    the two. Three or more orientations about different axes determine it by least squares.

    Parameters
    ----------
    poses
        ``base_from_tool``.
    turned_mm
        (n, 3) the sphere's centre, turned to Tool but not shifted: ``R_s X_s``.
    """
    rows = np.concatenate([np.hstack([pose.rotation, -np.eye(3)]) for pose in poses])
    right = -np.concatenate([
        pose.rotation @ centre + pose.translation_mm
        for pose, centre in zip(poses, turned_mm, strict=True)
    ])  # fmt: skip
    solution, _, _, strength = np.linalg.lstsq(rows, right, rcond=None)
    if strength[-1] <= RANK_RATIO * strength[0]:
        return FitFailure(
            "the postures turn about one axis, or not at all, so that the translation along it is "
            "not determined",
            "turn the tool about two or three axes",
        )
    return np.asarray(solution[:3])
