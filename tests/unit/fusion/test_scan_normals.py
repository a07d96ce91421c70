# SPDX-License-Identifier: Apache-2.0
"""Normals made piece by piece are those of the whole cloud in memory."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.fusion import cell_sums, point_spool, scan_normals
from armscan.fusion.cell_sums import AXIS_CELLS, CellSums, cell_numbers, cells_of, numbers_at
from armscan.fusion.point_spool import PointSpool
from armscan.fusion.scan_normals import ScanNormals, choose_scan_radius_mm
from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.place import choose_radius_mm, estimate_normals, merge_clouds
from rigs.long_scan import RADIUS_MM, spool_of, stripes

EYE = np.array([0.0, 0.0, 200.0])


def normals_of(spool: PointSpool, radius_mm: float) -> FloatArray:
    with ScanNormals(spool, radius_mm) as surface:
        found = [
            surface.at(points, np.broadcast_to(EYE, points.shape)) for points, _ in spool.places()
        ]
    return np.concatenate(found)


@pytest.mark.parametrize("piece_points", [400, 10**6])
def test_they_are_those_of_the_cloud_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece_points: int
) -> None:
    monkeypatch.setattr(point_spool, "PIECE_POINTS", piece_points)
    clouds = stripes(60)
    whole = merge_clouds(clouds)
    with spool_of(clouds, tmp_path) as spool:
        radius_mm = choose_scan_radius_mm(spool)
        found = normals_of(spool, radius_mm)
    assert radius_mm == choose_radius_mm(whole.points_mm, whole.exposure)
    wanted = estimate_normals(
        whole.points_mm, np.broadcast_to(EYE, whole.points_mm.shape), radius_mm
    )
    np.testing.assert_array_equal(found, wanted)
    true = whole.points_mm / RADIUS_MM
    assert np.median(np.abs(np.einsum("ni,ni->n", found, true))) > 0.9999
    assert not any(tmp_path.iterdir())


def test_they_are_the_same_from_cells_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs over one surface: pieces of them end within blocks, some in one that was begun."""
    clouds = [*stripes(60), *stripes(60)]
    with spool_of(clouds, tmp_path) as spool:
        radius_mm = choose_scan_radius_mm(spool)
        wanted = normals_of(spool, radius_mm)
        monkeypatch.setattr(cell_sums, "FEWEST_ROWS", 8)
        monkeypatch.setattr(scan_normals, "CellSums", partial(CellSums, most_bytes=20_000))
        found = normals_of(spool, radius_mm)
    assert (np.linalg.norm(found, axis=1) > 0.5).tolist() == wanted.any(axis=1).tolist()
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_a_radius_of_a_part_of_the_cells_is_nearly_that_of_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sixteenth of the cells: the 75th percentile of some 200 spacings is known to a tenth."""
    clouds = stripes(60)
    spool = spool_of(clouds)
    whole = choose_scan_radius_mm(spool)
    monkeypatch.setattr(scan_normals, "MOST_KEYS", 200)
    assert choose_scan_radius_mm(spool) == pytest.approx(whole, rel=0.1)


def test_a_lonely_line_has_the_largest_radius() -> None:
    (one,) = stripes(1)
    spool = spool_of([one])
    assert choose_scan_radius_mm(spool) == choose_radius_mm(one.points_mm, one.exposure)


def test_points_are_numbered_as_their_cells_are() -> None:
    points, low = np.random.default_rng(4).uniform(-50.0, 900.0, (2000, 3)), np.full(3, -60.0)
    cell = np.floor((points - low) / 0.7).astype(np.int64)
    np.testing.assert_array_equal(numbers_at(points, low, 0.7), cell_numbers(cell))
    for far in (-60.1, 0.7 * AXIS_CELLS, 1e300):
        points[7, 1] = far
        with pytest.raises(InputError, match="cells along an axis"):
            numbers_at(points, low, 0.7)


def table_of(sums: CellSums) -> tuple[FloatArray, FloatArray]:
    keys, values = zip(*sums.merged(), strict=True)
    return np.concatenate(keys), np.concatenate(values)


def test_sums_of_cells_are_those_of_bincount(tmp_path: Path) -> None:
    """In memory to the last bit; with runs on disk to the rounding of some 60 terms of one."""
    rng = np.random.default_rng(0)
    keys = cell_numbers(rng.integers(0, 40, (50_000, 3)))
    values = rng.normal(size=(50_000, 3))
    numbers, member = np.unique(keys, return_inverse=True)
    wanted = np.stack([np.bincount(member, weights=values[:, k]) for k in range(3)], axis=1)
    held, spilled = CellSums(3), CellSums(3, tmp_path, most_bytes=100_000)
    for sums in (held, spilled):
        for part in np.array_split(np.arange(len(keys)), 5):
            sums.add(keys[part], values[part])
    assert spilled.n_runs > 5
    assert held.n_runs == 0
    found = table_of(held)
    np.testing.assert_array_equal(found[0], numbers)
    np.testing.assert_array_equal(found[1], wanted)
    found = table_of(spilled)
    np.testing.assert_array_equal(found[0], numbers)
    np.testing.assert_allclose(found[1], wanted, atol=1e-13)
    spilled.close()
    assert not any(tmp_path.iterdir())


def test_numbers_of_cells_are_of_one_cell_each_and_end_somewhere() -> None:
    cell = np.stack(np.meshgrid([0, 1, 31, 32, 65, AXIS_CELLS - 1], [0, 7, 33], [5, 64]), -1)
    numbers = cell_numbers(cell.reshape(-1, 3))
    assert len(np.unique(numbers)) == len(numbers)
    assert (numbers >= 0).all()
    np.testing.assert_array_equal(cells_of(numbers), cell.reshape(-1, 3))
    with pytest.raises(InputError):
        cell_numbers(np.array([[0, 0, AXIS_CELLS]]))
