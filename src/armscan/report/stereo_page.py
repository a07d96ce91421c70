# SPDX-License-Identifier: Apache-2.0
"""The report of a stereo calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.stereo.advice import right_camera_centre_mm
from armscan.calibration.stereo.result import PairFit, StereoFit
from armscan.geometry.rotation import skew
from armscan.models.calibration import Provenance
from armscan.models.camera import PARAMETER_NAMES
from armscan.records.exposure import Exposure
from armscan.report import stereo_figures as figures
from armscan.report.camera_page import MEANINGS, RMS_MEANING, UNITS, noise_text
from armscan.report.numbers import sentence, significant, with_sigma, without_source
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Facts, Gallery, Page, Section, Text
from armscan.report.summary import Table

TITLE = "Stereo calibration"
AXES = "xyz"
N_INTRINSICS = 2 * len(PARAMETER_NAMES)
USES = {
    "free": "Both cameras' intrinsics were solved from these images.",
    "prior": "Given calibrations of the cameras counted as observations beside these images.",
    "fixed": "The given calibrations of the cameras were held; their uncertainty is carried on.",
}


def stereo_page(
    fit: StereoFit,
    not_found: Sequence[tuple[str, str]],
    exposures: dict[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    fit
        The calibration.
    not_found
        Source and reason of each image without a usable target.
    exposures
        The photographs by source name; those that are missing are not shown.
    provenance
        How the calibration came to be.
    is_simulated
        True if the photographs were rendered.
    """
    sections = [
        _relative_section(fit),
        _fit_section(fit),
        _pairs_section(fit, exposures),
        _cameras_section(fit),
    ]
    if not_found:
        rows = tuple((source, without_source(source, reason)) for source, reason in not_found)
        table = Table(("image", "why"), rows, word_columns=(1,))
        sections.append(Section("Images without a usable target", (table,)))
    sections += [_covariance_section(fit), origin_section(provenance)]
    return Page(
        title=TITLE,
        subtitle=f"{len(fit.related)} of {len(fit.pairs)} pairs relate the cameras, "
        f"{fit.n_points} target points",
        cards=_cards(fit),
        warnings=tuple(sentence(warning) for warning in fit.warnings),
        sections=tuple(sections),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def relative_rows(fit: StereoFit) -> tuple[tuple[str, str, str], ...]:
    """Name, value with sigma, and meaning of what relates the cameras."""
    baseline, sigma_baseline = _baseline_mm(fit)
    angle, sigma_angle = _angle_deg(fit)
    pose = fit.views.right_from_left
    sigma = fit.sigma[N_INTRINSICS:]
    rows = [
        ("baseline", with_sigma(baseline, sigma_baseline, "mm"), "between the cameras' centres"),
        ("angle", with_sigma(angle, sigma_angle, "°"), "between their optical axes"),
    ]
    turns = np.rad2deg(pose.rotation_vector_rad)
    for k, axis in enumerate(AXES):
        text = with_sigma(float(turns[k]), float(np.rad2deg(sigma[k])), "°")
        rows.append((f"rotation {axis}", text, f"rotation vector of right_from_left, {axis}"))
    for k, axis in enumerate(AXES):
        text = with_sigma(float(pose.translation_mm[k]), float(sigma[3 + k]), "mm")
        rows.append(
            (f"translation {axis}", text, f"the left camera in the right one's frame, {axis}")
        )
    return tuple(rows)


def _baseline_mm(fit: StereoFit) -> tuple[float, float]:
    translation = fit.views.right_from_left.translation_mm
    length = float(np.linalg.norm(translation))
    gradient = translation / length
    return length, float(np.sqrt(gradient @ fit.covariance[-3:, -3:] @ gradient))


def _angle_deg(fit: StereoFit) -> tuple[float, float]:
    """Between the optical axes; its derivative by the increments is along their common normal."""
    axis = fit.views.right_from_left.rotation[:, 2]
    angle = float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2]))
    normal = skew(axis) @ np.array([0.0, 0.0, 1.0])
    length = float(np.linalg.norm(normal))
    if length == 0.0:
        return np.rad2deg(angle), float("nan")
    rows = slice(N_INTRINSICS, N_INTRINSICS + 3)
    gradient = normal / length
    variance = float(gradient @ fit.covariance[rows, rows] @ gradient)
    return float(np.rad2deg(angle)), float(np.rad2deg(np.sqrt(variance)))


def _cards(fit: StereoFit) -> tuple[Card, ...]:
    baseline, angle = _baseline_mm(fit), _angle_deg(fit)
    cards = [
        Card("Baseline", with_sigma(*baseline, "mm"), "axes " + with_sigma(*angle, "°") + " apart"),
        Card(
            "Reprojection residual",
            f"{significant(fit.rms_px)} px rms",
            f"left {significant(fit.left.rms_px)}, right {significant(fit.right.rms_px)} px",
        ),
        Card(
            "Distance from epipolar lines",
            f"{significant(fit.epipolar_rms_px)} px rms",
            f"mean {fit.epipolar_mean_px:+.4f} px",
        ),
    ]
    if fit.hold_out is not None:
        cards.append(
            Card(
                "On pairs it has not seen",
                f"{significant(fit.hold_out.rms_px)} px rms",
                f"{fit.hold_out.n_folds}-fold hold-out; "
                f"{significant(fit.hold_out.rms_in_sample_px)} px in sample",
            )
        )
    return tuple(cards)


