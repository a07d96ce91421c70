# SPDX-License-Identifier: Apache-2.0
"""The page of a demo: figures beside the truth and beside the thesis, with pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.inspection.results import Deviations, PointCounts, StepInspection
from armscan.pipeline.head_demo import HeadDemo
from armscan.pipeline.scan import ScanReconstruction
from armscan.pipeline.truth import NamingErrors, SheetErrors
from armscan.reconstruction.labels import PointStatus
from armscan.records.exposure import Exposure
from armscan.report import cloud as cloud_figures
from armscan.report import hand_eye as hand_eye_charts
from armscan.report.drawing import Marks, photo_markup
from armscan.report.hand_eye import (
    hand_eye_numbers,
    hand_eye_quantities,
    posture_scene,
    posture_table,
    total_covariance,
)
from armscan.report.inspect import deviation_histogram, deviation_view, height_histogram, share_text
from armscan.report.page import Facts, Gallery, Page, Picture, Section, Text
from armscan.report.photographs import sheet_colour
from armscan.report.quantity import Quantity, Table, fact, for_people, sentence, significant

FRACTION_RULE = (
    "rms and shares count every measured point of the feature (up to 1 mm from it), those that its "
    "fit left out included; points further away are counted beside them: they lie on what stands "
    "around, or are wrong"
)


def demo_data(
    demo: HeadDemo, *, head: str, seed: int, preset: str, seconds: Mapping[str, float]
) -> dict[str, Any]:
    """All figures; fractions are 0 to 1, lengths in mm, angles in degrees."""
    return {
        "kind": "demo",
        "simulated": True,
        "seed": seed,
        "preset": preset,
        "rule": FRACTION_RULE,
        "heads": {head: {**head_data(demo), "seconds": dict(seconds)}},
    }


def head_data(demo: HeadDemo) -> dict[str, Any]:
    """The figures of one head."""
    scanner = demo.instrument.scanner
    variance = np.diag(total_covariance(scanner))
    errors = demo.errors.hand_eye
    scans = [demo.scans[scene] for scene in ("plate", "ball", "part")]
    sheets = demo.instrument.sensor.sheets
    return {
        "camera": [{"rms_px": camera.rms_px} for camera in demo.instrument.cameras],
        "sheets": [{"name": sheet.name, "rms_mm": sheet.rms_mm} for sheet in sheets],
        "hand_eye": {
            "rotation_error_deg": errors.rotation_deg,
            "translation_error_mm": errors.translation_mm,
            "sigma_rotation_deg": float(np.degrees(np.sqrt(variance[:3].sum()))),
            "sigma_translation_mm": float(np.sqrt(variance[3:].sum())),
            "normalised_error": errors.normalised,
        },
        "plate": {
            **_counts(demo.plate.counts),
            **_shares(demo.plate.fitted, (0.03, 0.05, 0.08)),
            "std_mm": demo.plate.fitted.value("std_mm"),
            "reference": demo.plate.fitted.reference,
        },
        "sphere": {
            **_counts(demo.ball.counts),
            **_shares(demo.ball.nominal, (0.03, 0.05, 0.08)),
            "diameter_mm": demo.ball.diameter.value_mm,
            "diameter_error_mm": demo.ball.diameter.value_mm - demo.ball.nominal_diameter_mm,
            "diameter_sigma_mm": demo.ball.diameter.sigma_mm,
            "reference": demo.ball.nominal.reference,
        },
        "steps": [
            *(_step(step, "Base") for step in demo.steps),
            _step(demo.still_step, "Sensor"),
        ],
        "part": {
            "n_points": len(demo.part.distance_mm),
            "n_measured": len(demo.part.distance_mm) + demo.part.n_elsewhere,
            "n_beyond_1mm": demo.part.n_elsewhere,
            "rms_mm": demo.part.rms_mm,
            "fraction_within_0p05mm": demo.part.fraction_within(0.05),
            "normalised_rms": demo.part.normalised_rms,
        },
        "named_stripes_per_exposure": float(np.mean([stripes for stripes, _ in instants(scans)])),
        "points_per_exposure": float(np.mean([points for _, points in instants(scans)])),
        "naming": {scene: naming_data(found) for scene, found in demo.naming.items()},
    }


def instants(scans: Sequence[ScanReconstruction]) -> list[tuple[int, int]]:
    """Light sheets that gave a measured point, and measured points, of every instant.

    What two cameras saw at one instant counts once.
    """
    found: dict[tuple[int, int], tuple[set[int], int]] = {}
    for number, scan in enumerate(scans):
        for row, image in zip(scan.image_rows, scan.images, strict=True):
            key = (number, scan.exposures[row].row.t_ns)
            sheets, count = found.get(key, (set(), 0))
            measured = image.fate == int(PointStatus.MEASURED)
            sheets = sheets | set(image.sheet[measured].tolist())
            found[key] = (sheets, count + int(measured.sum()))
    return [(len(sheets), count) for sheets, count in found.values()]


def naming_data(found: NamingErrors) -> dict[str, Any]:
    """Names against the truth: counts over the instants that were checked."""
    return {**asdict(found), "wrong_share": found.wrong_share, "named_share": found.named_share}


def fraction_within(values_mm: FloatArray, limit_mm: float) -> float:
    """Share of values whose size is at most a limit."""
    return float(np.mean(np.abs(values_mm) <= limit_mm))


def _shares(deviations: Deviations, limits_mm: Sequence[float]) -> dict[str, Any]:
    values = deviations.deviations_mm
    return {
        f"fraction_within_{limit:g}mm".replace(".", "p"): fraction_within(values, limit)
        for limit in limits_mm
    }


def _counts(counts: PointCounts) -> dict[str, int]:
    """Points of the feature, of the cloud, and those further from the feature than 1 mm."""
    return {
        "n_points": counts.n_feature,
        "n_measured": counts.n_region,
        "n_beyond_1mm": counts.n_region - counts.n_feature,
    }


def _step(step: StepInspection, frame: str) -> dict[str, Any]:
    return {
        "nominal_mm": step.nominal_height_mm,
        "mean_mm": float(step.heights_mm.mean()),
        "std_mm": float(step.heights_mm.std(ddof=1)),
        "fitted_mm": step.height.value_mm,
        "fitted_sigma_mm": step.height.sigma_mm,
        "n_points": step.counts.n_feature,
        "n_measured": step.counts.n_region,
        "frame": frame,
    }


NOT_PRINTED = "–"


@dataclass(frozen=True, slots=True)
class ThesisFigures:
    """What the thesis printed of one of its heads, measured on a real instrument.

    Parameters
    ----------
    plate, plate_limit_mm
        Share of the plate's points within a limit, and the limit.
    ball_diameter, ball_within
        Of its ball of 34.96 mm.
    step_mm, step
        Nominal height of its gauge block, and what it measured in one exposure.
    hand_eye_rotation, hand_eye_translation
        Spread of five calibrations.
    """

    plate: str
    plate_limit_mm: float
    step_mm: float
    step: str
    ball_diameter: str = NOT_PRINTED
    ball_within: str = NOT_PRINTED
    hand_eye_rotation: str = NOT_PRINTED
    hand_eye_translation: str = NOT_PRINTED


THESIS: Mapping[str, ThesisFigures] = {
    "thesis-single": ThesisFigures(
        "97.9 % of 83,210 points",
        0.05,
        20.0,
        "19.989 ± 0.006 mm (its cross-line head)",
        "34.94 mm, 0.02 mm off",
        "95.54 % of 179,427 points",
        "0.053°, 0.048°, 0.024° (spread of five)",
        "0.068, 0.027, 0.060 mm (spread of five)",
    ),
    "thesis-cross": ThesisFigures("96 %", 0.05, 20.0, "19.989 ± 0.006 mm"),
    "thesis-multi": ThesisFigures("95.1 % (five lines)", 0.08, 5.0, "5.002 ± 0.02 mm (five lines)"),
}
"""Sections 5.1.3, 5.1.4, 5.2.2, 5.2.4, 5.3.3 and 5.3.5."""


def comparison_table(head: Mapping[str, Any], name: str) -> Table:
    """The thesis's figures of the same head, measured, beside ours, simulated."""
    plate, ball, thesis = head["plate"], head["sphere"], THESIS[name]
    limit = thesis.plate_limit_mm
    rows = [
        (
            f"Plate: within {limit:g} mm",
            thesis.plate,
            f"{_within(plate, limit)} of {points_text(plate)} ({plate['reference']} plane)",
        ),
        (
            "Ball of 34.96 mm: diameter",
            thesis.ball_diameter,
            f"{ball['diameter_mm']:.4f} mm, {ball['diameter_error_mm']:+.4f} mm off",
        ),
        (
            "Ball: within 0.05 mm",
            thesis.ball_within,
            f"{_within(ball, 0.05)} of {points_text(ball)} ({ball['reference']} radius)",
        ),
    ]
    for step in head["steps"]:
        is_still = step["frame"] == "Sensor"
        how = "one exposure at rest" if is_still else "through the arm"
        is_thesis = is_still and round(step["nominal_mm"]) == round(thesis.step_mm)
        rows.append(
            (
                f"Step of {step['nominal_mm']:g} mm, {how}",
                thesis.step if is_thesis else NOT_PRINTED,
                f"{step['mean_mm']:.4f} ± {step['std_mm']:.4f} mm ({points_text(step)})",
            )
        )
    hand_eye = head["hand_eye"]
    rows += [
        (
            "Hand-eye, rotation",
            thesis.hand_eye_rotation,
            f"{significant(hand_eye['rotation_error_deg'], digits=2)}° from the truth, expected "
            f"{significant(hand_eye['sigma_rotation_deg'], digits=2)}°",
        ),
        (
            "Hand-eye, translation",
            thesis.hand_eye_translation,
            f"{significant(hand_eye['translation_error_mm'], 'mm', 2)} from the truth, expected "
            f"{significant(hand_eye['sigma_translation_mm'], 'mm', 2)}",
        ),
    ]
    return Table(("", "thesis (real)", "ours (simulated)"), tuple(rows), "", (1, 2))


