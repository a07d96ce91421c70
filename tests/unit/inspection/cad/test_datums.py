# SPDX-License-Identifier: Apache-2.0
"""Alignment by features and by reference points, beside SciPy's, geometry and many draws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armscan.errors import FileFormatError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import SHAPE_KINDS, fit_shape
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.alignment import Alignment, align_none
from armscan.inspection.cad.comparison import CadComparison, CadOptions, compare_with_part
from armscan.inspection.cad.datums import (
    DatumFeature,
    Datums,
    align,
    align_features,
    datum_face,
)
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import part_of
from armscan.inspection.cad.reference_points import (
    ReferencePoints,
    align_points,
    paired_markers,
)
from armscan.records.points import MarkerSet
from armscan.storage.parts.tables import datum_features, read_reference_markers
from armscan.storage.points import markers_csv
from rigs.inspection_clouds import cloud_of
from rigs.parts import box_corners, extruded, turned

TURN = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
BOSS_AT = np.array([55.0, 18.0, 20.0])
BOSS = extruded(8.0 * np.column_stack([np.cos(TURN), np.sin(TURN)]), 14.0) + BOSS_AT
FIXED = part_of(
    np.concatenate([box_corners([0, 0, 0], [70, 40, 20]), BOSS]), source="plate with boss"
)
SURFACE = PartSurface(FIXED)
BACK: Pose[Part, Cad] = Pose(
    Rotation.from_rotvec([0.004, -0.003, 0.005]).as_matrix(), np.array([0.2, -0.1, 0.15])
)
"""A cloud lies so far from the model: a best fit would begin as near."""


def face_at(point: list[float]) -> str:
    middles = FIXED.vertices_mm[FIXED.triangles].mean(axis=1)
    nearest = int(np.linalg.norm(middles - point, axis=1).argmin())
    return FIXED.face_names[int(FIXED.face[nearest])]


NAMES = (face_at([20.0, 20.0, 20.0]), face_at([63.0, 18.0, 27.0]), face_at([35.0, 0.0, 10.0]))
A, B, C = (datum_face(FIXED.face_names.index(name), FIXED) for name in NAMES)
DATUMS = tuple(one for one in (A, B, C) if isinstance(one, DatumFeature))


def scan(
    seed: int, n: int = 9_000, noise: float = 0.0, off: dict[str, FloatArray] | None = None
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Points, normals and faces; whole faces carried off by a vector."""
    points, triangle = FIXED.surface_points(n, seed)
    normals, face = FIXED.normals[triangle], FIXED.face[triangle]
    for name, way in (off or {}).items():
        points = points + way * (face == FIXED.face_names.index(name))[:, None]
    random = np.random.default_rng(seed)
    return points + normals * random.normal(0.0, noise, n)[:, None], normals, face


def started() -> Alignment:
    return replace(align_none(cloud_of(np.zeros((3, 3)))), cad_from_part=BACK.inverse())


def by_features(cloud_mm: FloatArray, datums: tuple[DatumFeature, ...]) -> Alignment:
    found = align_features(SURFACE, cloud_of(BACK.apply(cloud_mm)), datums, started())
    assert isinstance(found, Alignment), found
    return found


def test_faces_are_the_features_that_they_are() -> None:
    kinds = [one.shape.kind for one in DATUMS]
    assert kinds == ["plane", "cylinder", "plane"]
    assert DATUMS[1].shape.radius_mm == pytest.approx(8.0)
    assert DATUMS[2].shape.direction == pytest.approx([0.0, -1.0, 0.0])
    ring = part_of(turned(np.array([[0, 0], [9, 0], [14, 3], [9, 6], [0, 6.0]])), source="ring")
    bent = [datum_face(k, ring) for k in range(len(ring.face_names))]
    assert sorted(one.shape.kind for one in bent if isinstance(one, DatumFeature)) == [
        "cone", "cone", "plane", "plane",
    ]  # fmt: skip


