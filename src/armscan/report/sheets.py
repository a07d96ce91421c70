# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration of light sheets, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from armscan.calibration.sheets.result import (
    LACK_OF_FIT_P,
    LaserFit,
    PointUse,
    SheetFit,
    SheetImage,
)
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.least_squares import p_text
from armscan.models.calibration import FTest, Provenance, SheetCalibration
from armscan.models.light_sheet import BOW_TERMS, PLANE_PARAMETER_NAMES
from armscan.records.exposure import Exposure
from armscan.report.camera import bow_quantities
from armscan.report.charts import PAGE_WIDTH, Bars, histogram_chart, short, symmetric_edges
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    INK,
    LINE,
    MUTED,
    PALETTE,
    SceneLines,
    closed_outline,
    new_figure,
    photo_markup,
    pyramid,
    raster_markup,
    scene_markup,
    styled,
    uniform_dots,
)
from armscan.report.page import Block, Facts, Gallery, Page, Picture, Section, Text, page_of
from armscan.report.photographs import (
    evenly_chosen,
    flags_of,
    nothing_found_section,
    stripe_legend,
    stripe_picture,
    target_marks,
)
from armscan.report.quantity import (
    Quantity,
    Table,
    fact,
    for_people,
    plural,
    sentence,
    significant,
    with_sigma,
)

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
WEAK_P = 0.01
"""A lack-of-fit probability below this is said to object, though too weakly for a bow."""
MAX_PANELS = 12
BINS_ALONG = 24
MAX_DOTS = 2000
POINTS_TEXT = (
    "The stripes are measured with the calibration as it is stored, as any later stripe is, "
    "and compared with the plane of the board on which they lay (positive: beyond it). Camera "
    "and sheets that do not belong together would show here. 'Left out': the board's points "
    "made with the sheet of all other boards. 'Claimed' is what the calibration's own "
    "uncertainty allows for these distances."
)
POINT_HEADS = (
    "sheet, image", "Z, mm", "points", "mean, mm", "rms / claimed, mm", "left out: mean, mm",
    "left out: rms / claimed, mm",
)  # fmt: skip


def sheet_quantities(fit: SheetFit) -> tuple[Quantity, ...]:
    """What is told of one sheet."""
    stored, sheet, known = fit.calibration, fit.sheet, fit.diagnostics
    a, b, c, d = sheet.plane
    low, high = stored.depth_range_mm
    sigmas = np.sqrt(fit.covariance.diagonal()[:3]).tolist()
    bow = ", ".join(
        f"{significant(float(value), 'mm')} {('', 'u', 'u²', 'u³')[i]}{('', 'v', 'v²', 'v³')[j]}"
        for value, (i, j) in zip(sheet.bow_mm, BOW_TERMS, strict=True)
    )
    if not sheet.is_bowed:
        bow = "none: a plane"
    elif not fit.is_bow_free:
        largest = significant(_largest_bow_mm(stored), "mm")
        bow = f"up to {largest}, the likeliest of small ones"
    alone = "no: two stripes fix a plane, only their coplanarity checks it"
    return (
        Quantity("name", "", fit.name),
        Quantity(
            "plane_sensor_a_b_c_d_mm",
            "Plane in Sensor",
            sheet.plane.tolist(),
            shown=f"{a:+.6f} x {b:+.6f} y {c:+.6f} z {d:+.4f} mm = 0",
        ),
        Quantity("plane_sigma_mm", "", dict(zip(PLANE_PARAMETER_NAMES, sigmas, strict=True))),
        Quantity(
            "tilt_sigma_deg",
            "Known to",
            fit.tilt_sigma_deg,
            shown=f"± {significant(fit.tilt_sigma_deg)}° in direction, "
            f"± {significant(fit.offset_sigma_mm)} mm in the middle",
        ),
        Quantity("offset_sigma_mm", "", fit.offset_sigma_mm),
        Quantity(
            "rms_mm",
            "Residual",
            stored.rms_mm,
            shown=f"{significant(stored.rms_mm)} mm rms, {significant(known.rms_px)} px rms",
        ),
        Quantity("rms_px", "", known.rms_px),
        *_point_quantities(fit),
        Quantity("depth_min_mm", "Depth covered", low, shown=f"Z {low:.1f} to {high:.1f} mm"),
        Quantity("depth_max_mm", "", high),
        Quantity(
            "n_boards",
            "Rests on",
            stored.n_boards,
            shown=f"{stored.n_boards} boards, at most {known.board_angle_deg:.0f}° apart, "
            f"{stored.n_points} points",
        ),
        Quantity("n_points", "", stored.n_points),
        Quantity(
            "is_redundant",
            "Checked by other boards",
            stored.is_redundant,
            shown="yes" if stored.is_redundant else alone,
        ),
        fact(
            "Stripes miss a common plane by",
            f"{significant(known.coplanarity_mm)} mm, expected "
            f"{significant(known.coplanarity_sigma_mm)} mm",
        ),
        Quantity(
            "bow_mm",
            "Bow (u along the stripe, v in depth)",
            sheet.bow_mm.tolist(),
            shown=bow,
        ),
        *([_light_source(fit)] if sheet.fan.any() else []),
        fact("Plane or bow, and why", sentence(known.bow_decision)),
        fact("Lack of fit of a plane", lack_of_fit_text(known.plane_test)),
        Quantity(
            "lack_of_fit_p",
            "Lack of fit of the sheet"
            if fit.is_bow_free
            else "Lack of fit, boards as they scatter",
            known.final_test.p_value,
            shown=lack_of_fit_text(known.final_test),
        ),
    )


