# SPDX-License-Identifier: Apache-2.0
"""The thesis's equations as printed, and what one light sheet leaves open in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.observations import (
    CondensedObservations,
    PlateReference,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.surface import (
    HandEyeState,
    PlateSurface,
    place,
    smooth_along_stripes,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Points, Pose, Tool
from armscan.thesis.hand_eye import (
    design_rows,
    hand_eye_unknowns,
    minimise_objective,
    objective,
    plane_in_tool,
    rotation_from_angles,
)
from rigs.plate_rig import (
    PLATE_CENTRE,
    PLATE_NORMAL,
    SILENT,
    TOOL_FROM_SENSOR,
    PlateRig,
    good_postures,
)

POSE: Pose[Base, Tool] = Pose.from_vectors([0.4, -0.2, 1.1], [300.0, -120.0, 80.0])
PLANE = np.array([*PLATE_NORMAL, -float(PLATE_NORMAL @ PLATE_CENTRE)])
RIG = PlateRig(good_postures(8, np.random.default_rng(3)))
SURFACE = PlateSurface(PlateReference(plane=RIG.plane))
STEP = np.array([1e-3, -2e-3, 5e-4, 0.1, -0.2, 0.3])


def _nodes(noise_seed: int = 3) -> tuple[CondensedObservations, PlateRig]:
    rig = PlateRig(good_postures(8, np.random.default_rng(noise_seed)))
    stripes, _ = rig.draw(noise_seed)
    return condense_plate(stripes, straight_stripes(stripes), 6), rig


def test_a_point_is_as_far_from_the_plane_in_tool_as_in_base() -> None:
    """Eqs. 2.57 and 2.58: a point keeps its distance when both are brought into Tool."""
    points: Points[Tool] = Points(np.random.default_rng(0).normal(size=(5, 3)) * 50.0)
    in_base = (POSE @ points).xyz_mm @ PLANE[:3] + PLANE[3]
    tool = plane_in_tool(PLANE, POSE)
    np.testing.assert_allclose(points.xyz_mm @ tool[:3] + tool[3], in_base, atol=1e-10)


def test_printed_angles_give_the_printed_product() -> None:
    """Eq. 2.69 is Rx(theta) Ry(gamma) Rz(phi), as SciPy builds it."""
    angles = (0.3, -0.7, 1.9)
    expected = Rotation.from_euler("XYZ", angles).as_matrix()
    np.testing.assert_allclose(rotation_from_angles(*angles), expected, atol=1e-15)


def test_rows_times_unknowns_are_the_distance_from_the_plate() -> None:
    points = np.random.default_rng(1).normal(size=(4, 3)) * 30.0 + [0.0, 0.0, 140.0]
    tool = plane_in_tool(PLANE, POSE)
    rows = design_rows(tool, points)
    misclosure = rows @ hand_eye_unknowns(TOOL_FROM_SENSOR) + tool[3]
    placed = (POSE @ TOOL_FROM_SENSOR @ Points(points)).xyz_mm
    np.testing.assert_allclose(misclosure, placed @ PLANE[:3] + PLANE[3], atol=1e-9)


def test_the_objective_is_the_sum_of_squared_residuals() -> None:
    """Eq. 2.76 and the residuals that the refinement uses are the same numbers."""
    nodes, rig = _nodes()
    off = TOOL_FROM_SENSOR.retract(STEP)
    residual = place(nodes, SURFACE, HandEyeState(off, np.zeros(3))).residual_mm
    poses: list[Pose[Base, Tool]] = [
        Pose(r, t) for r, t in zip(nodes.rotations, nodes.translations_mm, strict=True)
    ]
    points = [nodes.points_mm[nodes.stripe == k] for k in range(len(poses))]
    total = objective(rig.plane.coefficients, poses, points, off)
    np.testing.assert_allclose(total, residual @ residual, rtol=1e-10)


def test_twelve_unknowns_have_rank_nine_and_the_nine_are_enough() -> None:
    """FINDINGS: points of one flat sheet satisfy its equation, so three columns are dependent."""
    rig = PlateRig(good_postures(12, np.random.default_rng(5)), SILENT)
    stripes, _ = rig.draw(0)
    rows = np.concatenate(
        [design_rows(plane_in_tool(PLANE, s.base_from_tool), s.points_mm) for s in stripes]
    )
    singular = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    assert int((singular > 1e-9 * singular[0]).sum()) == 9


def test_residuals_differentiate_as_stated() -> None:
    nodes, _ = _nodes()
    state = HandEyeState(TOOL_FROM_SENSOR.retract(STEP), np.array([1e-3, -2e-3, 0.2]))
    placed = place(nodes, SURFACE, state)

    def at(step: FloatArray) -> FloatArray:
        return place(nodes, SURFACE, state.retract(step)).residual_mm

    for k, size in enumerate([1e-6] * 3 + [1e-4] * 3 + [1e-6] * 2 + [1e-4, 1e-6]):
        step = np.zeros(10)
        step[k] = size
        numeric = (at(step) - at(-step)) / (2.0 * size)
        scale = max(float(np.abs(numeric).max()), 1.0)
        np.testing.assert_allclose(placed.jacobian[:, k], numeric, atol=1e-7 * scale)


def test_a_shifted_plane_is_the_plane_of_the_residuals() -> None:
    """The plane that a report shows is the one that the residuals were measured from."""
    nodes, _ = _nodes()
    shift = np.array([2e-3, -1e-3, 0.3])
    placed = place(nodes, SURFACE, HandEyeState(TOOL_FROM_SENSOR, shift))
    plane = SURFACE.plane_at(shift)
    np.testing.assert_allclose(
        plane.distance_mm(placed.points_base_mm), placed.residual_mm, atol=2e-6
    )


def test_the_minimum_of_the_objective_is_found_from_afar() -> None:
    """Eq. 2.76: exact points give the truth; noisy ones a value that no step lowers."""
    rig = PlateRig(good_postures(8, np.random.default_rng(3)), SILENT)
    far = TOOL_FROM_SENSOR.retract(np.array([0.1, -0.2, 0.15, 8.0, -5.0, 6.0]))
    for noisy in (rig, PlateRig(rig.postures)):
        stripes, _ = noisy.draw(3)
        poses = [stripe.base_from_tool for stripe in stripes]
        points = [stripe.points_mm for stripe in stripes]
        found = minimise_objective(PLANE, poses, points, far)
        assert not isinstance(found, FitFailure)
        pose, rms_mm = found
        least = objective(PLANE, poses, points, pose)
        assert rms_mm**2 * sum(map(len, points)) == pytest.approx(least, rel=1e-6, abs=1e-9)
        if noisy is rig:
            np.testing.assert_allclose(
                pose.translation_mm, TOOL_FROM_SENSOR.translation_mm, atol=1e-5
            )
            continue
        for k in range(6):
            for way in (-1.0, 1.0):
                beside = pose.retract(way * 1e-4 * np.eye(6)[k] * (1.0 if k < 3 else 100.0))
                assert objective(PLANE, poses, points, beside) > least


def test_derivatives_along_a_stripe_are_those_of_points_without_errors() -> None:
    """Of errors across the stripe; of six observations a parabola keeps three parts of six."""
    observations, _ = _nodes()
    state = HandEyeState(TOOL_FROM_SENSOR, SURFACE.start)
    exact = place(observations, SURFACE, state).jacobian
    np.testing.assert_allclose(smooth_along_stripes(observations, exact), exact, atol=2e-3)
    points = observations.points_mm
    along = np.repeat(points[5::6] - points[::6], 6, axis=0)
    across = np.cross(along, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across, axis=1)[:, None]
    errors = np.random.default_rng(1).normal(0.0, 0.1, (len(points), 1)) * across
    erring = replace(observations, points_mm=points + errors)
    noisy = place(erring, SURFACE, state).jacobian
    smooth = smooth_along_stripes(erring, noisy)
    left = np.square(smooth - exact)[:, :3].sum() / np.square(noisy - exact)[:, :3].sum()
    assert left == pytest.approx(3 / 6, abs=0.2)


def test_stripes_of_one_or_two_observations_keep_their_derivatives() -> None:
    observations, _ = _nodes()
    values = np.random.default_rng(2).normal(size=(len(observations), 4))
    for n in (1, 2):
        kept = np.arange(len(observations)) % 6 < n
        few, own = observations.select(kept), values[kept]
        np.testing.assert_allclose(smooth_along_stripes(few, own), own, atol=1e-6)
