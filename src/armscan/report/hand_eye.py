# SPDX-License-Identifier: Apache-2.0
"""Pages of hand-eye and latency calibrations, and their numbers: matrix, angles, lengths, time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from armscan.calibration.hand_eye.board_result import BoardPosture
from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.result import (
    HandEyeFit,
    PostureResult,
    hand_eye_numbers,
    study_repeats,
)
from armscan.calibration.latency import LatencyFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import p_text
from armscan.geometry.shapes import Plane
from armscan.models.calibration import (
    HandEyeCalibration,
    HandEyeDiagnostics,
    Provenance,
    ScannerCalibration,
)
from armscan.reconstruction.labels import LabelledProfile
from armscan.records.exposure import Exposure
from armscan.report.charts import (
    DIVERGING,
    PAGE_WIDTH,
    Bars,
    correlation_chart,
    histogram_chart,
    named_columns,
    symmetric_edges,
)
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    LINE,
    MUTED,
    SceneDots,
    SceneLines,
    chart_markup,
    closed_outline,
    held_sensors,
    new_figure,
    ramp_colours,
    ramp_markup,
    raster_markup,
    scene_markup,
    styled,
)
from armscan.report.page import Block, Facts, Gallery, Page, Picture, Section, Text, page_of
from armscan.report.photographs import stripe_gallery
from armscan.report.quantity import (
    Quantity,
    Table,
    fact,
    for_people,
    only,
    significant,
    with_sigma,
)

TITLE = "Hand-eye calibration"
EULER_NAMES = ("θ (about X)", "γ (about Y)", "φ (about Z)")
SHORT_NAMES = ("rot X", "rot Y", "rot Z", "X", "Y", "Z")
MAX_DOTS_OF_POSTURE = 400
MAX_DOTS = 12_000
MAX_DOTS_OF_MAP = 8_000
FRUSTUM_SHARE = 0.3
"""Length of a drawn camera as a share of its distance from the points."""
NOISE_TEXT = (
    "The reported pose of a posture is off by a shift, a turn about the origin of Tool and a turn "
    "about the scan point that all exposures of the posture share; a smaller part is new in every "
    "exposure. The plate is off its plane by a smooth surface with the stated standard deviation, "
    "alike within the stated length. Stripe noise comes on top. Points of one posture therefore "
    "err together, and the sigmas of the hand-eye count postures, not points."
)


def total_covariance(scanner: ScannerCalibration) -> FloatArray:
    """(6, 6) covariance of the hand-eye with what the sensor's uncertainty does to it."""
    return np.asarray(scanner.covariance[-6:, -6:])


def hand_eye_quantities(scanner: ScannerCalibration) -> tuple[Quantity, ...]:
    """What is told of a hand-eye: the transformation, what it rests on, what was left over."""
    hand_eye = scanner.hand_eye
    is_board = hand_eye.diagnostics is not None and hand_eye.diagnostics.method == "board"
    numbers = hand_eye_numbers(hand_eye, total_covariance(scanner))
    rotation = hand_eye.tool_from_sensor.rotation
    matrix = "\n".join("  ".join(f"{v:+.6f}" for v in row) for row in np.round(rotation, 6))
    angles = zip(EULER_NAMES, numbers.euler_deg, numbers.euler_sigma_deg, strict=True)
    lengths = zip("XYZ", numbers.translation_mm, numbers.translation_sigma_mm, strict=True)
    size = (
        f"{hand_eye.n_postures} postures, {hand_eye.n_exposures} exposures, "
        f"{hand_eye.n_points:,} points"
    )
    return (
        Quantity(
            "rotation_tool_from_sensor",
            "Rotation tool_from_sensor",
            rotation.tolist(),
            shown=matrix,
        ),
        Quantity(
            "euler_intrinsic_xyz_deg",
            "The same as R = Rx(θ) Ry(γ) Rz(φ), eq. 2.69",
            numbers.euler_deg.tolist(),
            shown=", ".join(f"{name} {with_sigma(v, sigma)}°" for name, v, sigma in angles),
        ),
        Quantity(
            "translation_tool_mm",
            "Origin of Sensor in Tool",
            numbers.translation_mm.tolist(),
            shown=", ".join(f"{name} {with_sigma(v, sigma, 'mm')}" for name, v, sigma in lengths),
        ),
        Quantity("euler_sigma_deg", "", numbers.euler_sigma_deg.tolist()),
        Quantity("translation_sigma_mm", "", numbers.translation_sigma_mm.tolist()),
        *_arm_quantities(hand_eye),
        Quantity("n_postures", "Rests on", hand_eye.n_postures, shown=size),
        Quantity("n_exposures", "", hand_eye.n_exposures),
        Quantity("n_points", "", hand_eye.n_points),
        Quantity(
            "rms_mm",
            "Residual",
            hand_eye.rms_mm,
            shown=f"{significant(hand_eye.rms_mm)} mm rms",
            meaning="from the target's mean place" if is_board else "from the reference",
        ),
        *_evidence(hand_eye),
    )


