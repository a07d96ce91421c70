# SPDX-License-Identifier: Apache-2.0
"""The page of a hand-eye calibration, its figures and its numbers in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.repeat_study import study_repeats
from armscan.calibration.hand_eye.result import HandEyeFit, PostureResult
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.rotations import euler_from_rotations, rotation_from_vector
from armscan.geometry.shapes import Plane
from armscan.models.calibration import (
    ArmNoise,
    HandEyeCalibration,
    HandEyeDiagnostics,
    ScannerCalibration,
)
from armscan.reconstruction.labels import LabelledProfile
from armscan.records.exposure import Exposure
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    LINE,
    MUTED,
    PALETTE,
    chart_markup,
    new_figure,
    raster_markup,
    styled,
)
from armscan.report.page import (
    Block,
    Card,
    Facts,
    Gallery,
    Page,
    Picture,
    Section,
    Text,
    footer,
    origin_section,
)
from armscan.report.quantity import Table, sentence, significant, with_sigma
from armscan.report.scene3d import SceneDots, SceneLines, ramp_colours, ramp_markup, scene_markup
from armscan.report.stripes import stripe_gallery

ANGLE_STEP_RAD = 1e-6
EULER_NAMES = ("θ (about X)", "γ (about Y)", "φ (about Z)")


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeNumbers:
    """What is printed of a hand-eye.

    Parameters
    ----------
    euler_deg, euler_sigma_deg
        (3,) angles of eq. 2.69, ``R = Rx(theta) Ry(gamma) Rz(phi)``, and standard deviations.
    translation_mm, translation_sigma_mm
        (3,) origin of Sensor in Tool.
    rotation_sigma_deg
        Root mean square standard deviation of a rotation about an axis of Tool.
    size_sigma_mm
        Root mean square standard deviation of a component of the translation.
    """

    euler_deg: FloatArray
    euler_sigma_deg: FloatArray
    translation_mm: FloatArray
    translation_sigma_mm: FloatArray
    rotation_sigma_deg: float
    size_sigma_mm: float


def hand_eye_numbers(hand_eye: HandEyeCalibration, covariance: FloatArray) -> HandEyeNumbers:
    """Numbers of a hand-eye under a covariance (6, 6), in the order of its own."""
    rotation = hand_eye.tool_from_sensor.rotation
    steps = np.stack([rotation_from_vector(ANGLE_STEP_RAD * axis) @ rotation for axis in np.eye(3)])
    angles = euler_from_rotations(rotation[None], "intrinsic-xyz")[0]
    difference = euler_from_rotations(steps, "intrinsic-xyz") - angles
    wrapped = (difference + np.pi) % (2.0 * np.pi) - np.pi
    by_rotation = wrapped.T / ANGLE_STEP_RAD
    euler_variance = np.diag(by_rotation @ covariance[:3, :3] @ by_rotation.T)
    variance = np.diag(covariance)
    return HandEyeNumbers(
        np.degrees(angles),
        np.degrees(np.sqrt(euler_variance)),
        np.asarray(hand_eye.tool_from_sensor.translation_mm),
        np.sqrt(variance[3:]),
        float(np.degrees(np.sqrt(variance[:3].mean()))),
        float(np.sqrt(variance[3:].mean())),
    )


def total_covariance(scanner: ScannerCalibration) -> FloatArray:
    """(6, 6) covariance of the hand-eye with what the sensor's uncertainty does to it."""
    return np.asarray(scanner.covariance[-6:, -6:])


