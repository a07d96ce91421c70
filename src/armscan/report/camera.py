# SPDX-License-Identifier: Apache-2.0
"""The page of a camera calibration, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.ticker import MaxNLocator

from armscan.calibration.cameras.result import CameraFit, ViewFit
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import Provenance
from armscan.models.camera import PARAMETER_NAMES
from armscan.records.exposure import Exposure
from armscan.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    ALERT,
    INK,
    LINE,
    MUTED,
    Marks,
    chart_markup,
    new_figure,
    photo_markup,
    raster_markup,
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

ARROW_SHARE = 0.06
"""Length on the picture, as a share of its longer side, of a residual of three sigma."""


def residual_magnification(fit: CameraFit) -> float:
    """How much residual arrows are enlarged: a round number, the same in all pictures."""
    longest = max(fit.camera.width_px, fit.camera.height_px)
    wanted = ARROW_SHARE * longest / max(3.0 * fit.rms_px, 1e-6)
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted)


def view_picture(fit: CameraFit, view: ViewFit, exposure: Exposure) -> Picture:
    """The photograph with the target points found, and the residual arrows."""
    scale = residual_magnification(fit)
    points = view.view.points_px
    arrows = np.stack([points, points + scale * view.residuals_px], axis=1).reshape(-1, 2)
    colour = "#35e0c0" if view.is_used else "#ff8a4c"
    marks = [
        Marks(points, colour, "ring", 15.0),
        Marks(points[:1], colour, "dot", 13.0),
        Marks(arrows, "#ffb000", "line", 3.2),
    ]
    state = "" if view.is_used else "left out; "
    return Picture(
        photo_markup(exposure, marks, f"Target points found in {view.source}"),
        title=view.source,
        caption=f"{state}{len(view.view)} points, rms {significant(view.rms_px)} px, tilt "
        f"{view.tilt_deg:.0f}°, {view.distance_mm:.0f} mm away",
    )


def residual_field(fit: CameraFit) -> Picture:
    """All residual arrows over the image."""
    scale = residual_magnification(fit)
    points = np.concatenate([view.view.points_px for view in fit.used_views])
    residuals = np.concatenate([view.residuals_px for view in fit.used_views])
    with styled():
        figure = new_figure(*_size_of(fit))
        axes = figure.add_subplot()
        axes.quiver(
            *points.T, *(scale * residuals).T, angles="xy", scale_units="xy", scale=1.0,
            color=ACCENT, width=0.0022, headwidth=3.5, headlength=4.5,
        )  # fmt: skip
        _image_axes(axes, fit)
    return Picture(
        chart_markup(figure, "Residual arrows over the image"),
        title="Residuals over the image",
        caption=f"Observed minus predicted, all used views, {scale:g} times enlarged. A camera "
        "model that fits leaves arrows without any pattern; arrows that turn together show a lens "
        "that the model does not follow, or a board that is not flat.",
    )


def coverage_map(fit: CameraFit) -> Picture:
    """Where in the image target points were seen."""
    counts = fit.coverage.counts
    points = np.concatenate([view.view.points_px for view in fit.used_views])
    width, height = fit.camera.width_px, fit.camera.height_px
    with styled():
        figure = new_figure(*_size_of(fit))
        axes = figure.add_subplot()
        axes.imshow(
            np.where(counts > 0, np.log1p(counts), np.nan),
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            cmap=_ramp(),
            vmin=0.0,
            vmax=float(np.log1p(max(int(counts.max()), 1))) * 1.6,
            aspect="auto",
        )
        axes.plot(*points.T, ".", color=INK, markersize=1.6, alpha=0.7)
        _image_axes(axes, fit)
    empty = ", ".join(fit.coverage.empty)
    return Picture(
        chart_markup(figure, "Coverage of the image by target points"),
        title="Coverage",
        caption=f"Dots are target points of the used views; {100 * fit.coverage.fraction:.0f} % of "
        "the cells hold one. "
        + (f"Nothing was seen in: {empty}." if empty else "No ninth of the image is empty."),
    )


def view_bars(fit: CameraFit) -> Picture:
    """Root mean square of each view, with its hold-out value."""
    views = fit.views
    held_out = {}
    if fit.cross_validation is not None:
        held_out = dict(
            zip(fit.cross_validation.sources, fit.cross_validation.view_rms_px, strict=True)
        )
    rows = np.arange(len(views))
    with styled():
        figure = new_figure(6.0, max(2.0, 0.8 + 0.2 * len(views)))
        axes = figure.add_subplot()
        colours = [ACCENT if view.is_used else LINE for view in views]
        axes.barh(rows, [view.rms_px for view in views], color=colours, height=0.68)
        known = [k for k, view in enumerate(views) if view.source in held_out]
        if known:
            axes.plot(
                [held_out[views[k].source] for k in known], known, "|", color=ALERT,
                markersize=9, markeredgewidth=2, label="held out",
            )  # fmt: skip
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderpad=0.1)
        axes.axvline(fit.rms_px, color=MUTED, linewidth=0.8, linestyle="--")
        axes.set_yticks(rows, [_short(view.source) for view in views])
        axes.invert_yaxis()
        axes.set_xlabel("rms reprojection residual, px")
        axes.grid(axis="x")
    grey = " Grey bars are views that were left out." if len(fit.used_views) < len(views) else ""
    return Picture(
        chart_markup(figure, "Root mean square residual of each view"),
        title="Views",
        caption="Bars: residual of each view in the solution; the dashed line is all used views "
        "together. Orange: the same view predicted by a camera that was solved without it." + grey,
    )


def tilt_rose(fit: CameraFit) -> Picture:
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


def residual_histogram(fit: CameraFit) -> Picture:
    """Residuals against the Gaussian of their own sigma."""
    residuals = np.concatenate([view.residuals_px for view in fit.used_views])
    sigma = fit.sigma_point_px
    reach = 4.5 * sigma
    edges = np.linspace(-reach, reach, 46).tolist()
    x = np.linspace(-reach, reach, 200)
    n_bins = len(residuals) * (edges[1] - edges[0])
    bell = n_bins * np.exp(-0.5 * (x / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
    with styled():
        figure = new_figure(4.6, 3.4)
        axes = figure.add_subplot()
        axes.hist(residuals[:, 0], edges, color=ACCENT, alpha=0.75, label="x")
        axes.hist(residuals[:, 1], edges, color=ACCENT_LIGHT, alpha=0.75, label="y")
        axes.plot(x, bell, color=INK, linewidth=1.2, label=f"Gaussian, σ = {significant(sigma)} px")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlabel("residual, px")
        axes.set_ylabel("points")
        axes.set_ylim(top=1.3 * axes.get_ylim()[1])
        axes.legend(loc="upper right")
    beyond = int((np.abs(residuals) > reach).any(axis=1).sum())
    tail = f" Beyond the picture: {beyond}." if beyond else ""
    return Picture(
        chart_markup(figure, "Histogram of residuals"),
        title="Distribution of residuals",
        caption="Detected coordinates scatter about as the Gaussian if noise is all there is."
        + tail,
    )


def correlation_matrix(fit: CameraFit) -> Picture:
    """Correlations of the camera's free parameters."""
    index = [PARAMETER_NAMES.index(name) for name in fit.free_parameters]
    covariance = fit.covariance[np.ix_(index, index)]
    correlation = _correlation(covariance)
    names = [PARAMETER_NAMES[k].removesuffix("_px") for k in index]
    with styled():
        figure = new_figure(4.6, 4.2)
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
        raster_markup(figure, "Correlations of the parameters"),
        title="Correlations",
        caption="Two parameters near 1 or -1 trade against each other: neither is known well "
        "alone, their combination is.",
    )


