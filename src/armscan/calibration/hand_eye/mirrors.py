# SPDX-License-Identifier: Apache-2.0
"""Were images or poses mirrored? Left-handed data, tried against the data as they are.

A reflection in a flat light sheet leaves the sheet's points where they are, so that mirrored data
of one perfectly flat sheet fit as well as right ones: nothing but a drawing of the head can tell.
The bow of real sheets and a second sheet tell them apart, by a misfit of some tenths of a
millimetre that passes for scatter of a bad arm. So mirrored readings are always tried, and compared
by likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, fit_plate
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import PlateState, place_nodes
from armscan.calibration.hand_eye.plate_search import (
    Start,
    few_stripes,
    find_start,
    posture_rms,
    thinned,
)
from armscan.calibration.hand_eye.plate_start import linear_hand_eye
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose

LIKELIER = 10.0
"""Logarithm of the likelihood ratio from which mirrored data are believed: 22,000 to 1."""
SMALLER = 0.7
"""And they leave less than this part of what the data as given leave."""
LARGEST_SHIFT = 0.1
"""Of the middle of a mirrored image, over the focal length."""
NO_FIT_MM = 1e6
"""What a shift without a hand-eye leaves: finite, for the search fits parabolas."""
BOW_DEGREE = 2
LEAST_OF_SHEET = 12


@dataclass(frozen=True, slots=True, eq=False)
class _Mirrored:
    words: str
    remedy: str
    nodes: PlateNodes
    pose: Pose[Tool, Sensor]


def find_mirror(
    nodes: PlateNodes,
    plate: PlateReference,
    start: Start,
    options: HandEyeOptions,
    smaller: float = SMALLER,
) -> FitFailure | None:
    """Refuse data that are much likelier if something was mirrored; None if nothing was.

    Parameters
    ----------
    nodes, plate, options
        Data, reference and noise model.
    start
        The best hand-eye for the data as they are; its wrong postures take no part.
    smaller
        Part of what the data as given leave that mirrored data must not exceed.
    """
    few = few_stripes(thinned(nodes.select(~start.is_wrong[nodes.posture])))
    given = _likelihood(few, plate, start.tool_from_sensor, options)
    if given is None:
        return None
    best: tuple[float, float, _Mirrored] | None = None
    for mirrored in _all_mirrored(few, plate.plane):
        found = _likelihood(mirrored.nodes, plate, mirrored.pose, options)
        if found is not None and (best is None or found[0] > best[0]):
            best = (*found, mirrored)
    if best is None or best[0] < given[0] + LIKELIER or best[1] > smaller * given[1]:
        return None
    return FitFailure(
        f"mirrored data: the stripes of the typical posture lie {given[1]:.3f} mm from the plate, "
        f"and {best[1]:.3f} mm {best[2].words}",
        best[2].remedy,
    )


def _likelihood(
    nodes: PlateNodes,
    plate: PlateReference,
    pose: Pose[Tool, Sensor],
    options: HandEyeOptions,
) -> tuple[float, float] | None:
    """Logarithm of the likelihood, and the typical distance of the postures in mm."""
    fit = fit_plate(nodes, plate, PlateState(pose, np.zeros(3)), options)
    if not isinstance(fit, PlateFit):
        return None
    typical = float(np.nanmedian(posture_rms(nodes, fit.refined.placed.residual_mm)))
    return fit.linear.log_likelihood, typical


def _all_mirrored(nodes: PlateNodes, plate: Plane) -> Iterator[_Mirrored]:
    for axis, name in enumerate("xyz"):
        mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
        poses = nodes.moved(mirror @ nodes.rotations @ mirror, nodes.translations_mm @ mirror)
        yield _solved(
            f"if the poses were left-handed, {name} pointing the other way (the plate was not)",
            f"give the poses in a right-handed frame: turn the sign of {name} and of the two "
            "rotations that it changes, or read them by the convention of the arm's maker",
            poses,
            plate,
        )
    turned = _reflected(nodes)
    yield _solved(
        "if poses and plate were left-handed (an axis of Base and Tool points the other way), or "
        "the sensor's points",
        "give poses, probed points and the sensor's points in right-handed frames",
        turned,
        plate,
    )
    if float(nodes.points_mm[:, 2].min()) > 0.0:
        for axis, name in ((0, "left and right"), (1, "top and bottom")):
            yield _reversed_image(
                f"if {name} of the images were exchanged",
                "turn off the camera's mirroring (reverse X or Y), and record calibration and "
                "scan with the same setting",
                nodes,
                plate,
                axis,
            )


def _solved(words: str, remedy: str, nodes: PlateNodes, plate: Plane) -> _Mirrored:
    return _Mirrored(words, remedy, nodes, find_start(nodes, plate).tool_from_sensor)


def _reflected(nodes: PlateNodes) -> PlateNodes:
    """The sensor's points in a mirror: what left-handed poses and plate come to."""
    mirror = np.diag([-1.0, 1.0, 1.0])
    return replace(
        nodes,
        points_mm=nodes.points_mm @ mirror,
        noise_mm2=mirror @ nodes.noise_mm2 @ mirror,
        by_sensor=None if nodes.by_sensor is None else mirror @ nodes.by_sensor,
    )


def _reversed_image(
    words: str, remedy: str, nodes: PlateNodes, plate: Plane, axis: int
) -> _Mirrored:
    """What the sheets give along the rays of a reversed image; where its middle is, is sought."""

    def left(shift: float) -> float:
        tried = _along_reversed_rays(nodes, axis, shift)
        pose = linear_hand_eye(tried, plate)
        if pose is None:
            return NO_FIT_MM
        placed = place_nodes(tried, plate, PlateState(pose, np.zeros(3)))
        return float(np.nanmedian(posture_rms(tried, placed.residual_mm)))

    found = minimize_scalar(
        left, bounds=(-LARGEST_SHIFT, LARGEST_SHIFT), method="bounded", options={"xatol": 1e-4}
    )
    return _solved(words, remedy, _along_reversed_rays(nodes, axis, float(found.x)), plate)


def _along_reversed_rays(nodes: PlateNodes, axis: int, shift: float) -> PlateNodes:
    """Points of the same sheets on the rays ``-x/z + shift`` (or y).

    A plane's inverse depth is linear in a ray's x/z and y/z; its bow adds quadratic terms.
    """
    rays = nodes.points_mm[:, :2] / nodes.points_mm[:, 2:]
    turned = rays.copy()
    turned[:, axis] = shift - rays[:, axis]
    points = nodes.points_mm.copy()
    for sheet in np.unique(nodes.sheet):
        own = nodes.sheet == sheet
        degree = BOW_DEGREE if int(own.sum()) >= LEAST_OF_SHEET else 1
        inverse = np.linalg.lstsq(
            _terms(rays[own], degree), 1.0 / nodes.points_mm[own, 2], rcond=1e-9
        )[0]
        depth = 1.0 / np.maximum(_terms(turned[own], degree) @ inverse, 1e-6)
        points[own] = np.column_stack([turned[own], np.ones(int(own.sum()))]) * depth[:, None]
    return replace(nodes, points_mm=points)


def _terms(rays: FloatArray, degree: int) -> FloatArray:
    a, b = rays.T
    return np.column_stack([a**i * b**j for i in range(degree + 1) for j in range(degree + 1 - i)])
