# SPDX-License-Identifier: Apache-2.0
"""Statistics, spots and decisions of deviations, against NumPy and by hand."""

from __future__ import annotations

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from armscan.inspection.cad import point_errors
from armscan.inspection.cad.alignment import align_none
from armscan.inspection.cad.comparison import (
    DECISIONS,
    CadComparison,
    CadOptions,
    compare_with_part,
    deviation_statistics,
    median_uncertainty,
)
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import part_of
from armscan.inspection.cad.point_errors import scatter_of_means
from armscan.records.cloud import FUSED
from armscan.report.inspection.cad import (
    _histogram,
    cad_quantities,
    cad_warnings,
    face_charts,
    verdict_table,
)
from armscan.storage.parts.tables import face_table_bytes
from rigs.inspection_clouds import cloud_of
from rigs.parts import box_corners

BOX = PartSurface(part_of(box_corners([0, 0, 0.0], [60, 40, 20]), source="box"))


def top_points(n: int, height: float = 20.0, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    points = random.uniform(2.0, [58.0, 38.0, 2.0], (n, 3))
    points[:, 2] = height
    return points


def compared(points: np.ndarray, sigma: float = 0.0, **options: float) -> CadComparison:
    cloud = cloud_of(points, sigma_mm=sigma)
    found = compare_with_part(
        BOX, cloud, align_none(cloud), CadOptions(**options), errors_known=sigma > 0.0
    )
    assert isinstance(found, CadComparison)
    return found


def test_statistics_are_those_of_their_definitions() -> None:
    d = np.random.default_rng(1).normal(0.02, 0.1, 1001)
    found = deviation_statistics(d)
    ordered = np.sort(d)
    assert found.n == 1001
    assert found.mean_mm == pytest.approx(d.sum() / 1001)
    assert found.std_mm**2 == pytest.approx(((d - d.mean()) ** 2).sum() / 1000)
    assert found.rms_mm**2 == pytest.approx((d**2).sum() / 1001)
    assert (found.p05_mm, found.p95_mm) == pytest.approx((ordered[50], ordered[950]))
    assert (found.min_mm, found.max_mm) == (ordered[0], ordered[-1])
    assert math.isnan(deviation_statistics(np.zeros(0)).mean_mm)
    assert math.isnan(deviation_statistics(np.ones(1)).std_mm)


@pytest.mark.parametrize(
    ("height", "decision"), [(20.02, "pass"), (20.045, "undecided"), (20.055, "undecided"),
                             (20.08, "fail"), (19.92, "fail")],
)  # fmt: skip
def test_a_face_within_its_u_of_the_limit_is_undecided(height: float, decision: str) -> None:
    """All points err together by 0.01 mm, so U is 0.02 and the limit 0.05."""
    found = compared(top_points(3000, height), sigma=0.01, tolerance_mm=0.05)
    top = next(one for one in found.faces if one.statistics.n)
    assert top.decision == decision
    assert found.verdict == decision
    assert top.statistics.mean_mm == pytest.approx(height - 20.0)
    assert found.u_mm == pytest.approx(np.full(3000, 0.02))
    assert {DECISIONS[k] for k in found.decision.tolist()} == {decision}
    unseen = [one for one in found.faces if one.statistics.n == 0]
    assert {one.decision for one in unseen} == {"not seen"}


def test_a_dent_of_a_spot_fails_a_face_whose_mean_passes() -> None:
    points = top_points(20_000)
    dent = np.linalg.norm(points[:, :2] - [30.0, 20.0], axis=1) < 2.5
    points[dent, 2] -= 0.2
    found = compared(points, sigma=0.005, tolerance_mm=0.05)
    top = next(one for one in found.faces if one.statistics.n)
    assert abs(top.statistics.mean_mm) < 0.01
    assert top.spot_mm == pytest.approx(-0.2, abs=1e-6)
    assert np.linalg.norm(top.spot_place_mm[:2] - [30.0, 20.0]) < 2.5
    assert top.decision == "fail"


def test_the_spot_shown_is_the_one_that_decides() -> None:
    """A deep spot that is well known passes, a shallow one that scatters is undecided."""
    points = top_points(20_000)
    deep, rough = (
        np.abs(points[:, :2] - place).max(axis=1) < 2.5 for place in ([15.0, 20.0], [45.0, 20.0])
    )
    points[deep, 2] -= 0.12
    points[rough, 2] -= 0.09 + np.random.default_rng(4).normal(0.0, 0.25, int(rough.sum()))
    found = compared(points, sigma=0.005, tolerance_mm=0.15)
    top = next(one for one in found.faces if one.statistics.n)
    assert top.decision == "undecided"
    assert np.abs(top.spot_place_mm[:2] - [45.0, 20.0]).max() < 3.5
    assert abs(abs(top.spot_mm) - 0.15) < top.u_spot_mm
    loose = compared(points, sigma=0.005)
    whole = next(one for one in loose.faces if one.statistics.n)
    assert abs(whole.spot_mm) >= abs(top.spot_mm)


def test_a_stray_point_makes_no_dent() -> None:
    points = top_points(20_000)
    points[7, 2] += 1.5
    found = compared(points, sigma=0.005, tolerance_mm=0.05)
    top = next(one for one in found.faces if one.statistics.n)
    assert top.statistics.max_mm == pytest.approx(1.5)
    assert top.decision == "pass"


def test_own_noise_averages_out_of_a_mean_and_common_error_does_not() -> None:
    points = top_points(2500)
    up = np.tile([0.0, 0.0, 1.0], (2500, 1))
    exposure = np.arange(2500) % 5
    cloud = cloud_of(points, exposure, sigma_mm=0.004, noise_mm=0.05, noise_along=up)
    found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(), True)
    assert isinstance(found, CadComparison)
    top = next(one for one in found.faces if one.statistics.n)
    by_hand = 2.0 * math.sqrt(0.05**2 / 2500 + 0.004**2 / 5)
    assert top.u_mean_mm == pytest.approx(by_hand, rel=0.05)


