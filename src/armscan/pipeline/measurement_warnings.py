# SPDX-License-Identifier: Apache-2.0
"""What is weak about measured stripes, in words; the same for still images and for scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.result import PointFate, ReconstructedImage

CLEAN_SHARE = 0.5
"""An image of which less than this share of the stripe points is measured is pointed out."""
LISTED = 4


def measurement_warnings(
    images: Sequence[ReconstructedImage],
    depths_mm: Sequence[FloatArray],
    sensor: SensorCalibration,
) -> tuple[str, ...]:
    """Say what a person should know of these images.

    Parameters
    ----------
    images
        What each gave.
    depths_mm
        One array a sheet: the Z in Sensor of the points measured with it.
    sensor
        Camera and sheets.
    """
    return (*_image_warnings(images), *_sensor_warnings(depths_mm, sensor))


def _image_warnings(images: Sequence[ReconstructedImage]) -> list[str]:
    warnings = []
    empty = [image.profile.source for image in images if _n_measured(image) == 0]
    if empty:
        warnings.append(f"{len(empty)} images gave no point: {', '.join(empty[:LISTED])}")
    doubtful = [
        image.profile.source
        for image in images
        if 0 < _n_measured(image) < CLEAN_SHARE * len(image.profile)
    ]
    if doubtful:
        warnings.append(
            f"less than half of what looked like a stripe could be measured in "
            f"{', '.join(doubtful[:LISTED])}: see in the pictures whether it is a laser line"
        )
    n_outside = sum(image.count(PointFate.OUT_OF_DEPTH) for image in images)
    if n_outside:
        warnings.append(f"{n_outside} points were left out: too far outside the calibrated depths")
    return warnings


def _n_measured(image: ReconstructedImage) -> int:
    return image.count(PointFate.MEASURED) + image.count(PointFate.SHARED)


def _sensor_warnings(depths_mm: Sequence[FloatArray], sensor: SensorCalibration) -> list[str]:
    warnings = []
    if not sensor.camera.has_covariance:
        warnings.append(
            "the camera came without covariance: the points' sigmas leave its errors out"
        )
    for sheet, depth in zip(sensor.sheets, depths_mm, strict=True):
        low, high = sheet.depth_range_mm
        beyond = np.maximum(low - depth, depth - high)
        if (beyond > 0.0).any():
            warnings.append(
                f"sheet {sheet.name}: {int((beyond > 0.0).sum())} of {len(depth)} points lie up to "
                f"{float(beyond.max()):.1f} mm outside its calibrated depth range, {low:.1f} to "
                f"{high:.1f} mm: their sigma supposes that the sheet goes on as it was calibrated"
            )
        if len(depth) and not sheet.is_redundant:
            warnings.append(
                f"sheet {sheet.name} rests on two boards only: nothing but the coplanarity of two "
                "stripes checks it"
            )
    return warnings
