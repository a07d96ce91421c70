# SPDX-License-Identifier: Apache-2.0
"""From drawn images of stripes on a plate, with the arm's track, to the hand-eye."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.devices.sources import ScanSource
from armscan.errors import EstimationError, InputError
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import (
    CameraCalibration,
    Provenance,
    SensorCalibration,
)
from armscan.models.light_sheet import LightSheet
from armscan.pipeline.hand_eye import (
    ObservedStripes,
    _left_out,
    measured_beside,
    observe_stripes,
)
from armscan.reconstruction.points import points_again
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session
from rigs.plain_scanner import plain_camera, stored_sheet
from rigs.plate_rig import SHEET, SILENT, TOOL_FROM_SENSOR, PlateRig, Surface, good_postures

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 1000.0
LINE_SIGMA_PX = 2.0
DEPTH_PER_PX_MM = 0.19
"""Of the light sheet at 140 mm, with this camera."""
CENTRE_NOISE_PX = 0.1
BY_HAND = Provenance(
    document_id="by hand", created_utc="", armscan_version="", command=(), inputs=()
)
RIG = PlateRig(good_postures(8, np.random.default_rng(1)), SILENT)


def _sensor() -> SensorCalibration:
    model = plain_camera(FOCAL_PX, (319.5, 239.5), (WIDTH, HEIGHT))
    covered = np.array([0.0, 0.0, WIDTH - 1.0, HEIGHT - 1.0])
    camera = CameraCalibration(
        camera=model,
        covariance=np.eye(9) * 1e-12,
        has_covariance=True,
        rms_px=0.0,
        sigma_point_px=0.1,
        n_views=9,
        n_points=99,
        covered_px=covered,
        provenance=BY_HAND,
    )
    normal = SHEET[:3] / np.linalg.norm(SHEET[:3])
    along = np.cross(normal, [0.0, 0.0, 1.0])
    along /= np.linalg.norm(along)
    middle = np.array([0.0, 4.15, 140.0])
    middle -= (normal @ middle + SHEET[3] / np.linalg.norm(SHEET[:3])) * normal
    axes = np.stack([along, np.cross(normal, along), normal])
    sheet = LightSheet(origin_mm=middle, axes=axes, scale_mm=30.0, bow_mm=np.zeros(5))
    calibrated = stored_sheet("A", sheet, (110.0, 175.0), rms_mm=0.0, n_points=999)
    return SensorCalibration(
        camera=camera, sheets=(calibrated,), covariance=1e-12 * np.eye(17), provenance=BY_HAND
    )


def _image(points_mm: np.ndarray, seed: int) -> np.ndarray:
    """A line as the camera sees it, drawn column by column."""
    pixels = points_mm[:, :2] / points_mm[:, 2:] * FOCAL_PX + [319.5, 239.5]
    order = np.argsort(pixels[:, 0])
    columns = np.arange(WIDTH)
    centre = np.interp(columns, pixels[order, 0], pixels[order, 1], -1e3, -1e3)
    away = np.arange(HEIGHT)[:, None] - centre[None, :]
    noise = np.random.default_rng(seed).normal(0.0, 2.0, (HEIGHT, WIDTH))
    line = 180.0 * np.exp(-0.5 * (away / LINE_SIGMA_PX) ** 2)
    return np.clip(line + 10.0 + noise, 0.0, 255.0).astype(np.uint8)


@dataclass(frozen=True)
class DrawnScan:
    """A scan of drawn stripes: every posture ``repeats`` times, one after the other."""

    repeats: int = 1
    views: bool = True
    is_first_known: bool = True
    has_arm: bool = True
    name: str = "drawn"
    session: Session = field(default_factory=Session)
    is_simulated: bool = True

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        count = self.repeats * len(RIG.postures)
        return tuple(
            ExposureRow(
                index=k,
                t_ns=1_000_000 * k,
                camera=0,
                source=f"image{k}",
                lasers=("A",),
                trigger_id=k,
                view=self._view(k) if self.views else None,
            )
            for k in range(count)
        )

    @property
    def arm(self) -> ArmTrack | None:
        if not self.has_arm:
            return None
        rows = self.rows
        poses = [RIG.reported_pose(k // self.repeats, np.zeros(6)) for k in range(len(rows))]
        known = np.ones(len(rows), dtype=np.bool_)
        known[0] = self.is_first_known
        return ArmTrack(
            t_ns=np.array([row.t_ns for row in rows]),
            rotations=np.array([pose.rotation for pose in poses]),
            translations_mm=np.array([pose.translation_mm for pose in poses]),
            is_known=known,
            trigger_ids=np.arange(len(rows)),
        )

    def exposure(self, row: int) -> Exposure:
        flat = Surface(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1))
        points, _ = RIG.stripe(row // self.repeats, flat)
        meta = self.rows[row]
        return Exposure(
            _image(points, row),
            meta.source,
            lasers=meta.lasers,
            t_ns=meta.t_ns,
            trigger_id=meta.trigger_id,
            view=meta.view,
        )

    def _view(self, k: int) -> str:
        return f"posture {k // self.repeats}"


@dataclass(frozen=True)
class Run:
    """What was seen, and the hand-eye of it."""

    seen: ObservedStripes
    fit: HandEyeFit


def _fit(
    source: ScanSource, sensor: SensorCalibration, **limits: int
) -> tuple[ObservedStripes, HandEyeFit | FitFailure]:
    _, plate = RIG.draw(0)
    seen = observe_stripes(source, sensor, **limits)
    return seen, calibrate_on_plate(seen.stripes, plate, sensor_covariance=sensor.covariance)


def _run(source: ScanSource, **limits: int) -> Run:
    seen, fit = _fit(source, _sensor(), **limits)
    assert isinstance(fit, HandEyeFit)
    return Run(seen, fit)


def test_images_and_poses_give_the_hand_eye() -> None:
    """A stripe's plane is known to its noise over the root of its points; ten times that is far."""
    run = _run(DrawnScan(repeats=2))
    error = run.fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    limit_mm = 10.0 * CENTRE_NOISE_PX * DEPTH_PER_PX_MM / np.sqrt(400.0)
    assert np.abs(error[3:]).max() < 3.0 * limit_mm
    assert np.abs(error[:3]).max() < limit_mm / 33.0
    assert run.fit.calibration.n_postures == 8
    assert run.fit.calibration.n_exposures == 16
    coupling = run.fit.calibration.dhand_eye_dsensor
    assert coupling is not None and coupling.shape == (6, 17)
    assert len(run.seen.images) == len(run.seen.stripes) == 16
    assert run.seen.warnings == ()


