# SPDX-License-Identifier: Apache-2.0
"""The page that sets the demos of several heads beside each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.inspection.results import Deviations
from armscan.pipeline.head_demo import HeadDemo
from armscan.records.cloud import PointCloud
from armscan.report.inspect import deviation_histogram, share_text
from armscan.report.page import Gallery, Page, Picture, Section, Text
from armscan.report.photographs import sheet_colour
from armscan.report.quantity import Table
from armscan.report.scene3d import SceneDots, scene_markup, uniform_dots

FRAMES_A_SECOND = 80
"""Of the thesis's cameras (5.3.1)."""
MAX_SHOWN = 12_000

Figures = Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class HeadPicture:
    """What the comparison shows of one head.

    Parameters
    ----------
    plate
        Deviations of the plate from its fitted plane.
    scanned
        The part in Base.
    at_once
        The points of one exposure of it.
    """

    plate: Deviations
    scanned: Picture
    at_once: Picture


def head_picture(name: str, demo: HeadDemo) -> HeadPicture:
    """Reduce a demo to what the comparison shows."""
    scan = demo.scans["part"]
    cloud = scan.cloud
    times = np.array([scan.exposures[row].row.t_ns for row in scan.image_rows])
    of_point = times[cloud.exposure]
    middle = np.unique(of_point)[len(np.unique(of_point)) // 2]
    one = of_point == middle
    return HeadPicture(
        demo.plate.fitted,
        _by_sheet(cloud, np.flatnonzero(np.ones(len(cloud), dtype=np.bool_)), f"{name}: the part"),
        _by_sheet(cloud, np.flatnonzero(one), f"{name}: one exposure, {int(one.sum()):,} points"),
    )


def three_heads_page(
    heads: Mapping[str, Figures], pictures: Mapping[str, HeadPicture], footer: str
) -> Page:
    """Lay out the comparison.

    Parameters
    ----------
    heads
        Figures of each head, by its name.
    pictures
        What to show of each, by the same names.
    footer
        One line about origin.
    """
    histograms = tuple(
        deviation_histogram(
            picture.plate, title=f"{kind(name)}: plate", axis_label="distance to plane, mm"
        )
        for name, picture in pictures.items()
    )
    return Page(
        title="Three heads on the same scenes",
        subtitle="One line, two crossed lines and eleven lines on the same simulated arm, before "
        "the same plate, ball, blocks and part.",
        cards=(),
        warnings=(),
        sections=(
            Section("Beside each other", (three_heads_table(heads), Text(_reading()))),
            Section(
                "One exposure (as figure 5.42)",
                (Gallery(tuple(p.at_once for p in pictures.values()), 380),),
            ),
            Section(
                "The part, scanned (as figure 5.25)",
                (Gallery(tuple(p.scanned for p in pictures.values()), 380),),
            ),
            Section("The plate (as figures 5.12, 5.28 and 5.41)", (Gallery(histograms, 380),)),
        ),
        is_simulated=True,
        footer=footer,
    )


def three_heads_table(heads: Mapping[str, Figures]) -> Table:
    """A column a head; the thesis's own figures in brackets."""
    rows: list[tuple[str, Callable[[str, Figures], str]]] = [
        ("cameras, light sheets", lambda _, h: f"{len(h['camera'])}, {len(h['sheets'])}"),
        ("stripes named an exposure", lambda _, h: f"{h['named_stripes_per_exposure']:.2f}"),
        ("points an exposure", _points),
        (
            f"points a second at {FRAMES_A_SECOND} exposures a second",
            lambda _, h: f"{FRAMES_A_SECOND * h['points_per_exposure']:,.0f}",
        ),
        ("wrong names among the points", _wrong),
        ("plate within 0.05 mm", _plate),
        (
            "plate within 0.03 mm",
            lambda _, h: share_text(100 * h["plate"]["fraction_within_0p03mm"]),
        ),
        ("plate, standard deviation", lambda _, h: f"{1000 * h['plate']['std_mm']:.1f} µm"),
        (
            "ball, error of the diameter",
            lambda _, h: f"{1000 * h['sphere']['diameter_error_mm']:+.1f} µm",
        ),
        ("steps", _steps),
        ("part, from the true surface", lambda _, h: f"{1000 * h['part']['rms_mm']:.1f} µm rms"),
        (
            "hand-eye, off by",
            lambda _, h: (
                f"{h['hand_eye']['rotation_error_deg']:.4f}°, "
                f"{1000 * h['hand_eye']['translation_error_mm']:.0f} µm"
            ),
        ),
    ]
    return Table(
        ("", *(kind(name) for name in heads)),
        tuple((label, *(text(name, h) for name, h in heads.items())) for label, text in rows),
        "",
        tuple(range(1, len(heads) + 1)),
    )


def kind(name: str) -> str:
    """Words for a head."""
    return f"{name.removeprefix('thesis-')}-line"


_THESIS_POINTS = {
    "thesis-single": "968",
    "thesis-cross": "1171",
    "thesis-multi": "3859, five lines",
}
"""Figure 5.42."""
_THESIS_PLATE = {
    "thesis-single": "97.9 %",
    "thesis-cross": "96 %",
    "thesis-multi": "95.1 % within 0.08, five lines",
}
"""Figures 5.12, 5.28 and 5.41."""


def _points(name: str, head: Figures) -> str:
    return f"{head['points_per_exposure']:,.0f} [{_THESIS_POINTS[name]}]"


def _plate(name: str, head: Figures) -> str:
    share = share_text(100 * head["plate"]["fraction_within_0p05mm"])
    return f"{share} [{_THESIS_PLATE[name]}]"


def _wrong(_: str, head: Figures) -> str:
    naming = head["naming"].values()
    if not naming:
        return "one sheet"
    n_wrong = sum(found["n_wrong"] for found in naming)
    n_checked = sum(found["n_named"] for found in naming)
    return f"{n_wrong} of {n_checked:,}"


def _steps(_: str, head: Figures) -> str:
    return "; ".join(
        f"{step['nominal_mm']:g} mm {1000 * (step['mean_mm'] - step['nominal_mm']):+.1f} "
        f"± {1000 * step['std_mm']:.1f} µm"
        f"{' (one exposure)' if step['frame'] == 'Sensor' else ''}"
        for step in head["steps"]
    )


def _reading() -> str:
    return (
        "In brackets: the thesis's own figures, measured on real heads, whose lines and windows "
        "differ from these. The single line lies along the long side of the camera's window, the "
        "others cross it at about 45°: a line has fewer points there. How many points a head "
        "yields also depends on what it looks at."
    )


def _by_sheet(cloud: PointCloud, rows: Any, title: str) -> Picture:
    step = max(1, -(-len(rows) // MAX_SHOWN))
    shown = rows[::step]
    points: FloatArray = cloud.points_mm[shown]
    dots: list[SceneDots] = [
        uniform_dots(points[cloud.sheet[shown] == k], sheet_colour(k))
        for k in np.unique(cloud.sheet[shown])
    ]
    every = f" One point in {step} is shown." if step > 1 else ""
    markup = scene_markup(dots, [], [], title, is_z_up=True)
    return Picture(markup, f"Colour is the light sheet. Drag to turn.{every}", title)
