# SPDX-License-Identifier: Apache-2.0
"""Stripes labelled with their sheets by the head's rule; a set of exposures measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from armscan.errors import EstimationError, InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.instants import ExposurePair, pair_exposures
from armscan.pipeline.measure import (
    LitProfile,
    MeasuredImage,
    MeasureOptions,
    Measurer,
    cameras_of,
    collected,
    fates_of,
    see,
    stripe_points,
    stripes_for,
    triangulated,
)
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.reconstruction.label_cross import CrossLabeller, CrossOptions
from armscan.reconstruction.label_single import DepthRange, choose_sheets
from armscan.reconstruction.label_stereo import StereoLabelOptions
from armscan.reconstruction.labels import (
    LabelledProfile,
    MeasuredProfile,
    PointStatus,
    Reconstruction,
    StereoStatus,
    StripeLabeller,
)
from armscan.reconstruction.place import merge_clouds
from armscan.reconstruction.stereo_points import measure_stereo
from armscan.reconstruction.triangulate import StripePoints, cloud_in_sensor
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure

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
        return ByPast(sensor, options, CrossLabeller(sensor, cross))
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
        fate = np.where(choice.sheet < 0, int(PointStatus.OUT_OF_DEPTH), int(PointStatus.MEASURED))
        fate[~lit.profile.is_accepted] = int(PointStatus.FLAGGED)
        image = MeasuredProfile(lit.profile, fate, choice.sheet, choice.how)
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
    namer: StripeLabeller

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
            image = MeasuredProfile(lit.profile, fates_of(named), named.sheet, named.how)
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
    options: StereoLabelOptions = field(default_factory=StereoLabelOptions)

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
    StereoStatus.FUSED: PointStatus.MEASURED,
    StereoStatus.ALONE: PointStatus.MEASURED,
    StereoStatus.TAKEN: PointStatus.SHARED,
    StereoStatus.OUT_OF_DEPTH: PointStatus.OUT_OF_DEPTH,
    StereoStatus.INCONSISTENT: PointStatus.INCONSISTENT,
    StereoStatus.NO_RAY: PointStatus.NO_RAY,
}


def _stereo_options(options: MeasureOptions) -> StereoLabelOptions:
    """Limits of the naming; its own depths unless a person chose others."""
    if options.depths is None:
        return StereoLabelOptions()
    return StereoLabelOptions(depths=options.depths)


def _of_camera(named: LabelledProfile, points: StripePoints, became: IntArray) -> MeasuredProfile:
    """What became of the stripe points of one of two cameras."""
    fate = fates_of(named)
    for stereo_fate, point_fate in _FATES.items():
        fate[became == int(stereo_fate)] = int(point_fate)
    sheet = np.array(named.sheet)
    sheet[points.row] = points.sheet
    return MeasuredProfile(named.profile, fate, sheet, named.how)


def measured_again(
    images: Sequence[MeasuredProfile], sensor: SensorCalibration
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


CLEAN_SHARE = 0.5
"""An image of which less than this share of the stripe points is measured is pointed out."""
LISTED = 4


def measurement_warnings(
    images: Sequence[MeasuredProfile],
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


def _image_warnings(images: Sequence[MeasuredProfile]) -> list[str]:
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
    n_outside = sum(image.count(PointStatus.OUT_OF_DEPTH) for image in images)
    if n_outside:
        warnings.append(f"{n_outside} points were left out: too far outside the calibrated depths")
    return warnings


def _n_measured(image: MeasuredProfile) -> int:
    return image.count(PointStatus.MEASURED) + image.count(PointStatus.SHARED)


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
    images: list[MeasuredProfile] = []
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


def nothing_measured(images: Sequence[MeasuredProfile]) -> str:
    """Say why these images gave no point at all."""
    n_points = sum(len(image.profile) for image in images)
    if n_points == 0:
        return f"no stripe was found in {len(images)} images"
    counts = ", ".join(
        f"{count} {fate.label}"
        for fate in PointStatus
        if (count := sum(image.count(fate) for image in images))
    )
    return f"none of {n_points} stripe points could be measured: {counts}"
