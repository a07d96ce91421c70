# SPDX-License-Identifier: Apache-2.0
"""The report of a camera calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armscan.calibration.camera.result import CameraFit, ViewFit
from armscan.models.calibration import Provenance
from armscan.models.camera import PARAMETER_NAMES
from armscan.records.exposure import Exposure
from armscan.report import camera_figures as figures
from armscan.report.drawing import photo_markup
from armscan.report.numbers import sentence, significant, with_sigma, without_source
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Facts, Gallery, Page, Picture, Section, Text
from armscan.report.summary import Table

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
    charts = (figures.residual_field(fit), figures.residual_histogram(fit))
    return Section("How well it fits", (*blocks, Gallery(charts)))


def _coverage_section(fit: CameraFit) -> Section:
    return Section(
        "What the target covered",
        (Gallery((figures.coverage_map(fit), figures.tilt_rose(fit))),),
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
        figures.view_picture(fit, view, exposures[view.source])
        for view in fit.views
        if view.source in exposures
    )
    scale = figures.residual_magnification(fit)
    text = Text(
        f"Rings are the target points found, the filled one is the board's first point. Orange "
        f"lines are residuals, {scale:g} times enlarged. Rings in orange: the view was left out. "
        "Click a picture to enlarge it."
    )
    return Section(
        "The images", (Gallery((figures.view_bars(fit),)), table, text, Gallery(pictures, 300))
    )


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
        (facts, Gallery((figures.correlation_matrix(fit),)), table),
        is_folded=True,
    )
