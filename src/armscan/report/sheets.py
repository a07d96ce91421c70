# SPDX-License-Identifier: Apache-2.0
"""The page of a light sheet calibration, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from armscan.calibration.sheets.result import (
    LACK_OF_FIT_P,
    LaserFit,
    PointUse,
    SheetFit,
    SheetImage,
    SheetPointCheck,
)
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import FTest, Provenance
from armscan.models.light_sheet import BOW_TERMS
from armscan.records.exposure import Exposure
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    INK,
    LINE,
    MUTED,
    PALETTE,
    Marks,
    chart_markup,
    new_figure,
    photo_markup,
    raster_markup,
    styled,
)
from armscan.report.page import (
    Card,
    Facts,
    Gallery,
    Legend,
    Page,
    Picture,
    Section,
    Text,
    footer,
    origin_section,
)
from armscan.report.quantity import Table, sentence, significant, with_sigma, without_source
from armscan.report.scene3d import SceneLines, scene_markup, uniform_dots
from armscan.report.stripes import evenly_chosen, stripe_legend, stripe_picture

MAX_PANELS = 12
BINS_ALONG = 24
MAX_DOTS = 2000
PAGE_WIDTH = 10.4
"""Inches of a chart that fills the page's width."""


def residuals_along(fit: LaserFit, index: int) -> Picture:
    """Distance from the sheet along the stripe, one panel a board."""
    images = [image for image in fit.images if _used(image, index).any()]
    sheet = fit.sheets[index].sheet
    n = min(len(images), MAX_PANELS)
    columns = min(n, 3)
    rows = math.ceil(n / columns)
    reach = 1.15 * max(
        float(np.percentile(np.abs(image.residual_mm[_used(image, index)]), 98)) for image in images
    )
    with styled():
        figure = new_figure(PAGE_WIDTH, 1.9 * rows + 0.5)
        grid: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes, image in zip(grid.flat, images[:n], strict=False):
            chosen = _used(image, index)
            along = (image.points_mm[chosen] - sheet.origin_mm) @ sheet.axes[0]
            _residual_panel(axes, along, image.residual_mm[chosen])
            axes.set_title(_short(image.source), loc="left", fontsize=8)
            axes.set_ylim(-reach, reach)
        for axes in list(grid.flat)[n:]:
            axes.set_axis_off()
        figure.supxlabel("along the stripe, mm", fontsize=9, color=MUTED)
        figure.supylabel("off the sheet, mm", fontsize=9, color=MUTED)
    more = f" {len(images) - n} more boards are not shown." if len(images) > n else ""
    return Picture(
        raster_markup(figure, "Residuals along the stripe"),
        title=f"Sheet {fit.sheets[index].name}: residuals along the stripe",
        caption="Dots are stripe points, the line their running mean, the boards as measured. "
        "A line that leans means that the board's pose is off, within its uncertainty; the same "
        "bend on every board means that the sheet itself is bent." + more,
    )


def residual_histogram(fit: LaserFit) -> Picture:
    """Residuals across the stripe in the image, all sheets."""
    values = np.concatenate(
        [image.residual_px[image.use == int(PointUse.USED)] for image in fit.images]
    )
    remaining = np.concatenate(
        [image.remaining_px[image.use == int(PointUse.USED)] for image in fit.images]
    )
    found = fit.diagnostics
    reach = float(np.percentile(np.abs(values), 99.0)) * 1.3
    edges = np.linspace(-reach, reach, 61).tolist()
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        axes.hist(values, edges, color=LINE, label="boards as measured")
        axes.hist(
            remaining, edges, histtype="step", color=ACCENT, linewidth=1.4,
            label="boards moved within their uncertainty",
        )  # fmt: skip
        axes.set_xlabel("off the sheet, across the stripe, px")
        axes.set_ylabel("points")
        axes.set_ylim(top=axes.get_ylim()[1] * 1.25)
        axes.legend(loc="upper center")
    return Picture(
        chart_markup(figure, "Histogram of the residuals"),
        title="Distribution of residuals",
        caption=f"Stripe points scatter {found.noise_factor:.2f} times as much as their sigmas "
        f"say; about {found.correlation_points:.0f} points along a stripe count as one.",
    )