def truth_table(demo: HeadDemo, head: Mapping[str, Any]) -> Table:
    """Errors of the calibrations and of the part, also in their own sigmas."""
    errors, part = demo.errors, demo.part
    sides = ("",) if len(errors.cameras) == 1 else (", left", ", right")
    rows = [
        (
            f"Focal length{side}",
            f"{camera.focal_px:+.3f} px, sigma {camera.focal_sigma_px:.3f}",
            _sigmas(camera.normalised, camera.n_parameters),
        )
        for side, camera in zip(sides, errors.cameras, strict=True)
    ]
    rows += [
        _sheet_row(f"Light sheet {calibration.name}", sheet)
        for calibration, sheet in zip(demo.instrument.sensor.sheets, errors.sheets, strict=True)
    ]
    rows += [
        (
            "Hand-eye",
            f"{significant(errors.hand_eye.rotation_deg, digits=2)}°, "
            f"{significant(errors.hand_eye.translation_mm, 'mm', 2)}",
            _sigmas(errors.hand_eye.normalised, 6),
        ),
        (
            "Points on the part",
            f"{significant(part.rms_mm, 'mm rms')} of {points_text(head['part'])}",
            f"{part.normalised_rms:.2f} rms (1 is usual)",
        ),
    ]
    return Table(("", "error", "in its own sigmas"), tuple(rows), "", (1, 2))