def _largest_bow_mm(calibrated: SheetCalibration) -> float:
    """Within the depths that were calibrated."""
    sheet = calibrated.sheet
    u, v = np.meshgrid(*2 * (np.linspace(-1.0, 1.0, 81),))
    places = np.stack([u, v, np.zeros_like(u)], axis=-1) * sheet.scale_mm
    depth = (places @ sheet.axes + sheet.origin_mm)[..., 2]
    low, high = calibrated.depth_range_mm
    is_inside = (depth >= low) & (depth <= high)
    u, v = u[is_inside], v[is_inside]
    terms = zip(sheet.bow_mm, BOW_TERMS, strict=True)
    return float(np.abs(sum(bow * u**i * v**j for bow, (i, j) in terms)).max(initial=0.0))


def _light_source(fit: SheetFit) -> Quantity:
    lean, spread = fit.sheet.fan.tolist()
    along = math.hypot(1.0, lean)
    distance_mm = fit.sheet.scale_mm * along / spread if spread > 0.0 else 0.0
    where = f"about {distance_mm:.0f} mm before the middle" if spread > 0.0 else "far away"
    lean_deg = math.degrees(math.atan(abs(lean)))
    return fact("The bow's light comes from", f"{where}, {lean_deg:.0f} degrees aside of the depth")


def _point_quantities(fit: SheetFit) -> list[Quantity]:
    """The points that the stored calibration makes of its own stripes."""
    points, made = fit.points, fit.points.fitted
    data: dict[str, Any] = {
        **asdict(made),
        "left_out_rms_mm": points.left_out_rms_mm,
        "left_out_claimed_mm": points.left_out_claimed_mm,
        "boards": [asdict(board) for board in points.boards],
    }
    text = (
        f"mean {significant(made.mean_mm)} mm (known to ± {significant(made.sigma_mean_mm)}), "
        f"rms {significant(made.rms_mm)} mm, claimed {significant(made.claimed_rms_mm)}"
    )
    told = [Quantity("points_off_boards", "Its points off their boards", data, shown=text)]
    if math.isfinite(points.left_out_rms_mm):
        rms, claimed = significant(points.left_out_rms_mm), significant(points.left_out_claimed_mm)
        told.append(fact("The same, each board left out", f"rms {rms} mm, claimed {claimed}"))
    return told


def lack_of_fit_text(test: FTest) -> str:
    """A lack-of-fit test in words."""
    if test.degrees_of_freedom == 0 or not math.isfinite(test.p_value):
        return "nothing is redundant, so nothing can be tested"
    if test.p_value < LACK_OF_FIT_P:
        verdict = "the model does not explain the stripes"
    else:
        verdict = "weak objection" if test.p_value < WEAK_P else "no objection"
    return f"F = {test.f_ratio:.2f}, {p_text(test.p_value)}: {verdict}"