def _correlation(covariance: FloatArray) -> FloatArray:
    sigma = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(sigma, sigma))


def _size_of(fit: CameraFit) -> tuple[float, float]:
    ratio = fit.camera.height_px / fit.camera.width_px
    width = 6.0 if ratio <= 1.0 else 6.0 / ratio
    return width + 0.6, width * ratio + 0.6


def _image_axes(axes: Axes, fit: CameraFit) -> None:
    axes.set_xlim(-0.5, fit.camera.width_px - 0.5)
    axes.set_ylim(fit.camera.height_px - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    axes.spines[:].set_visible(True)


def _ramp() -> LinearSegmentedColormap:
    return LinearSegmentedColormap.from_list("accent", ["#e9f3f5", ACCENT])


def _short(source: str) -> str:
    return source if len(source) <= 26 else "…" + source[-25:]


TITLE = "Camera calibration"
UNITS = {"fx_px": "px", "fy_px": "px", "cx_px": "px", "cy_px": "px"}
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
RMS_MEANING = (
    "An rms here is the root of the mean, over points, of the squared length of the residual "
    "vector (x and y together), as OpenCV defines it."
)


def camera_page(
    fit: CameraFit,
    not_found: Sequence[tuple[str, str]],
    exposures: Mapping[str, Exposure],
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
    n_images = len(fit.views) + len(not_found)
    sections = [
        _camera_section(fit),
        _fit_section(fit),
        _coverage_section(fit),
        _views_section(fit, exposures),
    ]
    if not_found:
        sections.append(_not_found_section(not_found, exposures))
    if fit.warp is not None:
        sections.append(_warp_section(fit))
    sections += [_parameters_section(fit), origin_section(provenance)]
    return Page(
        title=TITLE,
        subtitle=f"{fit.camera.width_px} × {fit.camera.height_px} px camera, "
        f"{fit.n_views} of {n_images} images used, {fit.n_points} target points",
        cards=_cards(fit),
        warnings=tuple(sentence(warning) for warning in fit.warnings),
        sections=tuple(sections),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def parameter_rows(fit: CameraFit) -> tuple[tuple[str, str, str], ...]:
    """Name, value with sigma, and meaning of each parameter."""
    rows = []
    for name, value, sigma in zip(PARAMETER_NAMES, fit.camera.parameters, fit.sigma, strict=True):
        is_free = name in fit.free_parameters
        text = with_sigma(value, sigma, UNITS.get(name, "")) if is_free else f"{value:g} (held)"
        rows.append((name.removesuffix("_px"), text, MEANINGS[name]))
    return tuple(rows)


def _cards(fit: CameraFit) -> tuple[Card, ...]:
    camera, sigma = fit.camera, fit.sigma
    cards = [
        Card(
            "Focal length fx",
            with_sigma(camera.fx_px, sigma[0], "px"),
            "fy " + with_sigma(camera.fy_px, sigma[1], "px"),
        ),
        Card(
            "Principal point cx",
            with_sigma(camera.cx_px, sigma[2], "px"),
            "cy " + with_sigma(camera.cy_px, sigma[3], "px"),
        ),
        Card(
            "Reprojection residual",
            f"{significant(fit.rms_px)} px rms",
            f"{significant(fit.sigma_point_px)} px per axis",
        ),
    ]
    if fit.cross_validation is not None:
        held_out = fit.cross_validation
        cards.append(
            Card(
                "On images it has not seen",
                f"{significant(held_out.rms_px)} px rms",
                f"{held_out.n_folds}-fold hold-out; "
                f"{significant(held_out.rms_in_sample_px)} px in sample",
            )
        )
    return tuple(cards)


def _camera_section(fit: CameraFit) -> Section:
    return Section(
        "The camera",
        (
            Table(("parameter", "value ± 1 sigma", "meaning"), parameter_rows(fit), "", (2,)),
            Text(
                f"{sentence(fit.model_reason)} Pixel (0, 0) is the centre of the top-left pixel. "
                + noise_text(f"{fit.noise_scale:.2g} times")
                + _target_text(fit)
            ),
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


def _target_text(fit: CameraFit) -> str:
    if fit.target_error_mm == 0.0:
        return ""
    return (
        " Residuals of a target point repeat from view to view: the points miss their places by "
        f"{significant(fit.target_error_mm)} mm (one standard deviation an axis). More views do "
        "not average that; the standard deviations hold it."
    )


def _fit_section(fit: CameraFit) -> Section:
    blocks: list[Text | Gallery] = [Text(RMS_MEANING)]
    if fit.cross_validation is not None:
        held_out = fit.cross_validation
        growth = 100.0 * (held_out.rms_px / held_out.rms_in_sample_px - 1.0)
        blocks.append(
            Text(
                f"Hold-out: the views were dealt into {held_out.n_folds} groups; each group was "
                "predicted by a camera solved from the others, with only the board's pose fitted "
                f"to it. The residual there is {growth:+.1f} % against the solution itself."
            )
        )
    charts = (residual_field(fit), residual_histogram(fit))
    return Section("How well it fits", (*blocks, Gallery(charts)))


def _coverage_section(fit: CameraFit) -> Section:
    return Section(
        "What the target covered",
        (Gallery((coverage_map(fit), tilt_rose(fit))),),
    )


def _views_section(fit: CameraFit, exposures: Mapping[str, Exposure]) -> Section:
    held_out = {}
    if fit.cross_validation is not None:
        held_out = dict(
            zip(fit.cross_validation.sources, fit.cross_validation.view_rms_px, strict=True)
        )
    table = Table(
        ("image", "points", "rms, px", "held out, px", "tilt", "distance", "remark"),
        tuple(_view_row(view, held_out.get(view.source)) for view in fit.views),
        word_columns=(6,),
    )
    pictures = tuple(
        view_picture(fit, view, exposures[view.source])
        for view in fit.views
        if view.source in exposures
    )
    scale = residual_magnification(fit)
    text = Text(
        f"Rings are the target points found, the filled one is the board's first point. Orange "
        f"lines are residuals, {scale:g} times enlarged. Rings in orange: the view was left out. "
        "Click a picture to enlarge it."
    )
    return Section("The images", (Gallery((view_bars(fit),)), table, text, Gallery(pictures, 300)))


def _view_row(view: ViewFit, held_out: float | None) -> tuple[str, ...]:
    remark = view.note or ("used" if view.is_used else "left out")
    return (
        view.source,
        str(len(view.view)),
        significant(view.rms_px),
        "" if held_out is None else significant(held_out),
        f"{view.tilt_deg:.0f}°",
        f"{view.distance_mm:.0f} mm",
        remark,
    )


def _not_found_section(
    not_found: Sequence[tuple[str, str]], exposures: Mapping[str, Exposure]
) -> Section:
    pictures = tuple(
        Picture(
            photo_markup(exposures[source], (), f"No target in {source}", longest_px=500),
            title=source,
            caption=without_source(source, reason),
        )
        for source, reason in not_found
        if source in exposures
    )
    rows = tuple((source, without_source(source, reason)) for source, reason in not_found)
    table = Table(("image", "why"), rows, word_columns=(1,))
    return Section("Images without a usable target", (table, Gallery(pictures, 240)))


def _warp_section(fit: CameraFit) -> Section:
    warp = fit.warp
    if warp is None:
        return Section("Bow of the board", ())
    verdict = (
        "The board is bowed: the data ask for it."
        if warp.is_significant
        else "The data do not ask for a bow: the board is flat as far as they can tell."
    )
    rows = (
        ("Bow along x", with_sigma(float(warp.bow_mm[0]), float(warp.sigma_mm[0]), "mm")),
        ("Bow along y", with_sigma(float(warp.bow_mm[1]), float(warp.sigma_mm[1]), "mm")),
        ("F test", f"F = {warp.f_statistic:.1f}, p = {warp.p_value:.2g}"),
    )
    text = Text(f"{verdict} A positive bow lifts the middle away from the camera.")
    return Section("Bow of the board", (text, Facts(rows)))


def _parameters_section(fit: CameraFit) -> Section:
    facts = Facts(
        (
            ("Free parameters", ", ".join(n.removesuffix("_px") for n in fit.free_parameters)),
            ("Degrees of freedom", str(fit.degrees_of_freedom)),
            ("Condition number", f"{fit.condition:.3g} (poses eliminated, unit diagonal)"),
        )
    )
    names = [name for name in PARAMETER_NAMES if name in fit.free_parameters]
    index = [PARAMETER_NAMES.index(name) for name in names]
    matrix = fit.covariance[np.ix_(index, index)]
    table = Table(
        ("covariance", *names),
        tuple(
            (name, *(f"{value:.3g}" for value in row))
            for name, row in zip(names, matrix, strict=True)
        ),
    )
    return Section(
        "Covariance of the parameters",
        (facts, Gallery((correlation_matrix(fit),)), table),
        is_folded=True,
    )