def _relative_section(fit: StereoFit) -> Section:
    x, y, z = right_camera_centre_mm(fit)
    text = (
        f"{USES[fit.options.intrinsics]} The right camera's centre lies at x {x:.2f}, y {y:.2f}, "
        f"z {z:.2f} mm in the left camera's frame, which is the Sensor frame (x to the right, y "
        "down, z forward). "
    ) + noise_text(
        f"{fit.left.noise_scale:.2g} (left) and {fit.right.noise_scale:.2g} (right) times"
    )
    if fit.target_error_mm > 0.0:
        text += (
            " Residuals of a target point repeat from view to view: the points miss their places "
            f"by {significant(fit.target_error_mm)} mm (one standard deviation an axis). More "
            "pairs do not average that; the standard deviations hold it."
        )
    table = Table(("quantity", "value ± 1 sigma", "meaning"), relative_rows(fit), "", (2,))
    return Section("Where the cameras are to each other", (table, Text(text)))


def _fit_section(fit: StereoFit) -> Section:
    blocks = [Text(RMS_MEANING)]
    if fit.hold_out is not None:
        growth = 100.0 * (fit.hold_out.rms_px / fit.hold_out.rms_in_sample_px - 1.0)
        blocks.append(
            Text(
                f"Hold-out: the pairs were dealt into {fit.hold_out.n_folds} groups; each group "
                "was predicted by cameras solved from the others, with only one board pose a pair "
                f"fitted in both images. The residual there is {growth:+.1f} % against the "
                "solution itself."
            )
        )
    charts = (
        figures.epipolar_map(fit),
        figures.epipolar_levers(fit),
        figures.residual_field(fit, 0),
        figures.residual_field(fit, 1),
    )
    return Section("How well it fits", (*blocks, Gallery(charts)))


def _pairs_section(fit: StereoFit, exposures: dict[str, Exposure]) -> Section:
    table = Table(
        ("pair", "left rms, px", "right rms, px", "epipolar, px", "own pose: off by", "level",
         "remark"),
        tuple(pair_row(pair) for pair in fit.pairs),
        word_columns=(6,),
    )  # fmt: skip
    text = Text(
        "Each pair gives the relative pose by itself (eqs. 4.15, 4.16): 'off by' is its distance "
        "from the solution. 'Level' is its squared distance from the other pairs over the noise, "
        "against the typical pair: 1 is a pair like the others. Typically pairs lie "
        f"{np.sqrt(fit.typical_level):.1f} standard deviations apart. Rings are target points, "
        "the filled one is the board's first point; orange lines are residuals, "
        f"{figures.residual_magnification(fit):g} times enlarged."
    )
    pictures = [
        picture for pair in fit.pairs for picture in figures.pair_pictures(fit, pair, exposures)
    ]
    bars = Gallery((figures.pair_bars(fit),), 700)
    return Section("The pairs", (bars, table, text, Gallery(tuple(pictures), 440)))


def pair_row(pair: PairFit) -> tuple[str, ...]:
    """Cells of a pair in tables."""
    turn, shift = np.linalg.norm(pair.apart[:3]), np.linalg.norm(pair.apart[3:])
    remark = pair.note or "used"
    if pair.quarter_turns:
        remark += f"; right numbers turned by {90 * pair.quarter_turns}°"
    return (
        pair.pair.name,
        "" if pair.left is None else significant(pair.left.rms_px),
        "" if pair.right is None else significant(pair.right.rms_px),
        "" if pair.matched is None else significant(pair.matched.rms_px),
        f"{np.rad2deg(turn):.3f}°, {significant(float(shift))} mm" if pair.is_related else "",
        f"{pair.level:.2g}" if pair.is_related else "",
        remark,
    )


def _cameras_section(fit: StereoFit) -> Section:
    n = len(PARAMETER_NAMES)
    rows = []
    for k, name in enumerate(PARAMETER_NAMES):
        cells = []
        for side, camera in enumerate((fit.views.left, fit.views.right)):
            value, sigma = camera.parameters[k], fit.sigma[side * n + k]
            is_free = name in fit.sides[side].single.free_parameters
            text = with_sigma(value, sigma, UNITS.get(name, ""))
            cells.append(text if is_free or sigma > 0.0 else f"{value:g} (held)")
        rows.append((name.removesuffix("_px"), *cells, MEANINGS[name]))
    table = Table(
        ("parameter", "left ± 1 sigma", "right ± 1 sigma", "meaning"), tuple(rows), "", (3,)
    )
    reasons = f"Left: {sentence(fit.left.single.reason)} Right: {sentence(fit.right.single.reason)}"
    return Section("The two cameras", (table, Text(reasons)))


def _covariance_section(fit: StereoFit) -> Section:
    facts = Facts(
        (
            ("Degrees of freedom", str(fit.degrees_of_freedom)),
            ("Condition number", f"{fit.condition:.3g} (boards eliminated, unit diagonal)"),
        )
    )
    short = [f"{kind}{axis}" for kind in "rt" for axis in AXES]
    block = fit.covariance[N_INTRINSICS:, N_INTRINSICS:]
    table = Table(
        ("covariance (rad, mm)", *short),
        tuple(
            (name, *(f"{value:.3g}" for value in row))
            for name, row in zip(short, block, strict=True)
        ),
    )
    return Section(
        "Covariance of the relative pose",
        (facts, Gallery((figures.correlation_picture(fit),)), table),
        is_folded=True,
    )
