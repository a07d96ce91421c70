# SPDX-License-Identifier: Apache-2.0
"""Do exposures of one posture's name have one pose of the arm?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.errors import InputError
from armscan.geometry.frames import Tool
from armscan.geometry.poses import Pose

SAME_POSTURE_MM = 1.0
SAME_POSTURE_RAD = float(np.radians(0.2))
"""An arm that stands still reports its pose to some 0.02 mm and 0.002 degrees; a robot of 0.2 mm
is within it too."""
STANDING_SIGMAS = 10.0


def check_postures(
    stripes: Sequence[PosedStripe],
    exposure_mm: float | None = None,
    exposure_rad: float | None = None,
) -> None:
    """Refuse a posture's name that stands for different poses of the arm.

    Parameters
    ----------
    stripes
        With their postures and poses.
    exposure_mm, exposure_rad
        Scatter of the pose from exposure to exposure where it was given: a worse arm may move
        that much more.

    Raises
    ------
    InputError
        If two exposures of one posture are further apart than an arm that stands still.
    """
    most_mm = max(SAME_POSTURE_MM, STANDING_SIGMAS * (exposure_mm or 0.0))
    most_rad = max(SAME_POSTURE_RAD, STANDING_SIGMAS * (exposure_rad or 0.0))
    seen: dict[str, PosedStripe] = {}
    for stripe in stripes:
        first = seen.setdefault(stripe.posture, stripe)
        change: Pose[Tool, Tool] = first.base_from_tool.inverse() @ stripe.base_from_tool
        moved_mm = float(np.linalg.norm(change.translation_mm))
        turned_rad = float(np.linalg.norm(change.rotation_vector_rad))
        if moved_mm > most_mm or turned_rad > most_rad:
            raise InputError(
                f"posture '{stripe.posture}' has different poses: the arm moved by "
                f"{moved_mm:.1f} mm and {np.degrees(turned_rad):.1f} deg from {first.source} to "
                f"{stripe.source}",
                remedy="give every posture of the arm a view of its own; if the arm stood still, "
                "check that both exposures have their own poses",
            )
