# SPDX-License-Identifier: Apache-2.0
"""From images of stripes on an object to measured points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armscan.errors import EstimationError
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.exposure_pairs import ExposurePair, check_sizes, pair_exposures
from armscan.pipeline.measurement_warnings import measurement_warnings
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.reconstruction.choose_sheet import DepthRange, choose_sheets
from armscan.reconstruction.merge import merge_clouds
from armscan.reconstruction.result import PointFate, ReconstructedImage, Reconstruction
from armscan.reconstruction.triangulate import meet_sheets, triangulate
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.options import StripeOptions

STAGE = "reconstruct"


@dataclass(frozen=True, slots=True)
class ReconstructOptions:
    """How stripes on objects become points.

    Parameters
    ----------
    stripes
        Stripe extraction.
    depths
        Depths that are accepted; points outside are left out and counted.
    sheet
        Name of the sheet that drew all stripes; empty to find it.
    """

    stripes: StripeOptions = field(default_factory=StripeOptions)
    depths: DepthRange = field(default_factory=DepthRange)
    sheet: str = ""


def reconstruct(
    exposures: Sequence[Exposure],
    sensor: SensorCalibration,
    *,
    backgrounds: Sequence[Exposure] = (),
    options: ReconstructOptions | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """Extract the stripes of every exposure and triangulate them.

    Parameters
    ----------
    exposures
        With the laser on.
    sensor
        Camera and sheets.
    backgrounds
        The same views without laser, one for each exposure, or none.
    options
        Defaults if None.
    progress
        Told of every image.

    Raises
    ------
    InputError
        If images and backgrounds do not pair, or are not of the camera's sensor.
    EstimationError
        If the sheet of a stripe is ambiguous, or nothing was measured at all.
    """
    options = options or ReconstructOptions()
    pairs = pair_exposures(exposures, backgrounds)
    check_sizes([*exposures, *backgrounds], sensor.camera.camera)
    images: list[ReconstructedImage] = []
    clouds: list[PointCloud] = []
    for done, pair in enumerate(pairs):
        progress(ProgressEvent(STAGE, done, len(pairs), pair[0].source))
        image = measure_exposure(pair, sensor, options)
        images.append(image)
        sheet = np.where(image.fate == PointFate.MEASURED, image.sheet, -1)
        clouds.append(triangulate(image.profile, sheet, sensor))
    progress(ProgressEvent(STAGE, len(pairs), len(pairs)))
    cloud = merge_clouds(clouds)
    if len(cloud) == 0:
        raise EstimationError(nothing_measured(images), remedy=NOTHING_MEASURED_REMEDY)
    depths = [cloud.points_mm[cloud.sheet == k, 2] for k in range(len(sensor.sheets))]
    return Reconstruction(cloud, tuple(images), measurement_warnings(images, depths, sensor))


def measure_exposure(
    pair: ExposurePair, sensor: SensorCalibration, options: ReconstructOptions
) -> ReconstructedImage:
    """Stripes of one exposure, the sheet of each point and what becomes of it."""
    exposure, background = pair
    profile = extract_stripes(exposure, options.stripes, background)
    choice = choose_sheets(
        profile, sensor, options.depths, sheet_name=options.sheet, lasers=exposure.lasers
    )
    points, is_met = meet_sheets(profile.points_px, choice.sheet, sensor)
    fate = np.full(len(profile), int(PointFate.MEASURED))
    for k, sheet in enumerate(sensor.sheets):
        low, high = options.depths.limits_mm(sheet)
        outside = (points[:, 2] < low) | (points[:, 2] > high)
        fate[(choice.sheet == k) & outside] = PointFate.OUT_OF_DEPTH
    fate[choice.sheet < 0] = PointFate.OUT_OF_DEPTH
    fate[(choice.sheet >= 0) & ~is_met] = PointFate.NO_RAY
    fate[~profile.is_accepted] = PointFate.FLAGGED
    return ReconstructedImage(profile, fate, choice.sheet, choice.how)


NOTHING_MEASURED_REMEDY = (
    "check that the images show a laser line, that camera and sheet are the right ones, and give a "
    "larger --depth-margin if the object stood further outside the calibrated depths"
)


def nothing_measured(images: Sequence[ReconstructedImage]) -> str:
    """Say why these images gave no point at all."""
    n_points = sum(len(image.profile) for image in images)
    if n_points == 0:
        return f"no stripe was found in {len(images)} images"
    counts = ", ".join(
        f"{sum(image.count(fate) for image in images)} {fate.label}"
        for fate in PointFate
        if fate is not PointFate.MEASURED
    )
    return f"none of {n_points} stripe points could be measured: {counts}"
