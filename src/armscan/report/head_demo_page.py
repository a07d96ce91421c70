# SPDX-License-Identifier: Apache-2.0
"""The report of the demo of a single-line arm scanner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armscan.pipeline.head_demo import HeadDemo
from armscan.records.exposure import Exposure
from armscan.report import cloud_figures
from armscan.report import hand_eye_figures as hand_eye_charts
from armscan.report.deviation_figures import (
    deviation_histogram,
    deviation_view,
    height_histogram,
    share_text,
)
from armscan.report.drawing import Marks, photo_markup
from armscan.report.hand_eye_numbers import hand_eye_facts, hand_eye_numbers, total_covariance
from armscan.report.hand_eye_page import posture_table
from armscan.report.hand_eye_scene import posture_scene
from armscan.report.head_demo_data import FRACTION_RULE
from armscan.report.numbers import sentence, significant
from armscan.report.page import Card, Facts, Gallery, Page, Picture, Section, Text
from armscan.report.stripe_figures import sheet_colour
from armscan.report.summary import Table

SCENE_TEXTS = {
    "camera": "the circle grid, to calibrate the camera",
    "laser": "the laser on the grid (its points marked), to calibrate the light sheet",
    "hand-eye": "a posture over the flat plate, to calibrate the hand-eye",
    "plate": "the plate again, scanned by hand",
    "ball": "the ball",
    "steps": "gauge blocks",
    "still-step": "a 20 mm block, standing still",
    "part": "the free-form part",
}


def head_demo_page(
    demo: HeadDemo,
    head: Mapping[str, Any],
    photographs: Mapping[str, Exposure],
    commands: Table,
    footer: str,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    demo
        What the chain found.
    head
        The same figures as `armscan.report.head_demo_data.head_data` gives them.
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
        title="A line scanner on a measuring arm",
        subtitle="Calibrated and used. Everything below was measured on rendered images and a "
        "simulated arm; the simulator's truth was looked at only afterwards.",
        cards=_cards(head),
        warnings=tuple(sentence(f"hand-eye: {warning}") for warning in fit.warnings),
        sections=(
            Section("Against the thesis", (comparison_table(head), Text(_rule_text()))),
            Section("What the camera saw", (_photographs(demo, photographs),)),
            Section(
                "Where the sensor sits on the arm",
                (
                    Facts(hand_eye_facts(scanner)),
                    Gallery((posture_scene(fit, demo.instrument.hand_eye.stripes),), 560),
                    Gallery(_hand_eye_charts(demo), 700),
                    posture_table(fit),
                ),
            ),
            Section("The plate, the ball and the blocks", (_histograms(demo),)),
            Section("The part", (Text("These points are cloud.ply."), _part(demo))),
            Section("Against the truth", (truth_table(demo, head),)),
            Section("Step by step", (commands, seconds_table(head["seconds"]))),
        ),
        is_simulated=True,
        footer=footer,
    )


def comparison_table(head: Mapping[str, Any]) -> Table:
    """The thesis's figures, measured, beside ours, simulated."""
    plate, ball = head["plate"], head["sphere"]
    rows = [
        (
            "Plate: within ±0.05 mm",
            "97.9 % of 83,210 points",
            f"{_within(plate)} of {_points(plate)} ({plate['reference']} plane)",
        ),
        (
            "Ball of 34.96 mm: diameter",
            "34.94 mm, 0.02 mm off",
            f"{ball['diameter_mm']:.4f} mm, {ball['diameter_error_mm']:+.4f} mm off",
        ),
        (
            "Ball: within ±0.05 mm",
            "95.54 % of 179,427 points",
            f"{_within(ball)} of {_points(ball)} ({ball['reference']} radius)",
        ),
    ]
    for step in head["steps"]:
        how = "one exposure at rest" if step["frame"] == "Sensor" else "through the arm"
        is_thesis = round(step["nominal_mm"]) == 20 and step["frame"] == "Sensor"
        rows.append(
            (
                f"Step of {step['nominal_mm']:g} mm, {how}",
                "19.989 ± 0.006 mm (its cross-line head)" if is_thesis else "–",
                f"{step['mean_mm']:.4f} ± {step['std_mm']:.4f} mm ({_points(step)})",
            )
        )
    hand_eye = head["hand_eye"]
    rows += [
        (
            "Hand-eye, rotation",
            "0.053°, 0.048°, 0.024° (spread of five)",
            f"{significant(hand_eye['rotation_error_deg'], digits=2)}° from the truth, expected "
            f"{significant(hand_eye['sigma_rotation_deg'], digits=2)}°",
        ),
        (
            "Hand-eye, translation",
            "0.068, 0.027, 0.060 mm (spread of five)",
            f"{significant(hand_eye['translation_error_mm'], 'mm', 2)} from the truth, expected "
            f"{significant(hand_eye['sigma_translation_mm'], 'mm', 2)}",
        ),
    ]
    return Table(("", "thesis (real)", "ours (simulated)"), tuple(rows), "", (1, 2))


