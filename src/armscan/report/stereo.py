# SPDX-License-Identifier: Apache-2.0
"""The page of a stereo calibration, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from armscan.calibration.cameras.pairs import SIDES, common_bow
from armscan.calibration.cameras.stereo_result import (
    PairFit,
    StereoFit,
    ViewResiduals,
    right_camera_centre_mm,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotations import skew, vector_sigma
from armscan.models.calibration import Provenance
from armscan.models.camera import PARAMETER_NAMES
from armscan.records.exposure import Exposure
from armscan.report.camera import (
    NO_TARGET,
    bow_quantities,
    hold_out_quantity,
    meaning_of,
    noise_text,
    rms_texts,
    target_text,
    unit_of,
)
from armscan.report.charts import (
    DIVERGING,
    correlation_chart,
    image_axes,
    magnification,
    named_rows,
    residual_field,
)
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    MUTED,
    chart_markup,
    new_figure,
    photo_markup,
    styled,
)
from armscan.report.page import Block, Facts, Gallery, Page, Picture, Section, Text, page_of
from armscan.report.photographs import (
    LEFT_OUT_COLOUR,
    TARGET_COLOUR,
    nothing_found_section,
    target_marks,
)
from armscan.report.quantity import (
    Quantity,
    Table,
    fact,
    matrix_table,
    only,
    quantity_table,
    sentence,
    significant,
    with_sigma,
)

STEREO_TITLE = "Stereo calibration"
AXES = "xyz"
N_INTRINSICS = 2 * len(PARAMETER_NAMES)
USES = {
    "free": "Both cameras' intrinsics were solved from these images.",
    "prior": "Given calibrations of the cameras counted as observations beside these images.",
    "fixed": "The given calibrations of the cameras were held; their uncertainty is carried on.",
}
COLOUR_REACH = 3.0
"""The colours of epipolar distances end at this many times their rms."""


PAIRS_HELD_OUT = (
    "the pairs were dealt into {n} groups; each group was predicted by cameras solved from the "
    "others, with only one board pose a pair fitted in both images"
)


def stereo_quantities(fit: StereoFit) -> tuple[Quantity, ...]:
    """What is told of a stereo calibration."""
    related = f"{len(fit.related)} used of {len(fit.pairs)}"
    bow = common_bow((fit.left.single, fit.right.single))
    return (
        Quantity("n_pairs", "Pairs", len(fit.related), shown=related),
        Quantity("n_points", "Target points", fit.n_points),
        Quantity(
            "rms_px",
            "Reprojection residual",
            fit.rms_px,
            shown=f"{significant(fit.rms_px)} px rms",
            meaning=f"left {significant(fit.left.rms_px)}, right {significant(fit.right.rms_px)} "
            "px; length of the residual",
        ),
        Quantity("left_rms_px", "", fit.left.rms_px),
        Quantity("right_rms_px", "", fit.right.rms_px),
        Quantity(
            "epipolar_rms_px",
            "Distance from epipolar lines",
            fit.epipolar_rms_px,
            shown=f"{significant(fit.epipolar_rms_px)} px rms",
            meaning=f"mean {fit.epipolar_mean_px:+.4f} px",
        ),
        Quantity("epipolar_mean_px", "", fit.epipolar_mean_px),
        hold_out_quantity(fit.hold_out, "pairs"),
        *_relative_quantities(fit),
        *(() if bow is None else bow_quantities(bow.bow_mm)),
    )


def _relative_quantities(fit: StereoFit) -> tuple[Quantity, ...]:
    """What relates the cameras."""
    pose, sigma = fit.views.right_from_left, fit.sigma[N_INTRINSICS:]
    vector, rows = pose.rotation_vector_rad, slice(N_INTRINSICS, N_INTRINSICS + 3)
    turns = np.rad2deg(vector)
    turn_sigma = np.rad2deg(vector_sigma(vector, fit.covariance[rows, rows]))
    return (
        Quantity("", "Baseline", *_baseline_mm(fit), "mm", "between the cameras' centres"),
        Quantity("", "Angle", *_angle_deg(fit), "°", "between their optical axes"),
        *(
            Quantity(
                "", f"rotation {axis}", float(turns[k]), float(turn_sigma[k]), "°",
                f"rotation vector of right_from_left, {axis}",
            )
            for k, axis in enumerate(AXES)
        ),
        *(
            Quantity(
                "", f"translation {axis}", float(pose.translation_mm[k]), float(sigma[3 + k]), "mm",
                f"the left camera in the right one's frame, {axis}",
            )
            for k, axis in enumerate(AXES)
        ),
    )  # fmt: skip


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
        return float(np.rad2deg(angle)), 0.0
    rows = slice(N_INTRINSICS, N_INTRINSICS + 3)
    gradient = normal / length
    variance = float(gradient @ fit.covariance[rows, rows] @ gradient)
    return float(np.rad2deg(angle)), float(np.rad2deg(np.sqrt(variance)))


def stereo_page(
    fit: StereoFit,
    not_found: Sequence[tuple[str, str]],
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report of two cameras; arguments as `camera_page`."""
    told, relative = stereo_quantities(fit), _relative_quantities(fit)
    x, y, z = right_camera_centre_mm(fit)
    scales = f"{fit.left.noise_scale:.2g} (left) and {fit.right.noise_scale:.2g} (right) times"
    where = (
        f"{USES[fit.options.intrinsics]} The right camera's centre lies at x {x:.2f}, y {y:.2f}, "
        f"z {z:.2f} mm in the left camera's frame, which is the Sensor frame (x to the right, y "
        "down, z forward). " + noise_text(scales) + target_text(fit.target_error_mm, "pairs")
    )
    charts = (
        _epipolar_map(fit),
        _epipolar_levers(fit),
        _side_residuals(fit, 0),
        _side_residuals(fit, 1),
    )
    how_well: tuple[Block, ...] = (
        *rms_texts(fit.hold_out, "pairs", PAIRS_HELD_OUT),
        Gallery(charts),
    )
    table = quantity_table(("quantity", "value ± 1 sigma", "meaning"), relative)
    sections = [
        Section("Where the cameras are to each other", (table, Text(where))),
        Section("How well it fits", tuple(how_well)),
        _pairs_section(fit, exposures),
        _two_cameras_section(fit),
    ]
    if not_found:
        sections.append(nothing_found_section(NO_TARGET, not_found, exposures))
    sections.append(_relative_covariance_section(fit))
    return page_of(
        provenance,
        STEREO_TITLE,
        f"{len(fit.related)} of {len(fit.pairs)} pairs relate the cameras, "
        f"{fit.n_points} target points",
        sections,
        cards=(*relative[:2], *only(told, "rms_px", "epipolar_rms_px", "hold_out_rms_px")),
        warnings=fit.warnings,
        is_simulated=is_simulated,
    )


