# SPDX-License-Identifier: Apache-2.0
"""Charts that several reports have: each kind once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.camera import CameraModel
from armscan.report.drawing import (
    ACCENT,
    INK,
    SceneDots,
    chart_markup,
    new_figure,
    ramp_markup,
    round_below,
    scene_markup,
    styled,
)
from armscan.report.page import Picture
from armscan.report.quantity import significant

MAX_SHOWN = 20_000
RAMP = LinearSegmentedColormap.from_list(
    "deviation", colormaps["cividis"](np.linspace(0.0, 0.93, 32))
)
"""As of the comparison with a model: lightness alone tells the sign, also in grey print and to
colour-blind readers."""

DIVERGING = "RdBu_r"
PAGE_WIDTH = 10.4
"""Inches of a chart that fills the page's width."""
ARROW_SHARE = 0.06
"""Length on the picture, as a share of its longer side, of a residual of three sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class Bars:
    """Values to count in a histogram: filled bars, or an outline; unnamed without a label.

    Where ``counts`` are given, each value counts so often.
    """

    values: FloatArray
    colour: str
    label: str | None = None
    is_outline: bool = False
    counts: IntArray | None = None


def histogram_chart(
    series: Sequence[Bars],
    edges: FloatArray,
    axis_label: str,
    *,
    title: str,
    caption: str,
    curve: tuple[FloatArray, FloatArray, str] | None = None,
) -> Picture:
    """Counts of points.

    ``series``: what to count; the first lies below the others. ``edges``: (B + 1,) of the bins.
    ``curve``: x, y and label of a line over the bars; None for none.
    """
    bins = edges.tolist()
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        for item in series:
            if item.is_outline:
                axes.hist(
                    item.values, bins, histtype="step", color=item.colour, linewidth=1.4,
                    label=item.label, weights=item.counts,
                )  # fmt: skip
            else:
                axes.hist(
                    item.values, bins, histtype="stepfilled", color=item.colour,
                    label=item.label, weights=item.counts,
                )  # fmt: skip
        if curve is not None:
            axes.plot(curve[0], curve[1], color=INK, linewidth=1.2, label=curve[2])
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel(axis_label)
        axes.set_ylabel("points")
        if any(item.label for item in series):
            axes.set_ylim(top=1.3 * axes.get_ylim()[1])
            axes.legend(loc="upper right")
    return Picture(chart_markup(figure, title), caption, title)


def correlation_chart(
    covariance: FloatArray, names: Sequence[str], *, title: str, caption: str
) -> Picture:
    """Correlations of N parameters as a table of colours; ``covariance`` is (N, N)."""
    sigma = np.sqrt(np.diag(covariance))
    with styled():
        figure = new_figure(4.6, 4.2)
        axes = figure.add_subplot()
        correlation = covariance / np.outer(sigma, sigma)
        axes.imshow(correlation, cmap=DIVERGING, vmin=-1.0, vmax=1.0)
        axes.set_xticks(range(len(names)), names)
        axes.set_yticks(range(len(names)), names)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        for (i, j), value in np.ndenumerate(correlation):
            shade = "white" if abs(value) > 0.6 else INK
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=shade)
    return Picture(chart_markup(figure, title), caption, title)


def residual_field(
    camera: CameraModel, points_px: FloatArray, arrows_px: FloatArray, *, title: str, caption: str
) -> Picture:
    """Residual arrows over a camera's image; ``arrows_px`` (N, 2) are the enlarged residuals."""
    with styled():
        figure, axes = image_axes(camera)
        axes.quiver(
            *points_px.T, *arrows_px.T, angles="xy", scale_units="xy", scale=1.0,
            color=ACCENT, width=0.0022, headwidth=3.5, headlength=4.5,
        )  # fmt: skip
    return Picture(chart_markup(figure, title), caption, title)


def image_axes(camera: CameraModel) -> tuple[Figure, Axes]:
    """Axes over the pixels of a camera's image; inside `styled`."""
    ratio = camera.height_px / camera.width_px
    width = 6.0 if ratio <= 1.0 else 6.0 / ratio
    figure = new_figure(width + 0.6, width * ratio + 0.6)
    axes = figure.add_subplot()
    axes.set_xlim(-0.5, camera.width_px - 0.5)
    axes.set_ylim(camera.height_px - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    axes.spines[:].set_visible(True)
    return figure, axes


def named_rows(axes: Axes, names: Sequence[str]) -> None:
    """Lay out horizontal bars of residuals: a name a row, the first on top."""
    axes.set_yticks(range(len(names)), [short(name, 32) for name in names])
    axes.invert_yaxis()
    axes.set_xlabel("rms reprojection residual, px")
    axes.grid(axis="x")


def named_columns(axes: Axes, names: Sequence[str]) -> None:
    """Lay out upright bars: a name a column, slanted where there are many."""
    turn = 60 if len(names) > 8 else 0
    axes.set_xticks(range(len(names)), [short(name, 14) for name in names])
    axes.tick_params(axis="x", labelrotation=turn, labelsize=7.5)


def magnification(camera: CameraModel, rms_px: float) -> float:
    """How much residual arrows are enlarged: a round number, the same in all pictures."""
    longest = max(camera.width_px, camera.height_px)
    return round_below(ARROW_SHARE * longest / max(3.0 * rms_px, 1e-6))


def symmetric_edges(values: FloatArray, least: float = 0.0) -> FloatArray:
    """(61,) bin edges about zero that hold 99 % of the values with some room."""
    reach = max(1.3 * float(np.percentile(np.abs(values), 99.0)), least)
    return np.linspace(-reach, reach, 61)


def short(name: str, most: int = 28) -> str:
    """The end of a long name."""
    return name if len(name) <= most else f"…{name[1 - most :]}"


def deviation_view(
    points_mm: FloatArray, deviations_mm: FloatArray, *, title: str, frame: str, reference: str
) -> Picture:
    """Points in space, coloured by deviation: dark inside or below, light outside or above.

    Parameters
    ----------
    points_mm, deviations_mm
        (N, 3) and (N,).
    title
        Of the picture.
    frame
        Name of the coordinate frame.
    reference
        What the deviations are counted from, in words.
    """
    step = max(1, math.ceil(len(points_mm) / MAX_SHOWN))
    limit = max(float(np.percentile(np.abs(deviations_mm), 98)), 1e-6)
    share = np.clip(0.5 + 0.5 * deviations_mm[::step] / limit, 0.0, 1.0)
    colours = np.asarray(RAMP(share, bytes=True), dtype=np.uint8)[:, :3]
    scene = scene_markup(
        [SceneDots(points_mm[::step], colours)], [], [], title, is_z_up=frame != "Sensor"
    )
    text = significant(limit, "mm", 2)
    every = f" One point in {step} is shown." if step > 1 else ""
    return Picture(
        ramp_markup(f"−{text}", f"+{text}", RAMP) + scene,
        title=f"{title} ({frame} frame)",
        caption=f"Colour is the deviation from {reference}; points beyond the ramp have its end's "
        f"colour.{every}",
    )
