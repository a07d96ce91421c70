# SPDX-License-Identifier: Apache-2.0
"""The rule that names the sheet of each stripe: it is all in which heads differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from armscan.errors import OptionError
from armscan.geometry.arrays import IntArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.measure import (
    LitProfile,
    MeasuredImage,
    Measurer,
    fates_of,
    stripe_points,
    triangulated,
)
from armscan.pipeline.measure_options import MeasureOptions
from armscan.reconstruction.choose_sheet import DepthRange, choose_sheets
from armscan.reconstruction.identify_cross import CrossNamer, CrossOptions
from armscan.reconstruction.named_profile import NamedProfile
from armscan.reconstruction.result import PointFate, ReconstructedImage
from armscan.reconstruction.stereo_fate import StereoFate
from armscan.reconstruction.stereo_measure import measure_stereo
from armscan.reconstruction.stereo_options import StereoNamingOptions
from armscan.reconstruction.stripe_namer import StripeNamer
from armscan.reconstruction.triangulate import StripePoints

LEAST_APART_RAD = 0.5
"""Stripes whose directions differ by more are told from each other by direction."""


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

    Raises
    ------
    OptionError
        If a sheet is chosen for two cameras, which tell the sheet of every stripe themselves.
    """
    if sensor.second is not None:
        if options.sheet:
            raise OptionError(
                f"sheet {options.sheet!r} was asked for, but two cameras tell each stripe's sheet",
                where="--sheet",
                remedy="leave --sheet out",
            )
        return ByTwoCameras(sensor, _stereo_options(options))
    n_sheets = len(sensor.sheets)
    if n_sheets > 1 and not options.sheet and (is_scan or stripes_cross(sensor)):
        cross = CrossOptions() if options.depths is None else CrossOptions(depths=options.depths)
        return ByPast(sensor, options, CrossNamer(sensor, cross))
    return ByDepth(sensor, options)


def stripes_cross(sensor: SensorCalibration) -> bool:
    """True if the stripes of two sheets on a wall that faces the camera run clearly apart."""
    normals = np.array([calibrated.sheet.axes[2][:2] for calibrated in sensor.sheets])
    angles = np.arctan2(normals[:, 1], normals[:, 0])
    apart = np.abs(np.sin(angles[:, None] - angles))
    return bool((apart > np.sin(LEAST_APART_RAD)).any())


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

    @property
    def depths(self) -> DepthRange:
        """Depths accepted."""
        return self.options.depths or DepthRange()

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
            self.depths,
            sheet_name=self.options.sheet,
            lasers=lit.lasers,
        )
        fate = np.where(choice.sheet < 0, int(PointFate.OUT_OF_DEPTH), int(PointFate.MEASURED))
        fate[~lit.profile.is_accepted] = int(PointFate.FLAGGED)
        image = ReconstructedImage(lit.profile, fate, choice.sheet, choice.how)
        return triangulated(image, self.sensor, self.depths)


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
        """Measure the next exposure of a stroke; without a pose, each by itself.

        An exposure without pose makes the namer forget the stroke before it. That is right for
        stills and for hand-eye calibration, which give no pose at all; a scan leaves exposures
        without pose out and so never asks for it in the middle of a stroke.
        """
        if base_from_sensor is None:
            self.namer.reset()
        depths = self.options.depths or DepthRange()
        measured = []
        for lit in seen:
            named = self.namer.name(lit.profile, lit.lasers, base_from_sensor, t_ns)
            image = ReconstructedImage(lit.profile, fates_of(named), named.sheet, named.how)
            measured.append(triangulated(image, self.sensor, depths))
        return tuple(measured)


@dataclass(frozen=True, slots=True, eq=False)
class ByTwoCameras:
    """Two cameras: each names the stripes of the other (eqs. 4.17 and 4.18).

    Parameters
    ----------
    sensor
        Both cameras and all sheets.
    options
        Limits of the naming.
    """

    sensor: SensorCalibration
    options: StereoNamingOptions = field(default_factory=StereoNamingOptions)

    def measure(
        self,
        seen: Sequence[LitProfile],
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> tuple[MeasuredImage, ...]:
        """Measure one instant by itself; points that both cameras see belong to the left one."""
        left, right = (lit.profile for lit in seen)
        found = measure_stereo(left, right, self.sensor, self.options)
        return (
            MeasuredImage(
                _of_camera(found.left, found.left_points, found.left_fate),
                found.left_points,
                found.warnings,
            ),
            MeasuredImage(
                _of_camera(found.right, found.right_points, found.right_fate), found.right_points
            ),
        )


_FATES = {
    StereoFate.FUSED: PointFate.MEASURED,
    StereoFate.ALONE: PointFate.MEASURED,
    StereoFate.TAKEN: PointFate.SHARED,
    StereoFate.OUT_OF_DEPTH: PointFate.OUT_OF_DEPTH,
    StereoFate.INCONSISTENT: PointFate.INCONSISTENT,
    StereoFate.NO_RAY: PointFate.NO_RAY,
}


def _stereo_options(options: MeasureOptions) -> StereoNamingOptions:
    """Limits of the naming; its own depths unless a person chose others."""
    if options.depths is None:
        return StereoNamingOptions()
    return StereoNamingOptions(depths=options.depths)


def _of_camera(named: NamedProfile, points: StripePoints, became: IntArray) -> ReconstructedImage:
    """What became of the stripe points of one of two cameras."""
    fate = fates_of(named)
    for stereo_fate, point_fate in _FATES.items():
        fate[became == int(stereo_fate)] = int(point_fate)
    sheet = np.array(named.sheet)
    sheet[points.row] = points.sheet
    return ReconstructedImage(named.profile, fate, sheet, named.how)


def measured_again(
    images: Sequence[ReconstructedImage], sensor: SensorCalibration
) -> Iterator[tuple[int, StripePoints]]:
    """Number and measured points of each image of a scan: what it does not keep of them.

    Of a head of two cameras, the images of one instant follow each other.
    """
    if sensor.second is None:
        for k, image in enumerate(images):
            yield k, stripe_points(image, sensor)
        return
    for k in range(0, len(images) - 1, 2):
        found = measure_stereo(images[k].profile, images[k + 1].profile, sensor)
        yield k, found.left_points
        yield k + 1, found.right_points