def truth_table(demo: HeadDemo, head: Mapping[str, Any]) -> Table:
    """Errors of the calibrations and of the part, also in their own sigmas."""
    errors, part = demo.errors, demo.part
    rows = (
        (
            "Focal length",
            f"{errors.camera.focal_px:+.3f} px, sigma {errors.camera.focal_sigma_px:.3f}",
            _sigmas(errors.camera.normalised, errors.camera.n_parameters),
        ),
        (
            "Light sheet",
            f"{significant(errors.sheet.angle_deg, digits=2)}°, "
            f"{significant(errors.sheet.rms_mm, 'mm rms', 2)}",
            _sigmas(errors.sheet.normalised, errors.sheet.n_parameters),
        ),
        (
            "Hand-eye",
            f"{significant(errors.hand_eye.rotation_deg, digits=2)}°, "
            f"{significant(errors.hand_eye.translation_mm, 'mm', 2)}",
            _sigmas(errors.hand_eye.normalised, 6),
        ),
        (
            "Points on the part",
            f"{significant(part.rms_mm, 'mm rms')} of {_points(head['part'])}",
            f"{part.normalised_rms:.2f} rms (1 is usual)",
        ),
    )
    return Table(("", "error", "in its own sigmas"), rows, "", (1, 2))


def seconds_table(seconds: Mapping[str, float]) -> Table:
    """Time of each stage."""
    rows = [(stage.replace("_", " "), f"{value:.1f}") for stage, value in seconds.items()]
    rows.append(("together", f"{sum(seconds.values()):.1f}"))
    return Table(("stage", "seconds"), tuple(rows))


def _points(figures: Mapping[str, Any]) -> str:
    """How many points a figure is over, and of how many that were measured."""
    text = f"{figures['n_points']:,} points of {figures['n_measured']:,} measured"
    beyond = figures.get("n_beyond_1mm")
    return text if beyond is None else f"{text}, {beyond:,} beyond 1 mm"


def _within(figures: Mapping[str, Any]) -> str:
    return share_text(100.0 * figures["fraction_within_0p05mm"])


def _sigmas(length: float, n_parameters: int) -> str:
    return f"{length:.1f} ({n_parameters**0.5:.1f} is usual for {n_parameters} numbers)"


def _rule_text() -> str:
    return (
        f"Of plate, ball and part, {FRACTION_RULE}. Of a step's faces the margins are left "
        "out. The thesis's figures were measured on a real instrument; ours are simulated, with an "
        "arm and optics made to be like it."
    )


def _cards(head: Mapping[str, Any]) -> tuple[Card, ...]:
    plate, ball, hand_eye = head["plate"], head["sphere"], head["hand_eye"]
    still = next(step for step in head["steps"] if step["frame"] == "Sensor")
    return (
        Card(
            "Plate",
            f"{_within(plate)} in ±0.05 mm",
            f"std {1000.0 * plate['std_mm']:.1f} µm, {plate['n_points']:,} points",
        ),
        Card(
            "Ball",
            f"{1000.0 * ball['diameter_error_mm']:+.1f} µm",
            f"error of the diameter, sigma {1000.0 * ball['diameter_sigma_mm']:.1f} µm; "
            f"{_within(ball)} in ±0.05 mm",
        ),
        Card(
            "Step, one exposure",
            f"{1000.0 * (still['mean_mm'] - still['nominal_mm']):+.1f} µm",
            f"error of {still['nominal_mm']:g} mm; std {1000.0 * still['std_mm']:.1f} µm",
        ),
        Card(
            "Hand-eye",
            f"{1000.0 * hand_eye['translation_error_mm']:.0f} µm, "
            f"{hand_eye['rotation_error_deg']:.3f}°",
            f"off; expected {1000.0 * hand_eye['sigma_translation_mm']:.0f} µm, "
            f"{hand_eye['sigma_rotation_deg']:.3f}°",
        ),
        Card(
            "Free-form part",
            f"{1000.0 * head['part']['rms_mm']:.1f} µm rms",
            f"{_within(head['part'])} in ±0.05 mm of the truth",
        ),
    )


def _photographs(demo: HeadDemo, photographs: Mapping[str, Exposure]) -> Gallery:
    """One image a scene; on the bright target the found stripe is marked, else it is lost there."""
    found = {image.source: image.profile for image in demo.instrument.laser.images}
    pictures = []
    for scene, exposure in photographs.items():
        profile = found.get(exposure.source) if scene == "laser" else None
        marks = [] if profile is None else [Marks(profile.points_px, sheet_colour(0), "dot", 5.0)]
        alt = f"Rendered image: {SCENE_TEXTS[scene]}"
        markup = photo_markup(exposure, marks, alt, longest_px=900)
        pictures.append(Picture(markup, SCENE_TEXTS[scene], scene))
    return Gallery(tuple(pictures), 300)


def _hand_eye_charts(demo: HeadDemo) -> tuple[Picture, ...]:
    scanner, fit = demo.instrument.scanner, demo.instrument.hand_eye.fit
    numbers = hand_eye_numbers(fit.calibration, total_covariance(scanner))
    return (
        hand_eye_charts.residuals_by_posture(fit),
        hand_eye_charts.left_out_bars(fit, numbers.rotation_sigma_deg, numbers.size_sigma_mm),
    )


def _histograms(demo: HeadDemo) -> Gallery:
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


def _part(demo: HeadDemo) -> Gallery:
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
