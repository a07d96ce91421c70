# SPDX-License-Identifier: Apache-2.0
"""The rendered folder: its files, its truth, its repeatability."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.devices.registry import load_driver
from armscan.errors import InputError, OutputError
from armscan.simulation.photos import BOARD, PhotoSetOptions, PhotoSetTruth, render_photo_set

SMALL = PhotoSetOptions(width_px=320, height_px=240, n_camera=2, n_laser=2)
FILES = (
    *(f"camera/{k:02d}.png" for k in (1, 2)),
    *(f"laser/{state}/{k:02d}.png" for k in (1, 2) for state in ("on", "off")),
    "object/laser.png",
    "object/background.png",
)


@pytest.fixture(scope="module")
def photo_set(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PhotoSetTruth]:
    folder = tmp_path_factory.mktemp("photos")
    return folder, render_photo_set(folder, 7, options=SMALL)


def read(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), dtype=np.float64)


def test_the_registry_knows_the_photo_set_by_name() -> None:
    assert load_driver("photo-set") is render_photo_set


def test_all_files_are_there_and_nothing_half_written(
    photo_set: tuple[Path, PhotoSetTruth],
) -> None:
    folder, _ = photo_set
    found = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert found == {*FILES, "truth.json"}
    assert read(folder / "camera/01.png").shape == (240, 320)
    assert read(folder / "laser/on/01.png").shape == (240, 320, 3)


def test_dark_circles_lie_where_the_truth_projects_them(
    photo_set: tuple[Path, PhotoSetTruth],
) -> None:
    folder, truth = photo_set
    marks = BOARD.marks_board_mm
    between = marks + BOARD.pitch_mm * np.array([0.5, 0.5, 0.0])
    for k, pose in enumerate(truth.camera_boards, start=1):
        image = read(folder / f"camera/{k:02d}.png")
        grey = []
        for points in (marks, between):
            px = truth.camera.project(points @ pose.rotation.T + pose.translation_mm)
            u, v = np.rint(px).astype(int).T
            grey.append(image[v, u])
        assert grey[0].max() < 0.4 * grey[1].min()


def test_the_laser_is_the_only_difference_between_on_and_off(
    photo_set: tuple[Path, PhotoSetTruth],
) -> None:
    folder, truth = photo_set
    pairs = [
        *((f"laser/on/{k:02d}.png", f"laser/off/{k:02d}.png") for k in (1, 2)),
        ("object/laser.png", "object/background.png"),
    ]
    stripes = (*truth.laser_stripes, truth.body_stripe)
    for (on, off), stripe in zip(pairs, stripes, strict=True):
        red = (read(folder / on) - read(folder / off))[..., 2]
        u, v = np.rint(stripe.points_px[stripe.surface == 0]).astype(int).T
        assert np.mean(red[v, u] > 20.0) > 0.8
        column = np.arange(red.shape[1])[None, :]
        nearest = np.full(red.shape[0], np.inf)
        nearest[v] = u
        far = np.abs(column - nearest[:, None]) > 40
        far &= np.isfinite(nearest)[:, None]
        # 4 sigma of two exposures' noise and rounding, on the mean of thousands of pixels
        assert abs(red[far].mean()) < 0.2


def test_truth_is_written_beside_the_images_and_agrees_with_itself(
    photo_set: tuple[Path, PhotoSetTruth],
) -> None:
    folder, truth = photo_set
    document = json.loads((folder / "truth.json").read_text())
    assert document["simulated"] is True
    assert document["target"] == "circle-grid:11x9:12"
    assert len(document["laser_photos"]) == 2
    points = np.array(document["object"]["stripe_sensor_mm"])
    on_bust = truth.body_stripe.surface == 0
    assert np.abs(truth.sheet_offset_mm(points)).max() < 1e-4
    assert np.abs(truth.object_distance_mm(points[on_bust])).max() < 1e-4
    assert np.abs(truth.sheet_offset_mm(truth.sheet_points_mm)).max() < 1e-6
    assert truth.camera_parameters[0] == pytest.approx(1402.6 / 4)


def test_a_seed_repeats_every_byte_and_another_changes_the_photos(
    photo_set: tuple[Path, PhotoSetTruth], tmp_path: Path
) -> None:
    folder, _ = photo_set
    heard: list[tuple[int, int, str]] = []
    few = PhotoSetOptions(width_px=320, height_px=240, n_camera=2, n_laser=2)
    render_photo_set(tmp_path / "a", 7, lambda *event: heard.append(event), few)
    for name in (*FILES, "truth.json"):
        assert (tmp_path / "a" / name).read_bytes() == (folder / name).read_bytes()
    assert [event[2] for event in heard] == list(FILES)
    assert heard[-1][:2] == (len(FILES), len(FILES))
    render_photo_set(tmp_path / "b", 8, options=few)
    assert (tmp_path / "b/camera/01.png").read_bytes() != (folder / FILES[0]).read_bytes()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(OutputError, match=r"file.*choose a folder that can be written"):
        render_photo_set(blocker, options=SMALL)


@pytest.mark.parametrize("options", [{"n_camera": 0}, {"n_laser": 99}, {"width_px": 10}])
def test_impossible_counts_and_sizes_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(InputError):
        PhotoSetOptions(**options)