def _pairs_section(fit: StereoFit, exposures: Mapping[str, Exposure]) -> Section:
    heads = ("pair", "left rms, px", "right rms, px", "epipolar, px", "own pose: off by", "level",
             "remark")  # fmt: skip
    table = Table(heads, tuple(pair_row(pair) for pair in fit.pairs), word_columns=(6,))
    text = Text(
        "Each pair gives the relative pose by itself (eqs. 4.15, 4.16): 'off by' is its distance "
        "from the solution. 'Level' is its squared distance from the other pairs over the noise, "
        "against the typical pair: 1 is a pair like the others. Typically pairs lie "
        f"{np.sqrt(fit.typical_level):.1f} standard deviations apart. Rings are target points, "
        "the filled one is the board's first point; orange lines are residuals, "
        f"{magnification(fit.views.left, fit.rms_px):g} times enlarged."
    )
    pictures = [
        picture
        for pair in fit.pairs
        for side in range(2)
        if (picture := _pair_picture(fit, pair, side, exposures)) is not None
    ]
    bars = Gallery((_pair_bars(fit),), 700)
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


def _pair_picture(
    fit: StereoFit, pair: PairFit, side: int, exposures: Mapping[str, Exposure]
) -> Picture | None:
    """A photograph of a pair with the points found and the residual arrows."""
    view, residuals = pair.pair.views[side], (pair.left, pair.right)[side]
    if view is None or view.source not in exposures:
        return None
    if residuals is None:
        marks, text = target_marks(view.points_px, LEFT_OUT_COLOUR), "not used"
    else:
        arrows = magnification(fit.views.left, fit.rms_px) * residuals.residuals_px
        marks = target_marks(view.points_px, TARGET_COLOUR, arrows)
        text = f"rms {significant(residuals.rms_px)} px"
    alt = f"Target points found in {view.source}"
    return Picture(
        photo_markup(exposures[view.source], marks, alt, longest_px=700),
        title=view.source,
        caption=f"{SIDES[side]}, {len(view)} points, {text}",
    )