def hand_eye_facts(scanner: ScannerCalibration) -> tuple[tuple[str, str], ...]:
    """Labels and values of the hand-eye."""
    hand_eye = scanner.hand_eye
    numbers = hand_eye_numbers(hand_eye, total_covariance(scanner))
    rows = "\n".join(
        "  ".join(f"{value:+.6f}" for value in row)
        for row in np.round(hand_eye.tool_from_sensor.rotation, 6)
    )
    angles = (
        f"{name} {with_sigma(value, sigma)}°"
        for name, value, sigma in zip(
            EULER_NAMES, numbers.euler_deg, numbers.euler_sigma_deg, strict=True
        )
    )
    lengths = (
        f"{name} {with_sigma(value, sigma, 'mm')}"
        for name, value, sigma in zip(
            "XYZ", numbers.translation_mm, numbers.translation_sigma_mm, strict=True
        )
    )
    return (
        ("Rotation tool_from_sensor", rows),
        ("The same as R = Rx(θ) Ry(γ) Rz(φ), eq. 2.69", ", ".join(angles)),
        ("Origin of Sensor in Tool", ", ".join(lengths)),
    )


def size_facts(fit: HandEyeFit) -> tuple[tuple[str, str], ...]:
    """How much went in and what was left over."""
    hand_eye = fit.calibration
    facts = [
        (
            "Rests on",
            f"{hand_eye.n_postures} postures, {hand_eye.n_exposures} exposures, "
            f"{hand_eye.n_points:,} points",
        ),
        ("Residual", f"{significant(hand_eye.rms_mm)} mm rms from the reference"),
    ]
    known = hand_eye.diagnostics
    if known is not None:
        facts += [
            ("Condition", f"{known.condition:.0f}, rank {known.rank} of 6"),
            ("Known least", known.weakest),
            (
                "Largest change without one posture",
                f"{significant(known.left_out_rotation_deg)}°, "
                f"{significant(known.left_out_translation_mm)} mm",
            ),
            (
                "Residuals under the noise model",
                "the model's scatters were estimated from them, so they test nothing"
                if known.is_noise_estimated
                else chi2_verdict(known.chi2_probability),
            ),
        ]
    return tuple(facts)


def chi2_verdict(probability: float) -> str:
    """A probability of chi2 in words."""
    if not np.isfinite(probability):
        return "nothing is redundant, so nothing can be tested"
    if probability < 0.001:
        return f"larger than the noise model allows (p = {probability:.2g})"
    if probability > 0.999:
        return f"smaller than the noise model expects (p = {probability:.4f})"
    return f"as expected (p = {probability:.2f})"


PAGE_WIDTH = 10.4
MAX_DOTS_OF_POSTURE = 400
DIVERGING = "RdBu_r"
SHORT_NAMES = ("rot X", "rot Y", "rot Z", "X", "Y", "Z")


