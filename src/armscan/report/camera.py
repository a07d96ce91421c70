# SPDX-License-Identifier: Apache-2.0
"""The page of a camera calibration, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap

from armscan.calibration.cameras.result import BoardWarp, CameraFit, ViewFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.least_squares import p_text
from armscan.models.calibration import Provenance
from armscan.models.camera import PARAMETER_NAMES, Lens
from armscan.records.exposure import Exposure
from armscan.report.charts import (
    Bars,
    correlation_chart,
    histogram_chart,
    image_axes,
    magnification,
    named_rows,
    residual_field,
)
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    INK,
    LINE,
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

CAMERA_TITLE = "Camera calibration"
NO_TARGET = "Images without a usable target"
MEANINGS = {
    "fx_px": "focal length along x",
    "fy_px": "focal length along y",
    "cx_px": "principal point x",
    "cy_px": "principal point y",
    "k1": "radial distortion, r²",
    "k2": "radial distortion, r⁴",
    "p1": "tangential distortion",
    "p2": "tangential distortion",
    "k3": "radial distortion, r⁶",
}
FISHEYE_TERMS = {"k1": "θ³", "k2": "θ⁵", "k3": "θ⁷"}
"""Of the angle from the axis."""
RMS_MEANING = (
    "An rms here is the root of the mean, over points, of the squared length of the residual "
    "vector (x and y together), as OpenCV defines it."
)
PARAMETER_HEADS = ("parameter", "value ± 1 sigma", "meaning")
VIEWS_HELD_OUT = (
    "the views were dealt into {n} groups; each group was predicted by a camera solved from the "
    "others, with only the board's pose fitted to it"
)


def camera_quantities(fit: CameraFit, n_images: int) -> tuple[Quantity, ...]:
    """What is told of a camera's calibration from ``n_images`` images."""
    held_out = fit.cross_validation
    return (
        Quantity("n_views", "Images", fit.n_views, shown=f"{fit.n_views} used of {n_images}"),
        Quantity("n_points", "Target points", fit.n_points),
        Quantity(
            "rms_px",
            "Reprojection residual",
            fit.rms_px,
            shown=f"{significant(fit.rms_px)} px rms",
            meaning="length of the residual, x and y together; "
            f"{significant(fit.sigma_point_px)} px an axis",
        ),
        Quantity("sigma_point_px", "", fit.sigma_point_px),
        Quantity("covered_fraction", "", fit.coverage.fraction),
        *_stretch_quantities(fit),
        hold_out_quantity(held_out, "images"),
        *lens_quantities(fit.camera.lens),
        *parameter_quantities(fit),
        *(bow_quantities(fit.warp.bow_mm) if fit.warp is not None else ()),
        *_print_quantities(fit),
    )


def lens_quantities(lens: Lens) -> tuple[Quantity, ...]:
    """Said of a lens that is no pinhole."""
    if lens == "pinhole":
        return ()
    meaning = "a point's distance from the principal point follows its angle from the axis"
    return (Quantity("lens", "Lens", lens, meaning=meaning),)


def _stretch_quantities(fit: CameraFit) -> tuple[Quantity, ...]:
    """Of the print from row to row, as a part; nothing where the views do not tell."""
    if not math.isfinite(fit.stretch_sigma):
        return ()
    return (
        Quantity("stretch", "", fit.stretch),
        Quantity("stretch_sigma", "", fit.stretch_sigma),
    )


def bow_quantities(bow_mm: Sequence[float] | FloatArray) -> tuple[Quantity, ...]:
    """Bow of the board along x and along y; nothing of a flat one."""
    if not np.any(bow_mm):
        return ()
    x, y = (significant(float(each), "mm") for each in bow_mm)
    shown = f"{x} along x, {y} along y"
    value, words = [float(each) for each in bow_mm], "solved along"
    return (Quantity("board.bow_mm", "Bow of the board", value, shown=shown, meaning=words),)


def _print_quantities(fit: CameraFit) -> tuple[Quantity, ...]:
    """What the points were solved to miss their places by; nothing where that was not asked for."""
    if not fit.options.solve_print:
        return ()
    if not fit.is_print_solved:
        return (fact("Misprints", "none seen, of which four views and more tell: taken as stated"),)
    missed = np.concatenate([view.missed_mm for view in fit.used_views])
    largest_mm = float(np.linalg.norm(missed, axis=1).max())
    shown = f"{significant(fit.target_error_mm, 'mm')} rms an axis"
    words = f"solved along; the largest {significant(largest_mm, 'mm')}"
    label, value = "Misprints", fit.target_error_mm
    return (Quantity("board.print_error_mm", label, value, shown=shown, meaning=words),)