def test_of_a_symmetric_part_the_datums_tell_which_equal_pose_is_meant() -> None:
    """A box lies four ways alike; the three faces that were scanned are the datums."""
    box = part_of(box_corners([0, 0, 0], [40, 30, 10]), source="box")
    surface, rng = PartSurface(box), np.random.default_rng(4)
    u, v = rng.uniform(size=(2, 7000))
    top = np.column_stack([40 * u, 30 * v, np.full(7000, 10.1)])[:4000]
    front = np.column_stack([40 * u, np.full(7000, -0.05), 10 * v])[4000:5500]
    side = np.column_stack([np.full(7000, 39.92), 30 * u, 10 * v])[5500:]
    points = np.concatenate([top, front, side]) + rng.normal(0.0, 0.005, (7000, 3))
    middles = box.vertices_mm[box.triangles].mean(axis=1)
    seen = [
        int(box.face[int(np.linalg.norm(middles - place, axis=1).argmin())])
        for place in ([20.0, 15.0, 10.0], [20.0, 0.0, 5.0], [40.0, 15.0, 5.0])
    ]
    middle = np.array([20.0, 15.0, 5.0])
    for flips in ([1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]):
        cloud = cloud_of((points - middle) * flips + middle, sigma_mm=0.0)
        found = align(surface, cloud, "321", Datums(faces=tuple(seen)), False)
        assert isinstance(found, Alignment), found
        placed = found.cad_from_part.apply(cloud.points_mm)
        for rows, k, place in (
            (slice(0, 4000), 2, 10.0),
            (slice(4000, 5500), 1, 0.0),
            (slice(5500, 7000), 0, 40.0),
        ):
            assert np.median(placed[rows, k]) == pytest.approx(place, abs=0.002)


def test_datums_hold_in_their_order() -> None:
    """The boss stands 0.1 mm off in x and y and the side leans: A, then B, then C tells the pose.

    A takes both tilts and the height, B's axis the place, C the turn alone: the side's offset
    stays as a residual. Worked out by hand.
    """
    lean = 1e-3
    points, _, face = scan(0, off={NAMES[1]: np.array([0.1, 0.1, 0.0])})
    on_side = face == FIXED.face_names.index(NAMES[2])
    points[on_side, 1] += lean * (points[on_side, 0] - 35.0) + 0.05
    found = by_features(points, DATUMS)
    assert found.free == ()
    assert [len(one.held) for one in found.datums] == [3, 2, 1]
    carried = found.cad_from_part @ BACK
    # the frame turned back by the lean, about z, and the boss brought to its place
    assert carried.rotation_vector_rad == pytest.approx([0.0, 0.0, -lean], abs=2e-5)
    assert carried.apply(np.array([[55.1, 18.1, 20.0]]))[0] == pytest.approx(
        [55.0, 18.0, 20.0], abs=1e-3
    )
    # the side's middle was 0.05 mm inside and is carried with the boss, and turned
    middle = carried.apply(np.array([[35.0, 0.05, 10.0]]))[0, 1]
    assert found.datums[2].left_mm == pytest.approx(abs(middle), abs=2e-3)
    assert found.datums[0].left_mm < 1e-6


def test_another_order_gives_another_pose_and_the_first_is_always_met() -> None:
    points, _, _ = scan(0, off={NAMES[2]: np.array([0.0, 0.1, 0.0])})
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        found = by_features(points, tuple(DATUMS[k] for k in order))
        assert found.datums[0].left_mm < 1e-6
        assert found.free == ()


