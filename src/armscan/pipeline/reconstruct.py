# SPDX-License-Identifier: Apache-2.0
"""From images of stripes on an object to measured points."""

from __future__ import annotations

from collections.abc import Sequence

from armscan.errors import EstimationError, InputError
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.exposure_pairs import ExposurePair, pair_exposures
from armscan.pipeline.measure import cameras_of, collected, see, stripes_for
from armscan.pipeline.measure_options import MeasureOptions
from armscan.pipeline.measurement_warnings import measurement_warnings
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.sheet_rules import measurer_for
from armscan.reconstruction.merge import merge_clouds
from armscan.reconstruction.result import PointFate, ReconstructedImage, Reconstruction
from armscan.reconstruction.triangulate import cloud_in_sensor
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure

STAGE = "reconstruct"


def reconstruct(
    exposures: Sequence[Exposure],
    sensor: SensorCalibration,
    *,
    backgrounds: Sequence[Exposure] = (),
    rights: Sequence[Exposure] = (),
    right_backgrounds: Sequence[Exposure] = (),
    options: MeasureOptions | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """Extract the stripes of every exposure, name their sheets and triangulate them.

    Parameters
    ----------
    exposures
        With the laser on, of the left camera or the only one; each is measured by itself.
    sensor
        Camera or cameras and sheets.
    backgrounds
        The same views without laser, one for each exposure, or none.
    rights, right_backgrounds
        The right camera's exposures of the same instants, in the same order, and theirs without
        laser; for a sensor of two cameras.
    options
        Defaults if None.
    progress
        Told of every image.

    Raises
    ------
    InputError
        If images and backgrounds do not pair, are not of the camera's sensor, or if the images are
        not of as many cameras as the sensor has.
    EstimationError
        If the sheet of a stripe is ambiguous, or nothing was measured at all.
    """
    options = options or MeasureOptions()
    instants = _instants(exposures, backgrounds, rights, right_backgrounds, sensor)
    cameras = cameras_of(sensor)
    stripes = stripes_for(sensor, options.stripes)
    images: list[ReconstructedImage] = []
    clouds: list[PointCloud] = []
    weak: list[str] = []
    for done, pairs in enumerate(instants):
        progress(ProgressEvent(STAGE, done, len(instants), pairs[0][0].source))
        measurer = measurer_for(sensor, options)
        seen = [see(pair, camera, stripes) for pair, camera in zip(pairs, cameras, strict=True)]
        for one in measurer.measure(seen):
            images.append(one.image)
            weak += one.warnings
            clouds.append(cloud_in_sensor(one.points, one.image.profile, sensor))
    progress(ProgressEvent(STAGE, len(instants), len(instants)))
    cloud = merge_clouds(clouds)
    if len(cloud) == 0:
        raise EstimationError(nothing_measured(images), remedy=NOTHING_MEASURED_REMEDY)
    depths = [cloud.points_mm[cloud.sheet == k, 2] for k in range(len(sensor.sheets))]
    warnings = (*measurement_warnings(images, depths, sensor), *collected(weak))
    return Reconstruction(cloud, tuple(images), warnings)


def _instants(
    exposures: Sequence[Exposure],
    backgrounds: Sequence[Exposure],
    rights: Sequence[Exposure],
    right_backgrounds: Sequence[Exposure],
    sensor: SensorCalibration,
) -> list[tuple[ExposurePair, ...]]:
    left = pair_exposures(exposures, backgrounds)
    if sensor.second is None:
        if rights:
            raise InputError(
                f"{len(rights)} images of a right camera, but the sensor has one camera",
                remedy="leave them out, or name the sensor of the stereo head",
            )
        return [(pair,) for pair in left]
    if len(rights) != len(left):
        raise InputError(
            f"{len(left)} images of the left camera but {len(rights)} of the right one",
            remedy="give the right camera's image of every instant, in the same order",
        )
    return list(zip(left, pair_exposures(rights, right_backgrounds), strict=True))


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
        f"{count} {fate.label}"
        for fate in PointFate
        if (count := sum(image.count(fate) for image in images))
    )
    return f"none of {n_points} stripe points could be measured: {counts}"
