# SPDX-License-Identifier: Apache-2.0
"""Lists of markers: what is read, what is assumed, and what is refused with its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.records.points import MarkerSet
from armscan.storage.points import markers_csv, read_marker_list

HEAD = "x_mm,y_mm,z_mm"
ROWS = "1.5,2,3\n100,2,3\n1,200,3\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "markers.csv"
    path.write_text(text)
    return path


def test_a_full_list_comes_back_as_the_same_numbers(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    factor = generator.normal(size=(5, 3, 3)) * 0.02
    markers = MarkerSet(
        ids=np.array([7, 3, 90, 4, 1]),
        points_mm=generator.normal(size=(5, 3)) * 100.0,
        covariance_mm2=factor @ np.swapaxes(factor, 1, 2) + 1e-6 * np.eye(3),
        frame="Sensor",
    )
    path = tmp_path / "markers.csv"
    path.write_bytes(markers_csv(markers))
    found = read_marker_list(path, frame="Base")
    assert found.has_ids
    assert not found.is_sigma_assumed
    assert found.markers.frame == "Sensor"
    np.testing.assert_array_equal(found.markers.ids, markers.ids)
    np.testing.assert_array_equal(found.markers.points_mm, markers.points_mm)
    np.testing.assert_array_equal(found.markers.covariance_mm2, markers.covariance_mm2)


@pytest.mark.parametrize("is_simulated", [False, True])
def test_a_list_says_whether_its_images_were_rendered(tmp_path: Path, is_simulated: bool) -> None:
    markers = MarkerSet(
        ids=np.arange(3),
        points_mm=np.eye(3) * 50.0,
        covariance_mm2=np.tile(1e-4 * np.eye(3), (3, 1, 1)),
        frame="Sensor",
    )
    path = tmp_path / "markers.csv"
    path.write_bytes(markers_csv(markers, is_simulated=is_simulated))
    found = read_marker_list(path, frame="Base")
    assert found.is_simulated is is_simulated
    assert found.markers.frame == "Sensor"


def test_three_columns_are_enough(tmp_path: Path) -> None:
    found = read_marker_list(written(tmp_path, f"{HEAD}\n{ROWS}"), frame="Base", sigma_mm=0.05)
    assert found.markers.ids.tolist() == [1, 2, 3]
    assert not found.has_ids
    assert found.is_sigma_assumed
    assert found.markers.frame == "Base"
    np.testing.assert_allclose(found.markers.covariance_mm2[1], 0.0025 * np.eye(3))


@pytest.mark.parametrize(
    "comment", ["#frame=Base", "# Frame = Base", "# frame: Base", "# frame = base", "# FRAME =BASE"]
)
def test_a_frame_is_read_however_it_is_written(tmp_path: Path, comment: str) -> None:
    """All but `# frame = Base` were passed over, and the markers taken to be in Sensor."""
    path = written(tmp_path, f"{comment}\n{HEAD}\n{ROWS}")
    assert read_marker_list(path, frame="Sensor").markers.frame == "Base"
    path = written(tmp_path, f"# frame = Fixture 2\n# framed by us\n{HEAD}\n{ROWS}")
    assert read_marker_list(path, frame="Sensor").markers.frame == "Fixture 2"


def test_probed_points_are_a_list_too(tmp_path: Path) -> None:
    text = (
        f"# point = tip-centre, tip_diameter_mm = 6\n{HEAD},feature\n1,2,3,a\n100,2,3,b\n1,90,3,c\n"
    )
    found = read_marker_list(written(tmp_path, text), frame="Base")
    assert len(found.markers) == 3
    assert found.markers.points_mm[0].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{HEAD}\n1,2,nan\n", "line 2: 'nan' in column z_mm is no number"),
        (f"{HEAD}\n1,2,\n", "line 2: '' in column z_mm is no number"),
        ("x,y,z\n1,2,3\n", "no column is called x_mm, y_mm, z_mm"),
        ("x_m,y_m,z_m\n1,2,3\n", "in metres"),
        (f"{HEAD}\n0.1,0.2,0.3\n0.2,0.2,0.3\n0.1,0.4,0.3\n", "these look like metres"),
        (f"{HEAD}\n", "holds no marker"),
        ("", "the file is empty"),
        (f"id,{HEAD}\n4,1,2,3\n4,100,2,3\n", "line 3: id 4 appears again"),
        (f"id,{HEAD}\na,1,2,3\n", "'a' in column id is no whole number"),
        (f"{HEAD}\n1,2,3\n50,2,3\n1,2,3\n", "line 2: two markers have the same place"),
        (f"{HEAD},cov_xx_mm2\n1,2,3,0.1\n", "no column is called cov_xy_mm2"),
        (
            f"{HEAD},cov_xx_mm2,cov_xy_mm2,cov_xz_mm2,cov_yy_mm2,cov_yz_mm2,cov_zz_mm2\n"
            "1,2,3,1,0,0,1,0,1\n9,2,3,1,2,0,1,0,1\n",
            "line 3: the six covariances make no covariance matrix",
        ),
        (f"{HEAD}\n1,2\n", "line 2"),
        ('{"a": 1}', "no table"),
    ],
)
def test_what_is_no_list_is_refused_with_its_place(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_marker_list(written(tmp_path, text), frame="Base")
    assert said in str(caught.value)
    assert "markers.csv" in str(caught.value)