def test_second_and_third_datum_are_met_by_constrained_least_squares() -> None:
    """As SciPy minimises all points of the second, with what the first left."""
    from scipy.optimize import least_squares

    lean = 5e-4
    points, _, face = scan(1)
    on_side = face == FIXED.face_names.index(NAMES[2])
    # small, so that a turn's square times the part's size is below the tolerances
    points[on_side, 1] += lean * (points[on_side, 0] - 20.0) + 5e-4 * (points[on_side, 2] - 4.0)
    found = by_features(points, (DATUMS[0], DATUMS[2]))
    on_top = face == FIXED.face_names.index(NAMES[0])
    plane = fit_shape("plane", points[on_top])
    assert not isinstance(plane, FitFailure)

    def left(values: FloatArray) -> FloatArray:
        turn = Rotation.from_rotvec([0.0, 0.0, values[0]])
        moved = turn.apply(points[on_side])
        return np.asarray(moved[:, 1] + values[1])

    best = least_squares(left, [0.0, 0.0], xtol=1e-14, ftol=1e-14).x
    carried = found.cad_from_part @ BACK
    assert carried.rotation_vector_rad[2] == pytest.approx(best[0], abs=2e-6)
    y = carried.apply(points[on_side])[:, 1]
    assert y.mean() == pytest.approx(left(best).mean(), abs=1e-5)
    assert [one.kind for one in found.free] == ["shift"]
    assert abs(found.free[0].direction[0]) > 0.99


def test_a_size_holds_nothing() -> None:
    points, normals, face = scan(2)
    wide = points + 0.05 * normals * (face == FIXED.face_names.index(NAMES[1]))[:, None]
    found, wider = by_features(points, DATUMS), by_features(wide, DATUMS)
    moved = wider.cad_from_part.apply(BACK.apply(points)) - points
    assert np.abs(moved).max() < 2e-3
    # facets of the boss stand 0.003 mm inside their circle
    assert np.abs(found.cad_from_part.apply(BACK.apply(points)) - points).max() < 1e-3


def test_motion_of_the_cloud_does_not_matter() -> None:
    """Frame invariance: a cloud elsewhere, started as far off, is laid on the same place."""
    points, _, _ = scan(3, noise=0.01)
    here = by_features(points, DATUMS)
    away: Pose[Part, Part] = Pose(
        Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix(), np.array([200.0, 50.0, -90.0])
    )
    cloud = cloud_of(away.apply(BACK.apply(points)))
    start = replace(started(), cad_from_part=BACK.inverse() @ away.inverse())
    there = align_features(SURFACE, cloud, DATUMS, start)
    assert isinstance(there, Alignment)
    both = there.cad_from_part @ away
    assert both.matrix == pytest.approx(here.cad_from_part.matrix, abs=1e-7)


def test_the_stated_covariance_of_features_is_that_of_many_scans() -> None:
    """Also of a mean of a face, whose points share their errors with the alignment."""
    own, common, n, trials = 0.02, 0.01, 1500, 25
    squares, ratios = [], []
    for trial in range(trials):
        random = np.random.default_rng(700 + trial)
        points, normals, _ = scan(trial, n)
        exposure = np.minimum((points[:, 0] / 70.0 * 10.0).astype(np.int64), 9)
        shifts = random.normal(0.0, common, (10, 3))
        noisy = points + normals * random.normal(0.0, own, n)[:, None] + shifts[exposure]
        cloud = cloud_of(noisy, exposure, sigma_mm=common, noise_mm=own, noise_along=normals)
        start = replace(started(), cad_from_part=Pose(np.eye(3), np.zeros(3)))
        fit = align_features(SURFACE, cloud, DATUMS, start)
        assert isinstance(fit, Alignment), fit
        at = fit.centre_mm
        step = np.concatenate(
            [fit.cad_from_part.rotation_vector_rad, fit.cad_from_part.apply(at) - at]
        )
        squares.append(float(step @ np.linalg.solve(fit.step_covariance, step)))
        found = compare_with_part(SURFACE, cloud, fit, CadOptions(), True)
        assert isinstance(found, CadComparison)
        seen = [one for one in found.faces if one.statistics.n >= 100]
        ratios += [one.statistics.mean_mm / one.u_mean_mm for one in seen if one.name != NAMES[0]]
    low, high = chi2.ppf([0.0005, 0.9995], 6 * trials)
    assert low < sum(squares) < high
    assert 0.92 < np.mean(np.abs(ratios) < 1.0) <= 0.995


