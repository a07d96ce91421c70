# SPDX-License-Identifier: Apache-2.0
"""Charts and marked photographs as markup inside a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure

ACCENT = "#0b6e87"
ACCENT_LIGHT = "#9fcbd6"
INK = "#1d2733"
MUTED = "#5d6b7a"
LINE = "#d5dce2"
ALERT = "#c8541b"
PALETTE = ("#0b6e87", "#c8541b", "#7a5195", "#5b8c2a", "#b07d12", "#3f6fb5", "#a83a5b", "#4d4d4d")
"""Colours that stay apart, also for colour-blind readers; sheets take them in order."""

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#edf0f3",
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "text.color": INK,
    "legend.frameon": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "armscan",
    "savefig.facecolor": "white",
}
JPEG_QUALITY = 82


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of one colour on a photograph, in pixels of its exposure.

    Parameters
    ----------
    points_px
        (N, 2) positions; of lines, two rows a line.
    colour
        CSS colour.
    kind
        ``dot``, ``ring``, or ``line`` between each two rows.
    size
        Diameter or line width as a share of the picture's longer side, in thousandths.
    """

    points_px: FloatArray
    colour: str
    kind: str = "dot"
    size: float = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Words on a photograph.

    Parameters
    ----------
    points_px
        (N, 2) middle of each word's lower edge, in pixels of its exposure.
    texts
        N words.
    colour
        CSS colour.
    size
        Height of a letter as a share of the picture's longer side, in thousandths.
    """

    points_px: FloatArray
    texts: tuple[str, ...]
    colour: str
    size: float = 14.0


def new_figure(width: float = 6.0, height: float = 4.0) -> Figure:
    """Return an empty figure in the house's style; sizes in inches."""
    with mpl.rc_context(STYLE):
        return Figure(figsize=(width, height), layout="constrained")


def styled() -> Any:
    """Return the context in which axes are made and drawn in the house's style."""
    return mpl.rc_context(STYLE)


def chart_markup(figure: Figure, alt: str) -> str:
    """``<img>`` of a chart as SVG."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return _img(_uri("image/svg+xml", buffer.getvalue()), alt)


def raster_markup(figure: Figure, alt: str, dpi: int = 160) -> str:
    """``<img>`` of a chart as PNG, for charts of many points."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return _img(_uri("image/png", buffer.getvalue()), alt)


def photo_markup(
    exposure: Exposure,
    marks: Iterable[Marks],
    alt: str,
    *,
    labels: Iterable[Labels] = (),
    longest_px: int = 900,
    is_grey: bool = False,
) -> str:
    """``<svg>`` of a photograph, reduced to ``longest_px``, with marks in full resolution.

    Dark photographs are brightened for the eye; ``is_grey`` takes the colours out, so that those
    of the marks stand out.
    """
    height, width = exposure.image.shape[:2]
    unit = max(width, height) / 1000.0
    levels = display_levels(exposure, longest_px=longest_px, is_grey=is_grey)
    photo = _uri("image/jpeg", _jpeg(levels))
    parts = [
        f'<svg viewBox="-0.5 -0.5 {width} {height}" role="img" aria-label="{escape(alt)}">',
        f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="{photo}"/>',
    ]
    parts += [_mark_path(layer, exposure, unit) for layer in marks if len(layer.points_px)]
    parts += [_label_texts(layer, exposure, unit) for layer in labels]
    return "".join([*parts, "</svg>"])


def display_levels(
    exposure: Exposure, *, longest_px: int | None = None, is_grey: bool = False
) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """8-bit picture for the eye: dark photographs are stretched, never the other way.

    Parameters
    ----------
    exposure
        The photograph.
    longest_px
        Reduce it so that its longer side has this many pixels; None keeps its size.
    is_grey
        Take the colours out.
    """
    image: NDArray[Any] = exposure.image
    scale = 1.0 if longest_px is None else min(1.0, longest_px / max(image.shape[:2]))
    if scale < 1.0:
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    levels = image.astype(np.float64) / exposure.full_scale
    if is_grey and levels.ndim == 3:
        levels = levels.mean(axis=2)
    bright = float(np.percentile(levels, 99.5))
    scaled = levels / max(bright, 0.02) if bright < 0.7 else levels
    gamma = 0.7 if float(np.median(scaled)) < 0.2 else 1.0
    return np.asarray(255.0 * np.clip(scaled, 0.0, 1.0) ** gamma, dtype=np.uint8)


def _mark_path(layer: Marks, exposure: Exposure, unit: float) -> str:
    points = np.round(exposure.window.to_image(np.asarray(layer.points_px)), 2)
    radius = layer.size * unit / 2.0
    if layer.kind == "line":
        pairs = points.reshape(-1, 4)
        path = "".join(f"M{a:g} {b:g}L{c:g} {d:g}" for a, b, c, d in pairs)
        width = layer.size * unit
    elif layer.kind == "ring":
        path = "".join(
            f"M{x - radius:g} {y:g}a{radius:g} {radius:g} 0 1 0 {2 * radius:g} 0"
            f"a{radius:g} {radius:g} 0 1 0 {-2 * radius:g} 0"
            for x, y in points
        )
        width = 2.4 * unit
    else:
        path = "".join(f"M{x:g} {y:g}h0" for x, y in points)
        width = layer.size * unit
    return (
        f'<path d="{path}" fill="none" stroke="{layer.colour}" stroke-width="{width:.3g}" '
        'stroke-linecap="round"/>'
    )


def _label_texts(layer: Labels, exposure: Exposure, unit: float) -> str:
    """Words with a dark rim, so that they are read on light and dark ground."""
    points = np.round(exposure.window.to_image(np.asarray(layer.points_px)), 1)
    size = layer.size * unit
    words = "".join(
        f'<text x="{x:g}" y="{y:g}">{escape(text)}</text>'
        for (x, y), text in zip(points, layer.texts, strict=True)
    )
    return (
        f'<g fill="{layer.colour}" stroke="{INK}" stroke-width="{0.2 * size:.3g}" '
        f'paint-order="stroke" font-size="{size:.3g}" font-family="sans-serif" '
        f'text-anchor="middle">{words}</g>'
    )


def _jpeg(picture: np.ndarray[Any, np.dtype[np.uint8]]) -> bytes:
    ordered = picture if picture.ndim == 2 else np.ascontiguousarray(picture[:, :, ::-1])
    _, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _img(uri: str, alt: str) -> str:
    return f'<img src="{uri}" alt="{escape(alt)}">'
