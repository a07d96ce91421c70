# SPDX-License-Identifier: Apache-2.0
"""What figures are drawn with: sizes, colours, axes, and the scene in space."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Pose, Sensor
from armscan.records.exposure import Exposure

ACCENT = "#0b6e87"
ACCENT_LIGHT = "#9fcbd6"
INK = "#1d2733"
MUTED = "#5d6b7a"
LINE = "#d5dce2"
ALERT = "#c8541b"
PALETTE = ("#0b6e87", "#c8541b", "#7a5195", "#5b8c2a", "#b07d12", "#3f6fb5", "#a83a5b", "#4d4d4d")
"""Colours that stay apart, also for colour-blind readers; sheets take them in order."""

HALF_ANGLE = 0.28
"""Of a drawn sensor: half its width over its depth."""
AXIS_COLOURS = (PALETTE[1], PALETTE[3], PALETTE[5])

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
    "figure.facecolor": "white",
}
JPEG_QUALITY = 82


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of one colour on a photograph, in pixels of its exposure.

    Parameters
    ----------
    points_px
        (N, 2) positions; of lines, two rows a line.
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
    """Words on a photograph, (N, 2) the middle of each one's lower edge, in pixels of its exposure.

    ``size`` is a letter's height as a share of the picture's longer side, in thousandths.
    """

    points_px: FloatArray
    texts: tuple[str, ...]
    colour: str
    size: float = 14.0


def new_figure(
    width: float = 6.0,
    height: float = 4.0,
    layout: Literal["constrained"] | None = "constrained",
) -> Figure:
    """Return an empty figure in the house's style; sizes in inches.

    To lay out many panels takes as long as all else: None where it is known what lies where.
    """
    with mpl.rc_context(STYLE):
        return Figure(figsize=(width, height), layout=layout)


def styled() -> Any:
    """Return the context in which axes are made and drawn in the house's style."""
    return mpl.rc_context(STYLE)


def chart_markup(figure: Figure, alt: str) -> str:
    """``<img>`` of a chart as SVG."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        # `Figure.savefig` draws twice: once for the layout, which drawing makes anyway
        canvas = FigureCanvasSVG(figure)
        canvas.print_svg(buffer, metadata={"Date": None})  # type: ignore[no-untyped-call]
    return _img(_uri("image/svg+xml", buffer.getvalue()), alt)


def raster_markup(figure: Figure, alt: str, dpi: int = 160) -> str:
    """``<img>`` of a chart as PNG, for charts of many points."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.dpi = dpi
        canvas = FigureCanvasAgg(figure)
        canvas.print_png(buffer, metadata={"Software": None})  # type: ignore[no-untyped-call]
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

    Its longer side has at most ``longest_px`` pixels; None keeps its size.
    """
    image: NDArray[Any] = exposure.image
    scale = 1.0 if longest_px is None else min(1.0, longest_px / max(image.shape[:2]))
    if scale < 1.0:
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        while min(image.shape[1] // size[0], image.shape[0] // size[1]) > 1:
            # by half as often as that goes, which is a twentieth of the work
            half = image.shape[1] // 2, image.shape[0] // 2
            image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA))
        # beyond two thirds, between neighbours is as even as over areas
        way = cv2.INTER_LINEAR if image.shape[1] < 1.5 * size[0] else cv2.INTER_AREA
        image = np.asarray(cv2.resize(image, size, interpolation=way))
    if image.ndim == 2 and image.dtype.kind == "u":
        # few distinct levels: each is stretched once
        counts = np.bincount(image.ravel())
        table = np.arange(len(counts)) / exposure.full_scale
        bright, middle = (_quantile(table, counts, share) for share in (0.995, 0.5))
        return np.asarray(_stretched(table, bright, middle)[image])
    levels = image.astype(np.float64) / exposure.full_scale
    if is_grey and levels.ndim == 3:
        levels = levels.mean(axis=2)
    return _stretched(levels, float(np.percentile(levels, 99.5)), float(np.median(levels)))


def _quantile(values: FloatArray, counts: IntArray, share: float) -> float:
    """Of rising values that occur so often, between the two nearest (`numpy.quantile`)."""
    ends = np.cumsum(counts)
    place = share * (ends[-1] - 1)
    low, high = values[np.searchsorted(ends, [np.floor(place), np.ceil(place)], side="right")]
    return float(low + (place - np.floor(place)) * (high - low))


def _stretched(
    levels: FloatArray, bright: float, middle: float
) -> np.ndarray[Any, np.dtype[np.uint8]]:
    # both change steadily: photographs of one light look alike, and white paper is not burnt out
    scale = min(1.0, max(bright, 0.02) / 0.9)
    gamma = float(np.interp(middle / scale, [0.1, 0.3], [0.7, 1.0]))
    return np.asarray(255.0 * np.clip(levels / scale, 0.0, 1.0) ** gamma, dtype=np.uint8)


def _mark_path(layer: Marks, exposure: Exposure, unit: float) -> str:
    points = np.round(exposure.window.to_image(np.asarray(layer.points_px)), 2)
    radius = layer.size * unit / 2.0
    if layer.kind == "line":
        path = _filled("M%g %gL%g %g", points)
        width = layer.size * unit
    elif layer.kind == "ring":
        path = "".join(
            f"M{x - radius:g} {y:g}a{radius:g} {radius:g} 0 1 0 {2 * radius:g} 0"
            f"a{radius:g} {radius:g} 0 1 0 {-2 * radius:g} 0"
            for x, y in points
        )
        width = 2.4 * unit
    else:
        path = _filled("M%g %gh0", points)
        width = layer.size * unit
    return (
        f'<path d="{path}" fill="none" stroke="{layer.colour}" stroke-width="{width:.3g}" '
        'stroke-linecap="round"/>'
    )


def _filled(form: str, values: FloatArray) -> str:
    """A form, over and over, with as many numbers as there are."""
    return form * (values.size // form.count("%")) % tuple(values.ravel().tolist())


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


RAMP = "viridis"
RAMP_STOPS = 11
STILL_PX, STILL_DPI = (1100, 560), 130.0
"""Of the picture of a scene, for paper and where scripts do not run; in the canvas's shape."""
STILL_DOT = 1.6
"""Area of a dot in square points."""
STILL_LETTER = 10.0
"""Width of a letter, px."""
TURN_HINT = "Drag to turn; click, then scroll to zoom"
VALUE_HINT = "; a click on a point tells its values."
YAW, PITCH = -0.65, 0.42
"""From where a scene is seen before a person turns it, in rad."""


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


