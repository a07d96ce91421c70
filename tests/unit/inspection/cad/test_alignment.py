# SPDX-License-Identifier: Apache-2.0
"""Clouds laid on models: found without a guess, what is not held, stated certainty, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad import search
from armscan.inspection.cad.alignment import (
    Alignment,
    align_best,
    align_none,
    fit_to_part,
    free_text,
)
from armscan.inspection.cad.comparison import CadComparison, CadOptions, compare_with_part
from armscan.inspection.cad.datums import align_datums
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import PartModel, part_of
from armscan.inspection.cad.search import closer, even_turns, scale_mismatch, spread_rows
from rigs.inspection_clouds import cloud_of
from rigs.parts import box_corners, turned, wedge_part

CAD_FROM_PART: Pose[Cad, Part] = Pose(
    Rotation.from_rotvec([0.9, -1.7, 0.4]).as_matrix(), np.array([120.0, -40.0, 310.0])
)
PLATE = part_of(box_corners([0, 0, 0.0], [100, 80, 5]), source="plate")
STEPPED = part_of(
    turned(np.array([[0, 0], [20, 0], [20, 10], [12, 15], [12, 40], [0, 40.0]])), source="stepped"
)
WEDGE = PartSurface(wedge_part())


def scanned(
    part: PartModel, n: int = 15_000, noise: float = 0.02, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Points of a part with noise along the normal, and these normals, in Cad."""
    points, triangle = part.surface_points(n, seed)
    normals = part.normals[triangle]
    random = np.random.default_rng(seed + 1)
    return points + random.normal(0.0, noise, n)[:, None] * normals, normals


def laid(surface: PartSurface, points: FloatArray, normals: FloatArray | None = None) -> Alignment:
    back = CAD_FROM_PART.inverse()
    turned_normals = None if normals is None else back.rotate(normals)
    found = align_best(surface, cloud_of(back.apply(points), normals=turned_normals), True)
    assert isinstance(found, Alignment), found
    return found


