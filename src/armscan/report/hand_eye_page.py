# SPDX-License-Identifier: Apache-2.0
"""The report of a hand-eye calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.models.scanner import ArmNoise, HandEyeDiagnostics, ScannerCalibration
from armscan.reconstruction.result import ReconstructedImage
from armscan.records.exposure import Exposure
from armscan.report import hand_eye_figures as figures
from armscan.report.hand_eye_numbers import (
    chi2_verdict,
    hand_eye_facts,
    hand_eye_numbers,
    size_facts,
    total_covariance,
)
from armscan.report.hand_eye_scene import posture_scene
from armscan.report.numbers import sentence, significant
from armscan.report.origin import footer, origin_section
from armscan.report.page import Block, Card, Facts, Gallery, Page, Section, Text
from armscan.report.stripe_gallery import stripe_gallery
from armscan.report.summary import Table

NOISE_TEXT = (
    "The reported pose of a posture is off by a rotation and by a shift of the scan point that "
    "all exposures of the posture share; a smaller part is new in every exposure. The plate is "
    "off its plane by a smooth surface with the stated standard deviation, alike within the "
    "stated length. Stripe noise comes on top. Points of one posture therefore err together, and "
    "the sigmas of the hand-eye count postures, not points."
)

TITLE = "Hand-eye calibration"


def hand_eye_page(
    fit: HandEyeFit,
    scanner: ScannerCalibration,
    stripes: Sequence[PosedStripe],
    images: Sequence[ReconstructedImage] = (),
    exposures: Mapping[str, Exposure] | None = None,
    *,
    repeats: Sequence[Block] = (),
    is_simulated: bool = False,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    fit
        The calibration.
    scanner
        The document that holds it.
    stripes
        What was placed, with the poses of the arm.
    images
        Stripe points of each exposure; none where a sensor delivered points.
    exposures
        The images by source name; those that are missing are not shown.
    repeats
        A repeat study, shown after the result.
    is_simulated
        True if the images were rendered.
    """
    sections = [_result_section(fit, scanner)]
    if repeats:
        sections.append(Section("Repeated calibrations", tuple(repeats)))
    sections += [
        Section("The postures", (Gallery((posture_scene(fit, stripes),), 560),)),
        _residual_section(fit, scanner),
        Section("Posture by posture", (posture_table(fit),)),
        _noise_section(fit),
    ]
    if images:
        names = [] if scanner.sensor is None else [sheet.name for sheet in scanner.sensor.sheets]
        blocks = stripe_gallery(images, names, exposures or {})
        sections.append(Section("The stripes", blocks))
    sections.append(origin_section(scanner.provenance))
    hand_eye = fit.calibration
    return Page(
        title=TITLE,
        subtitle=f"Where the sensor sits on the arm, from {hand_eye.n_postures} postures, "
        f"{hand_eye.n_exposures} exposures and {hand_eye.n_points:,} points",
        cards=_cards(fit, scanner),
        warnings=tuple(sentence(warning) for warning in fit.warnings),
        sections=tuple(sections),
        is_simulated=is_simulated,
        footer=footer(scanner.provenance),
        forced=scanner.provenance.forced,
    )


def posture_table(fit: HandEyeFit) -> Table:
    """One line a posture."""
    columns = (
        "posture", "exposures", "points", "mean µm", "in sigmas", "rms µm", "tilt °", "azimuth °",
        "stand-off mm", "without it °", "without it mm", "left-out residual / sigma",
    )  # fmt: skip
    rows = tuple(
        (
            item.posture,
            str(item.n_exposures),
            str(item.n_points),
            f"{1000.0 * item.mean_mm:+.1f}",
            f"{item.normalised_mean:+.1f}",
            f"{1000.0 * item.rms_mm:.1f}",
            _angle(item.tilt_deg),
            _angle(item.azimuth_deg),
            f"{item.stand_off_mm:.1f}",
            significant(item.left_out_rotation_deg, digits=2),
            significant(item.left_out_translation_mm, digits=2),
            f"{item.left_out_normalised:.2f}",
        )
        for item in fit.postures
    )
    return Table(columns, rows)


