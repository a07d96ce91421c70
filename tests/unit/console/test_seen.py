# SPDX-License-Identifier: Apache-2.0
"""What the console says of a take: which camera sees what, and whether that is enough."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.console.journey import SessionSettings, StepName, open_journey
from armscan.console.scan import GrowingRecording
from armscan.console.work import seen_in_take
from armscan.records.exposure import Exposure
from armscan.records.recording import CameraSetup, ExposureRow, Session

HEIGHT, WIDTH = 240, 320
DARK = np.full((HEIGHT, WIDTH), 20, np.uint8)


def circles() -> np.ndarray:
    image = np.full((HEIGHT, WIDTH), 200, np.uint8)
    for k in range(20):
        cv2.circle(image, (60 + 48 * (k % 5), 40 + 50 * (k // 5)), 14, 40, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def line() -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    light = 20.0 + 180.0 * np.exp(-0.5 * ((columns - 150.0 - 0.1 * rows) / 2.0) ** 2)
    noise = np.random.default_rng(1).normal(size=light.shape)
    return np.clip(light + noise, 0, 255).astype(np.uint8)


def told(folder: Path, step: StepName, *shots: tuple[int, str, np.ndarray]) -> tuple[bool, str]:
    """Of one take with these images: camera, laser, pixels."""
    n = 1 + max(camera for camera, _, _ in shots)
    settings = SessionSettings(target="circle-grid:5x4:10", n_cameras=n)
    journey = open_journey(folder, settings)
    session = Session("calibration", (CameraSetup(WIDTH, HEIGHT),) * n)
    grown = GrowingRecording.of(journey.recording(step), session)
    for k, (camera, laser, image) in enumerate(shots):
        lasers = (laser,) if laser else ()
        row = ExposureRow(k, 1000 + 100 * k, camera, f"images/{k}.png", lasers, None, "01")
        grown.add(row, Exposure(image, row.source, camera=camera, lasers=lasers))
    grown.flush()
    return seen_in_take(folder, step)


@pytest.mark.parametrize("is_seen", [True, False])
def test_of_two_cameras_each_is_named_with_what_it_sees(tmp_path: Path, is_seen: bool) -> None:
    right = circles() if is_seen else DARK
    good, words = told(tmp_path / "s", StepName.CAMERA, (0, "", circles()), (1, "", right))
    assert good is is_seen
    start = "Seen in" if is_seen else "In"
    assert words.startswith(f"{start} the left image: 20 points of the target; in the right image:")
    assert words.endswith("image: 20 points of the target.") is is_seen


def test_of_one_camera_nothing_is_said_of_sides(tmp_path: Path) -> None:
    words = told(tmp_path / "s", StepName.CAMERA, (0, "", circles()))
    assert words == (True, "Seen: 20 points of the target.")


def test_a_sheet_is_calibrated_by_what_one_of_two_cameras_sees(tmp_path: Path) -> None:
    # the outer lines of a fan leave the view that both cameras share
    left = (0, "A", line()), (0, "", circles())
    good, words = told(tmp_path / "a", StepName.LASER, *left, (1, "A", DARK), (1, "", DARK))
    assert good and words.endswith("One of the two images is enough for each line.")
    good, words = told(
        tmp_path / "b", StepName.LASER, (0, "A", DARK), left[1], (1, "A", line()), (1, "", DARK)
    )
    assert not good and "no laser line" in words and words.endswith("Take it back and once more.")


def test_of_two_lasers_each_is_to_be_seen_by_one_camera(tmp_path: Path) -> None:
    both = (0, "", circles()), (1, "", circles())
    lit = (0, "A", line()), (0, "B", DARK), (1, "A", DARK)
    good, words = told(tmp_path / "a", StepName.LASER, *both, *lit, (1, "B", line()))
    assert good and "left image: no laser line of B" in words
    assert "right image: no laser line of A" in words
    good, words = told(tmp_path / "b", StepName.LASER, *both, *lit, (1, "B", DARK))
    assert not good and "left image: no laser line of B" in words
