# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration observes: stripes in the images of a scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import (
    MIN_POINTS,
    HandEyeOptions,
    PlateReference,
    PosedStripe,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError, EstimationError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.instants import PARTNER_MISSING, ScanInstants
from armscan.pipeline.measure import (
    MeasuredImage,
    MeasureOptions,
    cameras_of,
    collected,
    see,
    stripes_for,
)
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.reconstruct import measurer_for
from armscan.reconstruction.labels import MeasuredProfile
from armscan.reconstruction.sync import SyncOptions, exposure_poses
from armscan.reconstruction.triangulate import StripePoints, sensor_columns
from armscan.records.recording import ExposureRow

STAGE = "stripes of the postures"
SAME_PLACE_MM = 0.05
SAME_TURN_RAD = 2e-4
"""Consecutive exposures without a view whose poses differ by less are one posture."""


@dataclass(frozen=True, slots=True)
class HandEyeScanOptions:
    """How a scan of the plate becomes a hand-eye.

    Parameters
    ----------
    hand_eye
        The calibration itself.
    measure
        Stripe extraction and the depths accepted.
    sync
        How exposures find their pose.
    max_exposures
        Of a longer scan, so many are used, evenly spread.
    """

    hand_eye: HandEyeOptions = field(default_factory=HandEyeOptions)
    measure: MeasureOptions = field(default_factory=MeasureOptions)
    sync: SyncOptions = field(default_factory=SyncOptions)
    max_exposures: int = 200

    def __post_init__(self) -> None:
        if self.max_exposures < 3:
            raise OptionError(
                f"at most {self.max_exposures} exposures",
                where="hand-eye options",
                remedy="allow at least 3",
            )


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeRun:
    """A hand-eye, and what was seen on the way.

    Parameters
    ----------
    fit
        The result.
    stripes
        The stripes that it rests on, with their poses.
    images
        What each of these exposures gave, in the same order.
    not_used
        (source, reason) of exposures that were left out.
    warnings
        What is weak about the scan, in words; those of the calibration are in ``fit``.
    """

    fit: HandEyeFit
    stripes: tuple[PosedStripe, ...]
    images: tuple[MeasuredProfile, ...]
    not_used: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ObservedStripes:
    """What a hand-eye calibration needs of a scan, and what was seen on the way.

    Parameters
    ----------
    stripes, images, not_used, warnings
        As of `HandEyeRun`.
    """

    stripes: tuple[PosedStripe, ...]
    images: tuple[MeasuredProfile, ...]
    not_used: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]


def calibrate_hand_eye_from_scan(
    source: ScanSource,
    sensor: SensorCalibration,
    plate: PlateReference,
    options: HandEyeScanOptions | None = None,
    *,
    progress: Progress = silent,
) -> HandEyeRun | FitFailure:
    """Measure the stripe of every exposure on the plate and calibrate.

    Exposures of equal view are one posture; without views, consecutive exposures whose poses agree
    are one, so that a moving scan has a posture an exposure.

    Parameters
    ----------
    source
        The scan, with an arm and the sensor's cameras; exposures with the laser off serve as
        background of their view.
    sensor
        Camera and sheets.
    plate
        The plate in Base.
    options
        Defaults if None.
    progress
        Told of every exposure.

    Raises
    ------
    InputError
        If the scan has no arm or not the sensor's cameras, if its images are not of the camera's
        sensor, or if one view stands for different poses.
    EstimationError
        If no exposure has a pose, none of the images can be read, or the sheet of a stripe is
        ambiguous.
    """
    options = options or HandEyeScanOptions()
    seen = observe_stripes(source, sensor, options, progress=progress)
    fit = calibrate_on_plate(
        seen.stripes, plate, options.hand_eye, sensor_covariance=sensor.covariance
    )
    if isinstance(fit, FitFailure):
        return fit
    return HandEyeRun(fit, seen.stripes, seen.images, seen.not_used, seen.warnings)


