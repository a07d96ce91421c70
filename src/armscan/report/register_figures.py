# SPDX-License-Identifier: Apache-2.0
"""Pictures of a registration: markers in space with their residuals, and how large these are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.records.cloud import PointCloud
from armscan.report.drawing import ACCENT, ALERT, MUTED, PALETTE, chart_markup, new_figure, styled
from armscan.report.numbers import significant
from armscan.report.page import Picture
from armscan.report.scene import SceneDots, SceneLines, scene_markup, uniform_dots

MAX_CLOUD_DOTS = 12_000
CLOUD_GREY = "#c3ccd4"
RING_STEPS = 24
SHOWN_SHARE = 0.12
"""Length of the longest drawn residual as a share of the scene's extent."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerScene:
    """What to draw, all of it in the common frame.

    Parameters
    ----------
    points_mm, residual_mm
        (K, 3) markers and their residuals.
    is_used
        (K,) False where a marker moved.
    lonely_mm
        (L, 3) markers without partner.
    stations
        Labels with (3,) positions: where views were taken from, or the bases of the arm.
    clouds
        Clouds in the common frame, drawn pale.
    is_z_up
        True for Base.
    """

    points_mm: FloatArray
    residual_mm: FloatArray
    is_used: BoolArray
    lonely_mm: FloatArray
    stations: Sequence[tuple[str, FloatArray]]
    clouds: Sequence[PointCloud]
    is_z_up: bool


def marker_view(scene: MarkerScene) -> Picture:
    """Markers in space, residuals drawn much longer than they are."""
    extent = float(np.linalg.norm(np.ptp(scene.points_mm, axis=0)))
    longest = float(np.linalg.norm(scene.residual_mm, axis=1).max(initial=0.0))
    factor = _round_factor(SHOWN_SHARE * extent / longest) if longest > 0.0 else 1.0
    dots = [_pale(scene.clouds)] if scene.clouds else []
    lines = []
    for chosen, colour in ((scene.is_used, ACCENT), (~scene.is_used, ALERT)):
        if chosen.any():
            dots.append(uniform_dots(scene.points_mm[chosen], colour))
            lines.append(_rings(scene.points_mm[chosen], 0.012 * extent, colour))
            ends = scene.points_mm[chosen] + factor * scene.residual_mm[chosen]
            pairs = np.stack([scene.points_mm[chosen], ends], axis=1).reshape(-1, 3)
            lines.append(SceneLines(pairs, colour))
    if len(scene.lonely_mm):
        dots.append(uniform_dots(scene.lonely_mm, MUTED))
        lines.append(_rings(scene.lonely_mm, 0.008 * extent, MUTED))
    labels = []
    for text, place in scene.stations:
        x, y, z = (float(value) for value in place)
        dots.append(uniform_dots(place[None], PALETTE[2]))
        lines.append(_rings(place[None], 0.008 * extent, PALETTE[2]))
        labels.append((text, (x, y, z)))
    markup = scene_markup(dots, lines, labels, "Markers in space", is_z_up=scene.is_z_up)
    return Picture(
        markup,
        title="Markers in the common frame",
        caption=f"Blue: common markers, with their residuals drawn {factor:g} times as long. "
        "Orange: markers that moved. Grey: markers without partner, and the clouds. Violet: "
        "where the measurements were made from. Drag to turn; click, then scroll to zoom.",
    )


def residual_chart(length_mm: FloatArray, sigma_mm: FloatArray, is_used: BoolArray) -> Picture:
    """Lengths of the residuals in order, beside what the covariances let expect.

    Parameters
    ----------
    length_mm, sigma_mm
        (K,) length of a residual, and root of the trace of its covariance.
    is_used
        (K,) False where a marker moved.
    """
    order = np.argsort(length_mm)
    with styled():
        figure = new_figure(6.0, 3.2)
        axes = figure.add_subplot()
        place = np.arange(1, len(order) + 1)
        used = is_used[order]
        axes.plot(place[used], length_mm[order][used], "o", markersize=3.5, color=ACCENT)
        if not used.all():
            axes.plot(
                place[~used],
                length_mm[order][~used],
                "o",
                markersize=4.5,
                color=ALERT,
                label="moved",
            )
        expected = float(np.sqrt(np.mean(sigma_mm**2)))
        axes.axhline(expected, color=MUTED, linewidth=0.9, linestyle="--", label="expected rms")
        if float(length_mm.max(initial=0.0)) > 20.0 * expected:
            axes.set_yscale("log")
        axes.set_xlabel("markers, the best fitting first")
        axes.set_ylabel("residual, mm")
        axes.grid(axis="y")
        axes.legend()
    return Picture(
        chart_markup(figure, "Residuals of the markers in order of size"),
        title="Residuals",
        caption=f"Dashed: root mean square that the markers' covariances let expect, "
        f"{significant(expected, 'mm')}.",
    )


def drift_chart(names: Sequence[str], sigma_mm: FloatArray, rms_mm: FloatArray) -> Picture:
    """How uncertain each view's place is, in the order in which views were placed."""
    with styled():
        figure = new_figure(6.0, 3.2)
        axes = figure.add_subplot()
        place = np.arange(len(names))
        axes.bar(place, sigma_mm, width=0.6, color=ACCENT, label="uncertainty of its place")
        axes.plot(place, rms_mm, "o", color=ALERT, markersize=4, label="rms of its residuals")
        axes.set_xticks(place, [_short(name) for name in names], rotation=60, ha="right")
        axes.set_ylabel("mm")
        axes.grid(axis="y")
        axes.legend()
    return Picture(
        chart_markup(figure, "Uncertainty of each view's place"),
        title="How far the chain drifts",
        caption="Standard deviation (three axes together) with which a view's markers lie in the "
        "frame of the first view. It grows along a chain; the residuals do not show it.",
    )


def _short(name: str) -> str:
    return name if len(name) <= 14 else f"…{name[-13:]}"


def _round_factor(value: float) -> float:
    """The power of ten times 1, 2 or 5 next below a value."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-12)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12))


def _pale(clouds: Sequence[PointCloud]) -> SceneDots:
    n = sum(len(cloud) for cloud in clouds)
    step = max(1, -(-n // MAX_CLOUD_DOTS))
    return uniform_dots(np.concatenate([cloud.points_mm[::step] for cloud in clouds]), CLOUD_GREY)


def _rings(centres_mm: FloatArray, radius_mm: float, colour: str) -> SceneLines:
    """Three circles about each centre: a mark that is seen from every side."""
    angle = np.linspace(0.0, 2.0 * np.pi, RING_STEPS + 1)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    rings = np.stack([circle, circle[:, [0, 2, 1]], circle[:, [2, 0, 1]]])
    pieces = np.stack([rings[:, :-1], rings[:, 1:]], axis=2).reshape(-1, 3)
    return SceneLines((centres_mm[:, None] + pieces[None]).reshape(-1, 3), colour)
