# SPDX-License-Identifier: Apache-2.0
"""Charts of a calibration of light sheets."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from armscan.calibration.laser.result import LaserFit, PointUse, SheetFit, SheetImage
from armscan.geometry.arrays import FloatArray
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    INK,
    LINE,
    MUTED,
    PALETTE,
    chart_markup,
    new_figure,
    raster_markup,
    styled,
)
from armscan.report.page import Picture
from armscan.report.scene import SceneLines, scene_markup, uniform_dots

MAX_PANELS = 12
BINS_ALONG = 24
MAX_DOTS = 2000
PAGE_WIDTH = 10.4
"""Inches of a chart that fills the page's width."""


def residuals_along(fit: LaserFit, index: int) -> Picture:
    """Distance from the sheet along the stripe, one panel a board."""
    images = [image for image in fit.images if _used(image, index).any()]
    sheet = fit.sheets[index].sheet
    n = min(len(images), MAX_PANELS)
    columns = min(n, 3)
    rows = math.ceil(n / columns)
    reach = 1.15 * max(
        float(np.percentile(np.abs(image.residual_mm[_used(image, index)]), 98)) for image in images
    )
    with styled():
        figure = new_figure(PAGE_WIDTH, 1.9 * rows + 0.5)
        grid: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes, image in zip(grid.flat, images[:n], strict=False):
            chosen = _used(image, index)
            along = (image.points_mm[chosen] - sheet.origin_mm) @ sheet.axes[0]
            _residual_panel(axes, along, image.residual_mm[chosen])
            axes.set_title(_short(image.source), loc="left", fontsize=8)
            axes.set_ylim(-reach, reach)
        for axes in list(grid.flat)[n:]:
            axes.set_axis_off()
        figure.supxlabel("along the stripe, mm", fontsize=9, color=MUTED)
        figure.supylabel("off the sheet, mm", fontsize=9, color=MUTED)
    more = f" {len(images) - n} more boards are not shown." if len(images) > n else ""
    return Picture(
        raster_markup(figure, "Residuals along the stripe"),
        title=f"Sheet {fit.sheets[index].name}: residuals along the stripe",
        caption="Dots are stripe points, the line their running mean, the boards as measured. "
        "A line that leans means that the board's pose is off, within its uncertainty; the same "
        "bend on every board means that the sheet itself is bent." + more,
    )


def residual_histogram(fit: LaserFit) -> Picture:
    """Residuals across the stripe in the image, all sheets."""
    values = np.concatenate(
        [image.residual_px[image.use == int(PointUse.USED)] for image in fit.images]
    )
    remaining = np.concatenate(
        [image.remaining_px[image.use == int(PointUse.USED)] for image in fit.images]
    )
    reach = float(np.percentile(np.abs(values), 99.0)) * 1.3
    edges = np.linspace(-reach, reach, 61).tolist()
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        axes.hist(values, edges, color=LINE, label="boards as measured")
        axes.hist(
            remaining, edges, histtype="step", color=ACCENT, linewidth=1.4,
            label="boards moved within their uncertainty",
        )  # fmt: skip
        axes.set_xlabel("off the sheet, across the stripe, px")
        axes.set_ylabel("points")
        axes.set_ylim(top=axes.get_ylim()[1] * 1.25)
        axes.legend(loc="upper center")
    return Picture(
        chart_markup(figure, "Histogram of the residuals"),
        title="Distribution of residuals",
        caption=f"Stripe points scatter {fit.noise_factor:.2f} times as much as their sigmas "
        f"say; about {fit.correlation_points:.0f} points along a stripe count as one.",
    )


def scene(fit: LaserFit) -> Picture:
    """Camera, boards, stripes and sheets in space."""
    lines = [SceneLines(_camera_edges(fit), INK)]
    lines += [SceneLines(_board_edges(image), "#b4bec8") for image in fit.images]
    dots = []
    labels: list[tuple[str, tuple[float, float, float]]] = [("camera", (0.0, 0.0, 0.0))]
    for index, sheet in enumerate(fit.sheets):
        colour = PALETTE[index % len(PALETTE)]
        points = _points_of(fit, index)
        shown = points[:: max(1, len(points) // MAX_DOTS)]
        dots.append(uniform_dots(shown, colour))
        edges = _sheet_edges(sheet, points)
        lines.append(SceneLines(edges, colour))
        x, y, z = edges[0].tolist()
        labels.append((f"sheet {sheet.name}", (x, y, z)))
    return Picture(
        scene_markup(dots, lines, labels, "Camera, boards and light sheets in space"),
        title="In space (Sensor frame)",
        caption="The pyramid is the camera and what it sees, grey outlines are the boards, dots "
        "the stripes on them, coloured outlines the calibrated part of each sheet. Drag to turn; "
        "click, then scroll to zoom.",
    )


def _used(image: SheetImage, index: int) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.asarray((image.use == int(PointUse.USED)) & (image.sheet == index))


def _points_of(fit: LaserFit, index: int) -> FloatArray:
    return np.concatenate([image.points_mm[_used(image, index)] for image in fit.images])


def _residual_panel(axes: Any, along: FloatArray, residual: FloatArray) -> None:
    axes.axhline(0.0, color=LINE, linewidth=0.8)
    axes.plot(along, residual, ".", color=ACCENT, markersize=1.6, alpha=0.45)
    edges = np.linspace(along.min(), along.max() + 1e-9, BINS_ALONG + 1)
    cell = np.digitize(along, edges) - 1
    filled = [k for k in range(BINS_ALONG) if (cell == k).any()]
    middle = [float(along[cell == k].mean()) for k in filled]
    mean = [float(residual[cell == k].mean()) for k in filled]
    axes.plot(middle, mean, color=ALERT, linewidth=1.2)


def _board_edges(image: SheetImage) -> FloatArray:
    board = image.view.points_board_mm
    (x0, y0, _), (x1, y1, _) = board.min(axis=0), board.max(axis=0)
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    pose = image.sensor_from_board
    return _closed(corners @ pose.rotation.T + pose.translation_mm)


def _sheet_edges(fit: SheetFit, points: FloatArray) -> FloatArray:
    sheet = fit.sheet
    local = (points - sheet.origin_mm) @ sheet.axes.T
    (u0, v0), (u1, v1) = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    return _closed(sheet.origin_mm + corners @ sheet.axes[:2])


def _camera_edges(fit: LaserFit) -> FloatArray:
    camera = fit.camera.camera
    depth = 0.25 * min(sheet.calibration.depth_range_mm[0] for sheet in fit.sheets)
    corners = np.array(
        [[0, 0], [camera.width_px, 0], [camera.width_px, camera.height_px], [0, camera.height_px]]
    )
    centre, focal = [camera.cx_px, camera.cy_px], [camera.fx_px, camera.fy_px]
    rim = np.column_stack([(corners - centre) / focal * depth, np.full(4, depth)])
    spokes = np.stack([np.zeros((4, 3)), rim], axis=1).reshape(-1, 3)
    return np.concatenate([_closed(rim), spokes])


def _closed(corners: FloatArray) -> FloatArray:
    """(2 N, 3) ends of the sides of a closed outline of N corners."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 3)


def _short(source: str) -> str:
    return source if len(source) <= 30 else "…" + source[-29:]
