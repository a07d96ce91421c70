# SPDX-License-Identifier: Apache-2.0
"""The report of the demo of an arm scanner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armscan.pipeline.head_demo import HeadDemo
from armscan.records.exposure import Exposure
from armscan.report.hand_eye_numbers import hand_eye_facts
from armscan.report.hand_eye_page import posture_table
from armscan.report.hand_eye_scene import posture_scene
from armscan.report.head_demo_data import FRACTION_RULE
from armscan.report.head_demo_pictures import (
    hand_eye_pictures,
    histograms,
    part_pictures,
    photographs_of,
)
from armscan.report.head_demo_tables import (
    comparison_table,
    naming_table,
    seconds_table,
    truth_table,
    within_text,
)
from armscan.report.numbers import sentence
from armscan.report.page import Card, Facts, Gallery, Page, Section, Text
from armscan.report.summary import Table

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
                    Facts(hand_eye_facts(scanner)),
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


def _cards(head: Mapping[str, Any]) -> tuple[Card, ...]:
    plate, ball, hand_eye = head["plate"], head["sphere"], head["hand_eye"]
    still = next(step for step in head["steps"] if step["frame"] == "Sensor")
    return (
        Card(
            "Plate",
            f"{within_text(plate)} within 0.05 mm",
            f"std {1000.0 * plate['std_mm']:.1f} µm, {plate['n_points']:,} points",
        ),
        Card(
            "Ball",
            f"{1000.0 * ball['diameter_error_mm']:+.1f} µm",
            f"error of the diameter, sigma {1000.0 * ball['diameter_sigma_mm']:.1f} µm; "
            f"{within_text(ball)} within 0.05 mm",
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
            f"{within_text(head['part'])} within 0.05 mm of the truth",
        ),
    )