def _angle(value_deg: float) -> str:
    return f"{value_deg:.0f}" if np.isfinite(value_deg) else "–"


def _cards(fit: HandEyeFit, scanner: ScannerCalibration) -> tuple[Card, ...]:
    hand_eye = fit.calibration
    own = hand_eye_numbers(hand_eye, hand_eye.covariance)
    numbers = hand_eye_numbers(hand_eye, total_covariance(scanner))
    cards = [
        Card(
            "Sigma of the rotation",
            f"{significant(numbers.rotation_sigma_deg, digits=2)}°",
            f"about an axis; {significant(own.rotation_sigma_deg, digits=2)}° without the "
            "sensor's own",
        ),
        Card(
            "Sigma of the translation",
            f"{significant(numbers.size_sigma_mm, 'mm', 2)}",
            f"along an axis; {significant(own.size_sigma_mm, 'mm', 2)} without the sensor's own",
        ),
        Card("Residual", f"{significant(hand_eye.rms_mm)} mm rms", "from the reference"),
    ]
    known = hand_eye.diagnostics
    if known is not None:
        cards += [
            Card(
                "Condition", f"{known.condition:.0f}", f"rank {known.rank} of 6; below 100 is good"
            ),
            _noise_card(hand_eye.arm_noise, known),
        ]
    return tuple(cards)


def _noise_card(arm: ArmNoise, known: HandEyeDiagnostics) -> Card:
    """The test of a given noise model; a model fitted to the residuals cannot fail one."""
    if known.is_noise_estimated:
        position = float(np.hypot(arm.position_mm, arm.exposure_position_mm))
        return Card(
            "Arm's scatter",
            f"{significant(position, digits=2)} mm",
            "an axis at the scan point, estimated from the residuals: compare it with the "
            "arm's certificate",
        )
    return Card(
        "Fits the noise model",
        "no" if known.chi2_probability < 0.001 else "yes",
        f"residuals {chi2_verdict(known.chi2_probability)}",
    )


def _result_section(fit: HandEyeFit, scanner: ScannerCalibration) -> Section:
    pictures = (
        figures.correlation_picture(total_covariance(scanner)),
        figures.residual_histogram(fit),
    )
    return Section(
        "The hand-eye",
        (
            Facts(hand_eye_facts(scanner)),
            Facts(size_facts(fit)),
            Facts(fit.reference, "The reference"),
            Gallery(pictures, 420),
        ),
    )


def _residual_section(fit: HandEyeFit, scanner: ScannerCalibration) -> Section:
    numbers = hand_eye_numbers(fit.calibration, total_covariance(scanner))
    bars = figures.left_out_bars(fit, numbers.rotation_sigma_deg, numbers.size_sigma_mm)
    wide = [figures.residuals_by_posture(fit), bars]
    plate = fit.calibration.plate
    blocks = [Gallery(tuple(wide), 700)]
    if plate is not None:
        blocks.append(Gallery((figures.residual_map(fit, plate),), 420))
    return Section("How well it fits", tuple(blocks))


def _noise_section(fit: HandEyeFit) -> Section:
    noise, known = fit.calibration.arm_noise, fit.calibration.diagnostics
    rows = [
        (
            "Arm, common to a posture",
            f"{significant(noise.position_mm)} mm at the scan point, "
            f"{significant(float(np.degrees(noise.rotation_rad)))}°, an axis",
        ),
        (
            "Arm, new in every exposure",
            f"{significant(noise.exposure_position_mm)} mm, "
            f"{significant(float(np.degrees(noise.exposure_rotation_rad)))}°",
        ),
    ]
    if known is not None:
        if known.method == "plate":
            rows.append(
                (
                    "Plate's flatness",
                    f"{significant(known.plate_flatness_mm)} mm, alike within "
                    f"{known.flatness_length_mm:.0f} mm",
                )
            )
        origin = "estimated from the residuals" if known.is_noise_estimated else "as given"
        rows.append(("These standard deviations are", origin))
    text = Text(NOISE_TEXT)
    return Section("The noise model", (text, Facts(tuple(rows))))