def test_a_datum_that_adds_nothing_is_refused_and_what_stays_free_is_named() -> None:
    points, _, _ = scan(4)
    below = datum_face(FIXED.face_names.index(face_at([35.0, 20.0, 0.0])), FIXED)
    assert isinstance(below, DatumFeature)
    cloud = cloud_of(BACK.apply(points))
    found = align_features(SURFACE, cloud, (DATUMS[0], below), started())
    assert isinstance(found, FitFailure)
    assert "a turn about Z" in found.reason
    assert "a shift along" in found.reason
    two = by_features(points, DATUMS[:2])
    assert [one.kind for one in two.free] == ["turn"]
    assert two.free[0].point_mm[:2] == pytest.approx([55.0, 18.0], abs=1e-3)


def test_nominal_features_need_no_face() -> None:
    points, _, _ = scan(5)
    text = (
        "plane:at=0,0,20:axis=0,0,1:region=-1,40,-1,41,19,21|"
        "cylinder:at=55,18,0:axis=0,0,1:diameter=16:region=40,70,0,40,20.5,33.5|"
        "plane:at=0,0,0:axis=0,1,0:region=2,68,-2,2,1,19"
    )
    given = datum_features(text, FIXED)
    found = by_features(points, given)
    assert np.abs(found.cad_from_part.apply(BACK.apply(points)) - points).max() < 1e-3
    assert [len(one.held) for one in found.datums] == [3, 2, 1]


@pytest.mark.parametrize(
    ("kind", "text", "holds"),
    [
        ("line", "line:at=0,0,0:axis=1,0,0", 4),
        ("circle", "circle:at=0,0,0:axis=0,0,1:diameter=30", 5),
        ("sphere", "sphere:at=0,0,0:diameter=30", 3),
        ("cone", "cone:at=0,0,0:axis=0,0,1:diameter=30:half-angle=20", 5),
        ("cylinder", "cylinder:at=0,0,0:axis=0,0,1:diameter=30", 4),
        ("plane", "plane:at=0,0,0:axis=0,0,1", 3),
    ],
)
def test_every_kind_is_brought_onto_its_place(kind: str, text: str, holds: int) -> None:
    """The points of a shape that lies 0.2 mm off are carried onto the shape itself."""
    shape = datum_features(text, FIXED)[0]
    random = np.random.default_rng(8)
    turn, along = random.uniform(0.0, 2.0 * np.pi, 800), random.uniform(-10.0, 10.0, 800)
    wide = 15.0 + along * np.tan(np.radians(20.0)) * (kind == "cone")
    if kind == "line":
        points = along[:, None] * [1.0, 0.0, 0.0]
    elif kind == "plane":
        points = np.column_stack([along, random.uniform(-8.0, 8.0, 800), np.zeros(800)])
    elif kind == "sphere":
        points = 15.0 * Rotation.random(800, random_state=1).apply([0.0, 0.0, 1.0])
    else:
        height = along * (kind != "circle")
        points = np.column_stack([wide * np.cos(turn), wide * np.sin(turn), height])
    found = by_features(points, (shape,))
    placed = found.cad_from_part.apply(BACK.apply(points))
    assert np.abs(shape.shape.distance_mm(placed)).max() < 1e-6
    assert len(found.datums[0].held) == holds
    assert len(found.free) == 6 - holds


@pytest.mark.parametrize(
    "text",
    ["", "nothing", "plane 99", "cylinder:at=1,2", "cylinder:at=1,2,3:axis=0,0,1",
     "plane:at=0,0,0:axis=0,0,0", "plane:at=0,0,0:axis=0,0,1:diameter=3", "plane:at=a,b,c",
     "sphere:at=0,0,0:diameter=-1", "sphere:at=nan,0,0:diameter=1", f"{NAMES[0]}|{NAMES[0]}"],
)  # fmt: skip
def test_datums_that_are_none_are_refused(text: str) -> None:
    with pytest.raises((OptionError, FileFormatError)):
        datum_features(text, FIXED)


