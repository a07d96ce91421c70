# SPDX-License-Identifier: Apache-2.0
"""Tables of the demo of a head: beside the thesis, against the truth, names, time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from armscan.pipeline.head_demo import HeadDemo
from armscan.pipeline.naming_truth import NamingErrors
from armscan.pipeline.truth_errors import SheetErrors
from armscan.report.deviation_figures import share_text
from armscan.report.numbers import significant
from armscan.report.summary import Table

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
