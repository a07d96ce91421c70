# SPDX-License-Identifier: Apache-2.0
"""Page of a hand-eye calibration before a flat target, and what is told of the target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.board_result import BoardHandEyeFit, BoardPosture
from armscan.models.calibration import ScannerCalibration
from armscan.records.exposure import Exposure
from armscan.report.charts import PAGE_WIDTH, magnification, named_columns
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    MUTED,
    SceneDots,
    SceneLines,
    chart_markup,
    closed_outline,
    held_sensors,
    new_figure,
    photo_markup,
    ramp_colours,
    ramp_markup,
    scene_markup,
    styled,
)
from armscan.report.hand_eye import (
    FRUSTUM_SHARE,
    TITLE,
    correlations,
    hand_eye_quantities,
    left_out_bars,
    noise_facts,
    sigma_cards,
)
from armscan.report.page import Facts, Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.photographs import (
    ARROW_COLOUR,
    TARGET_COLOUR,
    evenly_chosen,
    nothing_found_section,
    target_marks,
)
from armscan.report.quantity import (
    Quantity,
    Table,
    fact,
    for_people,
    only,
    significant,
    with_sigma,
)
from armscan.vision.targets.target import Target, describe_target

NOISE_TEXT = (
    "The reported pose of a posture is off by a shift, a turn about the origin of Tool and a turn "
    "about the middle of the target's places, the scan point. The target's pose in a view has the "
    "covariance of its points and of the camera. Whatever the poses do not agree about beyond that "
    "counts as scatter of the arm: a target or a base that moved as well."
)


def board_quantities(fit: BoardHandEyeFit) -> tuple[Quantity, ...]:
    """What is told of the target: how far the views miss it, where it lay, and its size."""
    x, y, z = fit.base_from_board.translation_mm
    sigma = np.sqrt(np.diag(fit.board_covariance)[3:])
    place = zip("XYZ", (x, y, z), sigma, strict=True)
    return (
        Quantity(
            "rms_px",
            "Points in the image",
            fit.rms_px,
            unit="px rms",
            meaning="off where arm, hand-eye and target put them",
        ),
        Quantity(
            "target_origin_base_mm",
            "Target's first point in Base",
            [float(x), float(y), float(z)],
            shown=", ".join(f"{name} {with_sigma(v, s, 'mm')}" for name, v, s in place),
        ),
        Quantity(
            "target_scale",
            "Target's size, as the arm asks for",
            fit.asked.scale,
            fit.asked.sigma,
            meaning="times the stated one",
        ),
        Quantity("target_scale_sigma", "", fit.asked.sigma),
        Quantity("n_not_used", "Views not used", len(fit.not_used)),
    )


def look_table(fit: BoardHandEyeFit) -> Table:
    """One line a look at the target."""
    columns = (
        "image", "points", "off px", "off mm", "turned °", "tilt °", "stand-off mm",
        "without it °", "without it mm", "left-out misclosure / sigma",
    )  # fmt: skip
    rows = tuple(
        (
            item.source,
            str(item.n_points),
            significant(item.rms_px, digits=2),
            significant(item.shift_mm, digits=2),
            significant(item.turn_deg, digits=2),
            f"{item.tilt_deg:.0f}",
            f"{item.stand_off_mm:.0f}",
            significant(item.left_out_rotation_deg, digits=2),
            significant(item.left_out_translation_mm, digits=2),
            f"{item.left_out_normalised:.2f}",
        )
        for item in fit.postures
    )
    return Table(columns, rows)


def board_hand_eye_page(
    fit: BoardHandEyeFit,
    scanner: ScannerCalibration,
    target: Target,
    exposures: Mapping[str, Exposure],
    *,
    is_simulated: bool,
) -> Page:
    """Lay out the report; ``exposures`` by source name, those that are missing are not shown."""
    told = hand_eye_quantities(scanner)
    people, of_target = for_people(told), for_people(board_quantities(fit))
    facts = (fact("Target", describe_target(target)), *of_target)
    result = Section(
        "The hand-eye",
        (
            Facts(people[:3]),
            Facts(people[3:]),
            Facts(facts, "The target"),
            Gallery((correlations(scanner),)),
        ),
    )
    sections = [
        result,
        Section("The postures", (Gallery((_scene(fit),), 560),)),
        Section(
            "How well it fits",
            (Gallery((_misclosures(fit), left_out_bars(fit.postures, scanner)), 700),),
        ),
        Section("View by view", (look_table(fit),)),
        Section("The noise model", (Text(NOISE_TEXT), Facts(noise_facts(fit.calibration)))),
        _photographs(fit, exposures),
    ]
    if fit.not_used:
        sections.append(nothing_found_section("Views not used", fit.not_used, exposures))
    return page_of(
        scanner.provenance,
        TITLE,
        f"Where the camera sits on the arm, from {len(fit.looks)} views of a target at rest",
        sections,
        cards=(
            *sigma_cards(scanner),
            *(replace(one, meaning="an axis") for one in only(told, "arm_position_mm")),
            *(item for item in told if item.label in ("Residual", "Condition")),
            *only(of_target, "rms_px"),
        ),
        warnings=fit.warnings,
        is_simulated=is_simulated,
    )


def _misclosures(fit: BoardHandEyeFit) -> Picture:
    """By what each view's target is off the mean one."""
    names = [posture.source for posture in fit.postures]
    shift_mm, at_scan_point, at_tool = np.sqrt(fit.calibration.arm_noise.variances).tolist()
    reach_mm = [
        np.linalg.norm(fit.base_from_board.translation_mm - look.base_from_tool.translation_mm)
        for look in fit.looks
    ]
    moved_mm = np.sqrt(3.0 * shift_mm**2 + 2.0 * (at_tool * np.array(reach_mm)) ** 2)
    turned_deg = float(np.degrees(np.sqrt(3.0) * np.hypot(at_scan_point, at_tool)))
    series = (
        ("off in the image, px", None, [item.rms_px for item in fit.postures]),
        ("middle off its place, mm", moved_mm, [item.shift_mm for item in fit.postures]),
        ("turned off, °", np.full(len(names), turned_deg), [p.turn_deg for p in fit.postures]),
    )
    with styled():
        figure = new_figure(PAGE_WIDTH, 2.9)
        grid = figure.subplots(1, 3)
        for axes, (label, expected, heights) in zip(grid, series, strict=True):
            axes.bar(range(len(names)), heights, 0.6, color=ACCENT)
            if expected is not None:
                axes.plot(range(len(names)), expected, "_", color=ALERT, markersize=9)
            axes.set_title(label, loc="left", fontsize=8.5)
            named_columns(axes, names)
    return Picture(
        chart_markup(figure, "Misclosure of each view"),
        title="What each view is off",
        caption="Each bar is the target as one view and the arm's pose have it, beside the mean of "
        "all. The strokes are what the arm's scatter alone makes of it, root mean square.",
    )