def _side_residuals(fit: StereoFit, side: int) -> Picture:
    """Residual arrows of one camera over its image, and what the target covered."""
    scale = magnification(fit.views.left, fit.rms_px)
    used = [
        (view.points_px, residuals.residuals_px)
        for pair in fit.pairs
        if (view := pair.pair.views[side]) is not None
        and (residuals := (pair.left, pair.right)[side]) is not None
    ]
    coverage = fit.sides[side].coverage
    empty = f"; nothing was seen in: {', '.join(coverage.empty)}" if coverage.empty else ""
    return residual_field(
        (fit.views.left, fit.views.right)[side],
        np.concatenate([points for points, _ in used]),
        scale * np.concatenate([residuals for _, residuals in used]),
        title=f"{SIDES[side].capitalize()} camera: residuals over the image",
        caption=f"Observed minus predicted, {scale:g} times enlarged; "
        f"{fit.sides[side].n_views} views, {100 * coverage.fraction:.0f} % of the image "
        f"covered{empty}.",
    )


def _epipolar_map(fit: StereoFit) -> Picture:
    """Distances from the epipolar lines over the left image."""
    points, distances, _ = _matched(fit)
    reach = COLOUR_REACH * fit.epipolar_rms_px
    with styled():
        figure, axes = image_axes(fit.views.left)
        drawn = axes.scatter(
            points[:, 0], points[:, 1], 9.0, distances, cmap=DIVERGING, vmin=-reach, vmax=reach,
            linewidths=0.2, edgecolors=MUTED,
        )  # fmt: skip
        figure.colorbar(drawn, ax=axes, label="distance, px", shrink=0.8)
    return Picture(
        chart_markup(figure, "Epipolar distances over the left image"),
        title="Distance from the epipolar line, over the left image",
        caption="Signed distance in the right image of each target point from the epipolar line of "
        "the same point in the left image. Colours that mix show noise; a side of one colour shows "
        "a relative pose or a lens that does not fit.",
    )


def _epipolar_levers(fit: StereoFit) -> Picture:
    """Distances from the epipolar lines against depth and height in the image."""
    points, distances, depth = _matched(fit)
    with styled():
        figure = new_figure(6.6, 5.2)
        upper, lower = figure.subplots(2, 1, sharey=True)
        for axes, lever, label in (
            (upper, depth, "depth, mm"),
            (lower, points[:, 1], "y in the left image, px"),
        ):
            axes.plot(lever, distances, ".", color=ACCENT, markersize=2.5, alpha=0.6)
            axes.axhline(0.0, color=MUTED, linewidth=0.8)
            tenths = np.array_split(np.argsort(lever), min(10, len(lever)))
            means = [(lever[part].mean(), distances[part].mean()) for part in tenths]
            axes.plot(*zip(*means, strict=True), "-", color=ALERT, linewidth=1.6)
            axes.set_xlabel(label)
            axes.set_ylabel("distance, px")
            axes.grid(axis="y")
    return Picture(
        chart_markup(figure, "Epipolar distances against depth and height"),
        title="Epipolar distance against its levers",
        caption="A wrong rotation about the baseline shows as a slope over y, a wrong direction of "
        "the baseline as one over depth. The line is the mean of tenths of the points.",
    )