@dataclass(frozen=True, slots=True, eq=False)
class SceneValues:
    """What a click on a dot tells: (N,) numbers, NaN for not known, and (N,) index and list of
    names.
    """

    numbers: Mapping[str, FloatArray]
    names: Mapping[str, tuple[IntArray, Sequence[str]]]


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


def held_sensors(
    sensors: Mapping[str, tuple[Pose[Any, Sensor], float]],
) -> tuple[list[SceneLines], list[tuple[str, tuple[float, float, float]]]]:
    """Pyramids of sensors with their axes, and where each name stands: pose and depth, mm."""
    edges: list[FloatArray] = []
    axes: list[FloatArray] = []
    labels: list[tuple[str, tuple[float, float, float]]] = []
    for name, (pose, depth) in sensors.items():
        half = HALF_ANGLE * depth
        corners = ((-half, -half), (half, -half), (half, half), (-half, half))
        rim = np.array([(x, y, depth) for x, y in corners])
        triad = np.stack([np.zeros((3, 3)), 0.6 * depth * np.eye(3)], axis=1)
        edges.append(pose.apply(pyramid(rim)))
        axes.append(pose.apply(triad))
        x, y, z = pose.translation_mm.tolist()
        labels.append((name, (x, y, z)))
    lines = [SceneLines(np.concatenate(edges), LINE)] if edges else []
    for k, colour in enumerate(AXIS_COLOURS if axes else ()):
        lines.append(SceneLines(np.concatenate([item[k] for item in axes]), colour))
    return lines, labels


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
    values: SceneValues | None = None,
) -> str:
    """``<canvas>`` with its data; positions are in the Sensor frame, or in one with Z up.

    ``labels``: texts with their positions in mm. ``is_z_up``: true for frames like Base, whose Z
    points up; in Sensor Y points down and Z away. ``values``: what a click on one of all dots
    tells; None for nothing.
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
        f'data-labels="{escape(texts)}" data-yaw="{YAW}" data-pitch="{PITCH}" '
        f'data-up="{"z" if is_z_up else "-y"}"{_values_markup(values)}></canvas>'
        f'<p class="hint">{TURN_HINT}{"." if values is None else VALUE_HINT}</p>'
        f"<noscript>{_still(dots, lines, labels, alt, is_z_up=is_z_up)}</noscript>"
    )


def _turned(points_mm: FloatArray, *, is_z_up: bool) -> FloatArray:
    """(N, 3) right, down and away as a scene is first seen; the same turn as in ``scene.js``."""
    x, y, z = points_mm.T
    if is_z_up:
        y, z = -z, y
    cos_yaw, sin_yaw = math.cos(YAW), math.sin(YAW)
    ahead = cos_yaw * z - sin_yaw * x
    down = math.cos(PITCH) * y - math.sin(PITCH) * ahead
    away = math.cos(PITCH) * ahead + math.sin(PITCH) * y
    return np.stack([cos_yaw * x + sin_yaw * z, down, away], axis=1)


def _still(
    dots: Sequence[SceneDots],
    lines: Sequence[SceneLines],
    labels: Sequence[tuple[str, tuple[float, float, float]]],
    alt: str,
    *,
    is_z_up: bool,
) -> str:
    """``<img>`` of a scene as it is first seen, with a bar of its scale."""
    points = np.concatenate([item.points_mm for item in dots])
    everything = np.concatenate([points, *(item.points_mm for item in lines)])
    centre = (everything.min(axis=0) + everything.max(axis=0)) / 2.0
    wide, high = STILL_PX
    reach = np.abs(_turned(everything - centre, is_z_up=is_z_up)).max(axis=0)
    scale = 0.44 * min(wide / max(reach[0], 1e-6), high / max(reach[1], 1e-6))

    def place(places_mm: FloatArray) -> FloatArray:
        seen = _turned(places_mm - centre, is_z_up=is_z_up)
        return np.asarray(seen * scale + [wide / 2.0, high / 2.0, 0.0])

    with styled():
        figure = Figure(figsize=(wide / STILL_DPI, high / STILL_DPI))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set_xlim(0.0, wide)
        axes.set_ylim(high, 0.0)
        for item in lines:
            pairs = place(item.points_mm)[:, :2].reshape(-1, 2, 2)
            axes.add_collection(LineCollection(list(pairs), colors=item.colour, linewidths=0.7))
        seen = place(points)
        order = np.argsort(-seen[:, 2], kind="stable")
        colours = np.concatenate([item.colours for item in dots])[order] / 255.0
        right, down, _ = seen[order].T
        axes.scatter(right, down, c=colours, s=STILL_DOT, marker="s", linewidths=0)
        drawn: list[tuple[float, float, float]] = []
        for text, position in labels:
            x, y, _ = place(np.array([position]))[0].tolist()
            if not _is_covered(x, y, STILL_LETTER * len(text), drawn):
                drawn.append((x, y, STILL_LETTER * len(text)))
                axes.text(x, y, text, color=MUTED)
        bar_mm = round_below(0.15 * wide / scale)
        axes.plot([wide - 18.0 - scale * bar_mm, wide - 18.0], [high - 16.0] * 2, color=MUTED)
        axes.text(wide - 18.0, high - 24.0, f"{bar_mm:g} mm", ha="right", color=MUTED)
        _draw_triad(axes, is_z_up=is_z_up)
    return raster_markup(figure, alt, dpi=round(STILL_DPI))


def _is_covered(
    x: float, y: float, width: float, drawn: Sequence[tuple[float, float, float]]
) -> bool:
    """Whether a label would lie on one that is drawn: place and width of each, px."""
    return any(
        x < left + size and left < x + width and abs(y - top) < 2.0 * STILL_LETTER
        for left, top, size in drawn
    )


def _draw_triad(axes: Axes, *, is_z_up: bool) -> None:
    """The frame's axes in the lower left corner."""
    corner = np.array([52.0, STILL_PX[1] - 52.0])
    for name, tip in zip("XYZ", _turned(np.eye(3), is_z_up=is_z_up)[:, :2], strict=True):
        axes.plot(*np.stack([corner, corner + 34.0 * tip]).T, color=MUTED, linewidth=1.0)
        x, y = (corner + 46.0 * tip).tolist()
        axes.text(x, y, name, ha="center", va="center", color=MUTED)


def round_below(value: float) -> float:
    """The power of ten times 1, 2 or 5 next below a value."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-12)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12))


def _values_markup(values: SceneValues | None) -> str:
    """Attributes of a canvas with a row of float32 a dot: numbers, then indices of names."""
    if values is None:
        return ""
    columns = [*values.numbers.values(), *(index for index, _ in values.names.values())]
    told: list[list[object]] = [[name] for name in values.numbers]
    told += [[name, list(names)] for name, (_, names) in values.names.items()]
    table = np.stack([np.asarray(column, dtype=np.float64) for column in columns], axis=1)
    return f' data-values="{_packed(table)}" data-told="{escape(json.dumps(told))}"'


def _packed(values: FloatArray) -> str:
    return _encoded(values.astype("<f4"))


def _encoded(values: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def _bytes(colour: str) -> NDArray[np.uint8]:
    return np.round(255.0 * np.array(to_rgb(colour))).astype(np.uint8)