def naming_table(naming: Mapping[Any, NamingErrors]) -> Table:
    """Names of the stripes against the truth, scene by scene."""
    total = sum(naming.values(), NamingErrors())
    rows = [_naming_row(scene, found) for scene, found in naming.items()]
    rows.append(_naming_row("together", total))
    return Table(
        (
            "scene",
            "stripes named of those in view",
            "points named that every camera sees",
            "wrong name",
            "stray light measured",
            "dropped: ambiguous",
            "dropped: on no sheet",
        ),
        tuple(rows),
        "",
        (1, 2, 3, 4, 5, 6),
    )


def seconds_table(seconds: Mapping[str, float]) -> Table:
    """Time of each stage."""
    rows = [(stage.replace("_", " "), f"{value:.1f}") for stage, value in seconds.items()]
    rows.append(("together", f"{sum(seconds.values()):.1f}"))
    return Table(("stage", "seconds"), tuple(rows))


def points_text(figures: Mapping[str, Any]) -> str:
    """How many points a figure is over, and of how many that were measured."""
    text = f"{figures['n_points']:,} points of {figures['n_measured']:,} measured"
    beyond = figures.get("n_beyond_1mm")
    return text if beyond is None else f"{text}, {beyond:,} beyond 1 mm"


def within_text(figures: Mapping[str, Any]) -> str:
    """Share of the points within 0.05 mm."""
    return _within(figures, 0.05)


def _within(figures: Mapping[str, Any], limit_mm: float) -> str:
    key = f"fraction_within_{limit_mm:g}mm".replace(".", "p")
    return share_text(100.0 * figures[key])


def _sheet_row(name: str, sheet: SheetErrors) -> tuple[str, str, str]:
    return (
        name,
        f"{significant(sheet.angle_deg, digits=2)}°, {significant(sheet.rms_mm, 'mm rms', 2)}",
        _sigmas(sheet.normalised, sheet.n_parameters),
    )