def meaning_of(name: str, lens: Lens) -> str:
    """What a parameter of a camera is."""
    if lens == "fisheye" and name in FISHEYE_TERMS:
        return f"fisheye, {FISHEYE_TERMS[name]} of the angle from the axis"
    return MEANINGS[name]


def parameter_quantities(fit: CameraFit) -> tuple[Quantity, ...]:
    """Each parameter with its sigma; one that was held says so."""
    return tuple(
        Quantity(
            f"parameters.{name.removesuffix('_px')}",
            name.removesuffix("_px"),
            float(value),
            float(sigma),
            unit_of(name),
            meaning_of(name, fit.camera.lens),
            "" if name in fit.free_parameters else f"{value:g} (held)",
        )
        for name, value, sigma in zip(
            PARAMETER_NAMES, fit.camera.parameters, fit.sigma, strict=True
        )
        if name in fit.camera.parameter_names
    )


def camera_page(
    fit: CameraFit,
    not_found: Sequence[tuple[str, str]],
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report; ``exposures`` by source name, those that are missing are not shown.

    ``not_found`` are source and reason of images without a usable target.
    """
    n_images = len(fit.views) + len(not_found)
    told = camera_quantities(fit, n_images)
    words = (
        f"{sentence(fit.model_reason)} Pixel (0, 0) is the centre of the top-left pixel. "
        + noise_text(f"{fit.noise_scale:.2g} times")
        + _print_text(fit)
    )
    table = quantity_table(PARAMETER_HEADS, parameter_quantities(fit))
    charts = (_camera_residuals(fit), _residual_histogram(fit))
    how_well: tuple[Block, ...] = (
        *rms_texts(fit.cross_validation, "views", VIEWS_HELD_OUT),
        Gallery(charts),
    )
    sections = [
        Section("The camera", (table, Text(words))),
        Section("How well it fits", tuple(how_well)),
        Section("What the target covered", (Gallery((_coverage_map(fit), _tilt_rose(fit))),)),
        _views_section(fit, exposures),
    ]
    if not_found:
        sections.append(nothing_found_section(NO_TARGET, not_found, exposures))
    if fit.warp is not None:
        sections.append(_warp_section(fit.warp))
    sections.append(_covariance_section(fit))
    return page_of(
        provenance,
        CAMERA_TITLE,
        f"{fit.camera.width_px} × {fit.camera.height_px} px camera, "
        f"{'fisheye lens, ' if fit.camera.lens == 'fisheye' else ''}"
        f"{fit.n_views} of {n_images} images used, {fit.n_points} target points",
        sections,
        cards=only(told, "parameters.fx", "parameters.cx", "rms_px", "hold_out_rms_px"),
        warnings=fit.warnings,
        is_simulated=is_simulated,
    )


def unit_of(name: str) -> str:
    """Unit of a camera's parameter."""
    return "px" if name.endswith("_px") else ""


def hold_out_quantity(held_out: Any, what: str) -> Quantity:
    """The residual of a hold-out (``rms_px``, ``rms_in_sample_px``, ``n_folds``), or none."""
    label = f"On {what} it has not seen"
    if held_out is None:
        few = f"too few {what} to hold some of them back"
        return Quantity("hold_out_rms_px", label, None, shown="not known", meaning=few)
    return Quantity(
        "hold_out_rms_px",
        label,
        held_out.rms_px,
        shown=f"{significant(held_out.rms_px)} px rms",
        meaning=f"{held_out.n_folds}-fold hold-out; "
        f"{significant(held_out.rms_in_sample_px)} px in sample",
    )


def rms_texts(held_out: Any, what: str, how: str) -> tuple[Text, ...]:
    """What an rms is, and how a hold-out was made."""
    if held_out is None:
        return (Text(RMS_MEANING),)
    growth = 100.0 * (held_out.rms_px / held_out.rms_in_sample_px - 1.0)
    return (
        Text(RMS_MEANING),
        Text(
            f"Hold-out: {how.format(n=held_out.n_folds)}. The residual there is {growth:+.1f} % "
            "against the solution itself."
        ),
    )


def noise_text(times: str) -> str:
    """Why standard deviations rest on the residuals, and how much larger these are."""
    return (
        "Standard deviations rest on the scatter of the residuals, which is "
        f"{times} what the noise of the image's pixels alone would make: the rest is compression, "
        "sharpening, a board that is not quite flat or a lens that the model does not quite "
        "follow, and it is counted."
    )


def _print_text(fit: CameraFit) -> str:
    """What is said of the target's points."""
    if not fit.is_print_solved:
        return target_text(fit.target_error_mm, "views")
    return (
        f" The target's points lie {significant(fit.target_error_mm)} mm (rms an axis) beside "
        "their places. Where each is printed was estimated together with the camera: residuals "
        "are those from there, and unseen views are predicted on the places that the other views "
        "tell. A lens that the model does not follow may pass for a print that errs."
    )


def target_text(target_error_mm: float, what: str) -> str:
    """How far target points miss their places, which more of ``what`` do not average."""
    if target_error_mm == 0.0:
        return ""
    return (
        " Residuals of a target point repeat from view to view: the points miss their places by "
        f"{significant(target_error_mm)} mm (one standard deviation an axis). More {what} do "
        "not average that; the standard deviations hold it."
    )


def _views_section(fit: CameraFit, exposures: Mapping[str, Exposure]) -> Section:
    left = fit.cross_validation
    held_out = {} if left is None else dict(zip(left.sources, left.view_rms_px, strict=True))
    rows = tuple(
        (
            view.source,
            str(len(view.view)),
            significant(view.rms_px),
            significant(held_out[view.source]) if view.source in held_out else "",
            f"{view.tilt_deg:.0f}°",
            f"{view.distance_mm:.0f} mm",
            view.note or ("used" if view.is_used else "left out"),
        )
        for view in fit.views
    )
    heads = ("image", "points", "rms, px", "held out, px", "tilt", "distance", "remark")
    shown = [view for view in fit.views if view.source in exposures]
    pictures = tuple(_view_picture(fit, view, exposures[view.source]) for view in shown)
    text = Text(
        "Rings are the target points found, the filled one is the board's first point. Orange "
        f"lines are residuals, {magnification(fit.camera, fit.rms_px):g} times enlarged. Rings in "
        "orange: the view was left out. Click a picture to enlarge it."
    )
    table = Table(heads, rows, word_columns=(6,))
    return Section(
        "The images", (Gallery((_view_bars(fit, held_out),)), table, text, Gallery(pictures, 300))
    )


def _view_picture(fit: CameraFit, view: ViewFit, exposure: Exposure) -> Picture:
    """The photograph with the target points found, and the residual arrows."""
    arrows = magnification(fit.camera, fit.rms_px) * view.residuals_px
    colour = TARGET_COLOUR if view.is_used else LEFT_OUT_COLOUR
    marks = target_marks(view.view.points_px, colour, arrows)
    state = "" if view.is_used else "left out; "
    return Picture(
        photo_markup(exposure, marks, f"Target points found in {view.source}"),
        title=view.source,
        caption=f"{state}{len(view.view)} points, rms {significant(view.rms_px)} px, tilt "
        f"{view.tilt_deg:.0f}°, {view.distance_mm:.0f} mm away",
    )


def _camera_residuals(fit: CameraFit) -> Picture:
    scale = magnification(fit.camera, fit.rms_px)
    points = np.concatenate([view.view.points_px for view in fit.used_views])
    residuals = np.concatenate([view.residuals_px for view in fit.used_views])
    return residual_field(
        fit.camera,
        points,
        scale * residuals,
        title="Residuals over the image",
        caption=f"Observed minus predicted, all used views, {scale:g} times enlarged. A camera "
        "model that fits leaves arrows without any pattern; arrows that turn together show a lens "
        "that the model does not follow, or a board that is not flat.",
    )


def _coverage_map(fit: CameraFit) -> Picture:
    """Where in the image target points were seen."""
    counts = fit.coverage.counts
    points = np.concatenate([view.view.points_px for view in fit.used_views])
    width, height = fit.camera.width_px, fit.camera.height_px
    with styled():
        figure, axes = image_axes(fit.camera)
        axes.imshow(
            np.where(counts > 0, np.log1p(counts), np.nan),
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            cmap=LinearSegmentedColormap.from_list("accent", ["#e9f3f5", ACCENT]),
            vmin=0.0,
            vmax=float(np.log1p(max(int(counts.max()), 1))) * 1.6,
            aspect="equal",
        )
        axes.plot(*points.T, ".", color=INK, markersize=1.6, alpha=0.7)
    empty = ", ".join(fit.coverage.empty)
    return Picture(
        chart_markup(figure, "Coverage of the image by target points"),
        title="Coverage",
        caption=f"Dots are target points of the used views; {100 * fit.coverage.fraction:.0f} % of "
        "the cells hold one. "
        + (f"Nothing was seen in: {empty}." if empty else "No ninth of the image is empty."),
    )


def _view_bars(fit: CameraFit, held_out: Mapping[str, float]) -> Picture:
    """Root mean square of each view, with its hold-out value."""
    views = fit.views
    with styled():
        figure = new_figure(6.0, max(2.0, 0.8 + 0.2 * len(views)))
        axes = figure.add_subplot()
        colours = [ACCENT if view.is_used else LINE for view in views]
        axes.barh(range(len(views)), [view.rms_px for view in views], color=colours, height=0.68)
        known = [k for k, view in enumerate(views) if view.source in held_out]
        if known:
            axes.plot(
                [held_out[views[k].source] for k in known], known, "|", color=ALERT,
                markersize=9, markeredgewidth=2, label="held out",
            )  # fmt: skip
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderpad=0.1)
        axes.axvline(fit.rms_px, color=MUTED, linewidth=0.8, linestyle="--")
        named_rows(axes, [view.source for view in views])
    grey = " Grey bars are views that were left out." if len(fit.used_views) < len(views) else ""
    return Picture(
        chart_markup(figure, "Root mean square residual of each view"),
        title="Views",
        caption="Bars: residual of each view in the solution; the dashed line is all used views "
        "together. Orange: the same view predicted by a camera that was solved without it." + grey,
    )


