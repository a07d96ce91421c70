# SPDX-License-Identifier: Apache-2.0
"""What calibrations of hand-eye and latency observe: stripes in the images of a scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armscan.calibration.hand_eye.observations import (
    MIN_POINTS,
    PosedStripe,
)
from armscan.calibration.latency import PlateLooks, plate_looks
from armscan.devices.sources import ScanSource
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.instants import PARTNER_MISSING, ScanInstants, check_poses
from armscan.pipeline.measure import (
    MeasureOptions,
    cameras_of,
    labeller_for,
    laser_warnings,
    measure_instants,
    summarised,
)
from armscan.pipeline.progress import Progress, silent
from armscan.reconstruction.labels import LabelledProfile, PointStatus
from armscan.reconstruction.place import delivered_points
from armscan.reconstruction.points import MeasuredProfile, points_again
from armscan.reconstruction.sync import exposure_poses
from armscan.reconstruction.triangulate import StripePoints, sensor_columns
from armscan.records.exposure import Exposure
from armscan.records.profile import PointProfile

STAGE, LOOKS = "stripes of the postures", "stripes on the plate"
MAX_EXPOSURES = 200
"""Of a longer scan, so many are used, evenly spread."""
SAME_PLACE_MM = 0.05
SAME_TURN_RAD = 2e-4
"""Consecutive exposures without a view whose poses differ by less are one posture."""
REPEATED_DEG, REPEATED_MM = 0.1, 0.1
"""Poses of a table, as a robot tells them, that differ by less are one posture."""


@dataclass(frozen=True, slots=True, eq=False)
class ObservedStripes:
    """What a hand-eye calibration needs of a scan, and what was seen on the way.

    Parameters
    ----------
    stripes
        The stripes with their poses.
    images
        What each of these exposures gave, in the same order.
    not_used
        (source, reason) of exposures that were left out.
    warnings
        What is weak about the scan, in words.
    exposures
        The first of these exposures, as many as were wanted, by their row.
    """

    stripes: tuple[PosedStripe, ...]
    images: tuple[LabelledProfile, ...]
    not_used: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    exposures: Mapping[int, Exposure] = field(default_factory=dict)


def observe_stripes(
    source: ScanSource,
    sensor: SensorCalibration,
    options: MeasureOptions | None = None,
    *,
    max_exposures: int = MAX_EXPOSURES,
    n_wanted: int = 0,
    progress: Progress = silent,
) -> ObservedStripes:
    """Measure the stripe of every exposure that has a pose.

    Whatever reference the stripes lie on: a plate or a sphere. Exposures of equal view are one
    posture; without views, consecutive exposures whose poses agree are one, so that a moving scan
    has a posture an exposure. An image that cannot be read is left out and named, and so is one
    without its partner of the other camera.

    Parameters
    ----------
    source
        The scan, with an arm and the sensor's cameras; exposures with the laser off serve as
        background of their view.
    sensor
        Camera or cameras and sheets.
    options
        Stripe extraction and the depths accepted.
    max_exposures
        Of a longer scan, so many are used, evenly spread.
    n_wanted
        Exposures that are kept, for a page that shows them.
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
    options = options or MeasureOptions()
    poses = exposure_poses(source.rows, source.arm, source.session.clock)
    scan = ScanInstants(source, len(cameras_of(sensor)))
    has_pose = np.array([poses.has_pose[list(one.rows)].all() for one in scan.lit], dtype=np.bool_)
    chosen = [scan.lit[k] for k in _spread(np.flatnonzero(has_pose), max_exposures)]
    rows = [source.rows[one.rows[0]] for one in chosen]
    postures, merged = standing_postures(
        [row.view for row in rows],
        [poses.pose(one.rows[0]) for one in chosen],
        [f"exposure {row.index}" for row in rows],
    )
    posture_of = dict(zip(chosen, postures, strict=True))
    stripes: list[PosedStripe] = []
    images: list[LabelledProfile] = []
    kept: dict[int, Exposure] = {}
    without_stripe: dict[int, str] = {}
    weak: list[str] = []
    # Each still is labelled by itself: where the sensor is on the arm is not known yet.
    labeller = labeller_for(sensor, options)
    of_lasers = laser_warnings([one.lasers for one in chosen], labeller, sensor, options)
    measured = measure_instants(
        scan.read(chosen, STAGE, progress),
        labeller,
        sensor,
        options,
        is_pass=False,
    )
    for one in measured:
        instant = one.images.instant
        for row, (exposure, _), found in zip(
            instant.rows, one.images.pairs, one.profiles, strict=True
        ):
            weak += found.warnings
            if len(found.points) < MIN_POINTS:
                if not _is_shared(found.labelled):
                    without_stripe[row] = _why_without(found.labelled)
                continue
            images.append(found.labelled)
            if len(kept) < n_wanted:
                kept[row] = exposure
            pose = poses.pose(instant.rows[0])
            stripe = posed_stripe(found, sensor, posture_of[instant], pose)
            stripes.append(replace(stripe, instant=source.rows[instant.rows[0]].source))
    if chosen and all(one.rows[0] in scan.unreadable for one in chosen):
        raise EstimationError(
            f"no exposure with a pose could be read: {scan.unreadable[chosen[-1].rows[0]]}"
        )
    reasons = {
        row: "the arm gave no pose for it"
        for one, known in zip(scan.lit, has_pose, strict=True)
        for row in one.rows
        if not known
    }
    reasons |= dict.fromkeys(scan.without_partner, PARTNER_MISSING)
    for one in chosen:
        first = one.rows[0]
        if first in scan.unreadable:
            reasons[first] = scan.unreadable[first]
        reasons |= {row: without_stripe[row] for row in one.rows if row in without_stripe}
    not_used = tuple((source.rows[row].source, reason) for row, reason in reasons.items())
    warnings = (
        *poses.warnings,
        *of_lasers,
        *_left_out(len(chosen), int(has_pose.sum()), not_used),
        *merged,
        *summarised(weak),
    )
    return ObservedStripes(tuple(stripes), tuple(images), not_used, warnings, kept)


