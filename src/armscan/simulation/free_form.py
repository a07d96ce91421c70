# SPDX-License-Identifier: Apache-2.0
"""A free-form part: a shell about 90 mm long with ribs, domes and a hollow, soft all over.

Part frame: z up, x along the part; it stands on z = 0 and is about 22 mm high.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armscan.geometry.poses import Pose
from armscan.simulation.body import Body, Limb

_LIMBS = (
    Limb((-28, 0, -8), (28, 0, -6), 22.0, 20.0),
    Limb((-30, -14, 0), (30, -10, 0), 12.0, 10.0, 10.0),
    Limb((-30, 14, 0), (30, 10, 0), 10.0, 12.0, 10.0),
    Limb((-22, 0, 6), (-20, 0, 8), 11.0, 11.0, 8.0),
    Limb((18, 6, 2), (26, -6, 4), 11.0, 12.0, 6.0),
    Limb((-4, -18, 4), (4, 18, 4), 6.0, 7.0, 5.0),
    Limb((2, 2, 17), (4, 0, 17), 6.0, 6.0, 6.0, is_hollow=True),
)


def free_form_part() -> Body:
    """Return the part in its own frame."""
    here: Pose[Any, Any] = Pose(np.eye(3), np.zeros(3))
    return Body(_LIMBS, here)