def residuals_by_posture(fit: HandEyeFit) -> Picture:
    """All residuals of each posture, their mean, and the spread that the noise model expects."""
    generator = np.random.default_rng(0)
    with styled():
        figure = new_figure(PAGE_WIDTH, 3.6)
        axes = figure.add_subplot()
        axes.axhline(0.0, color=LINE, linewidth=0.9)
        for k, posture in enumerate(fit.postures):
            values = 1000.0 * _residuals_of(fit, posture)
            shown = values[:: max(1, len(values) // MAX_DOTS_OF_POSTURE)]
            place = k + generator.uniform(-0.3, 0.3, len(shown))
            axes.plot(place, shown, ".", color=ACCENT_LIGHT, markersize=1.8, zorder=1)
            sigma = 1000.0 * _sigma_of_mean(posture)
            axes.bar(k, 4 * sigma, 0.5, -2 * sigma, color="none", edgecolor=MUTED, zorder=2)
            axes.plot([k], [1000.0 * posture.mean_mm], "o", color=ALERT, markersize=5, zorder=3)
        axes.set_xticks(range(len(fit.postures)), [p.posture for p in fit.postures])
        axes.tick_params(axis="x", labelrotation=60 if len(fit.postures) > 8 else 0, labelsize=7.5)
        axes.set_xlabel("posture")
        axes.set_ylabel("distance from the reference, µm")
        widest = max(2.0 * _sigma_of_mean(posture) for posture in fit.postures)
        largest = float(np.percentile(np.abs(_all_residuals(fit)), 99.8))
        reach = 1.1 * max(1000.0 * widest, 1000.0 * largest, 1e-3)
        axes.set_ylim(-reach, reach)
    return Picture(
        raster_markup(figure, "Residuals by posture"),
        title="Residuals by posture",
        caption="Small dots are points, the large dot their mean; the box is two sigma of that "
        "mean under the noise model (pose of the arm, flatness, stripe, sensor), less what the fit "
        "follows. Means within their boxes "
        "are what an arm does; one far outside points to a posture that does not belong.",
    )


def residual_map(fit: HandEyeFit, plate: Plane) -> Picture:
    """Residuals over the plate: its flatness shows as a pattern that postures share."""
    points = np.concatenate([stripe.points_base_mm for stripe in fit.stripes])
    local = (points - plate.point_mm) @ plate.axes[:2].T
    values = 1000.0 * _all_residuals(fit)
    reach = max(float(np.percentile(np.abs(values), 98)), 1e-3)
    step = max(1, len(values) // 20_000)
    with styled():
        figure = new_figure(6.0, 4.2)
        axes = figure.add_subplot()
        dots = axes.scatter(
            local[::step, 0], local[::step, 1], c=values[::step], s=3.0, cmap=DIVERGING,
            vmin=-reach, vmax=reach, linewidths=0.0,
        )  # fmt: skip
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("along the plate's first axis, mm")
        axes.set_ylabel("second axis, mm")
        figure.colorbar(dots, ax=axes, label="distance, µm", shrink=0.85)
    return Picture(
        raster_markup(figure, "Residuals over the plate"),
        title="Residuals over the plate",
        caption="Colours that change from stripe to stripe are the arm; a pattern that crossing "
        "stripes share is the plate's flatness.",
    )


def left_out_bars(fit: HandEyeFit, rotation_sigma_deg: float, size_sigma_mm: float) -> Picture:
    """Change of the hand-eye when one posture takes no part."""
    names = [posture.posture for posture in fit.postures]
    series = (
        ("change of the rotation, °", rotation_sigma_deg, "left_out_rotation_deg"),
        ("change of the translation, mm", size_sigma_mm, "left_out_translation_mm"),
        ("residual left out, in sigmas", 1.0, "left_out_normalised"),
    )
    with styled():
        figure = new_figure(PAGE_WIDTH, 2.9)
        grid: Any = figure.subplots(1, 3)
        for axes, (label, usual, name) in zip(grid, series, strict=True):
            values = [getattr(posture, name) for posture in fit.postures]
            axes.bar(names, values, 0.6, color=ACCENT)
            axes.axhline(usual, color=ALERT, linewidth=1.0, linestyle="--")
            axes.set_title(label, loc="left", fontsize=8.5)
            axes.tick_params(axis="x", labelrotation=60 if len(names) > 8 else 0, labelsize=7.5)
    return Picture(
        chart_markup(figure, "Leave-one-posture-out"),
        title="What each posture holds",
        caption="Each bar is the solution without that posture. The dashed lines are the stated "
        "sigma of a rotation and of a component of the translation, and 1 for the size of the "
        "left-out residuals over their prediction.",
    )


def correlation_picture(covariance: FloatArray) -> Picture:
    """Correlations of the six parameters."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    with styled():
        figure = new_figure(4.4, 3.8)
        axes = figure.add_subplot()
        picture = axes.imshow(correlation, cmap=DIVERGING, vmin=-1.0, vmax=1.0)
        for (row, column), value in np.ndenumerate(correlation):
            colour = "white" if abs(value) > 0.6 else MUTED
            axes.text(
                column, row, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=colour
            )
        axes.set_xticks(range(6), SHORT_NAMES)
        axes.set_yticks(range(6), SHORT_NAMES)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        figure.colorbar(picture, ax=axes, shrink=0.8)
    return Picture(
        chart_markup(figure, "Correlations of the hand-eye's parameters"),
        title="Correlations",
        caption="Increments of rotation about, and of translation along, the axes of Tool. Near "
        "1 or -1, two of them can hardly be told apart with these postures.",
    )


def residual_histogram(fit: HandEyeFit) -> Picture:
    """All residuals, outliers in the outer bins."""
    values = 1000.0 * _all_residuals(fit)
    reach = max(1.3 * float(np.percentile(np.abs(values), 99.0)), 1e-3)
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        axes.hist(
            np.clip(values, -reach, reach), np.linspace(-reach, reach, 61).tolist(), color=ACCENT
        )
        axes.set_xlabel("distance from the reference, µm")
        axes.set_ylabel("points")
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return Picture(
        chart_markup(figure, "Histogram of the residuals"),
        title="Distribution of residuals",
        caption="Every point of every stripe; those beyond the ends are counted in the last bins.",
    )


def _residuals_of(fit: HandEyeFit, posture: PostureResult) -> FloatArray:
    own = [item.residual_mm for item in fit.stripes if item.posture == posture.posture]
    return np.concatenate(own) if own else np.zeros(0)


def _all_residuals(fit: HandEyeFit) -> FloatArray:
    return np.concatenate([stripe.residual_mm for stripe in fit.stripes])


def _sigma_of_mean(posture: PostureResult) -> float:
    """Standard deviation that the noise model gives the posture's mean; 0 where not told."""
    if posture.normalised_mean == 0.0 or not np.isfinite(posture.normalised_mean):
        return 0.0
    return abs(posture.mean_mm / posture.normalised_mean)


MAX_DOTS = 12_000
FRUSTUM_SHARE = 0.3
"""Length of a drawn camera as a share of its distance from the points."""
HALF_ANGLE = 0.28
AXIS_COLOURS = (PALETTE[1], PALETTE[3], PALETTE[5])


def posture_scene(fit: HandEyeFit, stripes: Sequence[PosedStripe]) -> Picture:
    """Camera pyramids of all postures with their stripes, coloured by residual."""
    points = np.concatenate([stripe.points_base_mm for stripe in fit.stripes])
    residual_um = 1000.0 * np.concatenate([stripe.residual_mm for stripe in fit.stripes])
    step = max(1, len(points) // MAX_DOTS)
    reach = max(float(np.percentile(np.abs(residual_um), 98)), 1.0)
    dots = SceneDots(points[::step], ramp_colours(residual_um[::step], -reach, reach))
    placed = {stripe.source: stripe.points_base_mm for stripe in fit.stripes}
    lines, labels = _cameras(fit, stripes, placed)
    plate = fit.calibration.plate
    if plate is not None:
        lines.append(SceneLines(_plate_edges(plate, points), MUTED))
    what = "plate" if plate is not None else "sphere"
    markup = scene_markup(
        [dots], lines, labels, f"Postures of the sensor over the {what}", is_z_up=True
    )
    return Picture(
        ramp_markup(f"residual −{reach:.0f} µm", f"+{reach:.0f} µm") + markup,
        title="Postures and stripes (Base frame)",
        caption="Each pyramid is the sensor as the arm held it, with its axes X (orange), Y "
        "(green) and Z (blue, the view); the dots are the stripes placed with the result, "
        "coloured by their distance from the reference. Drag to turn; click, then scroll to zoom.",
    )


def _cameras(
    fit: HandEyeFit, stripes: Sequence[PosedStripe], placed: Mapping[str, FloatArray]
) -> tuple[list[SceneLines], list[tuple[str, tuple[float, float, float]]]]:
    """Pyramid and axes of the first exposure of each posture."""
    edges: list[FloatArray] = []
    axes: list[FloatArray] = []
    labels: list[tuple[str, tuple[float, float, float]]] = []
    seen: set[str] = set()
    for stripe in stripes:
        if stripe.posture in seen or stripe.source not in placed or len(stripe) == 0:
            continue
        seen.add(stripe.posture)
        pose = stripe.base_from_tool @ fit.calibration.tool_from_sensor
        size = FRUSTUM_SHARE * float(np.linalg.norm(stripe.points_mm.mean(axis=0)))
        frustum, triad = _pyramid(size), _triad(0.6 * size)
        edges.append(frustum @ pose.rotation.T + pose.translation_mm)
        axes.append(triad @ pose.rotation.T + pose.translation_mm)
        x, y, z = pose.translation_mm.tolist()
        labels.append((stripe.posture, (x, y, z)))
    lines = [SceneLines(np.concatenate(edges), LINE)] if edges else []
    for k, colour in enumerate(AXIS_COLOURS if axes else ()):
        lines.append(SceneLines(np.concatenate([item[2 * k : 2 * k + 2] for item in axes]), colour))
    return lines, labels


def _pyramid(length: float) -> FloatArray:
    """(16, 3) ends of the edges of a camera's pyramid, in Sensor."""
    half = HALF_ANGLE * length
    rim = np.array(
        [[x, y, length] for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
    )
    sides = np.stack([rim, np.roll(rim, -1, axis=0)], axis=1).reshape(-1, 3)
    spokes = np.stack([np.zeros((4, 3)), rim], axis=1).reshape(-1, 3)
    return np.concatenate([sides, spokes])


def _triad(length: float) -> FloatArray:
    """(6, 3) ends of the three axes."""
    return np.stack([np.zeros((3, 3)), length * np.eye(3)], axis=1).reshape(-1, 3)


def _plate_edges(plate: Plane, points_mm: FloatArray) -> FloatArray:
    local = (points_mm - plate.point_mm) @ plate.axes[:2].T
    low, high = np.percentile(local, [1, 99], axis=0)
    (u0, v0), (u1, v1) = low - 0.1 * (high - low), high + 0.1 * (high - low)
    corners = plate.point_mm + np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]) @ plate.axes[:2]
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 3)


COLUMNS = ("calibration", "θ °", "γ °", "φ °", "tx mm", "ty mm", "tz mm")


def repeat_blocks(
    names: Sequence[str],
    fits: Sequence[HandEyeFit],
    sensor_covariance: FloatArray | None = None,
) -> tuple[Table, Text]:
    """Angles of eq. 2.69 and translation of each calibration, and how far they scatter.

    Parameters
    ----------
    names
        One a calibration.
    fits
        The calibrations, two or more, of one sensor.
    sensor_covariance
        (P, P) of its parameters; None where it is taken as exact.
    """
    study = study_repeats([fit.calibration for fit in fits], sensor_covariance)
    if isinstance(study, FitFailure):
        return Table(COLUMNS, ()), Text(study.reason)
    rows = [_row(name, row, 3) for name, row in zip(names, study.values, strict=True)]
    rows.append(_row("mean", study.mean_values, 3))
    rows.append(_row("standard deviation", study.std, 4))
    if study.predicted is not None:
        rows.append(_row("predicted", study.predicted, 4))
    low, high = study.ratio_range
    text = (
        "One calibration from each recording. The standard deviation is that of one calibration, "
        f"n - 1 = {len(fits) - 1} in the denominator; the prediction is what the calibrations "
        "state themselves; of the sensor's share, as all have one sensor, only what their postures "
        "make differ. If it is right, "
        f"their ratio falls between {low:.2f} and {high:.2f} in 95 % of such studies."
    )
    if study.unlike_predicted:
        text += f" It does not for {', '.join(study.unlike_predicted)}."
    return Table(COLUMNS, tuple(rows), "One calibration each (as Table 4)"), Text(text)


def _row(name: str, values: FloatArray, decimals: int) -> tuple[str, ...]:
    return (name, *(f"{value:.{decimals}f}" for value in values))


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
    images: Sequence[LabelledProfile] = (),
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
        correlation_picture(total_covariance(scanner)),
        residual_histogram(fit),
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
    bars = left_out_bars(fit, numbers.rotation_sigma_deg, numbers.size_sigma_mm)
    wide = [residuals_by_posture(fit), bars]
    plate = fit.calibration.plate
    blocks = [Gallery(tuple(wide), 700)]
    if plate is not None:
        blocks.append(Gallery((residual_map(fit, plate),), 420))
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
