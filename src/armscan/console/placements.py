# SPDX-License-Identifier: Apache-2.0
"""What is to be taken, one after the other: targets before the camera, the head over the plate,
touches; as lists, and each as a drawing.

The lists follow what the how-to pages ask for: targets in all corners, at tilts of 30 to 45 degrees
both ways and turned; heads tilted both ways, near and far, turned about their axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotations import rotation_from_vector
from armscan.report.drawing import ACCENT, ALERT, INK, LINE, MUTED

WIDTH, HEIGHT, SHOWN_PX = 320.0, 214.0, 250
"""Of a drawing, CSS pixels: as the image of a camera of 3 : 2."""
BOARD = (1.0, 0.82)
"""Half-width of the target as a part of its distance, times 4; and its height over its width."""
FACE_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Placement:
    """One thing to hold and take.

    Parameters
    ----------
    kind
        ``target`` before the camera, the same with ``laser``, the head over the ``plate``, or a
        ``touch`` of it.
    words
        What to do.
    tilt_x_deg, tilt_y_deg, roll_deg
        Of the target or the head, from facing each other.
    across, down
        Middle of the target in the image, or place on the plate, as parts of its size.
    distance
        In working distances.
    """

    kind: Literal["target", "laser", "plate", "touch"]
    words: str
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    roll_deg: float = 0.0
    across: float = 0.5
    down: float = 0.5
    distance: float = 1.0


def _words(tilt_x: float, tilt_y: float, roll: float) -> list[str]:
    """Tilts and turns in words; small ones go without saying."""
    found = []
    if abs(tilt_x) >= 8.0:
        found.append(f"upper edge {'away from the camera' if tilt_x > 0 else 'towards the camera'}")
    if abs(tilt_y) >= 8.0:
        found.append(f"{'left' if tilt_y > 0 else 'right'} edge away")
    size = max(abs(tilt_x), abs(tilt_y))
    if found:
        found[-1] += f" by {5.0 * round(size / 5.0):.0f}°"
    if abs(roll) >= 10.0:
        turn = 5.0 * round(abs(roll) / 5.0)
        found.append(f"turned {turn:.0f}° {'clockwise' if roll > 0 else 'anticlockwise'}")
    return found


def _targets(
    kind: Literal["target", "laser"], rows: Sequence[Sequence[float]]
) -> tuple[Placement, ...]:
    found = []
    for tilt_x, tilt_y, roll, across, down, distance in rows:
        places = [
            ("left" if across < 0.42 else "right" if across > 0.58 else ""),
            ("high" if down < 0.42 else "low" if down > 0.58 else ""),
        ]
        place = " ".join(word for word in reversed(places) if word) or "in the middle"
        far = "near" if distance < 0.93 else "far" if distance > 1.07 else ""
        words = [
            place,
            *([far] if far else []),
            *(_words(tilt_x, tilt_y, roll) or ["facing the camera"]),
        ]
        text = ", ".join(words)
        found.append(
            Placement(kind, text.capitalize(), tilt_x, tilt_y, roll, across, down, distance)
        )
    return tuple(found)


CAMERA = _targets(
    "target",
    (
        (0.0, 0.0, 0.0, 0.5, 0.5, 0.85),
        (0.0, 0.0, 0.0, 0.3, 0.33, 1.0),
        (0.0, 0.0, 0.0, 0.7, 0.33, 1.0),
        (0.0, 0.0, 0.0, 0.3, 0.67, 1.0),
        (0.0, 0.0, 0.0, 0.7, 0.67, 1.0),
        (30.0, 0.0, 0.0, 0.5, 0.5, 1.0),
        (-30.0, 0.0, 0.0, 0.5, 0.5, 1.0),
        (0.0, 30.0, 0.0, 0.5, 0.5, 1.0),
        (0.0, -35.0, 0.0, 0.5, 0.5, 1.0),
        (40.0, 10.0, 20.0, 0.36, 0.42, 1.05),
        (-30.0, 30.0, -15.0, 0.64, 0.42, 1.05),
        (25.0, -30.0, -35.0, 0.38, 0.57, 1.1),
        (-25.0, -30.0, 40.0, 0.64, 0.6, 1.1),
        (8.0, 42.0, 85.0, 0.5, 0.5, 1.1),
        (-20.0, 12.0, 90.0, 0.5, 0.5, 1.2),
    ),
)
LASER = _targets(
    "laser",
    (
        (-6.0, 3.0, 0.0, 0.36, 0.5, 0.83),
        (-22.0, 10.0, 0.0, 0.64, 0.5, 0.88),
        (6.0, -12.0, 0.0, 0.64, 0.5, 0.93),
        (-26.0, -8.0, 0.0, 0.36, 0.5, 0.98),
        (-8.0, 20.0, 0.0, 0.36, 0.5, 1.03),
        (2.0, -20.0, 0.0, 0.64, 0.5, 1.07),
        (-20.0, 5.0, 0.0, 0.36, 0.5, 1.12),
        (18.0, 2.0, 0.0, 0.64, 0.5, 1.17),
    ),
)
_POSTURES = (
    (-44.0, -15.0, 0.0, 0.9),
    (-44.0, 16.0, 75.0, 1.1),
    (-38.0, -28.0, 20.0, 1.1),
    (-36.0, 28.0, -40.0, 0.91),
    (-30.0, 0.0, 110.0, 1.0),
    (-8.0, 41.0, -15.0, 1.06),
    (-8.0, -41.0, 50.0, 0.94),
    (2.0, -34.0, -70.0, 1.09),
    (2.0, 34.0, 10.0, 0.9),
    (9.0, -12.0, 90.0, 0.9),
    (9.0, 12.0, -25.0, 1.1),
    (0.0, 0.0, 35.0, 1.0),
)


def _posture(tilt_x: float, tilt_y: float, roll: float, distance: float) -> Placement:
    words = []
    if abs(tilt_x) >= 8.0:
        words.append(f"tipped {'back' if tilt_x < 0 else 'forward'} {abs(tilt_x):.0f}°")
    if abs(tilt_y) >= 8.0:
        words.append(f"leaned {'right' if tilt_y > 0 else 'left'} {abs(tilt_y):.0f}°")
    if abs(roll) >= 10.0:
        words.append(f"turned {abs(roll):.0f}° {'clockwise' if roll < 0 else 'anticlockwise'}")
    height = "near" if distance < 0.95 else "far" if distance > 1.05 else "at working distance"
    return Placement(
        "plate", ", ".join([height, *words]).capitalize(), tilt_x, tilt_y, roll, distance=distance
    )


HAND_EYE = tuple(_posture(*row) for row in _POSTURES)
"""Twelve, near and far, tipped and leaned both ways."""


def _touches() -> tuple[Placement, ...]:
    """Twenty around the edge and over the middle; the first few are spread already."""
    corners = [(0.1, 0.1), (0.9, 0.9), (0.9, 0.1), (0.1, 0.9)]
    middle = [(0.35, 0.35), (0.65, 0.65), (0.65, 0.35), (0.35, 0.65), (0.5, 0.4), (0.5, 0.6)]
    rim = [(x, y) for x in (0.5, 0.3, 0.7) for y in (0.1, 0.9)]
    rim += [(x, y) for y in (0.37, 0.63) for x in (0.1, 0.9)]
    words = "Touch from above"
    places = (*corners, *middle, *rim)
    return tuple(Placement("touch", words, across=x, down=y) for x, y in places)


TOUCHES = _touches()


def drawing(placement: Placement) -> str:
    """SVG of a placement, from this program only, so that a page may show it as it is."""
    if placement.kind == "plate":
        body = _head_over_plate(placement)
        caption = "from the front; dark: the side of camera and laser"
    elif placement.kind == "touch":
        body, caption = _touch(placement), "the plate from above"
    else:
        body, caption = _target(placement), "as the camera's image shows it"
    return (
        f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT + 18:.0f}" width="100%" role="img" '
        f'aria-label="{escape(placement.words)}" style="display:block;max-width:{SHOWN_PX}px">'
        f"{body}"
        f'<text x="{WIDTH / 2:.0f}" y="{HEIGHT + 14:.0f}" text-anchor="middle" font-size="13" '
        f'fill="{MUTED}" font-family="sans-serif">{caption}</text></svg>'
    )


def _polygon(points: FloatArray, fill: str, stroke: str = INK) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polygon points="{text}" fill="{fill}" stroke="{stroke}" stroke-width="1.2"/>'


def _line(points: FloatArray, stroke: str, width: float) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{text}" fill="none" stroke="{stroke}" stroke-width="{width}"/>'


def _frame() -> str:
    return (
        f'<rect x="1" y="1" width="{WIDTH - 2:.0f}" height="{HEIGHT - 2:.0f}" rx="4" '
        f'fill="#f6f8f9" stroke="{LINE}"/>'
    )


def _turned(placement: Placement) -> FloatArray:
    """Rotation (3, 3) from the target, x right and y down, to the camera that it faces."""
    angles = (placement.roll_deg, placement.tilt_y_deg, -placement.tilt_x_deg)
    roll, about_y, about_x = (
        rotation_from_vector(np.radians(angle) * np.eye(3)[axis])
        for angle, axis in zip(angles, (2, 1, 0), strict=True)
    )
    return np.asarray(about_x @ about_y @ roll)


def _target(placement: Placement) -> str:
    """The target in the camera's image: perspective of a camera of 50 degrees."""
    focal = 1.07 * WIDTH
    half = np.array([0.215, 0.215 * BOARD[1]])
    rotation = _turned(placement)
    shift = np.array([placement.across - 0.5, placement.down - 0.5]) * [WIDTH, HEIGHT] / focal
    middle = placement.distance * np.array([*shift, 1.0])

    def project(points: FloatArray) -> FloatArray:
        seen = points @ rotation.T + middle
        return np.asarray(focal * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2])

    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.column_stack([signs * half, np.zeros(4)])
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 7), np.linspace(-0.76, 0.76, 5))
    dots = project(np.column_stack([x.ravel() * half[0], y.ravel() * half[1], 0.0 * x.ravel()]))
    size = 3.4 / placement.distance
    circles = "".join(
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{size:.1f}" fill="{INK}"/>' for u, v in dots
    )
    top = project(np.array([[-half[0], -half[1], 0.0], [half[0], -half[1], 0.0]]))
    body = _frame() + _polygon(project(corners), "#ffffff") + circles + _line(top, ACCENT, 3.0)
    if placement.kind == "laser":
        span = project(np.array([[-1.0 * half[0], 0.0, 0.0], [half[0], 0.0, 0.0]]))
        body += _line(span, ALERT, 2.6)
    return body