@pytest.mark.parametrize("kind", SHAPE_KINDS)
def test_the_remedy_of_a_datum_is_one_that_is_understood(kind: str) -> None:
    with pytest.raises(OptionError) as refused:
        datum_features(f"{kind}:at=1,2", FIXED)
    (found,) = datum_features(refused.value.remedy.rpartition(" ")[2], FIXED)
    assert isinstance(found, DatumFeature) and found.shape.kind == kind


def test_the_remedy_of_a_face_that_is_no_shape_is_understood() -> None:
    part = replace(FIXED, face=np.zeros_like(FIXED.face), face_names=("blob",))
    found = datum_face(0, part)
    assert isinstance(found, FitFailure)
    examples = [word for word in found.remedy.split() if ":at=" in word]
    assert len(datum_features("|".join(examples), FIXED)) == 2


# reference points and markers

NOMINAL = np.random.default_rng(0).uniform(-60.0, 60.0, (9, 3))
TRUE: Pose[Cad, Part] = Pose(
    Rotation.from_rotvec([0.8, -0.3, 1.9]).as_matrix(), np.array([30.0, -700.0, 55.0])
)


def given(noise: float, seed: int, *, sigma: float = 0.0, n: int = 9) -> ReferencePoints:
    random = np.random.default_rng(seed)
    measured = TRUE.inverse().apply(NOMINAL[:n]) + random.normal(0.0, noise, (n, 3))
    return ReferencePoints(
        names=tuple(f"P{k}" for k in range(n)),
        nominal_mm=NOMINAL[:n],
        measured_mm=measured,
        covariance_mm2=np.tile(sigma**2 * np.eye(3), (n, 1, 1)),
    )


CLOUD = cloud_of(TRUE.inverse().apply(np.random.default_rng(1).uniform(-50, 50, (50, 3))))


@pytest.mark.parametrize("sigma", [0.0, 0.03])
def test_reference_points_are_met_as_scipy_does(sigma: float) -> None:
    points = given(0.03, 4, sigma=sigma)
    found = align_points(CLOUD, points)
    assert isinstance(found, Alignment)
    a, b = (one - one.mean(axis=0) for one in (points.nominal_mm, points.measured_mm))
    turn, rssd = Rotation.align_vectors(a, b)
    assert found.cad_from_part.rotation == pytest.approx(turn.as_matrix(), abs=1e-9)
    assert found.rms_mm == pytest.approx(rssd / 3.0, rel=1e-9)
    assert found.notes == ()
    assert [one.name for one in found.datums] == list(points.names)


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_the_stated_covariance_of_points_is_that_of_many_measurements(sigma: float) -> None:
    """Also about the cloud's middle, far from Cad's origin; without sigmas it is F, not chi2."""
    trials, squares = 300, []
    for trial in range(trials):
        fit = align_points(CLOUD, given(0.05, trial, sigma=sigma))
        assert isinstance(fit, Alignment)
        error = fit.cad_from_part @ TRUE.inverse()
        at = fit.centre_mm
        step = np.concatenate([error.rotation_vector_rad, error.apply(at) - at])
        squares.append(float(step @ np.linalg.solve(fit.step_covariance, step)))
        turn = error.rotation_vector_rad
        about = np.concatenate([turn, error.apply(np.zeros((1, 3)))[0]])
        other = float(about @ np.linalg.solve(fit.covariance, about))
        assert other == pytest.approx(squares[-1], rel=1e-2)
    redundant = 3 * 9 - 6
    mean = 6.0 if sigma else 6.0 * redundant / (redundant - 2.0)
    assert np.mean(squares) == pytest.approx(mean, rel=4.0 * np.sqrt(2.6 / 6.0 / trials) + 0.02)


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_the_point_that_does_not_fit_is_named(sigma: float) -> None:
    points = given(0.01, 5, sigma=sigma)
    moved = points.measured_mm.copy()
    moved[6] += [0.3, 0.0, 0.0]
    found = align_points(CLOUD, replace(points, measured_mm=moved))
    assert isinstance(found, Alignment)
    assert "P6 does not fit" in found.warnings[0]
    assert "0.3" in found.warnings[0] or "0.29" in found.warnings[0]


