# SPDX-License-Identifier: Apache-2.0
"""What a person should know about two calibrated cameras, in plain sentences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.calibration.camera.advice import FEW_VIEWS, SMALL_TILT_DEG, THIN_COVERAGE, UNSEEN_WORSE
from armscan.calibration.stereo.pairs import SIDES
from armscan.calibration.stereo.result import SideFit, StereoFit

UNSTEADY_LEVEL = 9.0
"""The typical pair lies three of its standard deviations from where the others put the camera."""

ODD_GIVEN_LEVEL = 9.0
"""Given intrinsics lie three standard deviations from what the images say."""

BIAS_SIGMAS = 4.0
LEANING = 2.0
"""A baseline is horizontal if it is this many times longer along x than along y."""


def advise(fit: StereoFit) -> StereoFit:
    """Add warnings to a result."""
    warnings = [
        *_about_solution(fit),
        *_about_sides(fit),
        *_about_pairs(fit),
        *_about_epipolar(fit),
        *_about_cameras(fit),
    ]
    return replace(fit, warnings=tuple(warnings))


def right_camera_centre_mm(fit: StereoFit) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(3,) the right camera's centre in the Sensor frame."""
    return np.asarray(fit.views.right_from_left.inverse().translation_mm)


def _about_solution(fit: StereoFit) -> list[str]:
    warnings = []
    if not fit.is_converged:
        warnings.append(
            "the solution was stopped before it reached the best fit; do not rely on it: check "
            "the pairs with the largest residuals, and add pairs"
        )
    held_out = fit.hold_out
    if held_out is not None and held_out.rms_px > UNSEEN_WORSE * held_out.rms_in_sample_px:
        warnings.append(
            f"pairs not used in the solution fit worse ({held_out.rms_px:.3f} px) than those used "
            f"({held_out.rms_in_sample_px:.3f} px): add pairs"
        )
    return warnings


def _about_sides(fit: StereoFit) -> list[str]:
    x, y, _ = right_camera_centre_mm(fit)
    if not (x < 0.0 and abs(x) > LEANING * abs(y)):
        return []
    return [
        f"the right camera stands {-x:.0f} mm to the LEFT of the left one, in the left image: "
        "if the two lists of images were swapped, swap them back"
    ]


def _about_pairs(fit: StereoFit) -> list[str]:
    warnings = [f"{pair.pair.name}: {pair.note}" for pair in fit.pairs if pair.note]
    n_turned = sum(pair.quarter_turns != 0 for pair in fit.related)
    if n_turned:
        warnings.append(
            f"the target looks the same when it is turned: in {n_turned} of {len(fit.related)} "
            "pairs the right image's numbers were turned so that all pairs agree"
        )
    n_related = len(fit.related)
    if n_related < FEW_VIEWS:
        warnings.append(f"only {n_related} pairs: take 10 to 20")
    if fit.typical_level > UNSTEADY_LEVEL:
        warnings.append(
            "the pairs put the right camera further apart than their noise allows (typically "
            f"{np.sqrt(fit.typical_level):.0f} standard deviations): the images of a pair were "
            "perhaps not taken at one instant, the cameras are not fixed to each other, or the "
            "board is not flat"
        )
    return warnings


def _about_epipolar(fit: StereoFit) -> list[str]:
    n = sum(len(pair.matched.depth_mm) for pair in fit.related if pair.matched is not None)
    allowed = BIAS_SIGMAS * fit.epipolar_rms_px / np.sqrt(max(n, 1))
    if abs(fit.epipolar_mean_px) <= allowed:
        return []
    return [
        f"matched points lie {fit.epipolar_mean_px:+.3f} px to one side of each other's epipolar "
        f"lines on average, more than the scatter allows ({allowed:.3f} px)"
    ]


def _about_cameras(fit: StereoFit) -> list[str]:
    warnings = []
    cameras = (fit.views.left, fit.views.right)
    for word, side, camera in zip(SIDES, fit.sides, cameras, strict=True):
        warnings += [f"{word} camera: {text}" for text in _about_coverage(side)]
        if side.single.given_level > ODD_GIVEN_LEVEL:
            warnings.append(
                f"{word} camera: the given calibration lies {np.sqrt(side.single.given_level):.0f} "
                "standard deviations from what these images say by themselves: was the focus "
                "changed since?"
            )
        n_outliers = _n_outliers(fit, word)
        if n_outliers:
            warnings.append(f"{word} camera: {n_outliers} points lie too far out and were not used")
        if len(camera.folded_border()):
            warnings.append(
                f"{word} camera: the distortion has no inverse at the image's border: do not "
                "measure outside the covered part"
            )
    return warnings


def _about_coverage(side: SideFit) -> list[str]:
    warnings = []
    coverage = side.coverage
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


def _n_outliers(fit: StereoFit, word: str) -> int:
    views = [pair.left if word == "left" else pair.right for pair in fit.pairs]
    return sum(int(view.is_outlier.sum()) for view in views if view is not None)
