# SPDX-License-Identifier: Apache-2.0
"""The search for the least minimum, and what keeps the refinement on a sphere near it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate, calibrate_on_sphere
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PosedStripe,
    condense_plate,
    find_sections,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.search import (
    descend_all,
    distinct,
    find_start,
    many_placed,
    minima_on_plate,
    minima_on_sphere,
    placed_on_plate,
    plate_in_tool,
    rotations_all_over,
    unit_steps,
)
from armscan.calibration.hand_eye.surface import PlateSurface
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose, Sensor, Tool
from rigs.plate_rig import PLATE_NORMAL, TOOL_FROM_SENSOR, PlateRig, Postures, good_postures
from rigs.sphere_rig import CENTRE_MM, DIAMETER_MM, HAND_EYE, SphereRig

FORM_MM = 0.04
QUICK = HandEyeOptions(per_stripe=10)


def test_the_rotations_leave_no_orientation_far_away() -> None:
    """200 balls of equal size that filled the rotations would reach 22 degrees."""
    rotations = rotations_all_over(200)
    traces = np.einsum(
        "kij,nij->nk", rotations, Rotation.random(2000, rng=np.random.default_rng(1)).as_matrix()
    )
    nearest = np.degrees(np.arccos(np.clip(0.5 * (traces.max(axis=1) - 1.0), -1.0, 1.0)))
    assert nearest.max() < 40.0
    assert np.linalg.det(rotations) == pytest.approx(1.0)


def test_distinct_takes_the_least_costly_of_alike_rotations() -> None:
    turns = Rotation.from_rotvec([[0.0, 0.0, a] for a in (0.0, 0.01, 1.0, 1.01, 2.0)]).as_matrix()
    kept = distinct(turns, np.array([2.0, 1.0, 3.0, 4.0, 5.0]), 0.05, 2)
    assert kept.tolist() == [1, 2]


def _hardly_turned(rig: SphereRig, rng: np.random.Generator) -> list[PosedStripe]:
    """A robot's set: six postures that only shift, nine turned a little about one axis each."""
    turns = np.zeros((15, 3))
    turns[np.arange(6, 15), np.repeat([0, 1, 2], 3)] = np.tile([0.1, 0.17, 0.25], 3)
    heights = np.resize([1.0, -1.5, 0.5, 4.0, 9.0, 0.2, 2.0], 15)
    poses = [
        rig.base_from_tool(turn, height, rng.uniform(-8.0, 8.0), rng.uniform(-12.0, 12.0))
        for turn, height in zip(turns, heights, strict=True)
    ]
    return rig.stripes(poses, rng)


@pytest.mark.parametrize("seed", range(5))
def test_the_spheres_minimum_is_no_worse_than_the_truths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stripes = _hardly_turned(SphereRig(pose_noise_mm=0.1, point_noise_mm=0.01), rng)
    sections, _ = find_sections(stripes, 0.5 * DIAMETER_MM)
    best = minima_on_sphere(sections, 0.5 * DIAMETER_MM)[0]

    def left(pose: Pose[Tool, Sensor], centre: FloatArray) -> float:
        total = 0.0
        for section in sections:
            moved = section.stripe.base_from_tool @ pose
            placed = section.points_mm @ moved.rotation.T + moved.translation_mm
            off = np.linalg.norm(placed - centre, axis=1) - 0.5 * DIAMETER_MM
            total += float((off**2).mean())
        return total

    assert left(best.tool_from_sensor, best.surface[:3]) < left(HAND_EYE, CENTRE_MM)


