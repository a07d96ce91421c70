# SPDX-License-Identifier: Apache-2.0
"""A cloud on disk is the cloud in memory, whatever the size of its pieces."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import InputError, OutputError
from armscan.fusion import digest as digest_module
from armscan.fusion import point_spool
from armscan.fusion.digest import CloudDigest, percentiles
from armscan.reconstruction.place import merge_clouds
from armscan.storage.clouds import CloudPiece, ply_bytes, ply_parts, xyz_bytes
from armscan.storage.formats.text import xyz_parts
from rigs.long_scan import POINTS, pixels_of, spool_of, stripes

KEPT = [0, 1, 2, 3, 6, 7, 9]


@pytest.mark.parametrize("piece_points", [1, 2 * POINTS, 10**6])
@pytest.mark.parametrize("on_disk", [False, True])
def test_every_value_comes_back_to_the_last_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_disk: bool, piece_points: int
) -> None:
    monkeypatch.setattr(point_spool, "PIECE_POINTS", piece_points)
    clouds = stripes(10)
    whole = merge_clouds([clouds[k] for k in KEPT])
    with spool_of(clouds, tmp_path if on_disk else None) as spool:
        spool.keep(KEPT)
        found = spool.cloud()
        pieces = list(spool.pieces())
        starts = [piece.start for piece in pieces]
        parts = [CloudPiece(piece.cloud, piece.sigma_mm) for piece in pieces]
        marks = spool.without_points()
        assert len(spool) == len(whole)
        np.testing.assert_array_equal(spool.corners_mm[1], whole.points_mm.max(axis=0))
        pixels = np.concatenate([piece.pixel_px for piece in pieces])
    assert ply_bytes(found) == ply_bytes(whole)
    assert b"".join(ply_parts(marks, len(whole), parts)) == ply_bytes(whole)
    assert b"".join(xyz_parts(marks, len(whole), parts)) == xyz_bytes(whole)
    np.testing.assert_array_equal(pixels, np.concatenate([pixels_of(clouds[k], k) for k in KEPT]))
    assert starts == np.cumsum([0, *(len(part.cloud) for part in parts[:-1])]).tolist()
    assert len(pieces) > 1 or piece_points == 10**6
    assert not any(tmp_path.iterdir()), "the files go with the spool"


def test_two_cameras_of_an_instant_stay_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_spool, "PIECE_POINTS", 1)
    for piece in spool_of(stripes(8)).pieces():
        exposures = np.unique(piece.cloud.exposure)
        assert (exposures // 2).max() == (exposures // 2).min()


def test_what_does_not_belong_together_is_refused() -> None:
    clouds = stripes(3)
    spool = spool_of(clouds)
    with pytest.raises(InputError):
        spool.add(merge_clouds([clouds[0]]).__class__.concat([clouds[0]], sheet_names=("C", "D")))
    with pytest.raises(InputError):
        spool.add(clouds[0].__class__.concat([clouds[0]], noise_length=None))


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no device that is always full")
    (tmp_path / "rest").symlink_to("/dev/full")
    with pytest.raises(OutputError), spool_of([], tmp_path) as spool:
        for cloud in stripes(200):
            spool.add(cloud)


def test_a_full_disk_is_told_where_few_points_would_fit_into_a_buffer(tmp_path: Path) -> None:
    """The error came without a place or what to do, where the points were read."""
    if not Path("/dev/full").exists():
        pytest.skip("no device that is always full")
    (tmp_path / "rest").symlink_to("/dev/full")
    with spool_of([], tmp_path) as spool, pytest.raises(OutputError, match="free some space"):
        spool.add(stripes(1)[0].select(slice(20)))


@pytest.mark.parametrize("n", [1, 2, 1001, 40_000])
def test_percentiles_of_many_values_are_those_of_sorting(
    monkeypatch: pytest.MonkeyPatch, n: int
) -> None:
    monkeypatch.setattr(digest_module, "MOST_SORTED", 0)
    values = np.random.default_rng(1).lognormal(0.0, 2.0, n)
    wanted = (0.0, 2.0, 50.0, 95.0, 99.9, 100.0)
    found = percentiles(lambda: np.array_split(values, 7), wanted, n)
    np.testing.assert_allclose(found, np.percentile(values, wanted), rtol=1e-13)


def test_a_page_tells_the_same_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_spool, "PIECE_POINTS", 500)
    monkeypatch.setattr(digest_module, "SHOWN_POINTS", 100)
    clouds = stripes(12)
    spool = spool_of(clouds)
    one = CloudDigest.of_spool(spool, spool.without_points())
    other = CloudDigest.of(merge_clouds(clouds))
    for name in ("n_points", "step", "sigma_mm", "low_mm", "edges_mm", "sigma_counts"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.shown.points_mm, other.shown.points_mm)
    np.testing.assert_array_equal(one.shown_sigma_mm, other.shown_sigma_mm)
    assert int(other.sigma_counts.sum()) >= 0.99 * other.n_points


def test_a_digest_holds_nothing_of_the_points_that_it_does_not_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four times the points must not take more memory: 16 bytes of each once did."""
    monkeypatch.setattr(point_spool, "PIECE_POINTS", 2_000)
    monkeypatch.setattr(digest_module, "SHOWN_POINTS", 100)
    monkeypatch.setattr(digest_module, "MOST_SORTED", 1_000)
    peaks = []
    for times in (1, 4):
        with spool_of(stripes(40) * 10 * times, tmp_path) as spool:
            marks = spool.without_points()
            tracemalloc.start()
            CloudDigest.of_spool(spool, marks)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
            n_points = len(spool)
    assert peaks[1] - peaks[0] < 16 * (n_points * 3 / 4) / 4
