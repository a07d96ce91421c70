# SPDX-License-Identifier: Apache-2.0
"""From the stripes of one instant to measured points: the rule that names sheets, by head."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from armscan.geometry.arrays import IntArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel
from armscan.pipeline.exposure_pairs import ExposurePair, check_sizes
from armscan.pipeline.measure_options import MeasureOptions
from armscan.reconstruction.choose_sheet import DepthRange, choose_sheets
from armscan.reconstruction.identify_cross import CrossNamer
from armscan.reconstruction.named_profile import NamedProfile, NameFate
from armscan.reconstruction.result import PointFate, ReconstructedImage
from armscan.reconstruction.stripe_namer import StripeNamer
from armscan.reconstruction.triangulate import StripePoints, meet_sheets, triangulate_stripe
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.options import StripeOptions

LEAST_APART_RAD = 0.5
"""Stripes whose directions differ by more are told from each other by direction."""


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
    """

    image: ReconstructedImage
    points: StripePoints


class Measurer(Protocol):
    """Names the sheets of stripes and triangulates them, instant by instant in order of time."""

    def measure(
        self,
        seen: Sequence[LitProfile],
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> tuple[MeasuredImage, ...]:
        """Measure what the cameras saw at one instant; one result a camera."""


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


@dataclass(frozen=True, slots=True, eq=False)
class ByDepth:
    """One camera whose sheets are told by the laser that was on, or by depth.

    Parameters
    ----------
    sensor
        Camera and sheets.
    options
        Depths accepted, and the user's choice of a sheet.
    """

    sensor: SensorCalibration
    options: MeasureOptions

    def measure(
        self,
        seen: Sequence[LitProfile],
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> tuple[MeasuredImage, ...]:
        """Measure each exposure by itself.

        Raises
        ------
        EstimationError
            If the sheet of a stripe is ambiguous.
        """
        return tuple(self._one(lit) for lit in seen)

    def _one(self, lit: LitProfile) -> MeasuredImage:
        choice = choose_sheets(
            lit.profile,
            self.sensor,
            self.options.depths,
            sheet_name=self.options.sheet,
            lasers=lit.lasers,
        )
        fate = np.where(choice.sheet < 0, int(PointFate.OUT_OF_DEPTH), int(PointFate.MEASURED))
        fate[~lit.profile.is_accepted] = int(PointFate.FLAGGED)
        image = ReconstructedImage(lit.profile, fate, choice.sheet, choice.how)
        return triangulated(image, self.sensor, self.options.depths)


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
    measured = replace(image, fate=fate)
    return MeasuredImage(measured, stripe_points(measured, sensor))


def stripe_points(image: ReconstructedImage, sensor: SensorCalibration) -> StripePoints:
    """The measured points of an image of one camera in the Sensor frame."""
    sheet = np.where(image.fate == int(PointFate.MEASURED), image.sheet, -1)
    return triangulate_stripe(image.profile, sheet, sensor)


def measured_again(
    images: Sequence[ReconstructedImage], sensor: SensorCalibration
) -> Iterator[tuple[int, StripePoints]]:
    """Number and measured points of each image: what a scan does not keep of them."""
    for k, image in enumerate(images):
        yield k, stripe_points(image, sensor)


@dataclass(frozen=True, slots=True, eq=False)
class ByPast:
    """One camera whose lasers are on together: stripes are told by their past and direction.

    Parameters
    ----------
    sensor
        Camera and sheets.
    options
        Depths accepted.
    namer
        Remembers what it saw.
    """

    sensor: SensorCalibration
    options: MeasureOptions
    namer: StripeNamer

    def measure(
        self,
        seen: Sequence[LitProfile],
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> tuple[MeasuredImage, ...]:
        """Measure the next exposure of a stroke; without a pose, each by itself."""
        if base_from_sensor is None:
            self.namer.reset()
        measured = []
        for lit in seen:
            named = self.namer.name(lit.profile, lit.lasers, base_from_sensor, t_ns)
            image = ReconstructedImage(lit.profile, fates_of(named), named.sheet, named.how)
            measured.append(triangulated(image, self.sensor, self.options.depths))
        return tuple(measured)


def measurer_for(
    sensor: SensorCalibration, options: MeasureOptions, *, is_scan: bool = False
) -> Measurer:
    """The rule by which this sensor's stripes are named; it may remember what it saw before.

    Parameters
    ----------
    sensor
        Camera or cameras and sheets.
    options
        Depths accepted, and the user's choice of a sheet.
    is_scan
        True for exposures in order of time with the arm's pose; else each is measured by itself.
    """
    n_sheets = len(sensor.sheets)
    if n_sheets > 1 and not options.sheet and (is_scan or stripes_cross(sensor)):
        return ByPast(sensor, options, CrossNamer(sensor))
    return ByDepth(sensor, options)


def stripes_cross(sensor: SensorCalibration) -> bool:
    """True if the stripes of two sheets on a wall that faces the camera run clearly apart."""
    normals = np.array([calibrated.sheet.axes[2][:2] for calibrated in sensor.sheets])
    angles = np.arctan2(normals[:, 1], normals[:, 0])
    apart = np.abs(np.sin(angles[:, None] - angles))
    return bool((apart > np.sin(LEAST_APART_RAD)).any())


_FATES = {
    NameFate.NAMED: PointFate.MEASURED,
    NameFate.AMBIGUOUS: PointFate.AMBIGUOUS,
    NameFate.UNEXPLAINED: PointFate.STRAY,
    NameFate.NOT_ASKED: PointFate.FLAGGED,
}


def fates_of(named: NamedProfile) -> IntArray:
    """(N,) `PointFate` of named stripe points, before they are triangulated."""
    table = np.array([int(_FATES[fate]) for fate in sorted(NameFate)])
    return np.asarray(table[named.fate])
