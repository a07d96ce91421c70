# SPDX-License-Identifier: Apache-2.0
"""Stripe points to Sensor points with their covariance (eqs. 2.20 and 2.21)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    given_away,
    ints,
)
from armscan.geometry.poses import Pose, Sensor
from armscan.kernels.fusing import ACROSS, N_PARAMETERS, N_SENSOR, RIGHT, SHEET
from armscan.kernels.placing import spread_stripe
from armscan.kernels.rays import differentiate_sheets, meet_sheets, sheet_gradients
from armscan.models.calibration import (
    SHEET_PARAMETER_NAMES,
    SensorCalibration,
    SheetCalibration,
)
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.records.profile import PointProfile, Profile

N_CAMERA, N_SHEET = 9, len(SHEET_PARAMETER_NAMES)
IN_SENSOR = np.eye(3, 4).ravel()
"""Rows of no turn and no shift."""


MOST_MARGIN = 20.0
"""Widths of the calibrated depths; more was meant as percent or as millimetres."""


@dataclass(frozen=True, slots=True)
class DepthRange:
    """Depths that a reconstruction accepts: the calibrated range of the sheet, or more.

    Parameters
    ----------
    margin
        Part of the calibrated range's width by which it is widened at either end. Between the
        calibrated range and this limit points are extrapolated: their covariance grows, and a
        warning counts them.
    """

    margin: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.margin <= MOST_MARGIN:
            raise OptionError(
                f"depth margin {self.margin:g}",
                remedy=f"give 0 to {MOST_MARGIN:g} widths of the calibrated depths: 0.8 for 80 %",
            )

    def or_wider(self, other: DepthRange | None) -> DepthRange:
        """The wider of both; itself if there is no other."""
        return self if other is None or other.margin <= self.margin else other

    def limits_mm(self, sheet: SheetCalibration) -> tuple[float, float]:
        """Smallest and largest Z accepted, before the camera."""
        low, high = sheet.depth_range_mm
        slack = self.margin * (high - low)
        return max(low - slack, 0.0), high + slack

    def of_all_mm(self, sensor: SensorCalibration) -> tuple[float, float]:
        """Smallest and largest Z that any sheet of a sensor accepts."""
        low, high = np.array([self.limits_mm(one) for one in sensor.sheets]).T
        return float(low.min()), float(high.max())

    def holds(
        self, points_mm: FloatArray, sheet: IntArray | int, sensor: SensorCalibration
    ) -> BoolArray:
        """(..., N) True where points (..., N, 3) are within the depths of their sheets (N,)."""
        low, high = np.array([self.limits_mm(one) for one in sensor.sheets]).T
        depth = points_mm[..., 2]
        return np.asarray((depth >= low[sheet]) & (depth <= high[sheet]))


CALIBRATED_DEPTHS = DepthRange(0.0)
"""Depths that are accepted from one camera unless a person says more (ADR 15)."""
LABEL_DEPTHS = DepthRange(0.5)
"""Depths in which a sheet is looked for where several may have drawn a stripe, unless a person says
otherwise. Two cameras accept them too: the second one sees whether the sheet goes on as it was
calibrated."""
SOUGHT_DEPTHS = DepthRange(3.0)
"""Depths in which two cameras look for sheets, and more where a person accepts more. All lines of a
plate beyond its own sheets' depths lie, moved by one line, on the sheets beside them, a fraction of
a pixel off: where only these are asked for, they have every name wrong."""


def intersect_sheets(
    points_px: FloatArray,
    sheet_of_point: IntArray,
    sensor: SensorCalibration,
    at: Pose[Any, Sensor] | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Intersect the rays of pixels with their sheets, without covariance.

    Parameters
    ----------
    points_px
        (N, 2) full-sensor pixels.
    sheet_of_point
        (N,) index into ``sensor.sheets``; -1 for none.
    sensor
        Camera and sheets.
    at
        Where the sensor was; None to stay in its frame.

    Returns
    -------
    points_mm
        (N, 3) in the Sensor frame, or where ``at`` leads; zero where there is none.
    is_valid
        (N,) False without sheet, without inverse of the distortion, and where the ray misses.
    """
    carried = None if at is None else np.column_stack([at.rotation, at.translation_mm])
    turn = IN_SENSOR if carried is None else carried.ravel()
    return meet(points_px, sheet_of_point, lens_numbers(sensor), sheet_numbers(sensor), turn)


