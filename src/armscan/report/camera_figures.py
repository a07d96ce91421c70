# SPDX-License-Identifier: Apache-2.0
"""Charts of a camera calibration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.ticker import MaxNLocator

from armscan.calibration.camera.result import CameraFit, ViewFit
from armscan.geometry.arrays import FloatArray
from armscan.models.camera import PARAMETER_NAMES
from armscan.records.exposure import Exposure
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    INK,
    LINE,
    MUTED,
    Marks,
    chart_markup,
    new_figure,
    photo_markup,
    raster_markup,
    styled,
)
from armscan.report.numbers import significant
from armscan.report.page import Picture

ARROW_SHARE = 0.06
"""Length on the picture, as a share of its longer side, of a residual of three sigma."""


def residual_magnification(fit: CameraFit) -> float:
    """How much residual arrows are enlarged: a round number, the same in all pictures."""
    longest = max(fit.camera.width_px, fit.camera.height_px)
    wanted = ARROW_SHARE * longest / max(3.0 * fit.rms_px, 1e-6)
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted)


def view_picture(fit: CameraFit, view: ViewFit, exposure: Exposure) -> Picture:
    """The photograph with the target points found, and the residual arrows."""
    scale = residual_magnification(fit)
    points = view.view.points_px
    arrows = np.stack([points, points + scale * view.residuals_px], axis=1).reshape(-1, 2)
    colour = "#35e0c0" if view.is_used else "#ff8a4c"
    marks = [
        Marks(points, colour, "ring", 15.0),
        Marks(points[:1], colour, "dot", 13.0),
        Marks(arrows, "#ffb000", "line", 3.2),
    ]
    state = "" if view.is_used else "left out; "
    return Picture(
        photo_markup(exposure, marks, f"Target points found in {view.source}"),
        title=view.source,
        caption=f"{state}{len(view.view)} points, rms {significant(view.rms_px)} px, tilt "
        f"{view.tilt_deg:.0f}°, {view.distance_mm:.0f} mm away",
    )


def residual_field(fit: CameraFit) -> Picture:
    """All residual arrows over the image."""
    scale = residual_magnification(fit)
    points = np.concatenate([view.view.points_px for view in fit.used_views])
    residuals = np.concatenate([view.residuals_px for view in fit.used_views])
    with styled():
        figure = new_figure(*_size_of(fit))
        axes = figure.add_subplot()
        axes.quiver(
            *points.T, *(scale * residuals).T, angles="xy", scale_units="xy", scale=1.0,
            color=ACCENT, width=0.0022, headwidth=3.5, headlength=4.5,
        )  # fmt: skip
        _image_axes(axes, fit)
    return Picture(
        chart_markup(figure, "Residual arrows over the image"),
        title="Residuals over the image",
        caption=f"Observed minus predicted, all used views, {scale:g} times enlarged. A camera "
        "model that fits leaves arrows without any pattern; arrows that turn together show a lens "
        "that the model does not follow, or a board that is not flat.",
    )


def coverage_map(fit: CameraFit) -> Picture:
    """Where in the image target points were seen."""
    counts = fit.coverage.counts
    points = np.concatenate([view.view.points_px for view in fit.used_views])
    width, height = fit.camera.width_px, fit.camera.height_px
    with styled():
        figure = new_figure(*_size_of(fit))
        axes = figure.add_subplot()
        axes.imshow(
            np.where(counts > 0, np.log1p(counts), np.nan),
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            cmap=_ramp(),
            vmin=0.0,
            vmax=float(np.log1p(max(int(counts.max()), 1))) * 1.6,
            aspect="auto",
        )
        axes.plot(*points.T, ".", color=INK, markersize=1.6, alpha=0.7)
        _image_axes(axes, fit)
    empty = ", ".join(fit.coverage.empty)
    return Picture(
        chart_markup(figure, "Coverage of the image by target points"),
        title="Coverage",
        caption=f"Dots are target points of the used views; {100 * fit.coverage.fraction:.0f} % of "
        "the cells hold one. "
        + (f"Nothing was seen in: {empty}." if empty else "No ninth of the image is empty."),
    )


def view_bars(fit: CameraFit) -> Picture:
    """Root mean square of each view, with its hold-out value."""
    views = fit.views
    held_out = {}
    if fit.cross_validation is not None:
        held_out = dict(
            zip(fit.cross_validation.sources, fit.cross_validation.view_rms_px, strict=True)
        )
    rows = np.arange(len(views))
    with styled():
        figure = new_figure(6.0, max(2.0, 0.8 + 0.2 * len(views)))
        axes = figure.add_subplot()
        colours = [ACCENT if view.is_used else LINE for view in views]
        axes.barh(rows, [view.rms_px for view in views], color=colours, height=0.68)
        known = [k for k, view in enumerate(views) if view.source in held_out]
        if known:
            axes.plot(
                [held_out[views[k].source] for k in known], known, "|", color=ALERT,
                markersize=9, markeredgewidth=2, label="held out",
            )  # fmt: skip
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderpad=0.1)
        axes.axvline(fit.rms_px, color=MUTED, linewidth=0.8, linestyle="--")
        axes.set_yticks(rows, [_short(view.source) for view in views])
        axes.invert_yaxis()
        axes.set_xlabel("rms reprojection residual, px")
        axes.grid(axis="x")
    grey = " Grey bars are views that were left out." if len(fit.used_views) < len(views) else ""
    return Picture(
        chart_markup(figure, "Root mean square residual of each view"),
        title="Views",
        caption="Bars: residual of each view in the solution; the dashed line is all used views "
        "together. Orange: the same view predicted by a camera that was solved without it." + grey,
    )


def tilt_rose(fit: CameraFit) -> Picture:
    """How far, and which way, the board was tilted."""
    with styled():
        figure = new_figure(5.4, 4.0)
        axes: Any = figure.add_subplot(projection="polar")
        directions = np.deg2rad(fit.coverage.tilt_directions_deg)
        axes.plot(directions, fit.coverage.tilts_deg, "o", color=ACCENT, markersize=5, alpha=0.85)
        axes.set_theta_direction(-1)
        axes.set_rlim(0.0, max(45.0, float(fit.coverage.tilts_deg.max(initial=0.0)) + 5.0))
        axes.set_rticks([15, 30, 45], ["15°", "30°", "45°"], fontsize=7.5)
        axes.set_thetagrids([0, 90, 180, 270], ["right", "down", "left", "up"])
    return Picture(
        chart_markup(figure, "Tilts of the board"),
        title="Tilts of the board",
        caption="Each dot is a view: distance from the middle is the tilt, the direction is where "
        "the board's normal leans in the image. Dots all around, at 20 to 45°, tell focal "
        "length and distance apart.",
    )


def residual_histogram(fit: CameraFit) -> Picture:
    """Residuals against the Gaussian of their own sigma."""
    residuals = np.concatenate([view.residuals_px for view in fit.used_views])
    sigma = fit.sigma_point_px
    reach = 4.5 * sigma
    edges = np.linspace(-reach, reach, 46).tolist()
    x = np.linspace(-reach, reach, 200)
    n_bins = len(residuals) * (edges[1] - edges[0])
    bell = n_bins * np.exp(-0.5 * (x / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
    with styled():
        figure = new_figure(4.6, 3.4)
        axes = figure.add_subplot()
        axes.hist(residuals[:, 0], edges, color=ACCENT, alpha=0.75, label="x")
        axes.hist(residuals[:, 1], edges, color=ACCENT_LIGHT, alpha=0.75, label="y")
        axes.plot(x, bell, color=INK, linewidth=1.2, label=f"Gaussian, σ = {significant(sigma)} px")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlabel("residual, px")
        axes.set_ylabel("points")
        axes.set_ylim(top=1.3 * axes.get_ylim()[1])
        axes.legend(loc="upper right")
    beyond = int((np.abs(residuals) > reach).any(axis=1).sum())
    tail = f" Beyond the picture: {beyond}." if beyond else ""
    return Picture(
        chart_markup(figure, "Histogram of residuals"),
        title="Distribution of residuals",
        caption="Detected coordinates scatter about as the Gaussian if noise is all there is."
        + tail,
    )


def correlation_matrix(fit: CameraFit) -> Picture:
    """Correlations of the camera's free parameters."""
    index = [PARAMETER_NAMES.index(name) for name in fit.free_parameters]
    covariance = fit.covariance[np.ix_(index, index)]
    correlation = _correlation(covariance)
    names = [PARAMETER_NAMES[k].removesuffix("_px") for k in index]
    with styled():
        figure = new_figure(4.6, 4.2)
        axes = figure.add_subplot()
        axes.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
        axes.set_xticks(range(len(names)), names)
        axes.set_yticks(range(len(names)), names)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        for (i, j), value in np.ndenumerate(correlation):
            shade = "white" if abs(value) > 0.6 else INK
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=shade)
    return Picture(
        raster_markup(figure, "Correlations of the parameters"),
        title="Correlations",
        caption="Two parameters near 1 or -1 trade against each other: neither is known well "
        "alone, their combination is.",
    )


def _correlation(covariance: FloatArray) -> FloatArray:
    sigma = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(sigma, sigma))


def _size_of(fit: CameraFit) -> tuple[float, float]:
    ratio = fit.camera.height_px / fit.camera.width_px
    width = 6.0 if ratio <= 1.0 else 6.0 / ratio
    return width + 0.6, width * ratio + 0.6


def _image_axes(axes: Axes, fit: CameraFit) -> None:
    axes.set_xlim(-0.5, fit.camera.width_px - 0.5)
    axes.set_ylim(fit.camera.height_px - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    axes.spines[:].set_visible(True)


def _ramp() -> LinearSegmentedColormap:
    return LinearSegmentedColormap.from_list("accent", ["#e9f3f5", ACCENT])


def _short(source: str) -> str:
    return source if len(source) <= 26 else "…" + source[-25:]
