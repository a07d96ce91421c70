# SPDX-License-Identifier: Apache-2.0
"""The page of a stereo calibration, and its figures."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from armscan.calibration.cameras.pairs import SIDES
from armscan.calibration.cameras.stereo_result import (
    PairFit,
    StereoFit,
    ViewResiduals,
    right_camera_centre_mm,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotations import skew
from armscan.models.calibration import Provenance
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.records.exposure import Exposure
from armscan.report.camera import MEANINGS, RMS_MEANING, UNITS, noise_text
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    INK,
    MUTED,
    Marks,
    chart_markup,
    new_figure,
    photo_markup,
    styled,
)
from armscan.report.page import (
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
from armscan.report.quantity import Table, sentence, significant, with_sigma, without_source
from armscan.vision.targets.target import TargetView

ARROW_SHARE = 0.06
"""Length on the picture, as a share of its longer side, of a residual of three sigma."""

COLOUR_REACH = 3.0
"""The colours of epipolar distances end at this many times their rms."""


def residual_magnification(fit: StereoFit) -> float:
    """How much residual arrows are enlarged: a round number, the same in all pictures."""
    longest = max(fit.views.left.width_px, fit.views.left.height_px)
    wanted = ARROW_SHARE * longest / max(3.0 * fit.rms_px, 1e-6)
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted)


def residual_field(fit: StereoFit, side: int) -> Picture:
    """Residual arrows of one camera over its image, and what the target covered."""
    scale = residual_magnification(fit)
    used = [
        (view.points_px, residuals.residuals_px)
        for pair in fit.pairs
        if (view := pair.pair.views[side]) is not None
        and (residuals := (pair.left, pair.right)[side]) is not None
    ]
    points = np.concatenate([pixels for pixels, _ in used])
    arrows = scale * np.concatenate([residuals for _, residuals in used])
    camera = (fit.views.left, fit.views.right)[side]
    coverage = fit.sides[side].coverage
    with styled():
        figure = new_figure(*_size_of(camera))
        axes = figure.add_subplot()
        axes.quiver(
            *points.T, *arrows.T, angles="xy", scale_units="xy", scale=1.0,
            color=ACCENT, width=0.0022, headwidth=3.5, headlength=4.5,
        )  # fmt: skip
        _image_axes(axes, camera)
    empty = f"; nothing was seen in: {', '.join(coverage.empty)}" if coverage.empty else ""
    word = SIDES[side]
    return Picture(
        chart_markup(figure, f"Residual arrows over the {word} image"),
        title=f"{word.capitalize()} camera: residuals over the image",
        caption=f"Observed minus predicted, {scale:g} times enlarged; "
        f"{fit.sides[side].n_views} views, {100 * coverage.fraction:.0f} % of the image "
        f"covered{empty}.",
    )


def epipolar_map(fit: StereoFit) -> Picture:
    """Distances from the epipolar lines over the left image."""
    points, distances, _ = _matched(fit)
    reach = COLOUR_REACH * fit.epipolar_rms_px
    with styled():
        figure = new_figure(*_size_of(fit.views.left))
        axes = figure.add_subplot()
        drawn = axes.scatter(
            points[:, 0], points[:, 1], 9.0, distances, cmap="RdBu_r", vmin=-reach, vmax=reach,
            linewidths=0.2, edgecolors=MUTED,
        )  # fmt: skip
        _image_axes(axes, fit.views.left)
        figure.colorbar(drawn, ax=axes, label="distance, px", shrink=0.8)
    return Picture(
        chart_markup(figure, "Epipolar distances over the left image"),
        title="Distance from the epipolar line, over the left image",
        caption="Signed distance in the right image of each target point from the epipolar line of "
        "the same point in the left image. Colours that mix show noise; a side of one colour shows "
        "a relative pose or a lens that does not fit.",
    )


def epipolar_levers(fit: StereoFit) -> Picture:
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
            axes.plot(*_running_mean(lever, distances), "-", color=ALERT, linewidth=1.6)
            axes.set_xlabel(label)
            axes.set_ylabel("distance, px")
            axes.grid(axis="y")
    return Picture(
        chart_markup(figure, "Epipolar distances against depth and height"),
        title="Epipolar distance against its levers",
        caption="A wrong rotation about the baseline shows as a slope over y, a wrong direction of "
        "the baseline as one over depth. The line is the mean of tenths of the points.",
    )


def pair_bars(fit: StereoFit) -> Picture:
    """Root mean square of each view, and how far each pair's own pose is from the others."""
    rows = np.arange(len(fit.pairs), dtype=np.float64)
    levels = [math.sqrt(pair.level) if pair.is_related else 0.0 for pair in fit.pairs]
    with styled():
        figure = new_figure(9.0, max(2.2, 0.9 + 0.26 * len(rows)))
        left, right = figure.subplots(1, 2, sharey=True)
        for side, colour in enumerate((ACCENT, ACCENT_LIGHT)):
            values = [_rms((pair.left, pair.right)[side]) for pair in fit.pairs]
            left.barh(
                rows + 0.19 * (2 * side - 1), values, color=colour, height=0.36, label=SIDES[side]
            )
        left.set_yticks(rows, [_short(pair) for pair in fit.pairs])
        left.invert_yaxis()
        left.set_xlabel("rms reprojection residual, px")
        left.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderpad=0.1, ncols=2)
        colours = [ALERT if pair.is_misfit else ACCENT for pair in fit.pairs]
        right.barh(rows, levels, color=colours, height=0.6)
        right.axvline(1.0, color=MUTED, linewidth=0.8, linestyle="--")
        right.set_xlabel("own relative pose: distance from the other pairs'")
        for axes in (left, right):
            axes.grid(axis="x")
    return Picture(
        chart_markup(figure, "Residuals and relative pose of each pair"),
        title="Pairs",
        caption="Left: residuals of each view in the solution. Right: how far the relative pose "
        "that a pair gives by itself lies from that of the other pairs, in standard deviations "
        "and over that of the typical pair (dashed). Orange: the pair disagrees with the others.",
    )