def observe_stripes(
    source: ScanSource,
    sensor: SensorCalibration,
    options: HandEyeScanOptions,
    *,
    progress: Progress = silent,
) -> ObservedStripes:
    """Measure the stripe of every exposure that has a pose; else `calibrate_hand_eye_from_scan`.

    Whatever reference the stripes lie on: a plate or a sphere. An image that cannot be read is
    left out and named, as `armscan.pipeline.scan.measure_scan` does, and so is one without its
    partner of the other camera.
    """
    poses = exposure_poses(source.rows, source.arm, source.session.clock, options=options.sync)
    cameras = cameras_of(sensor)
    exposures = ScanInstants(source, len(cameras))
    lit = exposures.lit
    has_pose = np.array([poses.has_pose[list(one.rows)].all() for one in lit], dtype=np.bool_)
    chosen = [lit[k] for k in _spread(np.flatnonzero(has_pose), options.max_exposures)]
    postures, merged = _postures(
        [source.rows[one.rows[0]] for one in chosen], [poses.pose(one.rows[0]) for one in chosen]
    )
    stripes: list[PosedStripe] = []
    images: list[MeasuredProfile] = []
    not_used = [
        (source.rows[row].source, "the arm gave no pose for it")
        for one, known in zip(lit, has_pose, strict=True)
        for row in one.rows
        if not known
    ]
    not_used += [(source.rows[row].source, PARTNER_MISSING) for row in exposures.without_partner]
    n_unreadable = 0
    weak: list[str] = []
    for done, (instant, posture) in enumerate(zip(chosen, postures, strict=True)):
        first = source.rows[instant.rows[0]].source
        progress(ProgressEvent(STAGE, done, len(chosen), first))
        try:
            pairs = [exposures.pair(row) for row in instant.rows]
        except ArmscanError as error:
            not_used.append((first, str(error)))
            n_unreadable += 1
            continue
        seen = [
            see(pair, camera, stripes_for(sensor, options.measure.stripes))
            for pair, camera in zip(pairs, cameras, strict=True)
        ]
        # Each still is named by itself: where the sensor is on the arm is not known yet.
        for one in measurer_for(sensor, options.measure).measure(seen, None, instant.t_ns):
            weak += one.warnings
            if len(one.points.row) < MIN_POINTS:
                not_used.append((one.image.profile.source, "no stripe was measured in it"))
                continue
            images.append(one.image)
            stripes.append(posed_stripe(one, sensor, posture, poses.pose(instant.rows[0])))
    progress(ProgressEvent(STAGE, len(chosen), len(chosen)))
    if n_unreadable == len(chosen) > 0:
        raise EstimationError(f"no exposure with a pose could be read: {not_used[-1][1]}")
    n_posed = int(has_pose.sum())
    warnings = (
        *poses.warnings,
        *_left_out(len(chosen), n_posed, not_used),
        *merged,
        *collected(weak),
    )
    return ObservedStripes(tuple(stripes), tuple(images), tuple(not_used), warnings)


def _left_out(n_chosen: int, n_posed: int, not_used: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    warnings = []
    if n_chosen < n_posed:
        warnings.append(f"{n_chosen} of {n_posed} exposures were used, evenly spread")
    if not_used:
        named = ", ".join(f"{name} ({reason})" for name, reason in not_used[:4])
        named += f", and {len(not_used) - 4} more" if len(not_used) > 4 else ""
        warnings.append(f"{len(not_used)} exposures were not used: {named}")
    return tuple(warnings)


def posed_stripe(
    measured: MeasuredImage,
    sensor: SensorCalibration,
    posture: str,
    base_from_tool: Pose[Base, Tool],
) -> PosedStripe:
    """Give the measured points of one exposure their pose.

    Parameters
    ----------
    measured
        Points in the Sensor frame.
    sensor
        Camera or cameras and sheets.
    posture
        Name of the arm's posture.
    base_from_tool
        As the arm reported it.
    """
    points = measured.points
    return PosedStripe(
        source=measured.image.profile.source,
        posture=posture,
        base_from_tool=base_from_tool,
        points_mm=points.points_mm,
        noise_mm=points.noise_mm,
        sheet=points.sheet,
        dpoint_dsensor=_by_all_parameters(points, sensor),
    )


def _by_all_parameters(points: StripePoints, sensor: SensorCalibration) -> FloatArray:
    spread = np.zeros((len(points.row), 3, len(sensor.parameter_names)))
    for k in range(len(sensor.sheets)):
        own = np.flatnonzero(points.sheet == k)
        spread[np.ix_(own, np.arange(3), sensor_columns(sensor, k))] = points.by_sensor[own]
    return spread


def _spread(rows: IntArray, most: int) -> IntArray:
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def _postures(
    rows: list[ExposureRow], poses: list[Pose[Base, Tool]]
) -> tuple[list[str], tuple[str, ...]]:
    """Name the posture of each exposure; say which were put together without being asked."""
    names: list[str] = []
    n_merged = 0
    first = 0
    for k, row in enumerate(rows):
        if row.view is not None:
            names.append(row.view)
            continue
        may_join = k > 0 and rows[k - 1].view is None
        if may_join and _agree(poses[first], poses[k]):
            names.append(names[-1])
            n_merged += 1
            continue
        first = k
        names.append(f"exposure {row.index}")
    if not n_merged:
        return names, ()
    return names, (
        f"{n_merged} exposures were taken where the one before was (within {SAME_PLACE_MM} mm and "
        f"{np.degrees(SAME_TURN_RAD):.3f} deg) and count as one posture with it",
    )


def _agree(pose: Pose[Base, Tool], other: Pose[Base, Tool]) -> bool:
    shift = float(np.linalg.norm(pose.translation_mm - other.translation_mm))
    turn: Pose[Tool, Tool] = pose.inverse() @ other
    angle = float(np.linalg.norm(turn.rotation_vector_rad))
    return shift < SAME_PLACE_MM and angle < SAME_TURN_RAD