def scene(fit: LaserFit) -> Picture:
    """Camera, boards, stripes and sheets in space."""
    lines = [SceneLines(_camera_edges(fit), INK)]
    lines += [SceneLines(_board_edges(image), "#b4bec8") for image in fit.images]
    dots = []
    labels: list[tuple[str, tuple[float, float, float]]] = [("camera", (0.0, 0.0, 0.0))]
    for index, sheet in enumerate(fit.sheets):
        colour = PALETTE[index % len(PALETTE)]
        points = _points_of(fit, index)
        shown = points[:: max(1, len(points) // MAX_DOTS)]
        dots.append(uniform_dots(shown, colour))
        edges = _sheet_edges(sheet, points)
        lines.append(SceneLines(edges, colour))
        x, y, z = edges[0].tolist()
        labels.append((f"sheet {sheet.name}", (x, y, z)))
    return Picture(
        scene_markup(dots, lines, labels, "Camera, boards and light sheets in space"),
        title="In space (Sensor frame)",
        caption="The pyramid is the camera and what it sees, grey outlines are the boards, dots "
        "the stripes on them, coloured outlines the calibrated part of each sheet. Drag to turn; "
        "click, then scroll to zoom.",
    )


def _used(image: SheetImage, index: int) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.asarray((image.use == int(PointUse.USED)) & (image.sheet == index))


def _points_of(fit: LaserFit, index: int) -> FloatArray:
    return np.concatenate([image.points_mm[_used(image, index)] for image in fit.images])


def _residual_panel(axes: Any, along: FloatArray, residual: FloatArray) -> None:
    axes.axhline(0.0, color=LINE, linewidth=0.8)
    axes.plot(along, residual, ".", color=ACCENT, markersize=1.6, alpha=0.45)
    edges = np.linspace(along.min(), along.max() + 1e-9, BINS_ALONG + 1)
    cell = np.digitize(along, edges) - 1
    filled = [k for k in range(BINS_ALONG) if (cell == k).any()]
    middle = [float(along[cell == k].mean()) for k in filled]
    mean = [float(residual[cell == k].mean()) for k in filled]
    axes.plot(middle, mean, color=ALERT, linewidth=1.2)


def _board_edges(image: SheetImage) -> FloatArray:
    board = image.view.points_board_mm
    (x0, y0, _), (x1, y1, _) = board.min(axis=0), board.max(axis=0)
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    pose = image.sensor_from_board
    return _closed(corners @ pose.rotation.T + pose.translation_mm)


def _sheet_edges(fit: SheetFit, points: FloatArray) -> FloatArray:
    sheet = fit.sheet
    local = (points - sheet.origin_mm) @ sheet.axes.T
    (u0, v0), (u1, v1) = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    return _closed(sheet.origin_mm + corners @ sheet.axes[:2])


def _camera_edges(fit: LaserFit) -> FloatArray:
    camera = fit.camera.camera
    depth = 0.25 * min(sheet.calibration.depth_range_mm[0] for sheet in fit.sheets)
    corners = np.array(
        [[0, 0], [camera.width_px, 0], [camera.width_px, camera.height_px], [0, camera.height_px]]
    )
    centre, focal = [camera.cx_px, camera.cy_px], [camera.fx_px, camera.fy_px]
    rim = np.column_stack([(corners - centre) / focal * depth, np.full(4, depth)])
    spokes = np.stack([np.zeros((4, 3)), rim], axis=1).reshape(-1, 3)
    return np.concatenate([_closed(rim), spokes])


def _closed(corners: FloatArray) -> FloatArray:
    """(2 N, 3) ends of the sides of a closed outline of N corners."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 3)


def _short(source: str) -> str:
    return source if len(source) <= 30 else "…" + source[-29:]


TITLE = "Light sheet calibration"
USE_COLOURS = {
    PointUse.NO_RAY: "#8a6d5a",
    PointUse.OFF_BOARD: "#b8c0ca",
    PointUse.OFF_LINE: "#ffd23f",
    PointUse.UNNAMED: "#ff9df0",
    PointUse.OFF_SHEET: "#ff7a3c",
    PointUse.ON_EDGE: "#8d7bff",
    PointUse.OUTVOTED: "#c9a227",
}
BOARD_COLOUR = "#35e0c0"
WEAK_P = 0.01
"""A lack-of-fit probability below this is said to object, though too weakly for a bow."""


def laser_page(
    fit: LaserFit,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    fit
        The calibration.
    exposures
        The photographs by source name; those that are missing are not shown.
    provenance
        How the calibration came to be.
    is_simulated
        True if the photographs were rendered.
    """
    sections = [_sheets_section(fit), _points_section(fit), _images_section(fit, exposures)]
    sections.append(_residuals_section(fit))
    sections.append(_boards_section(fit, exposures))
    if fit.skipped:
        sections.append(_skipped_section(fit, exposures))
    sections += [_methods_section(fit), origin_section(provenance)]
    warnings = list(fit.warnings)
    for sheet in fit.sheets:
        warnings += [f"sheet {sheet.name}: {warning}" for warning in sheet.warnings]
    n = len(fit.sheets)
    return Page(
        title=TITLE if n == 1 else "Light sheets calibration",
        subtitle=f"{n} light sheet{'s' if n > 1 else ''} from {len(fit.images)} stripe images",
        cards=tuple(_card(sheet) for sheet in fit.sheets),
        warnings=tuple(sentence(warning) for warning in warnings),
        sections=tuple(sections),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def named_and_found(fit: LaserFit) -> str:
    """How the stripes were given to sheets, and in which channel they were found."""
    text = f"Named: {fit.diagnostics.naming}."
    return f"{text} Stripes in {fit.channel_reason}." if fit.channel_reason else text


def sheet_facts(fit: SheetFit) -> tuple[tuple[str, str], ...]:
    """Labels and values of one sheet."""
    calibration = fit.calibration
    a, b, c, d = fit.sheet.plane
    low, high = calibration.depth_range_mm
    bow = ", ".join(
        f"{significant(float(value), 'mm')} {_term(i, j)}"
        for value, (i, j) in zip(fit.sheet.bow_mm, BOW_TERMS, strict=True)
    )
    return (
        ("Plane in Sensor", f"{a:+.6f} x {b:+.6f} y {c:+.6f} z {d:+.4f} mm = 0"),
        (
            "Known to",
            f"± {significant(fit.tilt_sigma_deg)}° in direction, "
            f"± {significant(fit.offset_sigma_mm)} mm in the middle",
        ),
        (
            "Residual",
            f"{significant(calibration.rms_mm)} mm rms, "
            f"{significant(fit.diagnostics.rms_px)} px rms",
        ),
        *point_facts(fit.points),
        ("Depth covered", f"Z {low:.1f} to {high:.1f} mm"),
        (
            "Rests on",
            f"{calibration.n_boards} boards, at most {fit.diagnostics.board_angle_deg:.0f}° apart, "
            f"{calibration.n_points} points",
        ),
        (
            "Checked by other boards",
            "yes"
            if calibration.is_redundant
            else "no: two stripes fix a plane, only their coplanarity checks it",
        ),
        (
            "Stripes miss a common plane by",
            f"{significant(fit.diagnostics.coplanarity_mm)} mm, expected "
            f"{significant(fit.diagnostics.coplanarity_sigma_mm)} mm",
        ),
        ("Bow (u along the stripe, v in depth)", bow if fit.sheet.is_bowed else "none: a plane"),
        *(
            (("The bow's light comes from", f"about {_source_mm(fit):.0f} mm before the middle"),)
            if fit.sheet.fan.any()
            else ()
        ),
        ("Plane or bow, and why", sentence(fit.diagnostics.bow_decision)),
        ("Lack of fit of a plane", lack_of_fit_text(fit.diagnostics.plane_test)),
        ("Lack of fit of the sheet", lack_of_fit_text(fit.diagnostics.final_test)),
    )


def _source_mm(fit: SheetFit) -> float:
    spread = float(fit.sheet.fan[1])
    return fit.sheet.scale_mm / spread if spread else math.inf


def point_facts(points: SheetPointCheck) -> tuple[tuple[str, str], ...]:
    """Labels and values of the points that the stored calibration makes of its own stripes."""
    made = points.fitted
    facts = [
        (
            "Its points off their boards",
            f"mean {significant(made.mean_mm)} mm (known to ± {significant(made.sigma_mean_mm)}), "
            f"rms {significant(made.rms_mm)} mm, claimed {significant(made.claimed_rms_mm)}",
        )
    ]
    if math.isfinite(points.left_out_rms_mm):
        facts.append(
            (
                "The same, each board left out",
                f"rms {significant(points.left_out_rms_mm)} mm, claimed "
                f"{significant(points.left_out_claimed_mm)}",
            )
        )
    return tuple(facts)


def _points_section(fit: LaserFit) -> Section:
    rows = []
    for sheet in fit.sheets:
        for board in sheet.points.boards:
            made, alone = board.fitted, board.left_out
            rows.append(
                (
                    f"{sheet.name}, {board.source}",
                    f"{board.depth_mm:.1f}",
                    str(made.n_points),
                    with_sigma(made.mean_mm, made.sigma_mean_mm),
                    f"{significant(made.rms_mm)} / {significant(made.claimed_rms_mm)}",
                    "" if alone is None else with_sigma(alone.mean_mm, alone.sigma_mean_mm),
                    ""
                    if alone is None
                    else f"{significant(alone.rms_mm)} / {significant(alone.claimed_rms_mm)}",
                )
            )
    heads = (
        "sheet, image",
        "Z, mm",
        "points",
        "mean, mm",
        "rms / claimed, mm",
        "left out: mean, mm",
        "left out: rms / claimed, mm",
    )
    words = Text(
        "The stripes are measured with the calibration as it is stored, as any later stripe is, "
        "and compared with the plane of the board on which they lay (positive: beyond it). Camera "
        "and sheets that do not belong together would show here. 'Left out': the board's points "
        "made with the sheet of all other boards. 'Claimed' is what the calibration's own "
        "uncertainty allows for these distances."
    )
    table = Table(heads, tuple(rows), "Points against their boards", (1, 2, 3, 4, 5, 6))
    return Section("Points made with this calibration", (words, table))


def _term(i: int, j: int) -> str:
    """Powers of a bow term: ``u²v``."""
    powers = ("", "{}", "{}²", "{}³")
    return powers[i].format("u") + powers[j].format("v")


def lack_of_fit_text(test: FTest) -> str:
    """A lack-of-fit test in words."""
    if test.degrees_of_freedom == 0 or not math.isfinite(test.p_value):
        return "nothing is redundant, so nothing can be tested"
    if test.p_value < LACK_OF_FIT_P:
        verdict = "the model does not explain the stripes"
    else:
        verdict = "weak objection" if test.p_value < WEAK_P else "no objection"
    return f"F = {test.f_ratio:.2f}, p = {test.p_value:.2g}: {verdict}"


def _card(sheet: SheetFit) -> Card:
    low, high = sheet.calibration.depth_range_mm
    return Card(
        f"Sheet {sheet.name}",
        f"{significant(sheet.points.fitted.rms_mm)} mm rms off the boards",
        f"{sheet.calibration.n_boards} boards, Z {low:.0f} to {high:.0f} mm, "
        f"{'bowed' if sheet.sheet.is_bowed else 'plane'}",
    )


def _sheets_section(fit: LaserFit) -> Section:
    blocks: list[Facts | Text | Gallery] = []
    for sheet in fit.sheets:
        blocks.append(Facts(sheet_facts(sheet), f"Sheet {sheet.name}"))
    blocks += [Text(named_and_found(fit)), Gallery((scene(fit),), 560)]
    return Section("The sheets", tuple(blocks))


def _images_section(fit: LaserFit, exposures: Mapping[str, Exposure]) -> Section:
    flags = 0
    for image in fit.images:
        for value in image.profile.flags[image.use == int(PointUse.FLAGGED)]:
            flags |= int(value)
    seen = {use for use in USE_COLOURS if any(image.count(use) for image in fit.images)}
    fates = {int(use): (USE_COLOURS[use], use.label) for use in PointUse if use in seen}
    shown = evenly_chosen([image for image in fit.images if image.source in exposures])
    pictures = tuple(
        stripe_picture(
            exposures[image.source],
            image.profile,
            image.use,
            image.sheet,
            {int(use): colour for use, colour in USE_COLOURS.items()},
            outline_px=image.view.points_px,
            caption=_caption(image),
        )
        for image in shown
    )
    uses = [use for use in PointUse if any(image.count(use) for image in fit.images)]
    table = Table(
        ("image", *(use.label for use in uses), "board moved by"),
        tuple(
            (
                image.source,
                *(str(image.count(use)) for use in uses),
                f"{image.pose_shift_sigma:.1f} sigma",
            )
            for image in fit.images
        ),
    )
    text = Text(
        "Every stripe point, used or not. The white outline is the region of the board's points. "
        "Dark photographs are brightened here. Click a picture to enlarge it. "
        f"{len(shown)} of {len(fit.images)} images are shown."
    )
    legend = Legend(stripe_legend(fit.sheet_names, fates, flags))
    return Section("The stripes", (text, legend, Gallery(pictures, 420), table))


def _boards_section(fit: LaserFit, exposures: Mapping[str, Exposure]) -> Section:
    pictures = tuple(
        Picture(
            photo_markup(
                exposures[image.view.source],
                (
                    Marks(image.view.points_px, BOARD_COLOUR, "ring", 12.0),
                    Marks(image.view.points_px[:1], BOARD_COLOUR, "dot", 11.0),
                ),
                f"Target points in {image.view.source}",
                longest_px=700,
                is_grey=True,
            ),
            title=image.view.source,
            caption=f"{len(image.view)} target points; the filled ring is the board's first point",
        )
        for image in evenly_chosen([i for i in fit.images if i.view.source in exposures])
    )
    return Section("The boards", (Gallery(pictures, 300),), is_folded=True)


def _caption(image: SheetImage) -> str:
    used = image.count(PointUse.USED)
    board = "" if image.view.source == image.source else f"; board from {image.view.source}"
    return f"{used} of {len(image.profile)} points used{board}"


def _residuals_section(fit: LaserFit) -> Section:
    along = tuple(residuals_along(fit, index) for index in range(len(fit.sheets)))
    return Section(
        "How well it fits", (Gallery(along, 560), Gallery((residual_histogram(fit),), 420))
    )


def _skipped_section(fit: LaserFit, exposures: Mapping[str, Exposure]) -> Section:
    rows = tuple((item.source, without_source(item.source, item.reason)) for item in fit.skipped)
    table = Table(("image", "why"), rows, "", (1,))
    pictures = tuple(
        Picture(
            photo_markup(exposures[item.source], (), f"Nothing in {item.source}", longest_px=500),
            without_source(item.source, item.reason),
            item.source,
        )
        for item in fit.skipped
        if item.source in exposures
    )
    return Section("Images that gave nothing", (table, Gallery(pictures, 240)))


def _methods_section(fit: LaserFit) -> Section:
    rows = tuple(
        (
            sheet.name,
            item.method,
            f"{item.angle_deg:.3f}°",
            f"{significant(item.largest_mm)} mm",
        )
        for sheet in fit.sheets
        for item in sheet.comparisons
    )
    table = Table(("sheet", "method", "angle to ours", "largest distance"), rows, "", (1,))
    text = Text(
        "Planes that simpler methods give from the same points, against the sheet in use, over "
        "the calibrated region. The algebraic one is the thesis's eq. 2.44."
    )
    return Section("Against simpler methods", (text, table), is_folded=True)
