# SPDX-License-Identifier: Apache-2.0
"""One ray of the laser lights one point."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.models.calibration import SensorCalibration
from armscan.models.light_sheet import LightSheet
from armscan.reconstruction.labels import LabelledInstant, LabelledProfile, PointStatus
from armscan.reconstruction.points import (
    MeasuredProfile,
    is_without_ray,
    known_rays,
    measure_points,
)
from armscan.reconstruction.triangulate import DepthRange
from armscan.records.profile import Profile
from rigs.calibration_documents import sensor_calibration
from rigs.plain_scanner import stored_sheet

SHEET = LightSheet(
    origin_mm=np.array([0.0, 0.0, 300.0]),
    axes=np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]),
    scale_mm=50.0,
    bow_mm=np.zeros(5),
)
"""u along X, depth along Z."""


def line(low: float, high: float, depth_mm: float, step: float = 0.2) -> np.ndarray:
    u = np.arange(low, high, step)
    return np.stack([u, 0.0 * u, 0.0 * u + depth_mm], axis=1)


def judged(*pieces: tuple[np.ndarray, float]) -> list[bool]:
    """For each piece, whether it is left without a ray; points get the piece's brightness."""
    points = np.concatenate([p for p, _ in pieces])
    segment = np.concatenate([np.full(len(p), k) for k, (p, _) in enumerate(pieces)])
    bright = np.concatenate([np.full(len(p), b) for p, b in pieces])
    lost = is_without_ray(points, bright, segment, SHEET)
    found = [lost[segment == k] for k in range(len(pieces))]
    assert all(one.all() or not one.any() for one in found)
    return [bool(one.all()) for one in found]


def test_a_reflection_beside_an_unbroken_line_is_left_out() -> None:
    assert judged((line(-60, 60, 300.0), 100.0), (line(-5, 10, 340.0), 60.0)) == [False, True]
    assert judged((line(-5, 10, 340.0), 60.0), (line(-60, 60, 300.0), 100.0)) == [True, False]


def test_a_step_keeps_both_levels() -> None:
    low, block = line(-60, 0, 320.0), line(0, 60, 300.0)
    assert judged((low, 100.0), (block, 80.0)) == [False, False]


def test_a_small_thing_before_a_wall_is_kept_though_the_wall_goes_on_around_it() -> None:
    """A pin 3 mm wide, 60 mm before the wall: its shadow on the wall lies 30 mm aside.

    The rays are slanted there, and the gap that it leaves is not where the pin seems to be.
    """
    wall = [line(-80, 27, 360.0), line(30, 80, 360.0)]
    assert judged((wall[0], 100.0), (wall[1], 100.0), (line(0, 3, 300.0), 50.0)) == [False] * 3


def test_pieces_of_one_broken_line_are_kept() -> None:
    pieces = [line(k * 10.0, k * 10.0 + 8.0, 300.0 + k) for k in range(6)]
    assert judged(*((piece, 50.0 + 10 * k) for k, piece in enumerate(pieces))) == [False] * 6


def test_near_the_end_of_the_line_nothing_is_claimed() -> None:
    """Rays past the end of the bright line may have lit what lies in another depth there."""
    assert judged((line(-60, 60, 300.0), 100.0), (line(45, 58, 340.0), 60.0)) == [False, False]


BELOW = np.array([0.0, 100.0, 0.0])
"""A camera in the sheet would see nothing of its depth."""


def sensor_of(fan: tuple[float, float], of_u2v_mm: float) -> SensorCalibration:
    """Whose bow of 0.1 mm spreads its light so, and whose change with depth is known so well."""
    bow = np.array([0.1, 0.0, 0.0, 0.0, 0.0])
    bowed = replace(SHEET, origin_mm=SHEET.origin_mm + BELOW, bow_mm=bow, fan=np.array(fan))
    covariance = np.diag([*[1e-6] * 12, *[1e-8] * 4, of_u2v_mm**2])
    sheets = (stored_sheet("A", bowed, (250.0, 350.0)),)
    return replace(sensor_calibration(), sheets=sheets, covariance=covariance)


@pytest.mark.parametrize("sigma_mm", [0.001, 0.01, 0.02, 0.04])
def test_rays_are_followed_as_far_as_the_bow_tells_them(sigma_mm: float) -> None:
    """A spread is the bow's change with depth over the bow, and as uncertain."""
    sheet, slant = known_rays(sensor_of((0.1, 0.4), sigma_mm), 0)
    spread = sigma_mm / 0.1
    if 2.0 * spread < 0.6:
        assert sheet.fan.tolist() == [0.1, 0.4]
        assert slant == pytest.approx(max(0.3, 2.0 * spread), rel=1e-3)
    else:
        assert (sheet.fan.tolist(), slant) == ([0.0, 0.0], 0.6)


def test_a_fan_at_the_end_of_what_is_looked_for_is_none() -> None:
    sheet, slant = known_rays(sensor_of((0.1, 0.8), 0.001), 0)
    assert (sheet.fan.tolist(), slant) == ([0.0, 0.0], 0.6)


def seen(sensor: SensorCalibration, *pieces: np.ndarray) -> MeasuredProfile:
    """Pieces on the sheet, the first the brightest, as one image shows them and as measured."""
    places = np.concatenate(pieces) + BELOW
    segment = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    n = len(places)
    profile = Profile(
        source="one",
        points_px=sensor.camera.camera.project(places),
        normals_px=np.tile([0.0, 1.0], (n, 1)),
        sigma_px=np.full(n, 0.05),
        width_px=np.full(n, 2.0),
        intensity=100.0 - 40.0 * segment,
        segment=segment,
        flags=np.zeros(n, dtype=np.int64),
    )
    labelled = LabelledProfile(
        profile=profile,
        sheet=np.zeros(n, dtype=np.int64),
        status=np.full(n, int(PointStatus.MEASURED)),
        reason="one",
    )
    return measure_points(LabelledInstant((labelled,)), sensor, DepthRange(0.5))[0]


def test_measured_points_are_judged_by_what_is_known_of_the_fan() -> None:
    """A piece behind the line, near its end: by a fan that is known the line has its rays.

    Rays that may run aside by 0.6 pass the line's end.
    """
    line_, piece = line(-40, 40, 300.0), line(22, 32, 330.0)
    lost = []
    for sigma_mm in (0.001, 0.04):
        status = seen(sensor_of((0.0, 0.4), sigma_mm), line_, piece).labelled.status
        assert not (status[: len(line_)] == PointStatus.NO_LASER_RAY).any()
        lost.append(bool((status[len(line_) :] == PointStatus.NO_LASER_RAY).all()))
    assert lost == [True, False]