def test_without_sigmas_nothing_is_decided_unless_u_is_stated() -> None:
    points = top_points(2000)
    assert compared(points, tolerance_mm=0.05).verdict == "undecided"
    assert compared(points, tolerance_mm=0.05, uncertainty_mm=0.01).verdict == "pass"
    assert compared(points).verdict == ""


def test_a_face_may_have_a_tolerance_of_its_own() -> None:
    cloud = cloud_of(top_points(3000, 20.03), sigma_mm=0.002)
    open_found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(), True)
    assert isinstance(open_found, CadComparison)
    top = next(one.name for one in open_found.faces if one.statistics.n)
    options = CadOptions(tolerance_mm=0.05, face_tolerances_mm={top: 0.01})
    found = compare_with_part(BOX, cloud, align_none(cloud), options, True)
    assert isinstance(found, CadComparison)
    assert next(one for one in found.faces if one.name == top).decision == "fail"


def test_points_of_the_table_count_nowhere() -> None:
    table = np.random.default_rng(2).uniform(-200, 200, (400, 3)) * [1, 1, 0] - [0, 0, 30.0]
    found = compared(np.concatenate([top_points(1000, 20.01), table]), sigma=0.01)
    assert found.n_given == 1400
    assert found.overall.n == len(found) == 1000
    assert found.overall.mean_mm == pytest.approx(0.01)


def test_no_overlap_is_refused() -> None:
    cloud = cloud_of(top_points(200, 500.0))
    found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(), True)
    assert isinstance(found, FitFailure)


@pytest.mark.parametrize("options", [{"reach_mm": 0.0}, {"tolerance_mm": -1.0},
                                     {"uncertainty_mm": math.inf}, {"reach_mm": math.nan}],
)  # fmt: skip
def test_lengths_that_make_no_sense_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        CadOptions(**options)


def scanned(points: np.ndarray, exposure: np.ndarray, **options: float) -> CadComparison:
    cloud = cloud_of(points, exposure, sigma_mm=0.002)
    found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(**options), True)
    assert isinstance(found, CadComparison)
    return found


@pytest.mark.parametrize(
    ("n_seeing", "n_showing", "decision"),
    [(1, 1, "undecided"), (4, 1, "undecided"), (2, 2, "fail")],
)
def test_what_no_two_exposures_show_is_undecided(
    n_seeing: int, n_showing: int, decision: str
) -> None:
    """A stripe that errs along an edge is no dent, though it is most of what was seen there."""
    points = top_points(20_000)
    beside = np.abs(points[:, :2] - [30.0, 20.0])
    strip = (beside[:, 0] < 1.5) & (beside[:, 1] < 2.0)
    points[strip, 2] -= 0.2
    exposure = 3 + np.arange(20_000) % 4
    exposure[beside.max(axis=1) < 4.0] = 0
    exposure[strip] = np.arange(strip.sum()) % n_showing
    others = np.flatnonzero(strip)[: 4 * (n_seeing - n_showing)]
    points[others, 2] += 0.2
    exposure[others] = 3 + np.arange(len(others)) % 4
    found = scanned(points, exposure, tolerance_mm=0.05)
    top = next(one for one in found.faces if one.statistics.n)
    assert (top.decision, top.is_seen_once) == (decision, decision == "undecided")
    assert found.verdict == decision


