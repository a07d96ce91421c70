# SPDX-License-Identifier: Apache-2.0
"""From the stripes of one exposure with their sheets to measured points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, cast

import numpy as np

from armscan.geometry.arrays import IntArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel
from armscan.pipeline.exposure_pairs import ExposurePair, check_sizes
from armscan.reconstruction.choose_sheet import DepthRange
from armscan.reconstruction.free_rays import is_without_ray
from armscan.reconstruction.named_profile import NamedProfile, NameFate
from armscan.reconstruction.result import PointFate, ReconstructedImage
from armscan.reconstruction.triangulate import StripePoints, meet_sheets, triangulate_stripe
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.options import LaserColour, StripeOptions


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

    image: ReconstructedImage
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
    image: ReconstructedImage, sensor: SensorCalibration, depths: DepthRange
) -> MeasuredImage:
    """Triangulate the points that passed so far; those beyond the accepted depths do not."""
    points, is_met = meet_sheets(image.profile.points_px, image.sheet, sensor)
    fate = np.array(image.fate)
    is_open = fate == int(PointFate.MEASURED)
    for k, sheet in enumerate(sensor.sheets):
        low, high = depths.limits_mm(sheet)
        outside = (points[:, 2] < low) | (points[:, 2] > high)
        fate[is_open & (image.sheet == k) & outside] = int(PointFate.OUT_OF_DEPTH)
    fate[is_open & ~is_met] = int(PointFate.NO_RAY)
    for k, calibrated in enumerate(sensor.sheets):
        own = np.flatnonzero((fate == int(PointFate.MEASURED)) & (image.sheet == k))
        profile = image.profile
        lost = is_without_ray(
            points[own], profile.intensity[own], profile.segment[own], calibrated.sheet
        )
        fate[own[lost]] = int(PointFate.NO_LASER_RAY)
    measured = replace(image, fate=fate)
    return MeasuredImage(measured, stripe_points(measured, sensor))


def stripe_points(image: ReconstructedImage, sensor: SensorCalibration) -> StripePoints:
    """The measured points of an image of one camera in the Sensor frame."""
    sheet = np.where(image.fate == int(PointFate.MEASURED), image.sheet, -1)
    return triangulate_stripe(image.profile, sheet, sensor)


_FATES = {
    NameFate.NAMED: PointFate.MEASURED,
    NameFate.AMBIGUOUS: PointFate.AMBIGUOUS,
    NameFate.UNEXPLAINED: PointFate.STRAY,
    NameFate.NOT_ASKED: PointFate.FLAGGED,
}


def collected(warnings: Sequence[str]) -> tuple[str, ...]:
    """Of warnings of single exposures, how many there are and what the first says."""
    if not warnings:
        return ()
    return (f"{len(warnings)} exposures: {warnings[0]}",)


def fates_of(named: NamedProfile) -> IntArray:
    """(N,) `PointFate` of named stripe points, before they are triangulated."""
    table = np.array([int(_FATES[fate]) for fate in sorted(NameFate)])
    return np.asarray(table[named.fate])