def _naming_row(scene: str, found: NamingErrors) -> tuple[str, ...]:
    named = f"{100.0 * found.named_share:.2f} % of {found.n_shared:,}"
    n_measured = found.n_named + found.n_stray
    return (
        scene,
        f"{found.n_stripes_named} of {found.n_stripes_in_view}",
        named,
        f"{found.n_wrong} of {found.n_named:,} ({100.0 * found.wrong_share:.3f} %)",
        f"{found.n_stray} of {n_measured:,} ({100.0 * found.n_stray / max(n_measured, 1):.2f} %)",
        f"{found.n_ambiguous:,}",
        f"{found.n_unexplained:,}",
    )


def _sigmas(length: float, n_parameters: int) -> str:
    return f"{length:.1f} ({n_parameters**0.5:.1f} is usual for {n_parameters} numbers)"


SCENE_TEXTS = {
    "camera": "the circle grid, to calibrate the camera or cameras",
    "laser": "the laser on the grid (its points marked), to calibrate the light sheets",
    "hand-eye": "a posture over the flat plate, to calibrate the hand-eye",
    "plate": "the plate again, scanned by hand",
    "ball": "the ball",
    "steps": "gauge blocks",
    "still-step": "a gauge block, standing still",
    "part": "the free-form part",
    "waves": "a wavy plate",
}


def photographs_of(demo: HeadDemo, photographs: Mapping[str, Exposure]) -> Gallery:
    """One image a scene; stripes are marked on the bright target, and where they were named."""
    on_target = {image.source: image.profile for image in demo.instrument.laser.images}
    pictures = []
    for scene, exposure in photographs.items():
        marks: list[Marks] = []
        text = SCENE_TEXTS[scene]
        if scene == "laser" and exposure.source in on_target:
            points = on_target[exposure.source].points_px
            marks = [Marks(points, sheet_colour(0), "dot", 5.0)]
        elif demo.naming:
            marks = _named_marks(demo, scene, exposure.source)
            text += ", coloured by sheet" if marks else ""
        markup = photo_markup(exposure, marks, f"Rendered image: {text}", longest_px=900)
        pictures.append(Picture(markup, text, scene))
    return Gallery(tuple(pictures), 300)


def _named_marks(demo: HeadDemo, scene: str, source: str) -> list[Marks]:
    """The measured points of one exposure, a colour a sheet."""
    images = [image for name, scan in demo.scans.items() if name == scene for image in scan.images]
    for image in images:
        if image.profile.source == source:
            measured = image.fate == int(PointStatus.MEASURED)
            return [
                Marks(image.profile.points_px[measured & (image.sheet == k)], sheet_colour(k))
                for k in sorted(set(image.sheet[measured].tolist()))
            ]
    return []


def hand_eye_pictures(demo: HeadDemo) -> tuple[Picture, ...]:
    """Residuals and left-out postures of the hand-eye."""
    scanner, fit = demo.instrument.scanner, demo.instrument.hand_eye.fit
    numbers = hand_eye_numbers(fit.calibration, total_covariance(scanner))
    return (
        hand_eye_charts.residuals_by_posture(fit),
        hand_eye_charts.left_out_bars(fit, numbers.rotation_sigma_deg, numbers.size_sigma_mm),
    )


def histograms(demo: HeadDemo) -> Gallery:
    """Plate, ball and blocks, as the thesis shows them."""
    still = demo.still_step
    pictures = [
        deviation_histogram(
            demo.plate.fitted, title="Plate (as figure 5.12)", axis_label="distance to plane, mm"
        ),
        deviation_histogram(
            demo.ball.nominal,
            title="Ball (as figure 5.14)",
            axis_label="distance to the centre minus the radius, mm",
        ),
        height_histogram(
            still.heights_mm,
            still.nominal_height_mm,
            still.height.value_mm,
            title=f"Step of {still.nominal_height_mm:g} mm, one exposure (as figure 5.19)",
        ),
    ]
    pictures += [
        height_histogram(
            step.heights_mm,
            step.nominal_height_mm,
            step.height.value_mm,
            title=f"Step of {step.nominal_height_mm:g} mm, through the arm",
        )
        for step in demo.steps
    ]
    return Gallery(tuple(pictures), 420)