def test_stripes_of_a_wrong_curvature_do_not_drive_the_refinement_away() -> None:
    """Radii wrong by 0.04 mm near the great circle, as of real profiles: the centre's height
    over its sheet is then wrong by a millimetre, and must not be believed.
    """
    rng = np.random.default_rng(1)
    rig = SphereRig(pose_noise_mm=0.1, point_noise_mm=0.01)
    stripes = []
    for stripe in _hardly_turned(rig, rng):
        radial = (
            stripe.noise_mm[:, :, 0] / np.linalg.norm(stripe.noise_mm[:, :, 0], axis=1)[:, None]
        )
        wrong = stripe.points_mm + rng.normal(0.0, FORM_MM) * radial
        stripes.append(replace(stripe, points_mm=wrong))
    fit = calibrate_on_sphere(stripes, DIAMETER_MM, QUICK)
    assert isinstance(fit, HandEyeFit)
    assert fit.calibration.rms_mm < 0.2
    assert fit.calibration.arm_noise.position_mm == pytest.approx(0.1, rel=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_few_postures_on_a_plate_lead_to_the_truth_from_nowhere(seed: int) -> None:
    """Five hardly tilted postures: too few for the linear start."""
    rng = np.random.default_rng(seed)
    postures = Postures(
        rng.uniform(0.0, 0.3, 5),
        rng.uniform(0.0, 6.3, 5),
        rng.uniform(-1.0, 1.0, 5),
        rng.uniform(120.0, 160.0, 5),
        rng.uniform(-80.0, 80.0, (5, 2)),
    )
    stripes, plate = PlateRig(postures).draw(seed)
    nodes = condense_plate(stripes, straight_stripes(stripes), 3)
    turns = [
        Rotation.from_matrix(pose.rotation.T @ TOOL_FROM_SENSOR.rotation).magnitude()
        for pose in minima_on_plate(nodes, PlateSurface(plate))
    ]
    assert min(turns) < np.radians(3.0)


def test_a_pose_that_is_off_by_a_metre_does_not_spoil_the_start() -> None:
    for seed in range(3):
        rig = PlateRig(good_postures(12, np.random.default_rng([1, seed])))
        stripes, plate = rig.draw(seed)
        pose = stripes[4].base_from_tool
        far = Pose(pose.rotation, pose.translation_mm + 1000.0 * PLATE_NORMAL)
        wrong = [*stripes[:4], replace(stripes[4], base_from_tool=far), *stripes[5:]]
        fit = calibrate_on_plate(wrong, plate)
        assert isinstance(fit, HandEyeFit)
        assert any("left out 1 postures" in text and "posture04" in text for text in fit.warnings)


def test_descents_over_points_of_their_own_are_those_made_one_by_one() -> None:
    """A batch of subsets: places, poses and units of one must not reach another."""
    stripes, plate = PlateRig(good_postures(9, np.random.default_rng(4))).draw(3)
    observations = condense_plate(stripes, straight_stripes(stripes), 3)
    surface, random = PlateSurface(plate), np.random.default_rng(5)
    rows = np.array([random.choice(len(observations), 18, replace=False) for _ in range(6)])
    points, stripe = observations.points_mm[rows], observations.stripe[rows]
    normals, constants = (item[rows] for item in plate_in_tool(observations, plate.plane))
    starts, shifts = rotations_all_over(6), random.normal(0.0, 50.0, (6, 3))
    units = np.array([unit_steps(one, 3) for one in points])
    place = placed_on_plate(points, normals, constants)
    together = descend_all(place, starts, shifts, 6, units)
    for k in range(6):
        poses = observations.rotations[stripe[k]], observations.translations_mm[stripe[k]]
        place = many_placed(points[k], *poses, surface)
        alone = descend_all(place, starts[k : k + 1], shifts[k : k + 1], 6, units[k])
        for many, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(many[k], one[0], rtol=1e-9, atol=1e-9)


def test_a_swapped_pose_is_found_among_postures_of_unequal_count() -> None:
    """Subsets hold 6 to 12 stripes here: rows that fill a short one up must weigh nothing."""
    rig = PlateRig(good_postures(12, np.random.default_rng(6)))
    stripes, plate = rig.draw(7)
    stripes += [replace(one, source=f"{one.source} again") for one in stripes[:5]]
    far = replace(
        stripes[9],
        base_from_tool=Pose(
            stripes[9].base_from_tool.rotation, stripes[9].base_from_tool.translation_mm + 40.0
        ),
    )
    stripes[9] = far
    start = find_start(condense_plate(stripes, straight_stripes(stripes), 12), PlateSurface(plate))
    assert np.flatnonzero(start.is_wrong).tolist() == [9]
    apart = start.tool_from_sensor.translation_mm - TOOL_FROM_SENSOR.translation_mm
    assert np.linalg.norm(apart) < 0.3
