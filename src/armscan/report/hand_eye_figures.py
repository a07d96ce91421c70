# SPDX-License-Identifier: Apache-2.0
"""Charts of a hand-eye calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from armscan.calibration.hand_eye.result import HandEyeFit, PostureResult
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    LINE,
    MUTED,
    chart_markup,
    new_figure,
    raster_markup,
    styled,
)
from armscan.report.page import Picture

PAGE_WIDTH = 10.4
MAX_DOTS_OF_POSTURE = 400
DIVERGING = "RdBu_r"
SHORT_NAMES = ("rot X", "rot Y", "rot Z", "X", "Y", "Z")


def residuals_by_posture(fit: HandEyeFit) -> Picture:
    """All residuals of each posture, their mean, and the spread that the noise model expects."""
    generator = np.random.default_rng(0)
    with styled():
        figure = new_figure(PAGE_WIDTH, 3.6)
        axes = figure.add_subplot()
        axes.axhline(0.0, color=LINE, linewidth=0.9)
        for k, posture in enumerate(fit.postures):
            values = 1000.0 * _residuals_of(fit, posture)
            shown = values[:: max(1, len(values) // MAX_DOTS_OF_POSTURE)]
            place = k + generator.uniform(-0.3, 0.3, len(shown))
            axes.plot(place, shown, ".", color=ACCENT_LIGHT, markersize=1.8, zorder=1)
            sigma = 1000.0 * _sigma_of_mean(posture)
            axes.bar(k, 4 * sigma, 0.5, -2 * sigma, color="none", edgecolor=MUTED, zorder=2)
            axes.plot([k], [1000.0 * posture.mean_mm], "o", color=ALERT, markersize=5, zorder=3)
        axes.set_xticks(range(len(fit.postures)), [p.posture for p in fit.postures])
        axes.tick_params(axis="x", labelrotation=60 if len(fit.postures) > 8 else 0, labelsize=7.5)
        axes.set_xlabel("posture")
        axes.set_ylabel("distance from the reference, µm")
        widest = max(2.0 * _sigma_of_mean(posture) for posture in fit.postures)
        largest = float(np.percentile(np.abs(_all_residuals(fit)), 99.8))
        reach = 1.1 * max(1000.0 * widest, 1000.0 * largest, 1e-3)
        axes.set_ylim(-reach, reach)
    return Picture(
        raster_markup(figure, "Residuals by posture"),
        title="Residuals by posture",
        caption="Small dots are points, the large dot their mean; the box is two sigma of that "
        "mean under the noise model (pose of the arm, flatness, stripe, sensor), less what the fit "
        "follows. Means within their boxes "
        "are what an arm does; one far outside points to a posture that does not belong.",
    )


def residual_map(fit: HandEyeFit, plate: Plane) -> Picture:
    """Residuals over the plate: its flatness shows as a pattern that postures share."""
    points = np.concatenate([stripe.points_base_mm for stripe in fit.stripes])
    local = (points - plate.point_mm) @ plate.axes[:2].T
    values = 1000.0 * _all_residuals(fit)
    reach = max(float(np.percentile(np.abs(values), 98)), 1e-3)
    step = max(1, len(values) // 20_000)
    with styled():
        figure = new_figure(6.0, 4.2)
        axes = figure.add_subplot()
        dots = axes.scatter(
            local[::step, 0], local[::step, 1], c=values[::step], s=3.0, cmap=DIVERGING,
            vmin=-reach, vmax=reach, linewidths=0.0,
        )  # fmt: skip
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("along the plate's first axis, mm")
        axes.set_ylabel("second axis, mm")
        figure.colorbar(dots, ax=axes, label="distance, µm", shrink=0.85)
    return Picture(
        raster_markup(figure, "Residuals over the plate"),
        title="Residuals over the plate",
        caption="Colours that change from stripe to stripe are the arm; a pattern that crossing "
        "stripes share is the plate's flatness.",
    )


def left_out_bars(fit: HandEyeFit, rotation_sigma_deg: float, size_sigma_mm: float) -> Picture:
    """Change of the hand-eye when one posture takes no part."""
    names = [posture.posture for posture in fit.postures]
    series = (
        ("change of the rotation, °", rotation_sigma_deg, "left_out_rotation_deg"),
        ("change of the translation, mm", size_sigma_mm, "left_out_translation_mm"),
        ("residual left out, in sigmas", 1.0, "left_out_normalised"),
    )
    with styled():
        figure = new_figure(PAGE_WIDTH, 2.9)
        grid: Any = figure.subplots(1, 3)
        for axes, (label, usual, name) in zip(grid, series, strict=True):
            values = [getattr(posture, name) for posture in fit.postures]
            axes.bar(names, values, 0.6, color=ACCENT)
            axes.axhline(usual, color=ALERT, linewidth=1.0, linestyle="--")
            axes.set_title(label, loc="left", fontsize=8.5)
            axes.tick_params(axis="x", labelrotation=60 if len(names) > 8 else 0, labelsize=7.5)
    return Picture(
        chart_markup(figure, "Leave-one-posture-out"),
        title="What each posture holds",
        caption="Each bar is the solution without that posture. The dashed lines are the stated "
        "sigma of a rotation and of a component of the translation, and 1 for the size of the "
        "left-out residuals over their prediction.",
    )


def correlation_picture(covariance: FloatArray) -> Picture:
    """Correlations of the six parameters."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    with styled():
        figure = new_figure(4.4, 3.8)
        axes = figure.add_subplot()
        picture = axes.imshow(correlation, cmap=DIVERGING, vmin=-1.0, vmax=1.0)
        for (row, column), value in np.ndenumerate(correlation):
            colour = "white" if abs(value) > 0.6 else MUTED
            axes.text(
                column, row, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=colour
            )
        axes.set_xticks(range(6), SHORT_NAMES)
        axes.set_yticks(range(6), SHORT_NAMES)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        figure.colorbar(picture, ax=axes, shrink=0.8)
    return Picture(
        chart_markup(figure, "Correlations of the hand-eye's parameters"),
        title="Correlations",
        caption="Increments of rotation about, and of translation along, the axes of Tool. Near "
        "1 or -1, two of them can hardly be told apart with these postures.",
    )


def residual_histogram(fit: HandEyeFit) -> Picture:
    """All residuals, outliers in the outer bins."""
    values = 1000.0 * _all_residuals(fit)
    reach = max(1.3 * float(np.percentile(np.abs(values), 99.0)), 1e-3)
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        axes.hist(
            np.clip(values, -reach, reach), np.linspace(-reach, reach, 61).tolist(), color=ACCENT
        )
        axes.set_xlabel("distance from the reference, µm")
        axes.set_ylabel("points")
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return Picture(
        chart_markup(figure, "Histogram of the residuals"),
        title="Distribution of residuals",
        caption="Every point of every stripe; those beyond the ends are counted in the last bins.",
    )


def _residuals_of(fit: HandEyeFit, posture: PostureResult) -> FloatArray:
    own = [item.residual_mm for item in fit.stripes if item.posture == posture.posture]
    return np.concatenate(own) if own else np.zeros(0)


def _all_residuals(fit: HandEyeFit) -> FloatArray:
    return np.concatenate([stripe.residual_mm for stripe in fit.stripes])


def _sigma_of_mean(posture: PostureResult) -> float:
    """Standard deviation that the noise model gives the posture's mean; 0 where not told."""
    if posture.normalised_mean == 0.0 or not np.isfinite(posture.normalised_mean):
        return 0.0
    return abs(posture.mean_mm / posture.normalised_mean)
