# SPDX-License-Identifier: Apache-2.0
"""Marker sets as records and as tables."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError, InputError
from armscan.jobs.info import describe_registration
from armscan.jobs.job import Job
from armscan.jobs.register import register
from armscan.records.points import CommonErrors, MarkerSet
from armscan.storage.documents import read_registration
from armscan.storage.points import markers_csv, read_marker_list
from rigs.marker_scenes import walk


def some_markers(n: int = 4) -> MarkerSet:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((n, 3, 3))
    covariance = root @ root.transpose(0, 2, 1) + np.eye(3)
    return MarkerSet(
        ids=np.arange(n) * 3,
        points_mm=30.0 * rng.standard_normal((n, 3)),
        covariance_mm2=covariance,
        frame="Base",
    )


def test_a_table_reads_back_as_the_same_numbers(tmp_path: Path) -> None:
    markers = some_markers()
    path = tmp_path / "markers.csv"
    path.write_bytes(markers_csv(markers))
    again = read_marker_list(path, frame="Sensor").markers
    np.testing.assert_array_equal(again.ids, markers.ids)
    np.testing.assert_array_equal(again.points_mm, markers.points_mm)
    # The table holds the upper half: the lower one may differ in the last bit.
    upper = np.triu_indices(3)
    np.testing.assert_array_equal(
        again.covariance_mm2[:, upper[0], upper[1]], markers.covariance_mm2[:, upper[0], upper[1]]
    )
    assert again.frame == "Base"
    assert path.read_text().splitlines()[1].startswith("id,x_mm,y_mm,z_mm,cov_xx_mm2,cov_xy_mm2")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("cov_zz_mm2", "sigma_z", "cov_zz_mm2"),
        ("\n3,", "\n0,", "id 0 appears again"),
    ],
)
def test_other_tables_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "markers.csv"
    path.write_text(markers_csv(some_markers()).decode().replace(old, new))
    with pytest.raises(FileFormatError, match=message):
        read_marker_list(path, frame="Sensor")


def test_comments_about_moves_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    common = CommonErrors(groups=((1, 3), (2,)), covariance=np.diag(np.arange(1.0, 13.0)) + 0.1)
    markers = MarkerSet(
        ids=np.arange(1, 4),
        points_mm=10.0 * np.eye(3),
        covariance_mm2=np.tile(np.eye(3), (3, 1, 1)),
        common=common,
    )
    path = tmp_path / "markers.csv"
    path.write_bytes(markers_csv(markers))
    read = read_marker_list(path, frame="Base").markers.common
    assert read is not None
    assert read.groups == common.groups
    np.testing.assert_array_equal(read.covariance, common.covariance)
    path.write_text(path.read_text().replace("# moved together = 2\n", ""))
    with pytest.raises(FileFormatError, match="do not belong together"):
        read_marker_list(path, frame="Base")


def test_a_covariance_must_be_one() -> None:
    with pytest.raises(InputError, match="not positive definite"):
        MarkerSet(ids=np.arange(1), points_mm=np.zeros((1, 3)), covariance_mm2=-np.eye(3)[None])


@pytest.mark.parametrize("is_simulated", [False, True])
def test_views_of_rendered_images_join_to_a_marked_registration(
    tmp_path: Path, is_simulated: bool
) -> None:
    """One view that is marked is enough."""
    paths = [tmp_path / f"view{k}.csv" for k in range(3)]
    for k, view in enumerate(walk(np.random.default_rng(1), 3).views):
        paths[k].write_bytes(markers_csv(view, is_simulated=is_simulated and k == 1))
    folder = tmp_path / "joined"
    command = ("armscan", "register", *map(str, paths), "-o", "joined views")
    found = register(Job(output=folder, command=command), paths)
    assert found.data["simulated"] is is_simulated
    assert read_registration(folder / "registration.json").simulated is is_simulated
    described = describe_registration(folder / "registration.json")
    assert tuple(shlex.split(described["command"])) == command
    assert ("simulated" in (folder / "registration.html").read_text("utf-8")) is is_simulated
    assert read_marker_list(folder / "markers.csv", frame="").is_simulated is is_simulated