def _arm_quantities(hand_eye: HandEyeCalibration) -> tuple[Quantity, Quantity]:
    """Scatter of the arm in one exposure, an axis, and where it was taken from."""
    position_mm, at_scan_point, at_tool = np.sqrt(hand_eye.arm_noise.variances).tolist()
    turn_deg = float(np.degrees(np.hypot(at_scan_point, at_tool)))
    origin, known = "", hand_eye.diagnostics
    if known is not None:
        origin = f", {_origin(known)}"
    turns = f"{significant(turn_deg, digits=2)}° ({_turns(at_scan_point, at_tool, digits=2)})"
    return (
        Quantity(
            "arm_position_mm",
            "Arm's scatter",
            position_mm,
            meaning=f"{turns}, an axis in one exposure{origin}",
            shown=significant(position_mm, "mm", 2),
        ),
        Quantity("arm_rotation_deg", "", turn_deg),
    )


def _origin(known: HandEyeDiagnostics) -> str:
    if not known.is_noise_estimated:
        return "as given"
    if known.is_arm_given:
        return "the shift as given, what was not given estimated from the residuals"
    return (
        "estimated from the residuals, which therefore test nothing: compare it with the arm's "
        "certificate"
    )


def _evidence(hand_eye: HandEyeCalibration) -> tuple[Quantity, ...]:
    """How well the postures determine the hand-eye; nothing where that was not kept."""
    known = hand_eye.diagnostics
    if known is None:
        return ()
    change = (
        f"{significant(known.left_out_rotation_deg)}°, "
        f"{significant(known.left_out_translation_mm)} mm"
    )
    noise = []
    if not known.is_noise_estimated:
        fits = "no" if known.chi2_probability < 0.001 else "yes"
        verdict = f"residuals {chi2_verdict(known.chi2_probability)}"
        noise = [fact("Fits the noise model", fits, verdict)]
    return (
        Quantity("method", "", known.method),
        Quantity("rank", "", known.rank),
        Quantity(
            "condition",
            "Condition",
            known.condition,
            shown=f"{known.condition:.0f}",
            meaning=f"rank {known.rank} of 6; below 100 is good",
        ),
        Quantity("weakest", "Known least", known.weakest),
        fact("Largest change without one posture", change),
        *noise,
        Quantity(
            "region_factor",
            "Joint 95 % region",
            known.region_factor,
            shown=f"{known.region_factor:.2f} times the usual limit of e' C⁻¹ e",
            meaning=f"{np.sqrt(known.region_factor):.2f} times as wide: errors have longer tails "
            "where the scatter is known from few postures",
        ),
        Quantity("chi2_probability", "", known.chi2_probability),
        Quantity("plate_flatness_mm", "", known.plate_flatness_mm),
        Quantity("is_noise_estimated", "", known.is_noise_estimated),
    )


def chi2_verdict(probability: float) -> str:
    """A probability of chi2 in words."""
    if not np.isfinite(probability):
        return "nothing is redundant, so nothing can be tested"
    if probability < 0.001:
        return f"larger than the noise model allows ({p_text(probability)})"
    if probability > 0.999:
        return f"smaller than the noise model expects (p = {probability:.4f})"
    return f"as expected (p = {probability:.2f})"


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
    """Lay out the report; ``exposures`` by source name, those that are missing are not shown.

    ``images`` are none where a sensor delivered points; ``repeats`` is a repeat study.
    """
    sections = [_result_section(fit, scanner)]
    if repeats:
        sections.append(Section("Repeated calibrations", tuple(repeats)))
    sections += [
        Section("The postures", (Gallery((posture_scene(fit, stripes),), 560),)),
        _residual_section(fit, scanner),
        Section("Posture by posture", (posture_table(fit),)),
        Section("The noise model", (Text(NOISE_TEXT), Facts(noise_facts(fit.calibration)))),
    ]
    if images:
        names = [] if scanner.sensor is None else [sheet.name for sheet in scanner.sensor.sheets]
        sections.append(Section("The stripes", stripe_gallery(images, names, exposures or {})))
    hand_eye = fit.calibration
    told = hand_eye_quantities(scanner)
    of_result = ("Residual", "Condition", "Fits the noise model")
    return page_of(
        scanner.provenance,
        TITLE,
        f"Where the sensor sits on the arm, from {hand_eye.n_postures} postures, "
        f"{hand_eye.n_exposures} exposures and {hand_eye.n_points:,} points",
        sections,
        cards=(
            *sigma_cards(scanner),
            *(replace(one, meaning="an axis") for one in only(told, "arm_position_mm")),
            *(item for item in told if item.label in of_result),
        ),
        warnings=fit.warnings,
        is_simulated=is_simulated,
    )