def pair_pictures(
    fit: StereoFit, pair: PairFit, exposures: dict[str, Exposure]
) -> tuple[Picture, ...]:
    """The photographs of a pair with the points found and the residual arrows."""
    pictures = []
    for side, word in enumerate(SIDES):
        view, residuals = pair.pair.views[side], (pair.left, pair.right)[side]
        if view is not None and view.source in exposures:
            pictures.append(_photo(fit, view, residuals, exposures[view.source], word))
    return tuple(pictures)


def correlation_picture(fit: StereoFit) -> Picture:
    """Correlations of the relative pose."""
    names = ("rx", "ry", "rz", "tx", "ty", "tz")
    block = fit.covariance[18:, 18:]
    sigma = np.sqrt(np.diag(block))
    correlation = block / np.outer(sigma, sigma)
    with styled():
        figure = new_figure(4.2, 3.8)
        axes = figure.add_subplot()
        axes.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
        axes.set_xticks(range(len(names)), names)
        axes.set_yticks(range(len(names)), names)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        for (i, j), value in np.ndenumerate(correlation):
            shade = "white" if abs(value) > 0.6 else INK
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=shade)
    return Picture(
        chart_markup(figure, "Correlations of the relative pose"),
        title="Correlations of the relative pose",
        caption="Rotation (rx, ry, rz) and translation (tx, ty, tz) of right_from_left.",
    )


def _photo(
    fit: StereoFit, view: TargetView, residuals: ViewResiduals | None, exposure: Exposure, word: str
) -> Picture:
    points = view.points_px
    colour = "#35e0c0" if residuals is not None else "#ff8a4c"
    marks = [Marks(points, colour, "ring", 15.0), Marks(points[:1], colour, "dot", 13.0)]
    text = "not used"
    if residuals is not None:
        tips = points + residual_magnification(fit) * residuals.residuals_px
        arrows = np.stack([points, tips], axis=1).reshape(-1, 2)
        marks.append(Marks(arrows, "#ffb000", "line", 3.2))
        text = f"rms {significant(residuals.rms_px)} px"
    return Picture(
        photo_markup(exposure, marks, f"Target points found in {view.source}", longest_px=700),
        title=view.source,
        caption=f"{word}, {len(view)} points, {text}",
    )


def _matched(fit: StereoFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Left pixels, distances in the right image, depths of all pairs that relate the cameras."""
    found = [pair.matched for pair in fit.related if pair.matched is not None]
    return (
        np.concatenate([matched.left_px for matched in found]),
        np.concatenate([matched.in_right_px for matched in found]),
        np.concatenate([matched.depth_mm for matched in found]),
    )


def _running_mean(lever: FloatArray, values: FloatArray) -> tuple[list[float], list[float]]:
    parts = np.array_split(np.argsort(lever), min(10, len(lever)))
    return (
        [float(lever[part].mean()) for part in parts],
        [float(values[part].mean()) for part in parts],
    )


def _rms(residuals: ViewResiduals | None) -> float:
    return 0.0 if residuals is None else residuals.rms_px


def _short(pair: PairFit) -> str:
    name = pair.pair.name
    return name if len(name) <= 30 else "…" + name[-29:]


def _size_of(camera: CameraModel) -> tuple[float, float]:
    ratio = camera.height_px / camera.width_px
    width = 6.0 if ratio <= 1.0 else 6.0 / ratio
    return width + 0.6, width * ratio + 0.6


def _image_axes(axes: Axes, camera: CameraModel) -> None:
    axes.set_xlim(-0.5, camera.width_px - 0.5)
    axes.set_ylim(camera.height_px - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    axes.spines[:].set_visible(True)


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
        epipolar_map(fit),
        epipolar_levers(fit),
        residual_field(fit, 0),
        residual_field(fit, 1),
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
        f"{residual_magnification(fit):g} times enlarged."
    )
    pictures = [picture for pair in fit.pairs for picture in pair_pictures(fit, pair, exposures)]
    bars = Gallery((pair_bars(fit),), 700)
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
        (facts, Gallery((correlation_picture(fit),)), table),
        is_folded=True,
    )