def test_a_fused_cloud_fails_nothing_and_one_exposure_of_another_kind_does() -> None:
    points = top_points(3000, 20.2)
    decisions = []
    for name in (FUSED, "part.xyz"):
        cloud = replace(
            cloud_of(points, sigma_mm=0.002), exposure_sources=(name,), sheet_names=(name,)
        )
        found = compare_with_part(
            BOX, cloud, align_none(cloud), CadOptions(tolerance_mm=0.05), errors_known=True
        )
        assert isinstance(found, CadComparison)
        decisions.append(found.verdict)
        told = [text for text in cad_warnings(found, errors_known=True) if "is fused" in text]
        assert len(told) == (name == FUSED)
    assert decisions == ["undecided", "fail"]


def test_two_exposures_that_disagree_widen_the_u_of_their_face() -> None:
    """0.08 mm apart: the mean of both has a standard deviation of 0.04 mm by their difference."""
    points, exposure = top_points(4000), np.arange(4000) % 2
    points[:, 2] += np.where(exposure == 0, 0.04, -0.04)
    top = next(one for one in scanned(points, exposure).faces if one.statistics.n)
    assert top.u_mean_mm == pytest.approx(0.08, rel=1e-3)
    calm = next(one for one in scanned(top_points(4000), exposure).faces if one.statistics.n)
    assert calm.u_mean_mm == pytest.approx(2.0 * 0.002 / math.sqrt(2.0), rel=1e-3)


def test_u_of_a_face_covers_unstated_errors_of_exposures_and_is_never_reduced() -> None:
    """Exposures err by 0.02 mm where 0.002 is stated; U covers 95 % of many scans' means."""
    ratios = []
    exposure = np.arange(1200) % 20
    stated = 2.0 * 0.002 / math.sqrt(20)
    for seed in range(150):
        random = np.random.default_rng(seed)
        points = top_points(1200, seed=seed)
        points[:, 2] += random.normal(0.0, 0.02, 20)[exposure]
        top = next(one for one in scanned(points, exposure).faces if one.statistics.n)
        assert top.u_mean_mm >= stated * (1.0 - 1e-9)
        ratios.append(abs(top.statistics.mean_mm) / top.u_mean_mm)
    # k = 2 and 19 degrees of freedom: 94 %; blocks of neighbours can only widen
    assert 0.89 < np.mean(np.array(ratios) < 1.0) < 0.999


def test_scatter_is_that_of_a_jackknife_by_hand() -> None:
    random = np.random.default_rng(3)
    label, exposure = random.integers(-1, 3, 600), random.integers(0, 7, 600)
    exposure[label == 2] = 4
    d = random.normal(size=600)
    found = scatter_of_means(label, 4, d, exposure)
    for k in (0, 1):
        left = np.array([d[(label == k) & (exposure != e)].mean() for e in range(7)])
        assert found[k] == pytest.approx(math.sqrt(6 / 7 * ((left - left.mean()) ** 2).sum()))
    assert found[2] == found[3] == 0.0


def test_many_groups_get_the_shared_error_too(monkeypatch: pytest.MonkeyPatch) -> None:
    points, exposure = top_points(3000), np.arange(3000) % 10
    whole = scanned(points, exposure)
    monkeypatch.setattr(point_errors, "LARGEST_TABLE", 25)
    parts = scanned(points, exposure)
    for one, other in zip(whole.faces, parts.faces, strict=True):
        assert one.u_mean_mm == pytest.approx(other.u_mean_mm, rel=1e-12, nan_ok=True)
        assert one.u_spot_mm == pytest.approx(other.u_spot_mm, rel=1e-12, nan_ok=True)
    assert max(one.u_spot_mm for one in parts.faces if one.statistics.n) > 1e-3


def test_of_a_face_not_seen_nothing_is_told() -> None:
    found = compared(top_points(3000), sigma=0.01, tolerance_mm=0.05)
    unseen = [one for one in found.faces if one.statistics.n == 0]
    assert unseen
    assert all(math.isnan(one.u_mean_mm) for one in unseen)
    shown = {row[0]: row for row in verdict_table(found).rows}
    assert {shown[one.name][5] for one in unseen} == {"-"}
    lines = [line for line in face_table_bytes(found).decode().splitlines() if line[:1] != "#"]
    rows = list(csv.DictReader(lines))
    assert {row["u_mean_mm"] for row in rows if row["n"] == "0"} == {""}


