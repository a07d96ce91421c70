# SPDX-License-Identifier: Apache-2.0
"""Were the poses read in the wrong convention, direction or unit? Try the others on the data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_search import find_start, thinned
from armscan.geometry.arrays import FloatArray
from armscan.geometry.euler import EulerConvention, euler_from_rotations, rotations_from_euler
from armscan.geometry.fitting import Plane

BETTER = 0.1
"""A reading is offered if it leaves less than this part of what the given one leaves."""
_ASK_FOR_UNIT = "give the translations of the poses in mm"


@dataclass(frozen=True, slots=True)
class Reading:
    """Another way to read the poses, what it would leave, and how to ask for it."""

    words: str
    remedy: str
    typical_mm: float


def find_reading(
    nodes: PlateNodes, plate: Plane, typical_mm: float, *, most_mm: float = np.inf
) -> Reading | None:
    """First other reading of the same poses that the stripes agree with; None if there is none.

    Parameters
    ----------
    nodes, plate
        The data as read.
    typical_mm
        What they leave as read.
    most_mm
        What the reading may leave at most.
    """
    for words, remedy, moved in _readings(thinned(nodes)):
        left = find_start(moved, plate).typical_mm
        if left < BETTER * typical_mm and left <= most_mm:
            return Reading(words, remedy, left)
    return None


def _readings(nodes: PlateNodes) -> Iterator[tuple[str, str, PlateNodes]]:
    rotations, translations = nodes.rotations, nodes.translations_mm
    names: tuple[EulerConvention, ...] = get_args(EulerConvention)
    for read in names:
        angles = euler_from_rotations(rotations, read)
        for meant in names:
            if meant != read:
                for branch in (angles, _other_branch(angles, read)):
                    yield (
                        f"if the angles were read as {read}, reading them as {meant}",
                        f"give the rotation convention {meant}: of a recording in session.toml, "
                        f'[pose] rotation = "{meant}"; of robot poses with --euler',
                        nodes.moved(rotations_from_euler(branch, meant), translations),
                    )
    back = rotations.transpose(0, 2, 1)
    yield (
        "taking the poses as tool_from_base",
        "give base_from_tool: the inverse of the poses given",
        nodes.moved(back, -np.einsum("sij,sj->si", back, translations)),
    )
    yield (
        "transposing the rotations",
        "give the rotations row by row, the tool's axes in the columns",
        nodes.moved(back, translations),
    )
    for factor, unit in ((1000.0, "metres"), (25.4, "inches")):
        yield (
            f"reading the translations in {unit}",
            _ASK_FOR_UNIT,
            nodes.moved(rotations, factor * translations),
        )
    for shift in (-1, 1):
        yield (
            "giving each exposure the pose of the one "
            + ("after" if shift < 0 else "before")
            + " it",
            "check that no exposure and no pose is missing or doubled",
            nodes.moved(np.roll(rotations, shift, axis=0), np.roll(translations, shift, axis=0)),
        )


def _other_branch(angles_rad: FloatArray, convention: EulerConvention) -> FloatArray:
    """The other three angles (N, 3) of the same rotations."""
    first, middle, last = angles_rad.T
    turned = -middle if convention == "intrinsic-zxz" else np.pi - middle
    return np.column_stack([first + np.pi, turned, last + np.pi])