def sheet_warnings(fit: LaserFit) -> tuple[str, ...]:
    """Warnings of the whole and of each sheet."""
    of_sheets = (f"sheet {one.name}: {text}" for one in fit.sheets for text in one.warnings)
    return (*fit.warnings, *of_sheets)


def laser_page(
    fit: LaserFit,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report; ``exposures`` by source name, those that are missing are not shown."""
    along = tuple(_residuals_along(fit, index) for index in range(len(fit.sheets)))
    fits = (Gallery(along, 560), Gallery((_residual_histogram(fit),), 420))
    sections = [
        _sheets_section(fit),
        Section("Points made with this calibration", (Text(POINTS_TEXT), _points_table(fit))),
        _images_section(fit, exposures),
        Section("How well it fits", fits),
        Section("The boards", (Gallery(_board_pictures(fit, exposures), 300),), is_folded=True),
    ]
    if fit.skipped:
        reasons = [(item.source, item.reason) for item in fit.skipped]
        sections.append(nothing_found_section("Images that gave nothing", reasons, exposures))
    sections.append(_methods_section(fit))
    n = len(fit.sheets)
    return page_of(
        provenance,
        TITLE if n == 1 else "Light sheets calibration",
        f"{plural(n, 'light sheet')} from {len(fit.images)} stripe images",
        sections,
        cards=[_card(sheet) for sheet in fit.sheets],
        warnings=sheet_warnings(fit),
        is_simulated=is_simulated,
    )


def _card(fit: SheetFit) -> Quantity:
    low, high = fit.calibration.depth_range_mm
    plane = "plane with a likely bow" if fit.sheet.is_bowed else "plane"
    return fact(
        f"Sheet {fit.name}",
        f"{significant(fit.points.fitted.rms_mm)} mm rms off the boards",
        f"{fit.calibration.n_boards} boards, Z {low:.0f} to {high:.0f} mm, "
        f"{'bowed' if fit.is_bow_free else plane}",
    )


def _sheets_section(fit: LaserFit) -> Section:
    named = f"Named: {fit.diagnostics.naming}."
    if fit.channel_reason:
        named += f" Stripes in {fit.channel_reason}."
    if fit.print_reason:
        named += f" {sentence(fit.print_reason)}"
    blocks: list[Block] = [
        Facts(for_people(sheet_quantities(sheet)), f"Sheet {sheet.name}") for sheet in fit.sheets
    ]
    if bow := bow_quantities(fit.board_bow_mm):
        blocks.append(Facts(bow, "The board"))
    return Section("The sheets", (*blocks, Text(named), Gallery((_scene(fit),), 560)))


def _points_table(fit: LaserFit) -> Table:
    rows = []
    for sheet in fit.sheets:
        for board in sheet.points.boards:
            cells = []
            for made in (board.fitted, board.left_out):
                cells += ["", ""] if made is None else [
                    with_sigma(made.mean_mm, made.sigma_mean_mm),
                    f"{significant(made.rms_mm)} / {significant(made.claimed_rms_mm)}",
                ]  # fmt: skip
            name = f"{sheet.name}, {board.source}"
            rows.append((name, f"{board.depth_mm:.1f}", str(board.fitted.n_points), *cells))
    return Table(POINT_HEADS, tuple(rows), "Points against their boards", (1, 2, 3, 4, 5, 6))


def _images_section(fit: LaserFit, exposures: Mapping[str, Exposure]) -> Section:
    uses = [use for use in PointUse if any(image.count(use) for image in fit.images)]
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
    rows = tuple(
        (
            image.source,
            *(str(image.count(use)) for use in uses),
            f"{image.pose_shift_sigma:.1f} sigma",
        )
        for image in fit.images
    )
    text = Text(
        "Every stripe point, used or not. The white outline is the region of the board's points. "
        "Dark photographs are brightened here. Click a picture to enlarge it. "
        f"{len(shown)} of {len(fit.images)} images are shown."
    )
    legend = stripe_legend(
        fit.sheet_names,
        [(USE_COLOURS[use], use.label) for use in uses if use in USE_COLOURS],
        flags_of((image.profile, image.use) for image in fit.images),
    )
    table = Table(("image", *(use.label for use in uses), "board moved by"), rows)
    return Section("The stripes", (text, legend, Gallery(pictures, 420), table))


def _caption(image: SheetImage) -> str:
    used = image.count(PointUse.USED)
    board = "" if image.view.source == image.source else f"; board from {image.view.source}"
    return f"{used} of {len(image.profile)} points used{board}"


def _board_pictures(fit: LaserFit, exposures: Mapping[str, Exposure]) -> tuple[Picture, ...]:
    views = [image.view for image in fit.images if image.view.source in exposures]
    return tuple(
        Picture(
            photo_markup(
                exposures[view.source],
                target_marks(view.points_px),
                f"Target points in {view.source}",
                longest_px=700,
                is_grey=True,
            ),
            title=view.source,
            caption=f"{len(view)} target points; the filled ring is the board's first point",
        )
        for view in evenly_chosen(views)
    )


def _methods_section(fit: LaserFit) -> Section:
    rows = tuple(
        (sheet.name, item.method, f"{item.angle_deg:.3f}°", f"{significant(item.largest_mm)} mm")
        for sheet in fit.sheets
        for item in sheet.comparisons
    )
    table = Table(("sheet", "method", "angle to ours", "largest distance"), rows, "", (1,))
    text = Text(
        "Planes that simpler methods give from the same points, against the sheet in use, over "
        "the calibrated region. The algebraic one is the thesis's eq. 2.44."
    )
    return Section("Against simpler methods", (text, table), is_folded=True)


def _residuals_along(fit: LaserFit, index: int) -> Picture:
    """Distance from the sheet along the stripe, one panel a board."""
    images = [image for image in fit.images if _used(image, index).any()]
    sheet = fit.sheets[index].sheet
    n = min(len(images), MAX_PANELS)
    columns = min(n, 3)
    rows = math.ceil(n / columns)
    reach = 1.15 * max(
        float(np.percentile(np.abs(image.residual_mm[_used(image, index)]), 98)) for image in images
    )
    beyond = sum(
        int((np.abs(image.residual_mm[_used(image, index)]) > reach).sum()) for image in images[:n]
    )
    with styled():
        height = 1.9 * rows + 0.5
        figure = new_figure(PAGE_WIDTH, height, layout=None)
        margins = _margins(PAGE_WIDTH, height)
        grid: Any = figure.subplots(
            rows, columns, sharex=True, sharey=True, squeeze=False, gridspec_kw=margins
        )
        for axes, image in zip(grid.flat, images[:n], strict=False):
            chosen = _used(image, index)
            along = (image.points_mm[chosen] - sheet.origin_mm) @ sheet.axes[0]
            _residual_panel(axes, along, image.residual_mm[chosen])
            axes.set_title(short(image.source), loc="left", fontsize=8)
            axes.set_ylim(-reach, reach)
        for axes in list(grid.flat)[n:]:
            axes.set_axis_off()
        for axes in list(grid.flat)[n - columns : n]:
            axes.tick_params(labelbottom=True)
        figure.supxlabel("along the stripe, mm", fontsize=9, color=MUTED)
        figure.supylabel("off the sheet, mm", fontsize=9, color=MUTED)
    more = f" Beyond the pictures: {plural(beyond, 'point')}." if beyond else ""
    more += f" {len(images) - n} more boards are not shown." if len(images) > n else ""
    return Picture(
        raster_markup(figure, "Residuals along the stripe"),
        title=f"Sheet {fit.sheets[index].name}: residuals along the stripe",
        caption="Dots are stripe points, the line their running mean, the boards as measured. "
        "A line that leans means that the board's pose is off, within its uncertainty; the same "
        "bend on every board means that the sheet itself is bent." + more,
    )


def _margins(width: float, height: float) -> dict[str, float]:
    """Room for the names of axes and panels, in parts of a figure of such inches."""
    return {
        "left": 0.95 / width,
        "right": 1.0 - 0.1 / width,
        "bottom": 0.65 / height,
        "top": 1.0 - 0.25 / height,
        "wspace": 0.06,
        "hspace": 0.25,
    }


def _residual_panel(axes: Any, along: FloatArray, residual: FloatArray) -> None:
    axes.axhline(0.0, color=LINE, linewidth=0.8)
    axes.plot(along, residual, ".", color=ACCENT, markersize=1.6, alpha=0.45)
    edges = np.linspace(along.min(), along.max() + 1e-9, BINS_ALONG + 1)
    cell = np.digitize(along, edges) - 1
    filled = [k for k in range(BINS_ALONG) if (cell == k).any()]
    middle = [float(along[cell == k].mean()) for k in filled]
    mean = [float(residual[cell == k].mean()) for k in filled]
    axes.plot(middle, mean, color=ALERT, linewidth=1.2)


def _residual_histogram(fit: LaserFit) -> Picture:
    """Residuals across the stripe in the image, all sheets."""
    known = fit.diagnostics
    used = [(image, image.use == int(PointUse.USED)) for image in fit.images]
    measured = np.concatenate([image.residual_px[chosen] for image, chosen in used])
    moved = np.concatenate([image.remaining_px[chosen] for image, chosen in used])
    return histogram_chart(
        [
            Bars(measured, LINE, "boards as measured"),
            Bars(moved, ACCENT, "boards moved within their uncertainty", is_outline=True),
        ],
        symmetric_edges(measured),
        "off the sheet, across the stripe, px",
        title="Distribution of residuals",
        caption=f"Stripe points scatter {known.noise_factor:.2f} times as much as their sigmas "
        f"say; about {known.correlation_points:.0f} points along a stripe count as one.",
    )


def _scene(fit: LaserFit) -> Picture:
    """Camera, boards, stripes and sheets in space."""
    lines = [SceneLines(_camera_edges(fit), INK)]
    lines += [SceneLines(_board_edges(image), "#b4bec8") for image in fit.images]
    dots = []
    labels: list[tuple[str, tuple[float, float, float]]] = [("camera", (0.0, 0.0, 0.0))]
    for index, sheet in enumerate(fit.sheets):
        colour = PALETTE[index % len(PALETTE)]
        points = np.concatenate([image.points_mm[_used(image, index)] for image in fit.images])
        dots.append(uniform_dots(points[:: max(1, len(points) // MAX_DOTS)], colour))
        edges = _sheet_edges(sheet, points)
        lines.append(SceneLines(edges, colour))
        x, y, z = edges[0].tolist()
        labels.append((f"sheet {sheet.name}", (x, y, z)))
    return Picture(
        scene_markup(dots, lines, labels, "Camera, boards and light sheets in space"),
        title="In space (Sensor frame)",
        caption="The pyramid is the camera and what it sees, grey outlines are the boards, dots "
        "the stripes on them, coloured outlines the calibrated part of each sheet.",
    )


def _used(image: SheetImage, index: int) -> BoolArray:
    return np.asarray((image.use == int(PointUse.USED)) & (image.sheet == index))


def _board_edges(image: SheetImage) -> FloatArray:
    board = image.view.points_board_mm
    (x0, y0, _), (x1, y1, _) = board.min(axis=0), board.max(axis=0)
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    pose = image.sensor_from_board
    return closed_outline(corners @ pose.rotation.T + pose.translation_mm)


def _sheet_edges(fit: SheetFit, points: FloatArray) -> FloatArray:
    sheet = fit.sheet
    local = (points - sheet.origin_mm) @ sheet.axes.T
    (u0, v0), (u1, v1) = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    return closed_outline(sheet.origin_mm + corners @ sheet.axes[:2])


def _camera_edges(fit: LaserFit) -> FloatArray:
    camera = fit.camera.camera
    depth = 0.25 * min(sheet.calibration.depth_range_mm[0] for sheet in fit.sheets)
    corners = np.array(
        [[0, 0], [camera.width_px, 0], [camera.width_px, camera.height_px], [0, camera.height_px]]
    )
    centre, focal = [camera.cx_px, camera.cy_px], [camera.fx_px, camera.fy_px]
    return pyramid(np.column_stack([(corners - centre) / focal * depth, np.full(4, depth)]))
