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

MAX_PANELS = 12
BINS_ALONG = 24


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
        figure = new_figure(3.1 * columns + 0.4, 1.7 * rows + 0.5)
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
    with styled():
        figure = new_figure(6.4, 5.2)
        axes: Any = figure.add_subplot(projection="3d")
        _draw_camera(axes, fit)
        for image in fit.images:
            _draw_board(axes, image)
        for index, sheet in enumerate(fit.sheets):
            colour = PALETTE[index % len(PALETTE)]
            _draw_sheet(axes, sheet, _points_of(fit, index), colour)
        axes.set_xlabel("X, mm")
        axes.set_ylabel("Z (depth), mm")
        axes.set_zlabel("Y (down), mm")
        axes.invert_zaxis()
        axes.set_aspect("equal")
        axes.view_init(elev=24, azim=-58)
    return Picture(
        raster_markup(figure, "Camera, boards and light sheets in space"),
        title="In space (Sensor frame)",
        caption="The pyramid is the camera and what it sees, grey outlines are the boards, dots "
        "the stripes on them, coloured areas the calibrated part of each sheet.",
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


def _draw_board(axes: Any, image: SheetImage) -> None:
    board = image.view.points_board_mm
    (x0, y0, _), (x1, y1, _) = board.min(axis=0), board.max(axis=0)
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0], [x0, y0, 0.0]])
    pose = image.sensor_from_board
    x, y, z = (corners @ pose.rotation.T + pose.translation_mm).T
    axes.plot(x, z, y, color=MUTED, linewidth=0.8)


def _draw_sheet(axes: Any, fit: SheetFit, points: FloatArray, colour: str) -> None:
    sheet = fit.sheet
    local = (points - sheet.origin_mm) @ sheet.axes.T
    (u0, v0), (u1, v1) = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    x, y, z = (sheet.origin_mm + corners @ sheet.axes[:2]).T
    axes.plot_trisurf(
        x, z, y, triangles=[[0, 1, 2], [0, 2, 3]], color=colour, alpha=0.18, linewidth=0
    )
    shown = points[:: max(1, len(points) // 1500)]
    axes.plot(shown[:, 0], shown[:, 2], shown[:, 1], ".", color=colour, markersize=1.5)
    axes.plot([], [], [], "s", color=colour, label=f"sheet {fit.name}")
    axes.legend(loc="upper left")


def _draw_camera(axes: Any, fit: LaserFit) -> None:
    camera = fit.camera.camera
    depth = 0.25 * min(sheet.calibration.depth_range_mm[0] for sheet in fit.sheets)
    corners = np.array(
        [[0, 0], [camera.width_px, 0], [camera.width_px, camera.height_px], [0, camera.height_px]]
    )
    centre, focal = [camera.cx_px, camera.cy_px], [camera.fx_px, camera.fy_px]
    xy = (corners - centre) / focal * depth
    for k in range(4):
        a, b = xy[k], xy[(k + 1) % 4]
        axes.plot([0, a[0], b[0]], [0, depth, depth], [0, a[1], b[1]], color=INK, linewidth=0.9)


def _short(source: str) -> str:
    return source if len(source) <= 30 else "…" + source[-29:]
