# SPDX-License-Identifier: Apache-2.0
"""Points and lines to turn with the mouse inside a page."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, to_rgb
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray

RAMP = "viridis"
RAMP_STOPS = 11


@dataclass(frozen=True, slots=True, eq=False)
class SceneDots:
    """Dots: (N, 3) positions in mm and (N, 3) colours, red green blue, 0 to 255."""

    points_mm: FloatArray
    colours: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class SceneLines:
    """Lines of one CSS colour: (2 L, 3) positions in mm, two rows a line."""

    points_mm: FloatArray
    colour: str


def uniform_dots(points_mm: FloatArray, colour: str) -> SceneDots:
    """Dots of one CSS colour."""
    return SceneDots(points_mm, np.tile(_bytes(colour), (len(points_mm), 1)))


def closed_outline(corners_mm: FloatArray) -> FloatArray:
    """(2 N, 3) ends of the sides of a closed outline of N corners."""
    sides = np.stack([corners_mm, np.roll(corners_mm, -1, axis=0)], axis=1)
    return np.asarray(sides.reshape(-1, 3))


def pyramid(rim_mm: FloatArray) -> FloatArray:
    """(4 N, 3) ends of the edges of a pyramid from the origin to a rim of N corners."""
    spokes = np.stack([np.zeros_like(rim_mm), rim_mm], axis=1).reshape(-1, 3)
    return np.concatenate([closed_outline(rim_mm), spokes])


def ramp_colours(values: FloatArray, low: float, high: float) -> NDArray[np.uint8]:
    """(N, 3) colours of a ramp that runs from ``low`` to ``high``."""
    share = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.asarray(colormaps[RAMP](share, bytes=True), dtype=np.uint8)[:, :3]


def ramp_markup(low_text: str, high_text: str, ramp: Colormap | None = None) -> str:
    """A ramp of colours, that of `ramp_colours` if none is given, with its two ends named."""
    colour = ramp or colormaps[RAMP]
    places = np.linspace(0.0, 1.0, RAMP_STOPS)
    stops = ["#{:02x}{:02x}{:02x}".format(*colour(place, bytes=True)[:3]) for place in places]
    return (
        f'<p class="ramp">{escape(low_text)}<span style="background: '
        f'linear-gradient(to right, {", ".join(stops)})"></span>{escape(high_text)}</p>'
    )


def scene_markup(
    dots: list[SceneDots],
    lines: list[SceneLines],
    labels: list[tuple[str, tuple[float, float, float]]],
    alt: str,
    *,
    is_z_up: bool = False,
) -> str:
    """``<canvas>`` with its data; positions are in the Sensor frame, or in one with Z up.

    Parameters
    ----------
    dots, lines
        What to draw; lines lie below dots.
    labels
        Texts with their positions in mm.
    alt
        What it shows, in words.
    is_z_up
        True for frames like Base, whose Z points up; in Sensor Y points down and Z away.
    """
    points = np.concatenate([item.points_mm for item in dots])
    segments = np.concatenate([item.points_mm for item in lines] or [np.zeros((0, 3))])
    everything = np.concatenate([points, segments])
    low, high = everything.min(axis=0), everything.max(axis=0)
    colours = np.concatenate([item.colours for item in dots])
    line_colours = np.concatenate(
        [np.tile(_bytes(item.colour), (len(item.points_mm) // 2, 1)) for item in lines]
        or [np.zeros((0, 3), np.uint8)]
    )
    texts = json.dumps([[text, *position] for text, position in labels])
    return (
        f'<canvas class="scene" tabindex="0" role="img" aria-label="{escape(alt)}" '
        f'data-points="{_packed(points)}" data-colours="{_encoded(colours)}" '
        f'data-lines="{_packed(segments)}" data-line-colours="{_encoded(line_colours)}" '
        f'data-centre="{_packed((low + high) / 2)}" '
        f'data-labels="{escape(texts)}" data-yaw="-0.65" data-pitch="0.42" '
        f'data-up="{"z" if is_z_up else "-y"}"></canvas>'
    )


def _packed(values: FloatArray) -> str:
    return _encoded(values.astype("<f4"))


def _encoded(values: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def _bytes(colour: str) -> NDArray[np.uint8]:
    return np.round(255.0 * np.array(to_rgb(colour))).astype(np.uint8)
