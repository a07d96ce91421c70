# SPDX-License-Identifier: Apache-2.0
"""What a person should know about a calibrated camera, in plain sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from armscan.calibration.camera.result import CameraFit

FEW_VIEWS = 8
SMALL_TILT_DEG = 15.0
THIN_COVERAGE = 0.6
LISTED = 3
SQUARE_PIXELS = 0.02
SQUARE_SIGMAS = 5.0
"""Pixels are square to a part in a thousand in nearly all cameras."""
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
        *_about_pixels(fit),
        *_about_model(fit),
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
    warnings += _about_repeats(repeats)
    n_outliers = sum(int(view.is_outlier.sum()) for view in fit.used_views)
    if n_outliers:
        warnings.append(f"{n_outliers} points lie too far out and were not used")
    if fit.n_views < FEW_VIEWS:
        warnings.append(f"only {fit.n_views} views: take 10 to 20")
    return warnings


def _about_repeats(repeats: Sequence[tuple[str, str]]) -> list[str]:
    """One line, however many they are."""
    if not repeats:
        return []
    named = [f"{later} (as {earlier})" for later, earlier in repeats[:LISTED]]
    more = f" and {len(repeats) - LISTED} more" if len(repeats) > LISTED else ""
    verbs = ("view repeats", "adds") if len(repeats) == 1 else ("views repeat", "add")
    fact = f"{len(repeats)} {verbs[0]} an earlier one and {verbs[1]} little"
    return [f"{fact}: {', '.join(named)}{more}"]


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


def _about_pixels(fit: CameraFit) -> list[str]:
    camera, (sigma_fx, sigma_fy) = fit.camera, fit.sigma[:2]
    ratio = camera.fx_px / camera.fy_px
    sigma = ratio * math.hypot(sigma_fx / camera.fx_px, sigma_fy / camera.fy_px)
    if abs(ratio - 1.0) < max(SQUARE_PIXELS, SQUARE_SIGMAS * sigma):
        return []
    return [
        f"fx is {ratio:.3f} of fy, as if pixels were not square: check that the target's pitch is "
        "the same along both its sides and is given as the target page says, and that the images "
        "were not scaled along one side only"
    ]


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


def _about_warp(fit: CameraFit) -> list[str]:
    if fit.warp is None or not fit.warp.is_significant:
        return []
    bow = ", ".join(f"{value:+.3f}" for value in fit.warp.bow_mm)
    largest = float(abs(fit.warp.bow_mm).sum())
    return [
        f"the board is bowed by {bow} mm (along x, along y): the light-sheet calibration takes it "
        f"as flat; use a flatter board there, or expect errors of up to {largest:.2g} mm in height"
    ]
