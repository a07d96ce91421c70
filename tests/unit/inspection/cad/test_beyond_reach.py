# SPDX-License-Identifier: Apache-2.0
"""What lies beyond the reach of a comparison: dents and bosses are named, tables and strays not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.inspection.cad.alignment import align_none
from armscan.inspection.cad.comparison import CadComparison, CadOptions, compare_with_part
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import part_of
from armscan.records.cloud import FUSED, PointCloud
from armscan.report.inspection.cad import cad_warnings
from rigs.inspection_clouds import cloud_of
from rigs.parts import box_corners

BOX = PartSurface(part_of(box_corners([0, 0, 0.0], [60, 40, 20]), source="box"))


def top_points(n: int) -> FloatArray:
    """(n, 3) over the top of the box."""
    points = np.random.default_rng(0).uniform(2.0, [58.0, 38.0, 2.0], (n, 3))
    points[:, 2] = 20.0
    return points


def block_with(height_mm: float, *, normals: bool = True) -> PointCloud:
    """The top of the box, a square of 12 mm of it off by a height, in exposures 1 mm apart."""
    points = top_points(20_000)
    inside = np.abs(points[:, :2] - [30.0, 20.0]).max(axis=1) < 6.0
    points[inside, 2] += height_mm
    exposure = points[:, 0].astype(np.int64)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return cloud_of(points, exposure, sigma_mm=0.005, normals=up if normals else None)


@pytest.mark.parametrize("tell_normals", [True, False])
@pytest.mark.parametrize("depth_mm", [-2.5, -5.0, -9.0])
def test_no_dent_is_deep_enough_to_pass(depth_mm: float, tell_normals: bool) -> None:
    cloud = block_with(depth_mm, normals=tell_normals)
    options = CadOptions(tolerance_mm=0.1)
    found = compare_with_part(BOX, cloud, align_none(cloud), options, errors_known=True)
    assert isinstance(found, CadComparison)
    assert found.verdict == "undecided"
    (top,) = (one for one in found.faces if one.statistics.n)
    assert top.beyond_mm == pytest.approx(depth_mm)
    assert np.abs(top.beyond_place_mm - [30.0, 20.0, 20.0]).max() < 6.1
    (said,) = (text for text in cad_warnings(found, True) if top.name in text)
    assert f"{depth_mm:+.2f} mm" in said
    assert "undecided at best" in said


def reached(cloud: PointCloud, **options: float) -> list[float]:
    """What lies beyond the reach of each face that has such a spot."""
    chosen = CadOptions(**{"tolerance_mm": 0.1, **options})
    found = compare_with_part(BOX, cloud, align_none(cloud), chosen, errors_known=True)
    assert isinstance(found, CadComparison)
    return [one.beyond_mm for one in found.faces if math.isfinite(one.beyond_mm)]


def test_a_boss_counts_where_its_surface_lies_along_the_face() -> None:
    assert reached(block_with(3.0)) == [pytest.approx(3.0)]
    assert reached(block_with(3.0, normals=False)) == []
    assert reached(block_with(8.0)) == [], "so high above a face is a clamp"
    assert reached(block_with(3.0), reach_mm=4.0) == [], "within the reach it is a spot"


def test_what_one_exposure_alone_shows_is_a_stray() -> None:
    cloud = block_with(-3.0)
    alone = np.where(cloud.points_mm[:, 2] < 19.0, 30, cloud.exposure)
    assert reached(replace(cloud, exposure=alone)) == []
    assert reached(replace(cloud, exposure=np.zeros_like(alone))) == [pytest.approx(-3.0)]


def test_a_table_beside_the_part_is_no_boss_on_its_walls() -> None:
    """Its points are next to walls, inside their outline where the part stands in a nest."""
    random = np.random.default_rng(8)
    top = top_points(20_000)
    table = random.uniform([-8.0, -8.0, 0.0], [68.0, 48.0, 0.0], (20_000, 3))
    away = np.maximum(np.abs(table[:, :2] - [30.0, 20.0]) - [30.0, 20.0], 0.0).max(axis=1)
    for height in (0.0, 0.05, 4.0):
        beside = table[away > 2.5] + [0.0, 0.0, height]
        points = np.concatenate([top, beside])
        exposure = np.floor(points[:, 0] + 10.0).astype(np.int64)
        up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        cloud = cloud_of(points, exposure, sigma_mm=0.005, normals=up)
        assert reached(cloud) == []


def grid(low: list[float], high: list[float], z: float, step: float = 0.4) -> FloatArray:
    """(N, 3) points of a level rectangle."""
    x, y = np.meshgrid(*(np.arange(a, b, step) for a, b in zip(low, high, strict=True)))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def level_cloud(points: FloatArray, up: FloatArray) -> PointCloud:
    """Points with normals up or down, in exposures 1 mm apart."""
    exposure = np.floor(points[:, 0] - points[:, 0].min()).astype(np.int64)
    normals = np.column_stack([np.zeros((len(points), 2)), up])
    return cloud_of(points, exposure, sigma_mm=0.005, normals=normals)


@pytest.mark.parametrize("gap_mm", [3.0, 8.0, 15.0])
def test_a_table_under_a_brim_is_no_dent_in_it(gap_mm: float) -> None:
    """A plate of 3 mm stands out over the table, which is seen beneath it from the side."""
    foot = box_corners([25, 15, 0.0], [35, 25, gap_mm])
    brim = box_corners([0, 0, gap_mm], [60, 40, gap_mm + 3.0])
    part = PartSurface(part_of(np.concatenate([foot, brim]), source="brim"))
    top, table = grid([1, 1], [59, 39], gap_mm + 3.0), grid([0, 0], [20, 40], 0.0)
    cloud = level_cloud(np.concatenate([top, table]), np.ones(len(top) + len(table)))
    found = compare_with_part(
        part, cloud, align_none(cloud), CadOptions(tolerance_mm=0.1), errors_known=True
    )
    assert isinstance(found, CadComparison)
    assert found.verdict == "pass"


@pytest.mark.parametrize("depth_mm", [2.4, 2.9, 4.0])
def test_a_dent_through_a_thin_wall_is_one(depth_mm: float) -> None:
    """The other side of the wall is nearer to it, or it stands out there."""
    wall = PartSurface(part_of(box_corners([0, 0, 0.0], [60, 40, 3.0]), source="wall"))
    points = grid([1, 1], [59, 39], 3.0)
    points[np.abs(points[:, :2] - [30.0, 20.0]).max(axis=1) < 6.0, 2] -= depth_mm
    cloud = level_cloud(points, np.ones(len(points)))
    found = compare_with_part(
        wall, cloud, align_none(cloud), CadOptions(tolerance_mm=0.1), errors_known=True
    )
    assert isinstance(found, CadComparison)
    assert found.verdict in ("undecided", "fail")


@pytest.mark.parametrize("tell_normals", [True, False])
def test_the_back_of_a_sheet_is_no_dent_in_an_open_model(tell_normals: bool) -> None:
    box = box_corners([0, 0, -20.0], [60, 40, 0.0])
    is_bent = (box[:, :, 2] == 0.0).all(axis=1) | (box[:, :, 0] == 0.0).all(axis=1)
    sheet = PartSurface(part_of(box[is_bent], source="sheet"))
    front, back = grid([1, 1], [59, 39], 0.0), grid([4, 1], [59, 39], -3.0, 0.5)
    up = np.concatenate([np.ones(len(front)), -np.ones(len(back))])
    cloud = level_cloud(np.concatenate([front, back]), up)
    cloud = cloud if tell_normals else replace(cloud, normals=None)
    found = compare_with_part(
        sheet, cloud, align_none(cloud), CadOptions(tolerance_mm=0.1), errors_known=True
    )
    assert isinstance(found, CadComparison)
    assert found.verdict == "pass"


def test_strays_of_a_dense_scan_make_no_dent() -> None:
    """Fifteen of them in each spot of a few, and a twentieth of all points."""
    random = np.random.default_rng(2)
    points = top_points(200_000)
    in_spots = np.flatnonzero(np.abs(points[:, :2] - [30.7, 20.7]).max(axis=1) < 1.5)[:60]
    everywhere = random.choice(len(points), len(points) // 20, replace=False)
    for strays in (in_spots, everywhere):
        stray = points.copy()
        stray[strays, 2] -= random.uniform(2.1, 5.0, len(strays))
        assert reached(level_cloud(stray, np.ones(len(stray)))) == []


def test_a_fused_cloud_shows_a_deep_dent_too() -> None:
    cloud = block_with(-3.0)
    zeros = np.zeros_like(cloud.exposure)
    fused = replace(cloud, exposure=zeros, exposure_sources=(FUSED,), sheet_names=(FUSED,))
    assert fused.is_fused
    assert reached(fused) == [pytest.approx(-3.0)]
