# SPDX-License-Identifier: Apache-2.0
"""Charts of deviations: the thesis's histograms (figures 5.12, 5.14, 5.19), and points in space."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray
from armscan.inspection.histogram import histogram, within_key
from armscan.inspection.results import Deviations
from armscan.report.drawing import ACCENT, ALERT, INK, MUTED, chart_markup, new_figure, styled
from armscan.report.numbers import significant
from armscan.report.page import Picture
from armscan.report.scene import SceneDots, scene_markup

MAX_SHOWN = 20_000
BAND_MM = 0.05
LEAST_HALF_WIDTH_MM = 0.01
RAMP = LinearSegmentedColormap.from_list("deviation", ("#1d4fa5", "#a9b4bd", "#c2331c"))
"""Blue below, grey at zero, red above: a white middle would vanish on the page."""


def deviation_histogram(
    deviations: Deviations,
    *,
    title: str,
    axis_label: str = "deviation, mm",
    band_mm: float = BAND_MM,
    caption: str = "",
) -> Picture:
    """Histogram of deviations with a band and the share of the points within it.

    Parameters
    ----------
    deviations
        What to count.
    title, axis_label
        Texts of the picture and of its horizontal axis.
    band_mm
        Half width of the band that is drawn and whose share is stated, one of
        `armscan.inspection.histogram.WITHIN_MM`.
    caption
        Put before what the picture says of itself.
    """
    values = deviations.deviations_mm
    half_width = _half_width_mm(values, band_mm)
    counted = histogram(values, half_width)
    share = deviations.value(within_key(band_mm))
    with styled():
        figure = new_figure(6.0, 3.4)
        axes = figure.add_subplot()
        _bars(axes, counted.edges_mm, counted.counts)
        axes.axvspan(-band_mm, band_mm, color=ACCENT, alpha=0.08, linewidth=0)
        for edge in (-band_mm, band_mm):
            axes.axvline(edge, color=MUTED, linewidth=0.9, linestyle="--")
        axes.axvline(0.0, color=INK, linewidth=0.7)
        axes.set_xlim(-half_width, half_width)
        axes.set_xlabel(f"{axis_label}, from the {deviations.reference} reference")
        axes.set_ylabel("points")
        axes.set_title(f"{share:.2f} % of {len(values):,} points within {band_mm:g} mm", loc="left")
    return Picture(
        chart_markup(figure, f"Histogram: {title}"),
        title=title,
        caption=_caption(deviations, caption, counted.n_below + counted.n_above, half_width),
    )


def height_histogram(
    heights_mm: FloatArray, nominal_mm: float, fitted_mm: float, *, title: str
) -> Picture:
    """Histogram of heights over the lower face (figure 5.19) with the nominal height marked."""
    mean, std = float(heights_mm.mean()), float(heights_mm.std(ddof=1))
    half_width = _half_width_mm(heights_mm - mean, 4.0 * std)
    counted = histogram(heights_mm - mean, half_width)
    with styled():
        figure = new_figure(6.0, 3.4)
        axes = figure.add_subplot()
        _bars(axes, counted.edges_mm + mean, counted.counts)
        axes.axvline(nominal_mm, color=ALERT, linewidth=1.3, label=f"nominal {nominal_mm:g} mm")
        axes.axvline(fitted_mm, color=INK, linewidth=1.0, label=f"fitted {fitted_mm:.4f} mm")
        axes.set_xlabel("height over the lower face, mm")
        axes.set_ylabel("points")
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.set_title(f"mean {mean:.4f} mm, standard deviation {std:.4f} mm", loc="left")
        axes.legend(loc="upper right")
    beyond = counted.n_below + counted.n_above
    return Picture(
        chart_markup(figure, f"Histogram: {title}"),
        title=title,
        caption=f"All {len(heights_mm):,} points of the upper face, outliers included; standard "
        "deviation about their mean, divided by n - 1."
        + (f" {beyond:,} points lie beyond the axis." if beyond else ""),
    )


def deviation_view(
    points_mm: FloatArray, deviations_mm: FloatArray, *, title: str, frame: str, reference: str
) -> Picture:
    """Points in space, coloured by deviation: blue inside or below, red outside or above.

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
    shown = deviations_mm[::step]
    limit = max(float(np.percentile(np.abs(deviations_mm), 98)), 1e-6)
    dots = SceneDots(points_mm[::step], _diverging(shown, limit))
    every = f" One point in {step} is shown." if step > 1 else ""
    return Picture(
        _diverging_ramp(limit) + scene_markup([dots], [], [], title, is_z_up=frame != "Sensor"),
        title=f"{title} ({frame} frame)",
        caption=f"Colour is the deviation from {reference}; points beyond the ramp have its end's "
        f"colour. Drag to turn; click, then scroll to zoom.{every}",
    )


def share_text(percent: float) -> str:
    """A share with two decimals that never reads 100 if something is outside."""
    return "above 99.99 %" if 99.995 <= percent < 100.0 else f"{percent:.2f} %"


def _bars(axes: Axes, edges_mm: FloatArray, counts: NDArray[np.int64]) -> None:
    axes.stairs(counts, edges_mm, fill=True, color=ACCENT)
    axes.grid(axis="y")


def _half_width_mm(values: FloatArray, least: float) -> float:
    """Half width that shows 99.5 % of the values, and the band with some room about it."""
    reach = float(np.percentile(np.abs(values), 99.5)) if len(values) else 0.0
    return max(1.15 * reach, 1.5 * least, LEAST_HALF_WIDTH_MM)


def _caption(deviations: Deviations, before: str, beyond: int, half_width_mm: float) -> str:
    parts = [before.rstrip()] if before else []
    parts.append(f"Deviations from {deviations.reference_text}; {deviations.points_text}.")
    if beyond:
        parts.append(
            f"{beyond:,} of them lie beyond {significant(half_width_mm)} mm, outside the picture; "
            "the share counts them."
        )
    return " ".join(parts)


def _diverging(values: FloatArray, limit: float) -> NDArray[np.uint8]:
    share = np.clip(0.5 + 0.5 * values / limit, 0.0, 1.0)
    return np.asarray(RAMP(share, bytes=True), dtype=np.uint8)[:, :3]


def _diverging_ramp(limit: float) -> str:
    stops = ["#{:02x}{:02x}{:02x}".format(*RAMP(k / 10, bytes=True)[:3]) for k in range(11)]
    text = significant(limit, "mm", 2)
    return (
        f'<p class="ramp">−{text}<span style="background: linear-gradient(to right, '
        f'{", ".join(stops)})"></span>+{text}</p>'
    )
