# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration of light sheets."""

from __future__ import annotations

import math
from collections.abc import Mapping

from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.result import (
    LackOfFit,
    LaserFit,
    PointUse,
    SheetFit,
    SheetImage,
    SheetPointCheck,
)
from armscan.models.calibration import Provenance
from armscan.models.light_sheet import BOW_TERMS
from armscan.records.exposure import Exposure
from armscan.report import laser_figures as figures
from armscan.report.drawing import Marks, photo_markup
from armscan.report.numbers import sentence, significant, with_sigma, without_source
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Facts, Gallery, Legend, Page, Picture, Section, Text
from armscan.report.stripe_figures import evenly_chosen, stripe_legend, stripe_picture
from armscan.report.summary import Table

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
    text = f"Named: {fit.naming}."
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
        ("Residual", f"{significant(calibration.rms_mm)} mm rms, {significant(fit.rms_px)} px rms"),
        *point_facts(fit.points),
        ("Depth covered", f"Z {low:.1f} to {high:.1f} mm"),
        (
            "Rests on",
            f"{calibration.n_boards} boards, at most {fit.board_angle_deg:.0f}° apart, "
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
            f"{significant(fit.coplanarity_mm)} mm, expected "
            f"{significant(fit.coplanarity_sigma_mm)} mm",
        ),
        ("Bow (u along the stripe, v in depth)", bow if fit.sheet.is_bowed else "none: a plane"),
        *(
            (("The bow's light comes from", f"about {_source_mm(fit):.0f} mm before the middle"),)
            if fit.sheet.fan.any()
            else ()
        ),
        ("Plane or bow, and why", sentence(fit.bow_decision)),
        ("Lack of fit of a plane", lack_of_fit_text(fit.plane_test)),
        ("Lack of fit of the sheet", lack_of_fit_text(fit.final_test)),
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


def lack_of_fit_text(test: LackOfFit) -> str:
    """A lack-of-fit test in words."""
    if test.degrees_of_freedom == 0 or not math.isfinite(test.p_value):
        return "nothing is redundant, so nothing can be tested"
    if test.p_value < SheetOptions().lack_of_fit_p:
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
    blocks += [Text(named_and_found(fit)), Gallery((figures.scene(fit),), 560)]
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
    along = tuple(figures.residuals_along(fit, index) for index in range(len(fit.sheets)))
    return Section(
        "How well it fits", (Gallery(along, 560), Gallery((figures.residual_histogram(fit),), 420))
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