@pytest.fixture
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of the starting turns: enough for what is no test of the search, and quicker."""
    monkeypatch.setattr(search, "TURNS", 140)


def test_a_part_of_a_scan_finds_its_place() -> None:
    points, _ = scanned(WEDGE.part)
    points = points[points @ [1.0, 0.5, 0.3] > 60.0]
    found = laid(WEDGE, points)
    moved = found.cad_from_part.apply(CAD_FROM_PART.inverse().apply(points))
    assert np.linalg.norm(moved - points, axis=1).max() < 0.01
    assert found.free == ()
    assert found.rms_mm == pytest.approx(0.02, rel=0.1)


@pytest.mark.usefixtures("few_starts")
def test_a_patch_of_a_plate_slides_and_turns() -> None:
    points, normals = scanned(PLATE)
    patch = (normals[:, 2] > 0.9) & (np.abs(points - [50, 40, 5]).max(axis=1) < 20.0)
    found = laid(PartSurface(PLATE), points[patch], normals[patch])
    assert sorted(one.kind for one in found.free) == ["shift", "shift", "turn"]
    turn = next(one for one in found.free if one.kind == "turn")
    assert abs(turn.direction[2]) > 0.999
    assert all(abs(one.direction[2]) < 0.01 for one in found.free if one.kind == "shift")
    # what is held is stated: the height, and both tilts
    sigma = np.sqrt(np.diag(found.step_covariance))
    assert sigma[5] > 1e-4
    assert max(sigma[3], sigma[4]) < 1e-6


@pytest.mark.usefixtures("few_starts")
def test_a_turned_part_turns_about_its_axis_though_its_triangles_are_flat() -> None:
    points, _ = scanned(STEPPED)
    found = laid(PartSurface(STEPPED), points)
    assert len(found.free) == 1
    motion = found.free[0]
    assert motion.kind == "turn"
    assert abs(motion.direction[2]) > 0.9999
    # a twentieth of a facet's breadth: facets alone lean the fit by so much
    assert np.abs(motion.point_mm[:2]).max() < 0.05 * 2.0 * 20.0 * np.sin(np.pi / 90)
    assert not found.rivals
    assert "turn about Z" in free_text(found.free)


def test_a_box_has_four_poses() -> None:
    box = part_of(box_corners([0, 0, 0.0], [60, 40, 20]), source="box")
    points, _ = scanned(box)
    found = laid(PartSurface(box), points)
    assert sum(one.is_equal for one in found.rivals) == 3
    costs = [one.cost for one in found.rivals]
    assert costs == sorted(costs)
    assert any("equally well" in text for text in found.warnings)


def test_a_small_mark_tells_the_poses_of_a_box_apart() -> None:
    corners = box_corners([0, 0, 0.0], [60, 40, 20])
    part = part_of(
        np.concatenate([corners, box_corners([5, 5, 20.0], [12, 10, 23])]), source="marked box"
    )
    points, _ = scanned(part, 20_000)
    found = laid(PartSurface(part), points)
    moved = found.cad_from_part.apply(CAD_FROM_PART.inverse().apply(points))
    assert np.linalg.norm(moved - points, axis=1).max() < 0.01
    assert not any(one.is_equal for one in found.rivals)


@pytest.mark.usefixtures("few_starts")
def test_the_mirrored_part_and_another_part_are_refused() -> None:
    points, _ = scanned(WEDGE.part)
    mirrored = align_best(WEDGE, cloud_of(points * [1.0, 1.0, -1.0]), True)
    assert isinstance(mirrored, FitFailure)
    assert "mirror" in mirrored.reason
    other = align_best(PartSurface(STEPPED), cloud_of(points), True)
    assert isinstance(other, FitFailure)
    assert "does not fit" in other.reason


@pytest.mark.parametrize(
    ("factor", "word"), [(1e-3, "metres"), (1e3, "metres"), (1 / 25.4 / 10, ""), (25.4, "inches")]
)
def test_units_are_noticed(factor: float, word: str) -> None:
    points, _ = scanned(WEDGE.part, 2000)
    found = scale_mismatch(WEDGE, points * factor)
    if not word:
        found = scale_mismatch(WEDGE, points)
        assert found is None
    else:
        assert found is not None
        assert word in found.reason


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize(
    ("factor", "word"),
    [(1 / 25.4, "cloud seems to be in inches"), (0.1, "cloud seems to be in centimetres")],
)
def test_a_small_cloud_that_fits_much_better_enlarged_is_in_another_unit(
    factor: float, word: str
) -> None:
    """Small as it is, it fits on one face; its own relief tells the unit."""
    points, _ = scanned(WEDGE.part)
    found = align_best(WEDGE, cloud_of(points * factor), True)
    assert isinstance(found, FitFailure)
    assert word in found.reason
    assert "leave --unit" in found.remedy


@pytest.mark.usefixtures("few_starts")
def test_a_small_patch_of_the_part_is_in_the_right_unit() -> None:
    """A tenth of the plate, 0.05 mm of noise: scaling makes it fit no better over its size."""
    points, normals = scanned(PLATE, 60_000, 0.05)
    patch = (normals[:, 2] > 0.9) & (np.abs(points - [50, 40, 5])[:, :2].max(axis=1) < 5.0)
    cloud = cloud_of(points[patch], sigma_mm=0.001, normals=normals[patch])
    assert len(cloud) > 150
    assert isinstance(align_best(PartSurface(PLATE), cloud, True), Alignment)


@pytest.mark.usefixtures("few_starts")
def test_a_cloud_that_lies_a_hundredth_of_its_size_off_is_of_another_part() -> None:
    """Waves of 2 mm on a patch of 30 mm, near the plate as its size goes, and not of it."""
    x, y = np.meshgrid(np.linspace(-15, 15, 40), np.linspace(-15, 15, 40))
    waves = np.column_stack([x.ravel(), y.ravel(), 2.0 * np.sin(x.ravel()) * np.sin(y.ravel())])
    found = align_best(PartSurface(PLATE), cloud_of(waves), True)
    assert isinstance(found, FitFailure)
    assert "does not fit" in found.reason


def test_too_few_points_are_refused() -> None:
    found = align_best(WEDGE, cloud_of(scanned(WEDGE.part, 50)[0]), True)
    assert isinstance(found, FitFailure)


def test_points_in_one_place_are_not_called_metres() -> None:
    """The same point many times, and a heap of a tenth of a micrometre, are in no unit a part."""
    for size in (0.0, 1e-4):
        heap = 5.0 + size * np.random.default_rng(3).normal(size=(5000, 3))
        found = align_best(WEDGE, cloud_of(heap), True)
        assert isinstance(found, FitFailure)
        assert "all points of the cloud lie within" in found.reason


def noisy_trials(n_trials: int) -> tuple[list[float], list[float]]:
    """Normalised squares of the pose's errors, and face means over their U, of many scans.

    Each exposure is shifted as a whole, each point has noise of its own. There are so few exposures
    that none are taken together, which would be careful.
    """
    own, common, n = 0.02, 0.01, 1500
    squares, ratios = [], []
    for trial in range(n_trials):
        random = np.random.default_rng(100 + trial)
        points, triangle = WEDGE.part.surface_points(n, trial)
        normals = WEDGE.part.normals[triangle]
        exposure = np.minimum((points[:, 0] / 80.0 * 10.0).astype(np.int64), 9)
        shifts = random.normal(0.0, common, (10, 3))
        noisy = points + normals * random.normal(0.0, own, n)[:, None] + shifts[exposure]
        cloud = cloud_of(noisy, exposure, sigma_mm=common, noise_mm=own, noise_along=normals)
        fit = fit_to_part(WEDGE, cloud, Pose(np.eye(3), np.zeros(3)), True)
        at = fit.centre_mm
        step = np.concatenate(
            [fit.cad_from_part.rotation_vector_rad, fit.cad_from_part.apply(at) - at]
        )
        squares.append(float(step @ np.linalg.solve(fit.step_covariance, step)))
        found = compare_with_part(WEDGE, cloud, fit, CadOptions(), True)
        assert isinstance(found, CadComparison)
        seen = [one for one in found.faces if one.statistics.n >= 100]
        ratios += [one.statistics.mean_mm / one.u_mean_mm for one in seen]
    return squares, ratios


def test_the_stated_covariance_is_that_of_many_scans() -> None:
    trials = 40
    squares, ratios = noisy_trials(trials)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * trials)
    assert low < sum(squares) < high
    inside = np.mean(np.abs(ratios) < 1.0)
    assert 0.93 < inside <= 0.995


def test_datums_take_what_they_hold_one_after_the_other() -> None:
    """The first face is met on the whole, though others disagree by a tenth."""
    part = WEDGE.part
    points, triangle = part.surface_points(20_000, 3)
    normals, face = part.normals[triangle], part.face[triangle]
    first = [int(part.face[np.argmax(part.normals @ way)]) for way in np.eye(3) * -1.0]
    datums = (first[2], first[1], first[0])
    high = points + 0.1 * normals * (face == first[1])[:, None]
    cloud = cloud_of(CAD_FROM_PART.inverse().apply(high))
    start = fit_to_part(WEDGE, cloud, CAD_FROM_PART, True)
    found = align_datums(WEDGE, cloud, datums, start)
    assert isinstance(found, Alignment)
    assert found.free == ()
    moved = found.cad_from_part.apply(cloud.points_mm)
    for number in datums:
        d = np.einsum("ij,ij->i", moved - points, normals)[face == number]
        assert np.abs(d).max() < 1e-3
    # so the faces opposite carry the tenth
    assert np.abs(moved - high)[:, 1] == pytest.approx(np.full(len(high), 0.1), abs=2e-3)


def test_a_datum_face_without_points_is_named() -> None:
    points, normals = scanned(WEDGE.part)
    part = WEDGE.part
    below = int(part.face[np.argmin(part.normals[:, 2])])
    cloud = cloud_of(points[normals[:, 2] > -0.5])
    start = fit_to_part(WEDGE, cloud, Pose(np.eye(3), np.zeros(3)), True)
    found = align_datums(WEDGE, cloud, (below, 0, 1), start)
    assert isinstance(found, FitFailure)
    assert part.face_names[below] in found.reason


def test_no_alignment_takes_the_frame_as_it_is() -> None:
    points, _ = scanned(WEDGE.part, 500)
    found = align_none(cloud_of(points))
    assert np.array_equal(found.cad_from_part.matrix, np.eye(4))
    assert not found.step_covariance.any()


def test_turns_are_spread_evenly() -> None:
    """The farthest of random turns from the nearest start is what the descent must bridge."""
    turns = even_turns(700)
    assert np.allclose(turns @ np.swapaxes(turns, 1, 2), np.eye(3), atol=1e-12)
    probes = Rotation.random(300, random_state=0).as_matrix()
    traces = np.einsum("aij,bij->ab", probes, turns).max(axis=1)
    angle = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    assert angle.max() < 32.0


def test_rows_are_spread_over_the_surface_however_dense() -> None:
    random = np.random.default_rng(0)
    dense = random.uniform(0.0, 1.0, (20_000, 3)) * [10, 10, 0]
    thin = random.uniform(0.0, 1.0, (2_000, 3)) * [10, 10, 0] + [10, 0, 0]
    rows = spread_rows(np.concatenate([dense, thin]), 400)
    assert len(np.unique(rows)) == 400
    assert 120 < int((rows >= 20_000).sum()) < 280


def test_few_points_that_alone_hold_a_motion_are_not_taken_for_outliers() -> None:
    """A plate seen from above, with 25 points on each side: where it begins 0.3 mm off, these lie
    beyond 4.7 robust standard deviations. Weighted so from the start, it stayed there.
    """
    random = np.random.default_rng(3)
    flat = np.column_stack([random.uniform([0, 0], [100, 80], (2900, 2)), np.full(2900, 5.0)])
    ends = random.uniform([0, 0, 0], [100, 80, 5], (100, 3))
    ends[:50, 0] = np.repeat([0.0, 100.0], 25)
    ends[50:, 1] = np.repeat([0.0, 80.0], 25)
    points = np.concatenate([flat, ends]) + random.normal(0.0, 0.02, (3000, 3))
    off: Pose[Cad, Part] = Pose(np.eye(3), np.array([0.3, -0.3, 0.0]))
    surface = PartSurface(PLATE)
    stuck = closer(surface, points, None, off, 16)
    found = closer(surface, points, None, off, 16, widened=search.WIDENED)
    assert np.abs(stuck.translation_mm).max() > 0.2
    five_sigma = 5.0 * 0.02 / np.sqrt(50)
    assert np.abs(found.translation_mm).max() < five_sigma