def test_a_good_list_names_no_point() -> None:
    named = 0
    for seed in range(200):
        found = align_points(CLOUD, given(0.02, seed, sigma=0.02 * (seed % 2)))
        assert isinstance(found, Alignment)
        named += bool(found.notes)
    # 1 in 1000 each by the test, and 1 in 1000 by the sum
    assert named <= 3


@pytest.mark.parametrize(
    ("n", "words"),
    [(1, ("any turn about",)), (2, ("a turn about",)), (0, ("no reference point",))],
)
def test_too_few_points_name_what_they_leave_free(n: int, words: tuple[str, ...]) -> None:
    found = align_points(CLOUD, given(0.01, 1, n=n))
    assert isinstance(found, FitFailure)
    assert all(word in found.reason for word in words)


def test_points_on_a_line_leave_the_turn_about_it() -> None:
    on_line = np.linspace(-40.0, 40.0, 5)[:, None] * [0.0, 1.0, 0.0] + [3.0, 0.0, 7.0]
    points = replace(
        given(0.0, 1, n=5), nominal_mm=on_line, measured_mm=TRUE.inverse().apply(on_line)
    )
    found = align_points(CLOUD, points)
    assert isinstance(found, FitFailure)
    assert "a turn about Y through (3.0" in found.reason


def test_a_rough_point_counts_by_its_weight() -> None:
    """It makes no line of eight good points, and holds no turn about a line of them."""
    points = given(0.01, 4, sigma=0.01)
    own = points.covariance_mm2.copy()
    own[8] *= 500.0**2
    assert isinstance(align_points(CLOUD, replace(points, covariance_mm2=own)), Alignment)
    on_line = points.nominal_mm * [0.0, 1.0, 0.0] + [3.0, 0.0, 7.0]
    on_line[8] += [20.0, 0.0, 0.0]
    line = replace(points, nominal_mm=on_line, measured_mm=TRUE.inverse().apply(on_line))
    assert isinstance(align_points(CLOUD, line), Alignment)
    found = align_points(CLOUD, replace(line, covariance_mm2=own))
    assert isinstance(found, FitFailure)
    assert "a turn about Y through (3.0" in found.reason


@pytest.mark.parametrize(
    ("change", "word"), [(np.diag([1.0, 1.0, -1.0]), "mirror"), (1e-3 * np.eye(3), "spread")]
)
def test_mirrored_points_and_another_unit_are_refused(change: FloatArray, word: str) -> None:
    points = given(0.0, 2)
    found = align_points(CLOUD, replace(points, measured_mm=points.measured_mm @ change))
    assert isinstance(found, FitFailure)
    assert word in found.reason


def test_picked_points_are_the_clouds_nearest() -> None:
    places = given(0.0, 3)
    cloud = cloud_of(np.concatenate([places.measured_mm, CLOUD.points_mm]))
    rough = places.measured_mm + np.random.default_rng(0).normal(0.0, 0.3, (9, 3))
    found = align_points(cloud, replace(places, measured_mm=rough, is_picked=True))
    assert isinstance(found, Alignment)
    assert found.cad_from_part.matrix == pytest.approx(TRUE.matrix, abs=1e-9)
    far = align_points(cloud, replace(places, measured_mm=rough + 60.0, is_picked=True))
    assert isinstance(far, FitFailure)
    assert "picked" in far.reason