MAX_LOOKS = 2000
"""Of a longer recording of a moving stand-off, so many exposures are used, evenly spread."""


def observe_plate(
    source: ScanSource,
    sensor: SensorCalibration,
    options: MeasureOptions | None = None,
    *,
    progress: Progress = silent,
) -> PlateLooks:
    """Measure the stripes of every exposure of a plate, whether it has a pose or not.

    Parameters
    ----------
    source, sensor, options, progress
        As for `observe_stripes`; the plate should fill the view.

    Raises
    ------
    InputError
        If the scan has not the sensor's cameras, or its images are not of the camera's sensor.
    EstimationError
        If the sheet of a stripe is ambiguous.
    """
    options = options or MeasureOptions()
    scan = ScanInstants(source, len(cameras_of(sensor)))
    chosen = [scan.lit[k] for k in _spread(np.arange(len(scan.lit)), MAX_LOOKS)]
    times, points = [], []
    for one in measure_instants(
        scan.read(chosen, LOOKS, progress),
        labeller_for(sensor, options),
        sensor,
        options,
        is_pass=False,
    ):
        times.append(source.rows[one.images.instant.rows[0]].t_ns)
        found = [profile.points.points_mm for profile in one.profiles]
        points.append(np.concatenate([np.zeros((0, 3)), *found]))
    return plate_looks(times, points)


def _is_shared(image: LabelledProfile) -> bool:
    """Whether its points are measured as those of the other camera of the instant."""
    return image.count(PointStatus.SHARED) >= MIN_POINTS


def _why_without(image: LabelledProfile) -> str:
    """What became of most of its stripe points, if there were any."""
    lost = image.status[image.status != PointStatus.MEASURED]
    if len(lost) < MIN_POINTS:
        return "no stripe was measured in it"
    most = PointStatus(int(np.bincount(lost).argmax()))
    return f"most of its stripe points are {most.label}"


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
    measured: MeasuredProfile,
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
        source=measured.labelled.profile.source,
        posture=posture,
        base_from_tool=base_from_tool,
        points_mm=points.points_mm,
        noise_mm=points.noise_mm,
        sheet=points.sheet,
        dpoint_dsensor=_by_all(points, sensor),
    )


def _by_all(points: StripePoints, sensor: SensorCalibration) -> FloatArray:
    """(N, 3, P) derivative of points by all the sensor's parameters."""
    by_all = np.zeros((len(points), 3, len(sensor.parameter_names)))
    for k in range(len(sensor.sheets)):
        rows = np.flatnonzero(points.sheet == k)
        by_all[np.ix_(rows, np.arange(3), sensor_columns(sensor, k))] = points.by_sensor[rows]
    return by_all