def _tilt_rose(fit: CameraFit) -> Picture:
    """How far, and which way, the board was tilted."""
    with styled():
        figure = new_figure(5.4, 4.0)
        axes: Any = figure.add_subplot(projection="polar")
        directions = np.deg2rad(fit.coverage.tilt_directions_deg)
        axes.plot(directions, fit.coverage.tilts_deg, "o", color=ACCENT, markersize=5, alpha=0.85)
        axes.set_theta_direction(-1)
        axes.set_rlim(0.0, max(45.0, float(fit.coverage.tilts_deg.max(initial=0.0)) + 5.0))
        axes.set_rticks([15, 30, 45], ["15°", "30°", "45°"], fontsize=7.5)
        axes.set_thetagrids([0, 90, 180, 270], ["right", "down", "left", "up"])
    return Picture(
        chart_markup(figure, "Tilts of the board"),
        title="Tilts of the board",
        caption="Each dot is a view: distance from the middle is the tilt, the direction is where "
        "the board's normal leans in the image. Dots all around, at 20 to 45°, tell focal "
        "length and distance apart.",
    )


def _residual_histogram(fit: CameraFit) -> Picture:
    """Residuals against the Gaussian of their own sigma."""
    residuals = np.concatenate([view.residuals_px for view in fit.used_views])
    sigma = fit.sigma_point_px
    reach = 4.5 * sigma
    edges, x = np.linspace(-reach, reach, 46), np.linspace(-reach, reach, 200)
    n_bins = len(residuals) * (edges[1] - edges[0])
    bell = n_bins * np.exp(-0.5 * (x / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
    beyond = int((np.abs(residuals) > reach).any(axis=1).sum())
    tail = f" Beyond the picture: {beyond}." if beyond else ""
    return histogram_chart(
        [
            Bars(residuals[:, 0], ACCENT_LIGHT, "x"),
            Bars(residuals[:, 1], ACCENT, "y", is_outline=True),
        ],
        edges,
        "residual, px",
        curve=(x, bell, f"Gaussian, σ = {significant(sigma)} px"),
        title="Distribution of residuals",
        caption="Detected coordinates scatter about as the Gaussian if noise is all there is."
        + tail,
    )


def _warp_section(warp: BoardWarp) -> Section:
    verdict = (
        "The board is bowed: the data ask for it."
        if warp.is_significant
        else "The data do not ask for a bow: the board is flat as far as they can tell."
    )
    x, y = (
        with_sigma(float(bow), float(sigma), "mm")
        for bow, sigma in zip(warp.bow_mm, warp.sigma_mm, strict=True)
    )
    facts = (
        fact("Bow along x", x),
        fact("Bow along y", y),
        fact("F test", f"F = {warp.f_statistic:.1f}, {p_text(warp.p_value)}"),
    )
    text = Text(f"{verdict} A positive bow lifts the middle away from the camera.")
    return Section("Bow of the board", (text, Facts(facts)))


def _covariance_section(fit: CameraFit) -> Section:
    names = [name for name in PARAMETER_NAMES if name in fit.free_parameters]
    index = [PARAMETER_NAMES.index(name) for name in names]
    matrix = fit.covariance[np.ix_(index, index)]
    short = [name.removesuffix("_px") for name in names]
    facts = Facts(
        (
            fact("Free parameters", ", ".join(short)),
            fact("Degrees of freedom", str(fit.degrees_of_freedom)),
            fact("Condition number", f"{fit.condition:.3g} (poses eliminated, unit diagonal)"),
        )
    )
    chart = correlation_chart(
        matrix,
        short,
        title="Correlations",
        caption="Two parameters near 1 or -1 trade against each other: neither is known well "
        "alone, their combination is.",
    )
    table = matrix_table("covariance", names, matrix)
    return Section("Covariance of the parameters", (facts, Gallery((chart,)), table), True)
