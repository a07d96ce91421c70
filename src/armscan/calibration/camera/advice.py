# SPDX-License-Identifier: Apache-2.0
"""What a person should know about a calibrated camera, in plain sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.camera.result import CameraFit

FEW_VIEWS = 8
SMALL_TILT_DEG = 15.0
THIN_COVERAGE = 0.6
USUAL_ASPECT_ERROR = 0.01
"""Sensors' pixels are square; lenses change the ratio by some parts per thousand at most."""
ASPECT_SIGMAS = 5.0
_NAMED = 3
UNSEEN_WORSE = 1.3
UNSEEN_BETTER = 0.9
"""Least squares fits the views that it used at least about as well as those that it did not."""


def advise(
    fit: CameraFit, repeats: Sequence[tuple[str, str]], *, is_converged: bool = True
) -> CameraFit:
    """Add warnings to a result.

    Parameters
    ----------
    fit
        The result.
    repeats
        Pairs (later, earlier) of views that show the board in the same place.
    is_converged
        Whether the adjustment reached its minimum.
    """
    warnings = [
        *_about_convergence(fit, is_converged=is_converged),
        *_about_views(fit, repeats),
        *_about_coverage(fit),
        *_about_model(fit),
        *_about_aspect(fit),
        *_about_warp(fit),
    ]
    return replace(fit, warnings=tuple(warnings))


def _about_convergence(fit: CameraFit, *, is_converged: bool) -> list[str]:
    remedy = "do not rely on it: check the views with the largest residuals, and add views"
    if not is_converged:
        return [f"the solution was stopped before it reached the best fit; {remedy}"]
    validation = fit.cross_validation
    if validation is None or validation.rms_px >= UNSEEN_BETTER * validation.rms_in_sample_px:
        return []
    return [
        f"the solution did not converge to the best fit: views that it used fit worse "
        f"({validation.rms_in_sample_px:.3f} px) than the same views when they are held out "
        f"({validation.rms_px:.3f} px); {remedy}"
    ]


def _about_views(fit: CameraFit, repeats: Sequence[tuple[str, str]]) -> list[str]:
    requested = fit.options.leave_out
    warnings = [
        f"{view.source}: {view.note}"
        for view in fit.views
        if view.note and view.source not in requested
    ]
    warnings += [f"{view.source} cannot be used: {view.reason}" for view in fit.refused_views]
    if repeats:
        shown = [f"{later} that of {earlier}" for later, earlier in repeats[:_NAMED]]
        more = f" and {len(repeats) - _NAMED} more" if len(repeats) > _NAMED else ""
        warnings.append(
            f"{len(repeats)} views repeat the place of another and add little: "
            f"{', '.join(shown)}{more}"
        )
    n_outliers = sum(int(view.is_outlier.sum()) for view in fit.used_views)
    if n_outliers:
        warnings.append(f"{n_outliers} points lie too far out and were not used")
    if fit.n_views < FEW_VIEWS:
        warnings.append(f"only {fit.n_views} views: take 10 to 20")
    return warnings


def _about_coverage(fit: CameraFit) -> list[str]:
    warnings = []
    coverage = fit.coverage
    if coverage.empty:
        warnings.append(f"no target points in the {', '.join(coverage.empty)} of the image")
    elif coverage.fraction < THIN_COVERAGE:
        warnings.append(f"target points in only {100 * coverage.fraction:.0f} % of the image")
    if float(coverage.tilts_deg.max()) < SMALL_TILT_DEG:
        warnings.append(
            f"the board is tilted by at most {coverage.tilts_deg.max():.0f} degrees: "
            "tilt it by 20 to 45"
        )
    return warnings


def _about_model(fit: CameraFit) -> list[str]:
    warnings = []
    if len(fit.camera.folded_border()):
        warnings.append(
            "the distortion has no inverse at the image's border: do not measure outside the "
            "covered part"
        )
    validation = fit.cross_validation
    if validation is not None and validation.rms_px > UNSEEN_WORSE * validation.rms_in_sample_px:
        warnings.append(
            f"views not used in the solution fit worse ({validation.rms_px:.3f} px) than those "
            f"used ({validation.rms_in_sample_px:.3f} px): add views"
        )
    return warnings


def _about_aspect(fit: CameraFit) -> list[str]:
    ratio = fit.camera.fx_px / fit.camera.fy_px
    sigma = ratio * float(np.hypot(*(fit.sigma[:2] / fit.camera.parameters[:2])))
    if abs(ratio - 1.0) <= max(USUAL_ASPECT_ERROR, ASPECT_SIGMAS * sigma):
        return []
    return [
        f"fx / fy is {ratio:.3f}, nearly every camera's is 1: were the images stretched or resized "
        "in one direction, or is the target's spacing along x not the same as along y?"
    ]


def _about_warp(fit: CameraFit) -> list[str]:
    if fit.warp is None or not fit.warp.is_significant:
        return []
    bow = ", ".join(f"{value:+.3f}" for value in fit.warp.bow_mm)
    largest = float(abs(fit.warp.bow_mm).sum())
    return [
        f"the board is bowed by {bow} mm (along x, along y): the light-sheet calibration takes it "
        f"as flat; use a flatter board there, or expect errors of up to {largest:.2g} mm in height"
    ]