def measured_beside(
    stripes: Sequence[PosedStripe],
    images: Sequence[LabelledProfile],
    moved: SensorCalibration,
    sensor_step: FloatArray,
) -> tuple[tuple[PosedStripe, ...], float]:
    """The stripes with derivatives by the sensor that are taken where a solution has moved it.

    A step that is large, of a weakly known lens, is not linear at the image's border. The points
    given back are those that lie, by their derivatives, where the moved sensor sees them once the
    step is added (`PosedStripe.beside`).

    Parameters
    ----------
    stripes, images
        What was measured, in equal order; of a sensor of one camera.
    moved
        The sensor after the step.
    sensor_step
        (P,) from the sensor with which the stripes were measured.

    Returns
    -------
    stripes, bend
        Root mean square over the points of how far they move beside where the derivatives at the
        sensor before put them, over their noise.
    """
    found: list[PosedStripe] = []
    squares = [np.zeros(0)]
    for stripe, image in zip(stripes, images, strict=True):
        points = points_again(image, moved)
        if len(points) != len(stripe.points_mm):
            found.append(stripe)  # some meet the moved sheet no more
            continue
        by_all = _by_all(points, moved)
        linear = stripe.beside(sensor_step).points_mm
        noise = np.sqrt((points.noise_mm**2).sum(axis=(1, 2)))
        squares.append(
            ((points.points_mm - linear) ** 2).sum(axis=1) / np.maximum(noise, 1e-9) ** 2
        )
        place = points.points_mm - by_all @ sensor_step
        found.append(
            replace(stripe, points_mm=place, noise_mm=points.noise_mm, dpoint_dsensor=by_all)
        )
    every = np.concatenate(squares)
    return tuple(found), float(np.sqrt(every.mean())) if len(every) else 0.0


def _spread(rows: IntArray, most: int) -> IntArray:
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def standing_postures(
    views: Sequence[str | None], poses: Sequence[Pose[Base, Tool]], names: Sequence[str]
) -> tuple[list[str], tuple[str, ...]]:
    """Name the posture of each exposure; say which were put together without being asked.

    A posture is named by its view, else by the name of its first exposure.
    """
    postures: list[str] = []
    n_merged = 0
    first = 0
    for k, view in enumerate(views):
        if view is not None:
            postures.append(view)
            continue
        may_join = k > 0 and views[k - 1] is None
        if may_join and _agree(poses[first], poses[k]):
            postures.append(postures[-1])
            n_merged += 1
            continue
        first = k
        postures.append(names[k])
    if not n_merged:
        return postures, ()
    return postures, (
        f"{n_merged} exposures were taken where the one before was (within {SAME_PLACE_MM} mm and "
        f"{np.degrees(SAME_TURN_RAD):.3f} deg) and count as one posture with it",
    )


def _agree(pose: Pose[Base, Tool], other: Pose[Base, Tool]) -> bool:
    shift = float(np.linalg.norm(pose.translation_mm - other.translation_mm))
    turn: Pose[Tool, Tool] = pose.inverse() @ other
    angle = float(np.linalg.norm(turn.rotation_vector_rad))
    return shift < SAME_PLACE_MM and angle < SAME_TURN_RAD


def repeated_postures(names: Sequence[str], poses: Sequence[Pose[Base, Tool]]) -> list[str]:
    """Name the posture of each pose of a table: that of the first with the same pose."""
    postures: list[str] = []
    for k, pose in enumerate(poses):
        same = [
            j
            for j in range(k)
            if np.linalg.norm(poses[j].translation_mm - pose.translation_mm) < REPEATED_MM
            and np.abs(poses[j].rotation - pose.rotation).max() < np.radians(REPEATED_DEG)
        ]
        postures.append(postures[same[0]] if same else names[k])
    return postures


def posed_stripes_from_profiles(
    profiles: Sequence[PointProfile], poses: Sequence[Pose[Base, Tool]]
) -> tuple[PosedStripe, ...]:
    """Join profiles that a sensor delivered and poses of equal order.

    Parameters
    ----------
    profiles
        One an exposure, in the Sensor frame.
    poses
        ``base_from_tool`` of each.

    Raises
    ------
    InputError
        If the counts differ.
    """
    check_poses(profiles, poses)
    postures = repeated_postures([profile.source for profile in profiles], poses)
    stripes = []
    for profile, posture, pose in zip(profiles, postures, poses, strict=True):
        points = delivered_points(profile)
        stripes.append(
            PosedStripe(
                source=profile.source,
                posture=posture,
                base_from_tool=pose,
                points_mm=points.points_mm,
                noise_mm=points.noise_mm,
                sheet=points.sheet,
            )
        )
    return tuple(stripes)
