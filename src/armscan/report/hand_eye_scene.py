# SPDX-License-Identifier: Apache-2.0
"""The postures of a hand-eye calibration in space, over what they looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane
from armscan.report.drawing import LINE, MUTED, PALETTE
from armscan.report.page import Picture
from armscan.report.scene import SceneDots, SceneLines, ramp_colours, ramp_markup, scene_markup

MAX_DOTS = 12_000
FRUSTUM_SHARE = 0.3
"""Length of a drawn camera as a share of its distance from the points."""
HALF_ANGLE = 0.28
AXIS_COLOURS = (PALETTE[1], PALETTE[3], PALETTE[5])


def posture_scene(fit: HandEyeFit, stripes: Sequence[PosedStripe]) -> Picture:
    """Camera pyramids of all postures with their stripes, coloured by residual."""
    points = np.concatenate([stripe.points_base_mm for stripe in fit.stripes])
    residual_um = 1000.0 * np.concatenate([stripe.residual_mm for stripe in fit.stripes])
    step = max(1, len(points) // MAX_DOTS)
    reach = max(float(np.percentile(np.abs(residual_um), 98)), 1.0)
    dots = SceneDots(points[::step], ramp_colours(residual_um[::step], -reach, reach))
    placed = {stripe.source: stripe.points_base_mm for stripe in fit.stripes}
    lines, labels = _cameras(fit, stripes, placed)
    plate = fit.calibration.plate
    if plate is not None:
        lines.append(SceneLines(_plate_edges(plate, points), MUTED))
    what = "plate" if plate is not None else "sphere"
    markup = scene_markup(
        [dots], lines, labels, f"Postures of the sensor over the {what}", is_z_up=True
    )
    return Picture(
        ramp_markup(f"residual −{reach:.0f} µm", f"+{reach:.0f} µm") + markup,
        title="Postures and stripes (Base frame)",
        caption="Each pyramid is the sensor as the arm held it, with its axes X (orange), Y "
        "(green) and Z (blue, the view); the dots are the stripes placed with the result, "
        "coloured by their distance from the reference. Drag to turn; click, then scroll to zoom.",
    )


def _cameras(
    fit: HandEyeFit, stripes: Sequence[PosedStripe], placed: Mapping[str, FloatArray]
) -> tuple[list[SceneLines], list[tuple[str, tuple[float, float, float]]]]:
    """Pyramid and axes of the first exposure of each posture."""
    edges: list[FloatArray] = []
    axes: list[FloatArray] = []
    labels: list[tuple[str, tuple[float, float, float]]] = []
    seen: set[str] = set()
    for stripe in stripes:
        if stripe.posture in seen or stripe.source not in placed or len(stripe) == 0:
            continue
        seen.add(stripe.posture)
        pose = stripe.base_from_tool @ fit.calibration.tool_from_sensor
        size = FRUSTUM_SHARE * float(np.linalg.norm(stripe.points_mm.mean(axis=0)))
        frustum, triad = _pyramid(size), _triad(0.6 * size)
        edges.append(frustum @ pose.rotation.T + pose.translation_mm)
        axes.append(triad @ pose.rotation.T + pose.translation_mm)
        x, y, z = pose.translation_mm.tolist()
        labels.append((stripe.posture, (x, y, z)))
    lines = [SceneLines(np.concatenate(edges), LINE)] if edges else []
    for k, colour in enumerate(AXIS_COLOURS if axes else ()):
        lines.append(SceneLines(np.concatenate([item[2 * k : 2 * k + 2] for item in axes]), colour))
    return lines, labels


def _pyramid(length: float) -> FloatArray:
    """(16, 3) ends of the edges of a camera's pyramid, in Sensor."""
    half = HALF_ANGLE * length
    rim = np.array(
        [[x, y, length] for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
    )
    sides = np.stack([rim, np.roll(rim, -1, axis=0)], axis=1).reshape(-1, 3)
    spokes = np.stack([np.zeros((4, 3)), rim], axis=1).reshape(-1, 3)
    return np.concatenate([sides, spokes])


def _triad(length: float) -> FloatArray:
    """(6, 3) ends of the three axes."""
    return np.stack([np.zeros((3, 3)), length * np.eye(3)], axis=1).reshape(-1, 3)


def _plate_edges(plate: Plane, points_mm: FloatArray) -> FloatArray:
    local = (points_mm - plate.point_mm) @ plate.axes[:2].T
    low, high = np.percentile(local, [1, 99], axis=0)
    (u0, v0), (u1, v1) = low - 0.1 * (high - low), high + 0.1 * (high - low)
    corners = plate.point_mm + np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]) @ plate.axes[:2]
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 3)