def _scene(fit: BoardHandEyeFit) -> Picture:
    """Camera pyramids of all postures over the target, its points coloured by what they are off."""
    hand_eye = fit.calibration.tool_from_sensor
    placed, off = [], []
    for look, pose in zip(fit.looks, fit.chosen, strict=True):
        points = pose.view.points_board_mm
        in_sensor = pose.sensor_from_board.apply(points)
        placed.append((look.base_from_tool @ hand_eye).apply(in_sensor))
        off.append(np.linalg.norm(placed[-1] - fit.base_from_board.apply(points), axis=1))
    values = np.concatenate(off)
    reach = max(float(np.percentile(values, 98)), 1e-3)
    dots = SceneDots(np.concatenate(placed), ramp_colours(values, 0.0, reach))
    lines, labels = held_sensors(
        {
            item.source: (look.base_from_tool @ hand_eye, FRUSTUM_SHARE * item.stand_off_mm)
            for look, item in zip(fit.looks, fit.postures, strict=True)
        }
    )
    corners = np.concatenate([pose.view.points_board_mm for pose in fit.chosen])
    (left, low, _), (right, high, _) = corners.min(axis=0), corners.max(axis=0)
    outline = np.array([[left, low, 0], [right, low, 0], [right, high, 0], [left, high, 0]])
    lines.append(SceneLines(closed_outline(fit.base_from_board.apply(outline)), MUTED))
    return Picture(
        ramp_markup("off 0", f"{significant(reach, digits=2)} mm")
        + scene_markup([dots], lines, labels, "Postures of the camera at the target", is_z_up=True),
        title="Postures and target (Base frame)",
        caption="Each pyramid is the camera as the arm held it, with its axes X (orange), Y "
        "(green) and Z (blue, the view); the dots are the target's points as each view places "
        "them, coloured by their distance from the mean target, whose outline is drawn.",
    )


def _photographs(fit: BoardHandEyeFit, exposures: Mapping[str, Exposure]) -> Section:
    shown = evenly_chosen(
        [k for k, posture in enumerate(fit.postures) if posture.source in exposures]
    )
    scale = magnification(fit.camera, fit.rms_px)
    pictures = tuple(_photograph(fit, k, exposures[fit.postures[k].source], scale) for k in shown)
    text = (
        "Arrows lead from where arm, hand-eye and mean target put a point to where it was found, "
        f"{scale:g} times enlarged: the same for all of a view is a shift of the arm."
    )
    legend = Legend(
        ((TARGET_COLOUR, "target point, the filled one is the first"), (ARROW_COLOUR, "misclosure"))
    )
    return Section("The photographs", (Text(text), legend, Gallery(pictures, 420)))


def _photograph(fit: BoardHandEyeFit, k: int, exposure: Exposure, scale: float) -> Picture:
    posture: BoardPosture = fit.postures[k]
    view = fit.chosen[k].view
    marks = target_marks(view.points_px, arrows_px=scale * fit.misclosures_px[k])
    return Picture(
        photo_markup(exposure, marks, f"Target points found in {posture.source}"),
        title=posture.source,
        caption=f"{posture.n_points} points, off by {significant(posture.rms_px, digits=2)} px "
        f"rms, {significant(posture.shift_mm, digits=2)} mm and "
        f"{significant(posture.turn_deg, digits=2)}°",
    )