def meet(
    points_px: FloatArray,
    sheet: IntArray,
    lens: FloatArray,
    sheets: FloatArray,
    turn: FloatArray = IN_SENSOR,
) -> tuple[FloatArray, BoolArray]:
    """Points (N, 3) of pixels (N, 2) on sheets (N,), and (N,) True where met, by `meet_sheets`.

    ``lens`` and ``sheets`` are those of `lens_numbers` and `sheet_numbers`, in the frame of the
    camera; ``turn`` leads from there to the points' frame.
    """
    own = np.ascontiguousarray(sheet, dtype=np.int64)
    points, is_met = np.zeros((len(own), 3)), np.zeros(len(own), dtype=np.int64)
    pixels = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1)
    meet_sheets(pixels, own, lens, sheets, turn, points.reshape(-1), is_met)
    return points, is_met.astype(np.bool_)


@lru_cache(maxsize=8)
def lens_numbers(sensor: SensorCalibration) -> FloatArray:
    """(11,) the left camera or the only one, as the kernels read it."""
    return sensor.camera.camera.numbers


def differentiated(
    points_mm: FloatArray, sheet: IntArray, lens: FloatArray, sheets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(N, 3, 2) and (N, 3, 17) derivatives of points on their sheets; zero for a sheet of -1.

    ``lens`` and ``sheets`` as for `meet`; all in the frame of the camera.
    """
    n, n_parameters = len(points_mm), N_CAMERA + N_SHEET
    by_px, by_sensor = np.zeros((n, 3, 2)), np.zeros((n, 3, n_parameters))
    differentiate_sheets(
        np.ascontiguousarray(points_mm),
        np.ascontiguousarray(sheet, dtype=np.int64),
        lens,
        sheets,
        by_px.reshape(n, 6),
        by_sensor.reshape(n, 3 * n_parameters),
    )
    return by_px, by_sensor


class StripePoints(RowRecord):
    """Points of one exposure in the Sensor frame, with what their errors come from.

    Parameters
    ----------
    row
        (M,) index of each point in the profile.
    points_mm
        (M, 3) in the Sensor frame.
    noise_mm
        (M, 3, J) one standard deviation of each independent noise: the direction in which it acts
        times its size. One camera has one, the stripe's own noise, which acts within the sheet;
        a point that both cameras see has one of each camera.
    shape_mm
        (M, 3) move of the point by one standard deviation of the sheet's own shape, which the
        model leaves (see `SheetCalibration`): smooth over the sheet, so that neighbours share it.
    dpoint_dsensor
        (M, 3, Q) derivative by the parameters that `sensor_columns` names for the point's sheet:
        the camera's 9, the sheet's 8, and the 15 of a second camera, if there is one. None where
        it follows from the places alone, of points of the only camera that lie on their sheets,
        and where it is held as a product.
    gain, by_distance
        (M, 3, 4) moves of the point by the four distances that tell it, and (M, 41) derivatives
        of these by the sensor, as `armscan.kernels.fusing.fuse_stripes` makes them. None if
        ``dpoint_dsensor`` is given or follows from the places.
    sheet
        (M,) index into ``sensor.sheets``.
    noise_length
        (M,) correlation length of the noise along the stripe, as in `Profile`; of a point of two
        cameras the mean by variance. None where it is not known.
    """

    row: IntArray = ints("N")
    points_mm: FloatArray = floats("N", 3)
    noise_mm: FloatArray = floats("N", 3, None)
    shape_mm: FloatArray = floats("N", 3)
    dpoint_dsensor: FloatArray | None = floats("N", 3, None, default=None)
    gain: FloatArray | None = floats("N", 3, 4, default=None)
    by_distance: FloatArray | None = floats("N", N_PARAMETERS, default=None)
    sheet: IntArray = ints("N")
    noise_length: FloatArray | None = floats("N", default=None)
    sensor: SensorCalibration | None = None

    @property
    def by_sensor(self) -> FloatArray:
        """(M, 3, Q) ``dpoint_dsensor``, found from the places or the product where it is not held.

        Raises
        ------
        InputError
            If neither it nor the sensor is given.
        """
        if self.dpoint_dsensor is not None:
            return self.dpoint_dsensor
        if self.gain is not None and self.by_distance is not None:
            second, own = N_CAMERA + N_SHEET, self.by_distance
            by_sensor = np.zeros((len(self), 4, N_SENSOR))
            by_sensor[:, 0, :N_CAMERA] = own[:, :ACROSS]
            by_sensor[:, 1, :N_CAMERA] = own[:, ACROSS:RIGHT]
            by_sensor[:, 2, second:] = own[:, RIGHT:SHEET]
            by_sensor[:, 3, N_CAMERA:second] = own[:, SHEET:]
            return np.asarray(-self.gain @ by_sensor)
        if self.sensor is None:
            raise InputError("points without derivatives and without the sensor that saw them")
        numbers = lens_numbers(self.sensor), sheet_numbers(self.sensor)
        found = differentiated(self.points_mm, self.sheet, *numbers)[1]
        n_rest = len(sensor_columns(self.sensor, 0)) - found.shape[2]
        return np.concatenate([found, np.zeros((len(self), 3, n_rest))], axis=2)

    @property
    def own_covariance_mm2(self) -> FloatArray:
        """(M, 3, 3) by the stripes' noise and the sheets' shape, in Sensor."""
        own = np.concatenate([self.noise_mm, self.shape_mm[:, :, None]], axis=2)
        return np.asarray(own @ own.transpose(0, 2, 1))


def triangulate(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> PointCloud:
    """Turn stripe points into a cloud in the Sensor frame.

    Parameters and errors are those of `triangulate_stripe`.

    Returns
    -------
    PointCloud
        In the order of the profile; ``covariance_mm2`` is stripe noise, sheet shape and
        calibration, ``sigma_noise_mm`` the stripe noise alone.
    """
    return cloud_in_sensor(triangulate_stripe(profile, sheet_of_point, sensor), profile, sensor)


def cloud_in_sensor(
    stripe: StripePoints, profile: Profile, sensor: SensorCalibration
) -> PointCloud:
    """The points of one exposure as a cloud in the Sensor frame."""
    covariance = stripe.own_covariance_mm2
    for k in range(len(sensor.sheets)):
        of_sheet = stripe.sheet == k
        jacobian = stripe.by_sensor[of_sheet]
        covariance[of_sheet] += (
            jacobian @ sensor_covariance(sensor, k) @ jacobian.transpose(0, 2, 1)
        )
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    names = tuple(one.name for one in sensor.sheets)
    return stripe_cloud("Sensor", stripe, profile, stripe.points_mm, covariance, sheet_names=names)


def stripe_cloud(
    frame: CloudFrame,
    stripe: StripePoints,
    profile: Profile | PointProfile,
    points_mm: FloatArray,
    covariance_mm2: FloatArray,
    *,
    sheet_names: tuple[str, ...],
) -> PointCloud:
    """The points of one exposure, given in a frame with symmetric covariances, as a cloud."""
    if isinstance(profile, Profile):
        segment, intensity = profile.segment, profile.intensity
        # what is complete is not copied
        if len(stripe) != len(profile):
            segment, intensity = segment[stripe.row], intensity[stripe.row]
    else:
        segment, intensity = np.zeros_like(stripe.row), np.zeros(len(stripe))
    return PointCloud(
        frame=frame,
        points_mm=points_mm,
        covariance_mm2=covariance_mm2,
        sigma_noise_mm=given_away(noise_size_mm(stripe.noise_mm)),
        sheet=stripe.sheet,
        sheet_names=sheet_names,
        exposure=given_away(np.zeros(len(stripe), dtype=np.int64)),
        exposure_sources=(profile.source,),
        segment=segment,
        intensity=intensity,
        noise_length=stripe.noise_length,
    )


def triangulate_stripe(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> StripePoints:
    """Intersect the rays of stripe points with their sheets, and say where errors come from.

    The stripe's noise acts across the stripe; along it a point's place is a choice of where to
    sample, not a measurement, so it has no error of its own. A point therefore errs in one
    direction within the sheet by its own noise, and with all others by the calibration.

    Parameters
    ----------
    profile
        Stripe points of one exposure.
    sheet_of_point
        (N,) index into ``sensor.sheets``; points with -1 are left out, and so are points whose
        ray does not meet the sheet in front of the camera.
    sensor
        Camera and sheets with their joint covariance.

    Raises
    ------
    InputError
        If ``sheet_of_point`` does not fit the profile or the sheets.
    """
    sheets = _checked_sheets(profile, sheet_of_point, sensor)
    row = np.flatnonzero(sheets >= 0)
    # what is complete is not copied
    chosen = slice(None) if len(row) == len(sheets) else row
    points, is_met = intersect_sheets(profile.points_px[chosen], sheets[chosen], sensor)
    if not is_met.all():
        row, points = row[is_met], points[is_met]
        chosen = row
    stripes = profile.normals_px[chosen], profile.sigma_px[chosen]
    of_row = np.ascontiguousarray(sheets[chosen], dtype=np.int64)
    noise, shape = _spread(points, *stripes, of_row, sensor)
    length = profile.noise_length
    for array in (row, points, noise, shape):
        array.setflags(write=False)
    return StripePoints(
        row=row,
        points_mm=points,
        noise_mm=noise,
        shape_mm=shape,
        sheet=of_row,
        noise_length=None if length is None else length[chosen],
        sensor=sensor,
    )


def _spread(
    points_mm: FloatArray,
    normals_px: FloatArray,
    sigma_px: FloatArray,
    sheet: IntArray,
    sensor: SensorCalibration,
) -> tuple[FloatArray, FloatArray]:
    """Moves of points (M, 3) by a sigma of their stripes, (M, 3, 1), and of shape, (M, 3)."""
    noise, shape = np.zeros((len(points_mm), 3, 1)), np.zeros((len(points_mm), 3))
    lens, numbers = lens_numbers(sensor), sheet_numbers(sensor)
    for k, rows in sheet_rows(sheet):
        outputs = noise[rows], shape[rows]
        spread_stripe(
            points_mm[rows].reshape(-1),
            normals_px[rows].reshape(-1),
            sigma_px[rows],
            lens,
            numbers[k],
            shape_mm(sensor, k),
            *(array.reshape(-1) for array in outputs),
        )
        if not isinstance(rows, slice):
            noise[rows], shape[rows] = outputs
    return noise, shape


def sheet_rows(sheet: IntArray) -> Iterator[tuple[int, IntArray | slice]]:
    """Each sheet of points (M,) and their rows: a slice where all are on one."""
    if not len(sheet):
        return
    if bool((sheet == sheet[0]).all()):
        yield int(sheet[0]), slice(None)
        return
    for k in np.unique(sheet):
        yield int(k), np.flatnonzero(sheet == k)


OLD_SHAPE_SHARE = 0.3
"""Part of a sheet's residual that is taken for its own shape where a document, older than the
estimate, states none."""


def shape_mm(sensor: SensorCalibration, sheet: int) -> float:
    """Standard deviation of a sheet's true surface about its model."""
    one = sensor.sheets[sheet]
    return OLD_SHAPE_SHARE * one.rms_mm if one.shape_mm is None else one.shape_mm


def gradients(points_mm: FloatArray, sheet: IntArray, sensor: SensorCalibration) -> FloatArray:
    """(M, 3) gradient of the distance from their sheets (M,) at points (M, 3) in Sensor."""
    found = np.zeros((len(points_mm), 3))
    own = np.ascontiguousarray(sheet, dtype=np.int64)
    sheet_gradients(np.ascontiguousarray(points_mm), own, sheet_numbers(sensor), found)
    return found


def shapes_mm(sensor: SensorCalibration) -> FloatArray:
    """(S,) standard deviation of each sheet's true surface about its model."""
    return np.array([shape_mm(sensor, k) for k in range(len(sensor.sheets))])


@lru_cache(maxsize=8)
def sheet_numbers(sensor: SensorCalibration) -> FloatArray:
    """(S, 20) the sheets, as the kernels read them."""
    return np.stack([one.sheet.numbers for one in sensor.sheets])


def noise_size_mm(noise_mm: FloatArray) -> FloatArray:
    """(M,) root sum square of the independent noises (M, 3, J) of each point."""
    return np.asarray(np.sqrt(np.einsum("nij,nij->n", noise_mm, noise_mm)))


def _checked_sheets(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> IntArray:
    sheets = np.asarray(sheet_of_point)
    if sheets.shape != (len(profile),):
        raise InputError(
            f"{sheets.shape} sheet numbers for {len(profile)} stripe points", where=profile.source
        )
    if len(sheets) and not -1 <= int(sheets.min()) <= int(sheets.max()) < len(sensor.sheets):
        raise InputError(
            f"sheet numbers {int(sheets.min())} to {int(sheets.max())}, but the calibration has "
            f"{len(sensor.sheets)} sheets",
            where=profile.source,
        )
    return sheets


def sensor_columns(sensor: SensorCalibration, sheet: int) -> IntArray:
    """(Q,) places, in ``sensor.covariance``, of what the points of one sheet depend on.

    The camera's 9 parameters, the sheet's 8, then the 15 of a second camera, if there is one.
    """
    of_sheet, second = sensor.sheet_parameter_slice(sheet), sensor.second_parameter_slice
    return np.asarray(np.r_[:N_CAMERA, of_sheet, second])


def sensor_covariance(sensor: SensorCalibration, sheet: int) -> FloatArray:
    """(Q, Q) covariance of what the points of one sheet depend on, as `sensor_columns`."""
    places = sensor_columns(sensor, sheet)
    return np.asarray(sensor.covariance[np.ix_(places, places)])