def sigma_cards(scanner: ScannerCalibration) -> tuple[Quantity, Quantity]:
    """Standard deviations of the hand-eye, with and without the sensor's own."""
    hand_eye = scanner.hand_eye
    alone = hand_eye_numbers(hand_eye, hand_eye.covariance)
    total = hand_eye_numbers(hand_eye, total_covariance(scanner))
    turn, shift = f"{significant(alone.rotation_sigma_deg, digits=2)}°", alone.size_sigma_mm
    beside = ["", ""]
    if scanner.sensor is not None:
        words = (turn, significant(shift, "mm", 2))
        beside = [f"; {word} without the sensor's own" for word in words]
    return (
        fact(
            "Sigma of the rotation",
            f"{significant(total.rotation_sigma_deg, digits=2)}°",
            f"about an axis{beside[0]}",
        ),
        fact(
            "Sigma of the translation",
            significant(total.size_sigma_mm, "mm", 2),
            f"along an axis{beside[1]}",
        ),
    )


def _result_section(fit: HandEyeFit, scanner: ScannerCalibration) -> Section:
    told = for_people(hand_eye_quantities(scanner))
    blocks = (
        Facts(told[:3]),
        Facts(told[3:]),
        Facts(tuple(fact(*pair) for pair in fit.reference), "The reference"),
        Gallery((correlations(scanner), _residual_histogram(fit))),
    )
    return Section("The hand-eye", blocks)