def _matched(fit: StereoFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Left pixels, distances in the right image, depths of all pairs that relate the cameras."""
    found = [pair.matched for pair in fit.related if pair.matched is not None]
    return (
        np.concatenate([matched.left_px for matched in found]),
        np.concatenate([matched.in_right_px for matched in found]),
        np.concatenate([matched.depth_mm for matched in found]),
    )


def _pair_bars(fit: StereoFit) -> Picture:
    """Root mean square of each view, and how far each pair's own pose is from the others."""
    rows = np.arange(len(fit.pairs), dtype=np.float64)
    levels = [math.sqrt(pair.level) if pair.is_related else 0.0 for pair in fit.pairs]
    with styled():
        figure = new_figure(9.0, max(2.2, 0.9 + 0.26 * len(rows)))
        left, right = figure.subplots(1, 2, sharey=True)
        for side, colour in enumerate((ACCENT, ACCENT_LIGHT)):
            rms = [_rms((pair.left, pair.right)[side]) for pair in fit.pairs]
            place = rows + 0.19 * (2 * side - 1)
            left.barh(place, rms, color=colour, height=0.36, label=SIDES[side])
        named_rows(left, [pair.pair.name for pair in fit.pairs])
        left.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderpad=0.1, ncols=2)
        colours = [ALERT if pair.is_misfit else ACCENT for pair in fit.pairs]
        right.barh(rows, levels, color=colours, height=0.6)
        right.axvline(1.0, color=MUTED, linewidth=0.8, linestyle="--")
        right.set_xlabel("own relative pose: distance from the other pairs'")
        right.grid(axis="x")
    return Picture(
        chart_markup(figure, "Residuals and relative pose of each pair"),
        title="Pairs",
        caption="Left: residuals of each view in the solution. Right: how far the relative pose "
        "that a pair gives by itself lies from that of the other pairs, in standard deviations "
        "and over that of the typical pair (dashed). Orange: the pair disagrees with the others.",
    )


def _rms(residuals: ViewResiduals | None) -> float:
    return 0.0 if residuals is None else residuals.rms_px


def _two_cameras_section(fit: StereoFit) -> Section:
    n = len(PARAMETER_NAMES)
    rows = []
    lenses = (fit.views.left.lens, fit.views.right.lens)
    for k, name in enumerate(PARAMETER_NAMES):
        if name not in {*fit.views.left.parameter_names, *fit.views.right.parameter_names}:
            continue
        meanings = dict.fromkeys(meaning_of(name, lens) for lens in lenses)
        cells = []
        for side, camera in enumerate((fit.views.left, fit.views.right)):
            value, sigma = camera.parameters[k], fit.sigma[side * n + k]
            is_free = name in fit.sides[side].single.free_parameters
            text = with_sigma(value, sigma, unit_of(name))
            cells.append(text if is_free or sigma > 0.0 else f"{value:g} (held)")
        rows.append((name.removesuffix("_px"), *cells, "; ".join(meanings)))
    heads = ("parameter", "left ± 1 sigma", "right ± 1 sigma", "meaning")
    reasons = f"Left: {sentence(fit.left.single.reason)} Right: {sentence(fit.right.single.reason)}"
    return Section("The two cameras", (Table(heads, tuple(rows), "", (3,)), Text(reasons)))


def _relative_covariance_section(fit: StereoFit) -> Section:
    facts = Facts(
        (
            fact("Degrees of freedom", str(fit.degrees_of_freedom)),
            fact("Condition number", f"{fit.condition:.3g} (boards eliminated, unit diagonal)"),
        )
    )
    short = [f"{kind}{axis}" for kind in "rt" for axis in AXES]
    block = fit.covariance[N_INTRINSICS:, N_INTRINSICS:]
    chart = correlation_chart(
        block,
        short,
        title="Correlations of the relative pose",
        caption="Rotation (rx, ry, rz) and translation (tx, ty, tz) of right_from_left.",
    )
    table = matrix_table("covariance (rad, mm)", short, block)
    return Section("Covariance of the relative pose", (facts, Gallery((chart,)), table), True)