def _head_over_plate(placement: Placement) -> str:
    """The plate with the head above it, in an oblique view."""
    roll, about_y, about_x = (
        rotation_from_vector(np.radians(angle) * np.eye(3)[axis])
        for angle, axis in (
            (placement.roll_deg, 2),
            (-placement.tilt_y_deg, 1),
            (-placement.tilt_x_deg, 0),
        )
    )
    rotation = roll @ FACE_DOWN @ about_x @ about_y
    height = placement.distance
    origin = -height * rotation[:, 2]

    def project(points: FloatArray) -> FloatArray:
        view = np.array([[0.96, -0.2, 0.0], [-0.09, -0.42, -0.92]])
        flat = points @ view.T
        return np.asarray(118.0 * flat + [WIDTH / 2, 0.80 * HEIGHT])

    plate = np.array([[-0.85, -0.6, 0], [0.85, -0.6, 0], [0.85, 0.6, 0], [-0.85, 0.6, 0]])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    rim = np.column_stack([signs * [0.20, 0.13], np.zeros(4)])
    back, front = (rim + np.array([0.0, 0.0, z]) for z in (-0.26, 0.0))
    box = [np.asarray(part @ rotation.T + origin) for part in (back, front)]
    line = np.array([[-0.42, 0.0, height], [0.42, 0.0, height]]) @ rotation.T + origin
    # the line lies on the plate, wherever the tilted sheet meets it
    rays = line - origin
    line = origin + rays * (-origin[2] / rays[:, 2])[:, None]
    fan = np.vstack([origin, line])
    sides = "".join(
        _polygon(project(np.array([box[0][k], box[0][j], box[1][j], box[1][k]])), "#e6eef1")
        for k, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    )
    ground = project(np.array([[0.0, 0.0, 0.0], [origin[0], origin[1], 0.0]]))
    return (
        _frame()
        + _polygon(project(plate), "#e3e7ea", MUTED)
        + f'<g stroke-dasharray="3 3">{_line(ground, MUTED, 1.0)}</g>'
        + _polygon(project(fan), "rgba(200,84,27,0.18)", "none")
        + _line(project(line), ALERT, 3.0)
        + sides
        + _polygon(project(box[0]), "#d3e4e9")
        + _polygon(project(box[1]), ACCENT)
    )


def _touch(placement: Placement) -> str:
    """The plate from above with the place to touch, those before it full, those after it empty."""
    x, y, w, h = 40.0, 22.0, WIDTH - 80.0, HEIGHT - 44.0
    rect = f'<rect x="{x}" y="{y}" width="{w}" height="{h}" fill="#e3e7ea" stroke="{MUTED}"/>'
    n_before = TOUCHES.index(placement) if placement in TOUCHES else 0
    dots = "".join(
        f'<circle cx="{x + w * one.across:.1f}" cy="{y + h * one.down:.1f}" r="3.5" '
        f'fill="{ACCENT if k < n_before else "none"}" stroke="{ACCENT}"/>'
        for k, one in enumerate(TOUCHES)
    )
    u, v = x + w * placement.across, y + h * placement.down
    here = f'<circle cx="{u:.1f}" cy="{v:.1f}" r="7" fill="{ALERT}"/>'
    return _frame() + rect + dots + here
