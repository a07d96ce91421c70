# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.simulation.objects.boards import CirclePattern, PrintedBoard, render_board
from armscan.simulation.optics.camera import RenderCamera
from armscan.simulation.optics.scene import RoomLight
from rigs.flat_prints import ChessboardPattern, Lighting, illumination, render_flat_target

CAMERA = RenderCamera(1000.0, 1000.0, 150.3, 99.8, width_px=300, height_px=200, blur_sigma_px=0.8)
TILTED = cv2.Rodrigues(np.array([0.5, -0.4, 0.2]))[0]

INK = Lighting(light_level=1.0, dark_level=0.0)


def reflectance(
    pattern: CirclePattern, rotation: FloatArray, translation_mm: FloatArray
) -> FloatArray:
    """(H, W) mean reflectance in each pixel's aperture, without the lens's blur."""
    sharp = replace(CAMERA, blur_sigma_px=0.0)
    return render_flat_target(sharp, pattern, rotation, translation_mm, INK).image


def test_frontal_disc_has_the_right_area_and_centre_of_mass() -> None:
    pattern = CirclePattern(1, 1, 10.0, 6.0)
    ink = 1.0 - reflectance(pattern, np.eye(3), np.array([0.0, 0.0, 100.0]))
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    # 16 samples across a pixel, some 190 pixels on the rim
    assert ink.sum() == pytest.approx(np.pi * 30.0**2, rel=2e-4)
    assert (ink * u).sum() / ink.sum() == pytest.approx(150.3, abs=1e-3)
    assert (ink * v).sum() / ink.sum() == pytest.approx(99.8, abs=1e-3)


def test_tilted_disc_has_the_moments_of_its_conic() -> None:
    pattern = CirclePattern(1, 1, 12.0, 9.0)
    t = np.array([0.4, -0.2, 100.0])
    ink = 1.0 - reflectance(pattern, TILTED, t)
    matrix = np.array([[1000.0, 0, 150.3], [0, 1000.0, 99.8], [0, 0, 1]])
    h = np.linalg.inv(matrix @ np.column_stack([TILTED[:, 0], TILTED[:, 1], t]))
    conic = h.T @ np.diag([1.0, 1.0, -(4.5**2)]) @ h
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    assert (ink * u).sum() / ink.sum() == pytest.approx(centre[0], abs=1e-3)
    assert (ink * v).sum() / ink.sum() == pytest.approx(centre[1], abs=1e-3)


def test_marks_are_where_opencv_projects_them() -> None:
    pattern = ChessboardPattern(4, 3, 3.0)
    t = np.array([-4.0, -3.0, 100.0])
    rendered = render_flat_target(CAMERA, pattern, TILTED, t)
    matrix = np.array([[1000.0, 0, 150.3], [0, 1000.0, 99.8], [0, 0, 1]])
    vector = cv2.Rodrigues(TILTED)[0]
    oracle = cv2.projectPoints(pattern.marks_board_mm, vector, t, matrix, np.zeros(5))[0]
    np.testing.assert_allclose(rendered.marks_px, oracle.reshape(-1, 2), atol=1e-9)


def test_chessboard_corner_is_dark_above_left_and_light_beside() -> None:
    pattern = ChessboardPattern(4, 3, 3.0)
    image = render_flat_target(CAMERA, pattern, np.eye(3), np.array([-4.5, -3.0, 100.0])).image
    u, v = (round(x) for x in (150.3 - 45.0, 99.8 - 30.0))
    assert image[v - 12, u - 12] == pytest.approx(40.0, abs=0.01)
    assert image[v - 12, u + 12] == pytest.approx(200.0, abs=0.01)
    assert image[v + 12, u + 12] == pytest.approx(40.0, abs=0.01)


def test_edge_profile_is_the_blur_and_the_aperture_at_every_phase() -> None:
    """An edge along the pixels, the worst case, keeps its place to half a sample (1/32 px)."""
    pattern = ChessboardPattern(1, 1, 40.0)
    for phase in np.arange(0, 1, 0.125) + 0.03:
        t = np.array([0.1 * phase, 0.0, 100.0])
        image = render_flat_target(CAMERA, pattern, np.eye(3), t).image
        row = image[40, 120:180] / 160.0 - 0.25
        edge = 119.5 + (1.0 - row).sum()
        assert edge == pytest.approx(150.3 + phase, abs=0.035)
        step = np.diff(row)
        u = np.arange(120.5, 179.0)
        variance = (step * (u - (step * u).sum()) ** 2).sum()
        assert variance == pytest.approx(0.8**2 + 1.0 / 12.0 + 1.0 / 12.0, abs=0.02)


def test_illumination_gradient_spans_the_image() -> None:
    shade = illumination(CAMERA, Lighting(gradient=0.5))
    assert shade[0, 0] == pytest.approx(1.0)
    assert shade[-1, -1] == pytest.approx(0.5)
    across = illumination(CAMERA, Lighting(gradient=0.5, gradient_azimuth_rad=np.pi / 2))
    assert across[0, -1] == pytest.approx(1.0)
    assert across[-1, 0] == pytest.approx(0.5)


def test_the_back_of_the_print_is_refused() -> None:
    flipped = np.diag([1.0, -1.0, -1.0])
    with pytest.raises(InputError, match="back"):
        render_flat_target(CAMERA, ChessboardPattern(4, 3, 3.0), flipped, np.array([0, 0, 100.0]))


@pytest.mark.parametrize("aside_mm", [-6.0, 4.0, 60.0])
def test_discs_that_a_board_cuts_are_as_those_of_a_larger_one(aside_mm: float) -> None:
    """What is drawn is the box around the board: some of each disc lies beyond that."""
    pose: Pose[Sensor, Board] = Pose(np.eye(3), np.array([aside_mm, -4.0, 100.0]))
    background = np.zeros((CAMERA.height_px, CAMERA.width_px), np.float32)
    images = [
        render_board(
            PrintedBoard(CirclePattern(2, 2, 10.0, 9.0, margin_mm=margin), pose, 0.8, 0.1),
            CAMERA,
            RoomLight(),
            background.copy(),
        )
        for margin in (0.0, 10.0)
    ]
    left, top = np.array([150.3, 99.8]) + 10.0 * np.array([aside_mm, -4.0])
    inside = (slice(int(top) + 9, int(top) + 92), slice(max(int(left) + 9, 0), int(left) + 92))
    np.testing.assert_array_equal(images[0][inside], images[1][inside])
    is_seen = left < CAMERA.width_px
    assert (images[0][inside].size > 0 and np.ptp(images[0][inside]) > 0.1) == is_seen
    assert images[0].any() == is_seen