def correlations(scanner: ScannerCalibration) -> Picture:
    """Of the hand-eye's six parameters."""
    return correlation_chart(
        total_covariance(scanner),
        SHORT_NAMES,
        title="Correlations",
        caption="Increments of rotation about, and of translation along, the axes of Tool. Near "
        "1 or -1, two of them can hardly be told apart with these postures.",
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


def _residual_section(fit: HandEyeFit, scanner: ScannerCalibration) -> Section:
    bars = left_out_bars(fit.postures, scanner)
    blocks = [Gallery((residuals_by_posture(fit), bars), 700)]
    plate = fit.calibration.plate
    if plate is not None:
        blocks.append(Gallery((_residual_map(fit, plate),)))
    return Section("How well it fits", tuple(blocks))


def _turns(scan_rad: float, tool_rad: float, digits: int = 3) -> str:
    """Turns of the arm about the origin of Tool and about the scan point, in words."""
    tool_deg, scan_deg = np.degrees([tool_rad, scan_rad]).tolist()
    tool, scan = significant(tool_deg, digits=digits), significant(scan_deg, digits=digits)
    return f"{tool}° about the origin of Tool, {scan}° about the scan point"


def _arm_scatter(shift_mm: float, scan_rad: float, tool_rad: float) -> str:
    return f"{significant(shift_mm, 'mm')}, {_turns(scan_rad, tool_rad)}"


def noise_facts(hand_eye: HandEyeCalibration) -> tuple[Quantity, ...]:
    """What scatters, and where that is from."""
    noise, known = hand_eye.arm_noise, hand_eye.diagnostics
    common = _arm_scatter(noise.position_mm, noise.rotation_rad, noise.tool_rotation_rad)
    new = _arm_scatter(
        noise.exposure_position_mm, noise.exposure_rotation_rad, noise.exposure_tool_rotation_rad
    )
    facts = [
        fact("Arm, common to a posture", f"{common}, an axis"),
        fact("Arm, new in every exposure", new),
    ]
    if known is not None and known.method == "plate":
        flatness = significant(known.plate_flatness_mm)
        alike = f"alike within {known.flatness_length_mm:.0f} mm"
        facts.append(fact("Plate's flatness", f"{flatness} mm, {alike}"))
    if known is not None:
        facts.append(fact("These standard deviations are", _origin(known)))
    return tuple(facts)


def repeat_blocks(
    names: Sequence[str],
    fits: Sequence[HandEyeFit],
    sensor_covariance: FloatArray | None = None,
) -> tuple[Table, Text]:
    """Angles of eq. 2.69 and translation of each calibration, and how far they scatter.

    As the thesis's Table 4.

    ``sensor_covariance``: (P, P) of its parameters; None where it is taken as exact.
    """
    columns = ("calibration", "θ °", "γ °", "φ °", "tx mm", "ty mm", "tz mm")
    study = study_repeats([fit.beside_given_sensor for fit in fits], sensor_covariance)
    if isinstance(study, FitFailure):
        return Table(columns, ()), Text(study.reason)
    lines = [(name, row, 3) for name, row in zip(names, study.values, strict=True)]
    lines += [("mean", study.mean_values, 3), ("standard deviation", study.std, 4)]
    if study.predicted is not None:
        lines.append(("predicted", study.predicted, 4))
    rows = tuple((name, *(f"{value:.{n}f}" for value in row)) for name, row, n in lines)
    low, high = study.ratio_range
    text = (
        "One calibration from each recording, beside the sensor as it was given. The standard "
        "deviation is that of one calibration, "
        f"n - 1 = {len(fits) - 1} in the denominator; the prediction is what the calibrations "
        "state themselves; of the sensor's share, as all have one sensor, only what their postures "
        "make differ. If it is right, "
        f"their ratio falls between {low:.2f} and {high:.2f} in 95 % of such studies."
    )
    if study.unlike_predicted:
        text += f" It does not for {', '.join(study.unlike_predicted)}."
    return Table(columns, rows, "One calibration each (as Table 4)"), Text(text)


def residuals_by_posture(fit: HandEyeFit) -> Picture:
    """All residuals of each posture, their mean, and the spread that the noise model expects."""
    generator = np.random.default_rng(0)
    with styled():
        figure = new_figure(PAGE_WIDTH, 3.6)
        axes = figure.add_subplot()
        axes.axhline(0.0, color=LINE, linewidth=0.9)
        for k, posture in enumerate(fit.postures):
            found = [s.residual_mm for s in fit.stripes if s.posture == posture.posture]
            values = 1000.0 * np.concatenate([*found, np.zeros(0)])
            shown = values[:: max(1, len(values) // MAX_DOTS_OF_POSTURE)]
            place = k + generator.uniform(-0.3, 0.3, len(shown))
            axes.plot(place, shown, ".", color=ACCENT_LIGHT, markersize=1.8, zorder=1)
            sigma = 1000.0 * _sigma_of_mean(posture)
            axes.bar(k, 4 * sigma, 0.5, -2 * sigma, color="none", edgecolor=MUTED, zorder=2)
            axes.plot([k], [1000.0 * posture.mean_mm], "o", color=ALERT, markersize=5, zorder=3)
        named_columns(axes, [posture.posture for posture in fit.postures])
        axes.set_xlabel("posture")
        axes.set_ylabel("distance from the reference, µm")
        widest = 2000.0 * max(_sigma_of_mean(posture) for posture in fit.postures)
        largest = float(np.percentile(np.abs(_residuals_um(fit)), 99.8))
        reach = 1.1 * max(widest, largest, 1e-3)
        axes.set_ylim(-reach, reach)
    return Picture(
        raster_markup(figure, "Residuals by posture"),
        title="Residuals by posture",
        caption="Small dots are points, the large dot their mean; the box is two sigma of that "
        "mean under the noise model (pose of the arm, flatness, stripe, sensor), less what the fit "
        "follows. Means within their boxes "
        "are what an arm does; one far outside points to a posture that does not belong.",
    )


def _residual_map(fit: HandEyeFit, plate: Plane) -> Picture:
    """Residuals over the plate: its flatness shows as a pattern that postures share."""
    local = (_points_mm(fit) - plate.point_mm) @ plate.axes[:2].T
    values = _residuals_um(fit)
    reach = max(float(np.percentile(np.abs(values), 98)), 1e-3)
    step = max(1, len(values) // MAX_DOTS_OF_MAP)
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


def left_out_bars(
    postures: Sequence[PostureResult] | Sequence[BoardPosture], scanner: ScannerCalibration
) -> Picture:
    """Change of the hand-eye when one posture takes no part."""
    names = [posture.posture for posture in postures]
    numbers = hand_eye_numbers(scanner.hand_eye, total_covariance(scanner))
    series = (
        ("change of the rotation, °", numbers.rotation_sigma_deg, "left_out_rotation_deg"),
        ("change of the translation, mm", numbers.size_sigma_mm, "left_out_translation_mm"),
        ("residual left out, in sigmas", 1.0, "left_out_normalised"),
    )
    with styled():
        figure = new_figure(PAGE_WIDTH, 2.9)
        grid: Any = figure.subplots(1, 3)
        for axes, (label, usual, name) in zip(grid, series, strict=True):
            heights = [getattr(posture, name) for posture in postures]
            axes.bar(range(len(names)), heights, 0.6, color=ACCENT)
            axes.axhline(usual, color=ALERT, linewidth=1.0, linestyle="--")
            axes.set_title(label, loc="left", fontsize=8.5)
            named_columns(axes, names)
    return Picture(
        chart_markup(figure, "Leave-one-posture-out"),
        title="What each posture holds",
        caption="Each bar is the solution without that posture. The dashed lines are the stated "
        "sigma of a rotation and of a component of the translation, and 1 for the size of the "
        "left-out residuals over their prediction.",
    )


def _residual_histogram(fit: HandEyeFit) -> Picture:
    """All residuals, outliers in the outer bins."""
    residuals = _residuals_um(fit)
    edges = symmetric_edges(residuals, least=1e-3)
    return histogram_chart(
        [Bars(np.clip(residuals, edges[0], edges[-1]), ACCENT)],
        edges,
        "distance from the reference, µm",
        title="Distribution of residuals",
        caption="Every point of every stripe; those beyond the ends are counted in the last bins.",
    )


def _points_mm(fit: HandEyeFit) -> FloatArray:
    return np.concatenate([stripe.points_base_mm for stripe in fit.stripes])


def _residuals_um(fit: HandEyeFit) -> FloatArray:
    return 1000.0 * np.concatenate([stripe.residual_mm for stripe in fit.stripes])


def _sigma_of_mean(posture: PostureResult) -> float:
    """Standard deviation that the noise model gives the posture's mean; 0 where not told."""
    if posture.normalised_mean == 0.0 or not np.isfinite(posture.normalised_mean):
        return 0.0
    return abs(posture.mean_mm / posture.normalised_mean)


def posture_scene(fit: HandEyeFit, stripes: Sequence[PosedStripe]) -> Picture:
    """Camera pyramids of all postures with their stripes, coloured by residual."""
    points, residuals = _points_mm(fit), _residuals_um(fit)
    step = max(1, len(points) // MAX_DOTS)
    reach = max(float(np.percentile(np.abs(residuals), 98)), 1.0)
    dots = SceneDots(points[::step], ramp_colours(residuals[::step], -reach, reach))
    lines, labels = _cameras(fit, stripes)
    plate = fit.calibration.plate
    if plate is not None:
        lines.append(SceneLines(_plate_edges(plate, points), MUTED))
    alt = f"Postures of the sensor over the {'sphere' if plate is None else 'plate'}"
    return Picture(
        ramp_markup(f"residual −{reach:.0f} µm", f"+{reach:.0f} µm")
        + scene_markup([dots], lines, labels, alt, is_z_up=True),
        title="Postures and stripes (Base frame)",
        caption="Each pyramid is the sensor as the arm held it, with its axes X (orange), Y "
        "(green) and Z (blue, the view); the dots are the stripes placed with the result, "
        "coloured by their distance from the reference.",
    )


def _cameras(
    fit: HandEyeFit, stripes: Sequence[PosedStripe]
) -> tuple[list[SceneLines], list[tuple[str, tuple[float, float, float]]]]:
    """Pyramid and axes of the first exposure of each posture."""
    used = {stripe.source for stripe in fit.stripes}
    first: dict[str, PosedStripe] = {}
    for stripe in stripes:
        if stripe.source in used and len(stripe):
            first.setdefault(stripe.posture, stripe)
    return held_sensors(
        {
            posture: (
                stripe.base_from_tool @ fit.calibration.tool_from_sensor,
                FRUSTUM_SHARE * float(np.linalg.norm(stripe.points_mm.mean(axis=0))),
            )
            for posture, stripe in first.items()
        }
    )


def _plate_edges(plate: Plane, points_mm: FloatArray) -> FloatArray:
    local = (points_mm - plate.point_mm) @ plate.axes[:2].T
    low, high = np.percentile(local, [1, 99], axis=0)
    (u0, v0), (u1, v1) = low - 0.1 * (high - low), high + 0.1 * (high - low)
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    return closed_outline(plate.point_mm + corners @ plate.axes[:2])


LATENCY_TITLE = "Latency calibration"
LATENCY_TEXT = (
    "A wrong time places the plate too high while the head goes one way and too low on the way "
    "back: the height is off by stand-off speed times time. What depends on where the head is "
    "comes back with the same sign, and is solved along as a smooth function of the place. The "
    "latency is added to an exposure's time before the arm's pose is looked up by time; poses "
    "found by trigger id do not need it."
)


def latency_quantities(fit: LatencyFit) -> tuple[Quantity, ...]:
    """What is told of a latency: the time, the drift, the motion and what is left over."""
    motion = fit.motion
    rms = float(np.sqrt((np.asarray(fit.estimate.residuals) ** 2).mean()))
    before = float(np.sqrt((fit.before_mm**2).mean()))
    noise = fit.noise[0]
    return (
        Quantity("latency_ns", "", fit.latency_ns),
        Quantity("latency_sigma_ns", "", fit.sigma_ns),
        Quantity(
            "latency_ms",
            "Latency",
            1e-6 * fit.latency_ns,
            1e-6 * fit.sigma_ns,
            "ms",
            "added to an exposure's time",
        ),
        Quantity(
            "drift_ppm",
            "Drift",
            1e6 * fit.drift,
            1e6 * fit.sigma_drift,
            "ppm",
            "by which the arm's clock runs faster",
        ),
        Quantity("t_middle_ns", "", fit.t_middle_ns),
        Quantity(
            "stand_off_mm_s",
            "Speed of the stand-off",
            motion.speed_mm_s,
            unit="mm/s rms",
            meaning=f"{significant(motion.telling_mm_s)} mm/s of it tell the time, "
            f"{motion.n_reversals} reversals in {motion.seconds:.1f} s",
        ),
        Quantity("telling_mm_s", "", motion.telling_mm_s),
        Quantity("n_reversals", "", motion.n_reversals),
        Quantity("n_exposures", "Exposures used", len(fit.t_ns)),
        Quantity("n_left_out", "Left out", fit.n_left_out),
        Quantity(
            "rms_mm", "Heights of the plate", rms, unit="mm rms", meaning=f"{before:.3g} before"
        ),
        Quantity(
            "white_mm",
            "Their scatter",
            noise.white_mm,
            unit="mm",
            meaning=f"each by itself, and {significant(noise.slow_mm)} mm that fade in "
            f"{noise.fades_s:.2g} s",
        ),
    )


def latency_page(
    fit: LatencyFit, provenance: Provenance, *, warnings: Sequence[str], is_simulated: bool
) -> Page:
    """Lay out the report of a latency, a picture of the plate's heights before and after."""
    told = latency_quantities(fit)
    title = "Heights of the plate"
    with styled():
        figure = new_figure(PAGE_WIDTH, 3.4)
        axes = figure.add_subplot()
        start = int(fit.t_ns[0])
        for t_ns, heights, colour, label in (
            (fit.before_t_ns, fit.before_mm, ACCENT_LIGHT, "without the latency"),
            (fit.t_ns, np.asarray(fit.estimate.residuals), ACCENT, "with it"),
        ):
            axes.plot(1e-9 * (t_ns - start), heights, ".", ms=3, color=colour, label=label)
        axes.set_xlabel("time, s")
        axes.set_ylabel("height over the plate, mm")
        axes.set_ylim(top=1.3 * axes.get_ylim()[1])
        axes.legend(loc="upper right", ncols=2)
    picture = Picture(chart_markup(figure, title), "One dot an exposure.", title)
    return page_of(
        provenance,
        LATENCY_TITLE,
        f"The time between camera and arm, from {len(fit.t_ns):,} exposures of a plate",
        [
            Section("The time", (Facts(for_people(told)), Gallery((picture,), 1000))),
            Section("How it is found", (Text(LATENCY_TEXT),)),
        ],
        cards=tuple(item for item in told if item.label in ("Latency", "Heights of the plate")),
        warnings=warnings,
        is_simulated=is_simulated,
    )
