# SPDX-License-Identifier: Apache-2.0
"""Passes over a ball: each mistake that people make is named, and a sound scan is left in peace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.models.calibration import ScannerCalibration
from armscan.reconstruction.sync import poses_by_time
from armscan.reconstruction.track_faults import TrackFault
from armscan.records.exposure import SensorWindow
from armscan.records.recording import CameraSetup, Session
from rigs.passes_over_a_ball import N_PASSES, N_STEPS, BallScan, ball_scan, doubt, poses_of, read_as
from rigs.scan_fake import CAMERA, scanner

Misread = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
UP = np.array([0.0, 0.6, 0.8])


@pytest.fixture(scope="module")
def scan() -> BallScan:
    return ball_scan()


def misread(scan: BallScan, wrong: Misread) -> BallScan:
    """The recording as it is read by someone who takes its poses for something else."""
    assert scan.arm is not None
    rotations, translations = wrong(scan.arm.rotations, scan.arm.translations_mm)
    return replace(scan, arm=replace(scan.arm, rotations=rotations, translations_mm=translations))


def cause(scan: BallScan, head: ScannerCalibration | None = None, *, mirrored: bool = False) -> str:
    """What is named when exposures find their poses in the track by their times."""
    assert scan.arm is not None
    return doubt(scan, poses_by_time(scan.rows, scan.arm, 0), head, mirrored=mirrored).cause


@pytest.mark.parametrize("n_cameras", [1, 2])
def test_a_sound_scan_is_not_doubted(scan: BallScan, n_cameras: int) -> None:
    """Two cameras of one instant are one stripe: else each instant would be a pass of its own."""
    found = doubt(scan, n_cameras=n_cameras)
    assert not found.warnings
    assert found.agreement is not None
    assert len(found.agreement.pairs) == N_PASSES * (N_PASSES - 1)


@pytest.mark.parametrize("n_cameras", [1, 2])
@pytest.mark.parametrize(("step", "words"), [(1, "the one after it"), (-1, "the one before it")])
def test_images_off_by_one(scan: BallScan, step: int, words: str, n_cameras: int) -> None:
    true = read_as(scan.truth)
    read = poses_of(
        np.roll(true.rotations, step, axis=0), np.roll(true.translations_mm, step, axis=0)
    )
    assert words in doubt(scan, read, n_cameras=n_cameras).cause


@pytest.mark.parametrize(("lag_ms", "words"), [(20.0, "late"), (-20.0, "early")])
def test_a_late_clock(scan: BallScan, lag_ms: float, words: str) -> None:
    late = tuple(replace(row, t_ns=row.t_ns + round(1e6 * lag_ms)) for row in scan.rows)
    found = cause(replace(scan, rows=late))
    assert words in found
    assert f"{abs(lag_ms):.2g} ms" in found


def _inverse(rotations: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    back = rotations.transpose(0, 2, 1)
    return back, -np.einsum("nij,nj->ni", back, places)


def _left_handed(rotations: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    mirror = np.diag([1.0, -1.0, 1.0])
    return mirror @ rotations @ mirror, places @ mirror


def _scalar_moved(rotations: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    numbers = Rotation.from_matrix(rotations).as_quat()
    return Rotation.from_quat(np.roll(numbers, 1, axis=1)).as_matrix(), places


def _other_angles(rotations: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    angles = Rotation.from_matrix(rotations).as_euler("XYZ")
    return Rotation.from_euler("xyz", angles).as_matrix(), places


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (_inverse, "tool_from_base"),
        (lambda r, t: (r.transpose(0, 2, 1), t), "transposed"),
        (_left_handed, "left-handed"),
        (_scalar_moved, "scalar"),
        (_other_angles, "angles"),
        (lambda r, t: (r, t / 25.4), "inches"),
        (lambda r, t: (r, t / 10.0), "centimetres"),
        (lambda r, t: (r, t[:, [1, 0, 2]]), "order y, x, z"),
        (lambda r, t: (r, t[:, [0, 2, 1]]), "order x, z, y"),
        (lambda r, t: (r, t[:, [2, 1, 0]]), "order z, y, x"),
        (lambda r, t: (r, t[:, [1, 2, 0]]), "order y, z, x"),
        (lambda r, t: (r, t[:, [2, 0, 1]]), "order z, x, y"),
    ],
)
def test_poses_taken_for_something_else(scan: BallScan, wrong: Misread, words: str) -> None:
    assert words in cause(misread(scan, wrong))


@pytest.mark.parametrize(("binning", "told"), [(1, 1), (2, 2), (2, 1)])
def test_mirrored_images(scan: BallScan, binning: int, told: int) -> None:
    """Stripes are in pixels of the sensor, the size in those of binned images or the sensor's."""
    size = (CAMERA.width_px // told, CAMERA.height_px // told)
    setup = CameraSetup(*size, window=SensorWindow(binning=binning))
    binned = replace(scan, session=Session(cameras=(setup,)))
    assert "mirrored, right to left" in cause(binned, mirrored=True)


def test_a_shifted_sheet(scan: BallScan) -> None:
    head = scanner()
    assert head.sensor is not None
    (one,) = head.sensor.sheets
    shifted = replace(one.sheet, origin_mm=one.sheet.origin_mm + one.sheet.axes[2])
    sensor = replace(head.sensor, sheets=(replace(one, sheet=shifted),))
    found = cause(scan, replace(head, sensor=sensor))
    assert "light sheet" in found
    assert " 1 mm" in found


def test_a_head_that_was_knocked(scan: BallScan) -> None:
    head = scanner()
    pose = head.hand_eye.tool_from_sensor
    moved = Pose(pose.rotation, pose.translation_mm + np.array([1.0, 0.0, 0.0]))
    other = replace(head, hand_eye=replace(head.hand_eye, tool_from_sensor=moved))
    assert "head that sits" in cause(scan, other)


def _shifted(scan: BallScan, first: int, last: int) -> BallScan:
    """The samples of passes ``first`` to ``last`` a millimetre off."""
    assert scan.arm is not None
    starts = [scan.rows[k * N_STEPS].t_ns - 500_000_000 for k in range(N_PASSES)]
    starts.append(int(scan.arm.t_ns[-1]) + 1)
    is_off = (scan.arm.t_ns >= starts[first]) & (scan.arm.t_ns < starts[last + 1])
    return misread(scan, lambda r, t: (r, t + is_off[:, None] * UP))


def test_a_shift_between_two_passes(scan: BallScan) -> None:
    assert "all before" in cause(_shifted(scan, 4, N_PASSES - 1))


def test_one_pass_that_lies_off(scan: BallScan) -> None:
    found = cause(_shifted(scan, 3, 3))
    assert "only the pass" in found


def test_a_jump_seen_in_the_track_is_the_cause(scan: BallScan) -> None:
    broken = _shifted(scan, 4, N_PASSES - 1)
    assert broken.arm is not None
    poses = poses_by_time(broken.rows, broken.arm, 0)
    jump = TrackFault("jump", 7, 8, (0, 1), 1.0)
    assert "jump" in doubt(broken, replace(poses, track_faults=(jump,))).cause