def test_a_face_of_few_points_is_nowhere_called_seen_and_no_alignment_has_no_rms() -> None:
    """Five points lie on a side: fewer than a spot needs."""
    side = [[0.0, 5.0 + k, 10.0] for k in range(5)]
    found = compared(np.concatenate([top_points(3000), side]), sigma=0.01, tolerance_mm=0.05)
    assert sum(one.statistics.n > 0 for one in found.faces) == 2
    told = {item.key: item for item in cad_quantities(found, BOX.part)}
    assert told["faces.n_seen"].value == 1
    assert told["verdict_faces"].value["not seen"] == 5
    assert not told["alignment.rms_mm"].label


def test_pictures_of_faces_that_were_not_judged_come_last() -> None:
    side = [[0.0, 5.0 + k, 10.0] for k in range(5)]
    found = compared(np.concatenate([top_points(3000), side]), sigma=0.01, tolerance_mm=0.05)
    captions = [one.caption for one in face_charts(found)]
    assert ["not seen" in text for text in captions] == [False, True]


def test_two_strays_do_not_make_one_bar_of_a_face() -> None:
    d = np.random.default_rng(4).normal(0.0, 0.005, 167)
    d[:2] = -1.9
    told = _histogram(d, [0.05], "top", share=0.98, size=(4.2, 2.6), caption="")
    assert "2 lie outside the picture" in told.caption


def test_failing_faces_stand_first_and_are_marked() -> None:
    """The side is as it should be, the top 0.2 mm high; the top has the higher number."""
    points = np.concatenate([top_points(3000, 20.2), top_points(3000, 0.0)])
    found = compared(points, sigma=0.002, tolerance_mm=0.05)
    words = [row[1] for row in verdict_table(found).rows]
    assert words == ["! fail", "pass", *["not seen"] * 4]


def test_points_beyond_an_edge_count_for_no_face() -> None:
    """The rim of a top that is 0.1 mm too high lies beyond the nominal side's edge."""
    points = top_points(5000)
    rim = np.column_stack([np.full(400, 60.03), np.linspace(5.0, 35.0, 400), np.full(400, 20.1)])
    side = np.column_stack([np.full(400, 60.0), np.linspace(5.0, 35.0, 400), np.full(400, 15.0)])
    whole = np.concatenate([points, rim, side])
    found = scanned(whole, np.arange(len(whole)) % 5, tolerance_mm=0.05)
    assert found.is_beside_edge.sum() == 400
    assert np.array_equal(np.flatnonzero(found.is_beside_edge), 5000 + np.arange(400))
    assert sum(one.statistics.n for one in found.faces) == 5400
    assert found.overall.n == 5800
    assert set(found.decision[found.is_beside_edge].tolist()) == {-1}
    assert found.verdict == "pass"


def test_a_normal_that_is_askew_beside_an_edge_moves_no_point_to_another_face() -> None:
    """Normals estimated beside an edge are off by up to 90 degrees; those of a far side by 180."""
    wall = PartSurface(part_of(box_corners([0, 0, 0.0], [60, 40, 2.0]), source="wall"))
    side = np.column_stack([np.full(50, 60.0), np.linspace(5.0, 35.0, 50), np.full(50, 1.9)])
    askew = np.tile(np.array([-0.2, 0.0, 1.0]) / np.hypot(0.2, 1.0), (50, 1))
    found = wall.distance(side, reach_mm=3.0, towards=askew)
    np.testing.assert_allclose(found.signed_mm, 0.0, atol=1e-12)
    assert np.abs(found.closest_mm - side).max() < 1e-12
    below = np.column_stack([np.full(50, 30.0), np.linspace(5.0, 35.0, 50), np.full(50, 0.8)])
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    np.testing.assert_allclose(wall.distance(below, towards=up).signed_mm, -1.2, atol=1e-12)


@pytest.mark.parametrize("n", [10, 20, 200])
def test_the_median_of_few_points_lies_within_its_wider_u(n: int) -> None:
    """95.45 % of normal draws, as k = 2 says; with the factor 2, ten points hold 90 %."""
    trials = 4000
    values = np.random.default_rng(n).normal(0.0, 0.3, (trials, n))
    label = np.repeat(np.arange(trials), n)
    u = median_uncertainty(label, trials, values.ravel())
    held = float((np.abs(np.median(values, axis=1)) <= u).mean())
    assert 0.935 < held < 0.975
    assert median_uncertainty(np.array([0, 0, 0, -1]), 2, np.arange(4.0)).tolist() == [0.0, 0.0]