def markers(points: FloatArray, ids: list[int], frame: str) -> MarkerSet:
    covariance = np.tile(1e-4 * np.eye(3), (len(points), 1, 1))
    return MarkerSet(ids=np.array(ids), points_mm=points, covariance_mm2=covariance, frame=frame)


@pytest.mark.parametrize("by_number", [True, False])
def test_markers_are_paired_with_or_without_numbers(by_number: bool) -> None:
    order = np.array([4, 2, 8, 0, 1, 7])
    seen = TRUE.inverse().apply(NOMINAL[order])
    seen += np.random.default_rng(2).normal(0.0, 0.005, seen.shape)
    stray = np.array([[500.0, 20.0, 30.0]])
    ids = [*(order + 1).tolist(), 99] if by_number else list(range(1, 8))
    measured = markers(np.concatenate([seen, stray]), ids, "Base")
    nominal = markers(NOMINAL, list(range(1, 10)), "Cad")
    points = paired_markers(nominal, measured, by_number=by_number)
    assert isinstance(points, ReferencePoints)
    assert sorted(points.names) == sorted(f"marker {k + 1}" for k in order)
    found = align_points(CLOUD, points)
    assert isinstance(found, Alignment)
    assert found.method == "markers"
    assert np.abs(found.cad_from_part.apply(seen) - NOMINAL[order]).max() < 0.03
    assert "1 of 7 measured markers" in found.warnings[0]


def test_a_list_of_markers_without_covariances_says_what_is_assumed(tmp_path: Path) -> None:
    nominal, measured = tmp_path / "nominal.csv", tmp_path / "measured.csv"
    places = TRUE.inverse().apply(NOMINAL)
    for path, rows_mm in ((nominal, NOMINAL), (measured, places)):
        rows = "".join("{},{},{}\n".format(*row) for row in rows_mm.tolist())
        path.write_text("x_mm,y_mm,z_mm\n" + rows)
    points = read_reference_markers(nominal, measured, "Base")
    assert isinstance(points, ReferencePoints)
    assert "0.02 mm an axis is assumed" in points.notes[0]
    known = markers(places, list(range(1, len(places) + 1)), "Base")
    measured.write_bytes(markers_csv(known))
    points = read_reference_markers(nominal, measured, "Base")
    assert isinstance(points, ReferencePoints)
    assert not points.notes


def test_markers_at_equal_distances_are_not_guessed() -> None:
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0), [0.0]), axis=-1).reshape(-1, 3)
    found = paired_markers(
        markers(30.0 * grid, list(range(1, 10)), "Cad"),
        markers(TRUE.inverse().apply(30.0 * grid), list(range(1, 10)), "Base"),
        by_number=False,
    )
    assert isinstance(found, FitFailure)
    assert "matched" in found.reason


def test_both_lists_of_markers_err() -> None:
    """Each has 0.01 mm an axis."""
    ids = list(range(1, len(NOMINAL) + 1))
    measured = markers(TRUE.inverse().apply(NOMINAL), ids, "Base")
    found = paired_markers(markers(NOMINAL, ids, "Cad"), measured, by_number=True)
    assert isinstance(found, ReferencePoints)
    assert found.covariance_mm2 == pytest.approx(np.tile(2e-4 * np.eye(3), (len(ids), 1, 1)))


def test_sigma_of_a_plane_datum_by_hand() -> None:
    """A plane has three motions, each of which the points' mean tells to noise / sqrt(n)."""
    points, normals, _ = scan(0)
    cloud = cloud_of(
        BACK.apply(points),
        np.arange(len(points)) % 7,
        sigma_mm=1e-9,
        noise_mm=0.02,
        noise_along=BACK.rotate(normals),
    )
    found = align_features(SURFACE, cloud, DATUMS, started())
    assert not isinstance(found, FitFailure)
    first = found.datums[0]
    assert first.sigma_mm == pytest.approx(0.02 * np.sqrt(3.0 / first.n_points), rel=0.1)
