# SPDX-License-Identifier: Apache-2.0
"""A printed board held before a background, under a lamp: what calibration photographs show."""

from __future__ import annotations

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.simulation.board import PrintedBoard
from armscan.simulation.flat_target import Lighting, render_flat_target
from armscan.simulation.optics import RenderCamera, blur_image
from armscan.simulation.scene import Lamp, Scene
from armscan.simulation.stripe_truth import camera_rays
from armscan.simulation.surfaces import Floor

_COARSE_STEP_PX = 16
_OUTLINE_STEPS = 24
_OUTLINE_BITS = 6


def render_board(
    board: PrintedBoard, camera: RenderCamera, lamp: Lamp, background: FloatArray
) -> FloatArray:
    """Render a board under room light over a background image.

    Parameters
    ----------
    board, camera, lamp
        What is seen, by what, under which light.
    background
        (H, W, 3) parts of full scale.

    Returns
    -------
    (H, W, 3) parts of full scale, blurred by the lens, without noise.
    """
    pose = board.sensor_from_board
    print_ = render_flat_target(
        camera,
        board.pattern,
        pose.rotation,
        pose.translation_mm,
        Lighting(light_level=board.light, dark_level=board.dark),
    ).image
    lit = (print_ * _lamp_on_board(board, camera, lamp))[..., None]
    cover = _coverage(board, camera)[..., None]
    return np.asarray(cover * lit + (1.0 - cover) * background)


def outline_px(board: PrintedBoard, camera: RenderCamera) -> FloatArray:
    """(N, 2) pixels along the board's rim."""
    x_min, y_min, x_max, y_max = board.pattern.extent_board_mm
    corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])
    share = (np.arange(_OUTLINE_STEPS) / _OUTLINE_STEPS)[:, None]
    sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    rim = np.concatenate(sides)
    pose = board.sensor_from_board
    return camera.project(rim @ pose.rotation[:, :2].T + pose.translation_mm)


def _coverage(board: PrintedBoard, camera: RenderCamera) -> FloatArray:
    """(H, W) part of each pixel that the board covers, blurred by the lens."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    outline = np.rint(outline_px(board, camera) * (1 << _OUTLINE_BITS)).astype(np.int32)
    cv2.fillPoly(mask, [outline], (255,), lineType=cv2.LINE_AA, shift=_OUTLINE_BITS)
    return blur_image(mask.astype(np.float64) / 255.0, camera.blur_sigma_px)


def _lamp_on_board(board: PrintedBoard, camera: RenderCamera, lamp: Lamp) -> FloatArray:
    """(H, W) light on the board's plane, from a coarse grid: it changes slowly."""
    pose = board.sensor_from_board
    plane = Floor(pose.translation_mm, -pose.rotation[:, 2], (1.0, 1.0, 1.0))
    height, width = camera.height_px // _COARSE_STEP_PX, camera.width_px // _COARSE_STEP_PX
    rows, columns = np.indices((height, width))
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    pixels = (cells + 0.5) * _COARSE_STEP_PX - 0.5
    scene = Scene((plane,), lamp=lamp)
    light = scene.room_light(scene.trace(np.zeros(3), camera_rays(camera, pixels)))
    coarse = light[:, 0].reshape(height, width)
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR))
