# SPDX-License-Identifier: Apache-2.0
"""Which of several minima is the hand-eye? The likelier one, or none if they are alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, fit_plate
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import PlateState
from armscan.calibration.hand_eye.plate_search import Start, few_stripes, thinned
from armscan.calibration.hand_eye.posture_geometry import REMEDY
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose

LIKELIER = 6.0
"""Logarithm of the likelihood ratio from which one minimum is preferred to another: 400 to 1."""
MOST_RIVALS = 4
APART_DEG = 1.0


def settle_rivals(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions, cause: str
) -> Start | FitFailure:
    """Take the likeliest of the start and its rivals; refuse where another one is as likely.

    Parameters
    ----------
    nodes, plate, options
        Data, reference and noise model.
    start
        With minima that leave little more.
    cause
        What the postures have in common, in words.
    """
    if not start.rivals:
        return start
    few = few_stripes(thinned(nodes.select(~start.is_wrong[nodes.posture])))
    found = []
    for pose in (start.tool_from_sensor, *start.rivals[:MOST_RIVALS]):
        fit = fit_plate(few, plate, PlateState(pose, np.zeros(3)), options)
        if isinstance(fit, PlateFit):
            found.append((fit.linear.log_likelihood, pose, fit.refined.state.tool_from_sensor))
    if not found:
        return start
    found.sort(key=lambda one: -one[0])
    likely, best, end = found[0]
    for other, _, other_end in found[1:]:
        if likely - other < LIKELIER and _apart_deg(end, other_end) > APART_DEG:
            return FitFailure(
                f"{len(nodes.used_postures)} postures leave different hand-eyes that explain the "
                f"stripes equally well, {_in_words(end, other_end)} apart{cause}",
                f"add postures: {REMEDY}",
            )
    return replace(start, tool_from_sensor=best)


def _apart_deg(one: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> float:
    cosine = 0.5 * (float((one.rotation * other.rotation).sum()) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _in_words(one: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> str:
    shift = float(np.linalg.norm(one.translation_mm - other.translation_mm))
    return f"{_apart_deg(one, other):.1f} deg and {shift:.1f} mm"
