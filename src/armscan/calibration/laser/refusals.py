# SPDX-License-Identifier: Apache-2.0
"""When solved light sheets are nothing to measure with.

As of a camera (`armscan.calibration.camera.refusals`), the limits lie far outside what photographs
of a laser on a board give, however plain: a refusal means a mistake (stripes of another light,
boards of another size, images that do not belong together), not a poor set.
"""

from __future__ import annotations

import math

from armscan.calibration.laser.result import LaserFit, SheetFit

LARGEST_RMS = 0.003
"""Of the image's diagonal, residual across the stripe: 2.4 px of 640 x 480. The plainest real sets
at hand have 0.0005."""
LARGEST_MISS = 0.03
"""Of the depth: how far points of a board lie off it if the sheet rests on the other boards. Real
sets at hand have 0.0001 to 0.007, the largest at a triangulation angle of 4 degrees."""


def reasons_to_refuse(fit: LaserFit) -> tuple[str, ...]:
    """Why solved sheets must not be written as if they were some; empty if nothing speaks against.

    Parameters
    ----------
    fit
        The sheets with their evidence.
    """
    camera = fit.camera.camera
    diagonal_px = math.hypot(camera.width_px, camera.height_px)
    return tuple(
        f"sheet {sheet.name}: {reason}"
        for sheet in fit.sheets
        for reason in _reasons(sheet, LARGEST_RMS * diagonal_px)
    )


def _reasons(sheet: SheetFit, largest_rms_px: float) -> tuple[str, ...]:
    found = []
    if sheet.rms_px > largest_rms_px:
        found.append(
            f"its stripes lie {sheet.rms_px:.1f} px (rms) from it, {largest_rms_px:.1f} px is the "
            "limit"
        )
    low, high = sheet.calibration.depth_range_mm
    alone = sheet.points.left_out_rms_mm
    rms_mm = alone if math.isfinite(alone) else sheet.points.fitted.rms_mm
    miss = rms_mm / (0.5 * (low + high))
    if miss > LARGEST_MISS:
        others = " if the sheet rests on the other boards" if math.isfinite(alone) else ""
        found.append(
            f"points on a board lie {rms_mm:.3g} mm (rms) off it{others}, {100.0 * miss:.1f} % of "
            f"the depth: {100.0 * LARGEST_MISS:.0f} % is the limit"
        )
    return tuple(found)