def test_stripes_are_linearised_where_the_sensor_is_moved_to() -> None:
    """There they lie on the moved sensor's points; what is left beside the first is a square."""
    sensor = _sensor()
    seen = observe_stripes(DrawnScan(), sensor)
    step = np.zeros(17)
    step[[0, 1, 4, 5]], step[9:12] = [4.0, 3.0, 0.02, -0.1], [0.1, -0.05, 1e-3]
    bends = []
    for share in (0.5, 1.0):
        moved = sensor.updated(share * step, sensor.covariance)
        found, bend = measured_beside(seen.stripes, seen.images, moved, share * step)
        bends.append(bend)
        for stripe, image in zip(found, seen.images, strict=True):
            expected = points_again(image, moved).points_mm
            assert stripe.beside(share * step).points_mm == pytest.approx(expected, abs=1e-9)
            nearby = 1e-4 * step
            other = points_again(image, sensor.updated(share * step + nearby, sensor.covariance))
            beside = stripe.beside(share * step + nearby).points_mm
            assert beside == pytest.approx(other.points_mm, abs=1e-6)
    assert bends[1] > 0.5
    assert bends[1] / bends[0] == pytest.approx(4.0, rel=0.1)
    still, none = measured_beside(seen.stripes, seen.images, sensor, np.zeros(17))
    assert none < 1e-6
    assert len(still) == len(seen.stripes)


def test_without_views_exposures_at_one_place_are_one_posture() -> None:
    run = _run(DrawnScan(repeats=2, views=False))
    assert run.fit.calibration.n_postures == 8
    assert any("count as one posture" in warning for warning in run.seen.warnings)


def test_a_moving_scan_has_a_posture_an_exposure() -> None:
    run = _run(DrawnScan(views=False))
    assert run.fit.calibration.n_postures == run.fit.calibration.n_exposures == 8