def part_pictures(demo: HeadDemo) -> Gallery:
    """The part in space and its deviations."""
    cloud = demo.part.scan.cloud
    return Gallery(
        (
            cloud_figures.cloud_view(cloud),
            deviation_view(
                cloud.points_mm[demo.part.rows],
                demo.part.distance_mm,
                title="Deviation from the true surface",
                frame="Base",
                reference="the true surface, which only a simulator knows",
            ),
        ),
        460,
    )


TITLES = {
    "thesis-single": "A line scanner on a measuring arm",
    "thesis-cross": "A cross-line scanner on a measuring arm",
    "thesis-multi": "A multi-line scanner on a measuring arm",
}


def head_demo_page(
    demo: HeadDemo,
    name: str,
    head: Mapping[str, Any],
    photographs: Mapping[str, Exposure],
    *,
    commands: Table,
    footer: str,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    demo
        What the chain found.
    name
        Name of the head.
    head
        The same figures as `armscan.report.demo.head_data` gives them.
    photographs
        One exposure of each scene, by the scene's name.
    commands
        How to repeat each step.
    footer
        One line about origin.
    """
    scanner = demo.instrument.scanner
    fit = demo.instrument.hand_eye.fit
    return Page(
        title=TITLES[name],
        subtitle="Calibrated and used. Everything below was measured on rendered images and a "
        "simulated arm; the simulator's truth was looked at only afterwards.",
        cards=_cards(head),
        warnings=tuple(sentence(f"hand-eye: {warning}") for warning in fit.warnings),
        sections=(
            Section("Against the thesis", (comparison_table(head, name), Text(_rule_text()))),
            Section("What the camera saw", (photographs_of(demo, photographs),)),
            Section(
                "Where the sensor sits on the arm",
                (
                    Facts(for_people(hand_eye_quantities(scanner))),
                    Gallery((posture_scene(fit, demo.instrument.hand_eye.stripes),), 560),
                    Gallery(hand_eye_pictures(demo), 700),
                    posture_table(fit),
                ),
            ),
            Section("The plate, the ball and the blocks", (histograms(demo),)),
            Section("The part", (Text("These points are cloud.ply."), part_pictures(demo))),
            *_names(demo),
            Section("Against the truth", (truth_table(demo, head),)),
            Section("Step by step", (commands, seconds_table(head["seconds"]))),
        ),
        is_simulated=True,
        footer=footer,
    )


def _names(demo: HeadDemo) -> tuple[Section, ...]:
    if not demo.naming:
        return ()
    text = (
        "Which light sheet drew each stripe, against the truth, over some instants of each scene. "
        "What is in doubt is dropped and counted, not guessed. Stray light is what lies more than "
        "2 px from every true stripe: faint light along a silhouette or an edge, or a reflection."
    )
    return (Section("The names of the stripes", (Text(text), naming_table(demo.naming))),)


def _rule_text() -> str:
    return (
        f"Of plate, ball and part, {FRACTION_RULE}. Of a step's faces the margins are left "
        "out. The thesis's figures were measured on a real instrument; ours are simulated, with an "
        "arm and optics made to be like it."
    )


def _cards(head: Mapping[str, Any]) -> tuple[Quantity, ...]:
    plate, ball, hand_eye = head["plate"], head["sphere"], head["hand_eye"]
    still = next(step for step in head["steps"] if step["frame"] == "Sensor")
    return (
        fact(
            "Plate",
            f"{within_text(plate)} within 0.05 mm",
            f"std {1000.0 * plate['std_mm']:.1f} µm, {plate['n_points']:,} points",
        ),
        fact(
            "Ball",
            f"{1000.0 * ball['diameter_error_mm']:+.1f} µm",
            f"error of the diameter, sigma {1000.0 * ball['diameter_sigma_mm']:.1f} µm; "
            f"{within_text(ball)} within 0.05 mm",
        ),
        fact(
            "Step, one exposure",
            f"{1000.0 * (still['mean_mm'] - still['nominal_mm']):+.1f} µm",
            f"error of {still['nominal_mm']:g} mm; std {1000.0 * still['std_mm']:.1f} µm",
        ),
        fact(
            "Hand-eye",
            f"{1000.0 * hand_eye['translation_error_mm']:.0f} µm, "
            f"{hand_eye['rotation_error_deg']:.3f}°",
            f"off; expected {1000.0 * hand_eye['sigma_translation_mm']:.0f} µm, "
            f"{hand_eye['sigma_rotation_deg']:.3f}°",
        ),
        fact(
            "Free-form part",
            f"{1000.0 * head['part']['rms_mm']:.1f} µm rms",
            f"{within_text(head['part'])} within 0.05 mm of the truth",
        ),
    )
