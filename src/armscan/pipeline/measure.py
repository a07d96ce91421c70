# SPDX-License-Identifier: Apache-2.0
"""One exposure to measured points in the Sensor frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, cast

import numpy as np

from armscan.geometry.arrays import IntArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel
from armscan.pipeline.instants import ExposurePair, check_sizes
from armscan.reconstruction.label_single import DepthRange, is_without_ray
from armscan.reconstruction.labels import LabelledProfile, LabelStatus, MeasuredProfile, PointStatus
from armscan.reconstruction.triangulate import StripePoints, intersect_sheets, triangulate_stripe
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import LaserColour, StripeOptions


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """How stripes on objects become points.

    Parameters
    ----------
    stripes
        Stripe extraction.
    depths
        Depths that are accepted; points outside are left out and counted. None for those that the
        head's own rule takes: `DepthRange` of one camera, `StereoLabelOptions.depths` of two.
    sheet
        Name of the sheet that drew all stripes; empty to find it. For one camera only.
    """

    stripes: StripeOptions = field(default_factory=StripeOptions)
    depths: DepthRange | None = None
    sheet: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class LitProfile:
    """Stripes of one exposure, and the lasers that its row names.

    Parameters
    ----------
    profile
        Stripe points.
    lasers
        Names of the sources that were on; empty if unknown.
    """

    profile: Profile
    lasers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredImage:
    """What one exposure gave.

    Parameters
    ----------
    image
        Its stripe points, the sheet of each and what became of it.
    points
        The measured ones in the Sensor frame.
    warnings
        What is weak, in words.
    """

    image: MeasuredProfile
    points: StripePoints
    warnings: tuple[str, ...] = ()


class Measurer(Protocol):
    """Names the sheets of stripes and triangulates them, instant by instant in order of time."""

    def measure(
        self,
        seen: Sequence[LitProfile],
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> tuple[MeasuredImage, ...]:
        """Measure what the cameras saw at one instant; one result a camera."""


def stripes_for(sensor: SensorCalibration, options: StripeOptions) -> StripeOptions:
    """The options with the channel in which the sensor was calibrated, unless one was chosen."""
    if options.laser_colour != "auto":
        return options
    return replace(options, laser_colour=cast(LaserColour, sensor.laser_colour))


def see(pair: ExposurePair, camera: CameraModel, options: StripeOptions) -> LitProfile:
    """Extract the stripes of one exposure.

    Raises
    ------
    InputError
        If the image is not of the camera's sensor.
    """
    exposure, background = pair
    check_sizes([image for image in pair if image is not None], camera)
    return LitProfile(extract_stripes(exposure, options, background), exposure.lasers)


def cameras_of(sensor: SensorCalibration) -> tuple[CameraModel, ...]:
    """The sensor's camera or cameras, left first."""
    if sensor.second is None:
        return (sensor.camera.camera,)
    return sensor.camera.camera, sensor.second.camera.camera


def triangulated(
    image: MeasuredProfile, sensor: SensorCalibration, depths: DepthRange
) -> MeasuredImage:
    """Triangulate the points that passed so far; those beyond the accepted depths do not."""
    points, is_met = intersect_sheets(image.profile.points_px, image.sheet, sensor)
    fate = np.array(image.fate)
    is_open = fate == int(PointStatus.MEASURED)
    for k, sheet in enumerate(sensor.sheets):
        low, high = depths.limits_mm(sheet)
        outside = (points[:, 2] < low) | (points[:, 2] > high)
        fate[is_open & (image.sheet == k) & outside] = int(PointStatus.OUT_OF_DEPTH)
    fate[is_open & ~is_met] = int(PointStatus.NO_RAY)
    for k, calibrated in enumerate(sensor.sheets):
        own = np.flatnonzero((fate == int(PointStatus.MEASURED)) & (image.sheet == k))
        profile = image.profile
        lost = is_without_ray(
            points[own], profile.intensity[own], profile.segment[own], calibrated.sheet
        )
        fate[own[lost]] = int(PointStatus.NO_LASER_RAY)
    measured = replace(image, fate=fate)
    return MeasuredImage(measured, stripe_points(measured, sensor))


def stripe_points(image: MeasuredProfile, sensor: SensorCalibration) -> StripePoints:
    """The measured points of an image of one camera in the Sensor frame."""
    sheet = np.where(image.fate == int(PointStatus.MEASURED), image.sheet, -1)
    return triangulate_stripe(image.profile, sheet, sensor)


_FATES = {
    LabelStatus.NAMED: PointStatus.MEASURED,
    LabelStatus.AMBIGUOUS: PointStatus.AMBIGUOUS,
    LabelStatus.UNEXPLAINED: PointStatus.STRAY,
    LabelStatus.NOT_ASKED: PointStatus.FLAGGED,
}


def collected(warnings: Sequence[str]) -> tuple[str, ...]:
    """Of warnings of single exposures, how many there are and what the first says."""
    if not warnings:
        return ()
    return (f"{len(warnings)} exposures: {warnings[0]}",)


def fates_of(named: LabelledProfile) -> IntArray:
    """(N,) `PointStatus` of named stripe points, before they are triangulated."""
    table = np.array([int(_FATES[fate]) for fate in sorted(LabelStatus)])
    return np.asarray(table[named.fate])