def test_a_stripe_along_a_rim_is_not_of_the_face_that_nobody_saw() -> None:
    """Points 0.07 mm beside the upper rim of a block, seen from above: next to its side, not of it.

    From the side, the same points are that side's; without a sensor's place nobody can tell.
    """
    block = part_of(box_corners([0, 0, 0], [60, 40, 20]), source="block")
    surface = PartSurface(block)
    side = int(block.face[np.argmax(block.normals @ [0.0, -1.0, 0.0])])
    x = np.linspace(5.0, 55.0, 200)
    rim = np.column_stack([x, np.full(200, -0.07), np.full(200, 19.98)])
    for where, counted in (([30.0, 60.0, 120.0], 0), ([30.0, -140.0, 60.0], 200), (None, 200)):
        places = None if where is None else np.array([where])
        cloud = replace(cloud_of(rim), seen_from_mm=places)
        found = compare_with_part(surface, cloud, align_none(cloud), CadOptions(), False)
        assert isinstance(found, CadComparison)
        assert found.faces[side].statistics.n == counted


@pytest.mark.parametrize(
    ("near_mm", "share", "far_mm", "is_refused"),
    [
        (1.8, 0.7, 6.0, True),  # another part, two thirds of it near by chance
        (1.8, 1.0, 6.0, False),  # a raw part, too large all over
        (0.0, 0.7, 6.0, False),  # a part with a face broken off, or its table
    ],
)
def test_another_part_is_told_from_a_raw_or_a_broken_one(
    near_mm: float, share: float, far_mm: float, is_refused: bool
) -> None:
    points = top_points(3000, height=20.0 + near_mm)
    points[int(share * len(points)) :, 2] += far_mm
    cloud = cloud_of(points)
    found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(), errors_known=False)
    assert isinstance(found, FitFailure) == is_refused
    if isinstance(found, FitFailure):
        assert "half of its points lie more than 1.8 mm off it, 30 % more than 2 mm" in found.reason


def test_a_cloud_that_lies_elsewhere_is_refused_and_table_about_a_part_is_not() -> None:
    """40 and 60 % of the points are on the part, the rest 30 mm beside it."""
    beside = top_points(1000) + np.array([90.0, 0.0, 0.0])
    for share, is_refused in ((0.4, True), (0.6, False)):
        n = int(1000 * share)
        cloud = cloud_of(np.concatenate([top_points(n), beside[n:]]), sigma_mm=0.01)
        found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(), errors_known=True)
        assert isinstance(found, FitFailure) == is_refused
        if isinstance(found, FitFailure):
            assert "only 40 % of the points come within 2 mm" in found.reason
            assert "--align none" in found.remedy
    none = cloud_of(top_points(10)).select(np.zeros(10, dtype=np.bool_))
    found = compare_with_part(BOX, none, align_none(none), CadOptions(), errors_known=False)
    assert isinstance(found, FitFailure)


def test_faces_without_points_and_with_too_few_are_told_apart() -> None:
    side = [[0.0, 5.0 + k, 10.0] for k in range(5)]
    found = compared(np.concatenate([top_points(3000), side]), sigma=0.01, tolerance_mm=0.05)
    few = next(one.name for one in found.faces if one.statistics.n == 5)
    texts = [text for text in cad_warnings(found, errors_known=True) if "not judged" in text]
    assert len(texts) == 2
    assert few not in texts[0]
    assert f"{few} (5 in all)" in texts[1]


def test_noise_that_neighbours_share_counts_so_many_times() -> None:
    """Nine points that err alike are one: U of their mean is three times as wide."""
    points, up = top_points(2500), np.tile([0.0, 0.0, 1.0], (2500, 1))
    alone = cloud_of(points, np.arange(2500) % 5, sigma_mm=1e-9, noise_mm=0.05, noise_along=up)
    cloud = replace(alone, noise_length=np.full(2500, 9.0))
    found = compare_with_part(BOX, cloud, align_none(cloud), CadOptions(), errors_known=True)
    assert isinstance(found, CadComparison)
    (face,) = (one for one in found.faces if one.statistics.n)
    assert face.u_mean_mm == pytest.approx(2.0 * 0.05 * 3.0 / 50.0, rel=0.05)


def test_u_of_a_point_holds_the_alignment() -> None:
    cloud = cloud_of(top_points(200), sigma_mm=0.01)
    moved = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.03**2])
    place = replace(align_none(cloud), step_covariance=moved)
    found = compare_with_part(BOX, cloud, place, CadOptions(), errors_known=True)
    assert isinstance(found, CadComparison)
    assert found.u_mm == pytest.approx(np.full(200, 2.0 * math.hypot(0.01, 0.03)))