def test_a_laser_that_the_calibration_has_no_sheet_of_is_told() -> None:
    """The sensor's calibration is of another head: nothing told of it."""
    sensor = _sensor()
    other = replace(sensor, sheets=(replace(sensor.sheets[0], name="R"),))
    seen = observe_stripes(DrawnScan(), other, max_exposures=8)
    assert [text for text in seen.warnings if "no sheet" in text and "of another head" in text]


def test_an_exposure_without_pose_is_named_and_left_out() -> None:
    run = _run(DrawnScan(is_first_known=False))
    assert run.seen.not_used == (("image0", "the arm gave no pose for it"),)
    assert run.fit.calibration.n_postures == 7


def test_a_long_scan_is_thinned_evenly_and_says_so() -> None:
    run = _run(DrawnScan(repeats=2), max_exposures=8)
    assert len(run.seen.stripes) == 8
    assert any("8 of 16 exposures" in warning for warning in run.seen.warnings)


def test_a_scan_without_arm_or_without_stripes_says_so() -> None:
    with pytest.raises(InputError, match="no samples of the arm"):
        observe_stripes(DrawnScan(has_arm=False), _sensor())
    behind = replace(_sensor().sheets[0], depth_range_mm=(1000.0, 1010.0))
    sensor = replace(_sensor(), sheets=(behind,))
    _, failure = _fit(DrawnScan(), sensor)
    assert isinstance(failure, FitFailure)
    assert "0 postures" in failure.reason


@dataclass(frozen=True)
class TornScan(DrawnScan):
    """Some of the images cannot be read."""

    torn: tuple[int, ...] = ()

    def exposure(self, row: int) -> Exposure:
        if row in self.torn:
            raise InputError("not an image", where=f"image{row}")
        return super().exposure(row)


def test_an_unreadable_image_is_named_and_left_out() -> None:
    run = _run(TornScan(torn=(2,)))
    assert [name for name, _ in run.seen.not_used] == ["image2"]
    assert "not an image" in run.seen.not_used[0][1]
    assert any("1 exposures were not used: image2 (" in warning for warning in run.seen.warnings)
    assert run.fit.calibration.n_postures == 7
    with pytest.raises(EstimationError, match=r"could be read: .*not an image"):
        observe_stripes(TornScan(torn=tuple(range(8))), _sensor())


@dataclass(frozen=True)
class BackgroundScan(DrawnScan):
    """The first exposure of every view is without laser; every reading is noted."""

    read: list[int] = field(default_factory=list)

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        rows = super().rows
        return tuple(replace(r, lasers=()) if r.index % self.repeats == 0 else r for r in rows)

    def exposure(self, row: int) -> Exposure:
        self.read.append(row)
        drawn = super().exposure(row)
        if self.rows[row].lasers:
            return drawn
        return replace(drawn, image=np.full_like(drawn.image, 10))


def test_the_background_of_a_view_is_read_once() -> None:
    scan = BackgroundScan(repeats=3)
    run = _run(scan)
    assert len(run.seen.stripes) == 16
    assert sorted(scan.read) == list(range(24))


@dataclass(frozen=True)
class TwoCameraScan(DrawnScan):
    """Every other exposure is another camera's."""

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        return tuple(replace(row, camera=row.index % 2) for row in super().rows)


def test_two_cameras_are_not_mixed() -> None:
    with pytest.raises(InputError, match="exposures of cameras 0, 1"):
        observe_stripes(TwoCameraScan(), _sensor())


def test_exposures_that_were_not_used_are_counted_beyond_those_named() -> None:
    (warning,) = _left_out(20, 20, [(f"image{k}", "dark") for k in range(12)])
    assert warning.startswith("12 exposures were not used: image0 (dark)")
    assert warning.endswith("image3 (dark), and 8 more")


def test_a_stripe_outside_the_calibrated_depths_is_said_to_be_there():
    """Not that there is no stripe: the user would look at the laser, and not at the depths."""
    sensor = _sensor()
    short = replace(sensor.sheets[0], depth_range_mm=(60.0, 70.0))
    seen = observe_stripes(DrawnScan(), replace(sensor, sheets=(short,)))
    assert not seen.stripes
    assert {reason for _, reason in seen.not_used} == {
        "most of its stripe points are too far outside the calibrated depths"
    }
