# SPDX-License-Identifier: Apache-2.0
"""A head as its calibration left it, on the arm of `plate_rig`: camera and sheet err as stated.

The camera's error is drawn; the sheet is then calibrated from stripes on boards with that camera,
so that it follows it. Pixels come from the true camera, by OpenCV. What the calibrated sensor makes
of them goes to the hand-eye, and to a scan of other postures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import LaserFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.models.calibration import HandEyeCalibration, ScannerCalibration, SensorCalibration
from armscan.reconstruction.place import BaseTransform, propagate_to_base
from armscan.reconstruction.triangulate import StripePoints, triangulate_stripe
from armscan.records.profile import Profile
from rigs.plate_rig import PlateRig, RigNoise, Surface, good_postures
from rigs.sheet_rig import (
    CAMERA_SIGMA,
    PROVENANCE,
    SheetRig,
    make_profile,
    placed,
    project,
    thesis_rig,
)

STRIPE_PX = 0.06
TILTS_AND_DEPTHS = (
    (0, 0, 138),
    (25, 5, 148),
    (-20, 15, 158),
    (15, -25, 130),
    (-25, -15, 122),
    (8, 28, 142),
)


def calibrating_rig(camera_factor: float) -> SheetRig:
    """Boards as large as the field, and a camera known to so many times `CAMERA_SIGMA`."""
    poses = tuple(placed(a, b, z, (32.0, 24.0)) for a, b, z in TILTS_AND_DEPTHS)
    covariance = np.diag((camera_factor * CAMERA_SIGMA) ** 2)
    return replace(thesis_rig(), poses=poses, columns=17, rows=13, camera_covariance=covariance)


@dataclass(frozen=True)
class SeenStripe:
    """A stripe in the image, and where its points truly are in Base (N, 3)."""

    posture: int
    profile: Profile
    base_mm: FloatArray


@dataclass(frozen=True)
class CalibratedHead:
    """A sensor as it was calibrated, an arm, a plate: all errors are drawn from ``seed``."""

    camera_factor: float
    seed: int
    noise: RigNoise = field(default_factory=RigNoise)
    n_postures: int = 12

    @property
    def rig(self) -> PlateRig:
        """Arm and plate, the postures of the calibration."""
        postures = good_postures(self.n_postures, np.random.default_rng(3))
        return PlateRig(postures, self.noise, points_per_stripe=60)

    def sensor(self) -> SensorCalibration:
        """Camera and sheet with their joint covariance."""
        rng = np.random.default_rng([self.seed, 1])
        rig = calibrating_rig(self.camera_factor)
        camera = rig.noisy_camera(rng)
        fit = calibrate_sheets(rig.boards(camera, rng), rig.calibration(camera))
        assert isinstance(fit, LaserFit), fit
        return SensorCalibration(
            camera=rig.calibration(camera),
            sheets=tuple(one.calibration for one in fit.sheets),
            covariance=fit.covariance,
            provenance=PROVENANCE,
        )

    def stripes(self, sensor: SensorCalibration) -> tuple[list[PosedStripe], PlateReference]:
        """What the hand-eye is calibrated from."""
        rng = np.random.default_rng([self.seed, 2])
        surface = Surface.draw(rng, self.noise.flatness_mm)
        plate = self.rig.probe(rng, surface)
        stripes = []
        for seen in _seen(self.rig, surface, rng):
            points = _points(seen, sensor)
            stripes.append(
                PosedStripe(
                    source=seen.profile.source,
                    posture=f"posture{seen.posture:02d}",
                    base_from_tool=self.rig.reported_pose(
                        seen.posture, _pose_error(rng, self.noise)
                    ),
                    points_mm=points.points_mm,
                    noise_mm=points.noise_mm,
                    sheet=points.sheet,
                    dpoint_dsensor=points.by_sensor,
                )
            )
        return stripes, plate

    def scan(
        self, sensor: SensorCalibration, hand_eye: HandEyeCalibration, n_postures: int = 12
    ) -> tuple[FloatArray, FloatArray]:
        """Errors (N, 3) in Base of points of fresh postures, and their covariance (N, 3, 3)."""
        rng = np.random.default_rng([self.seed, 3])
        rig = replace(self.rig, postures=good_postures(n_postures, rng))
        surface = Surface.draw(rng, 0.0)
        placing = BaseTransform.of(
            ScannerCalibration(sensor=sensor, hand_eye=hand_eye, provenance=PROVENANCE)
        )
        errors, covariances = [], []
        for seen in _seen(rig, surface, rng):
            points = _points(seen, sensor)
            pose = rig.reported_pose(seen.posture, _pose_error(rng, self.noise))
            cloud = propagate_to_base(points, seen.profile, pose, placing)
            errors.append(cloud.points_mm - seen.base_mm)
            covariances.append(cloud.covariance_mm2)
        return np.concatenate(errors), np.concatenate(covariances)


def _seen(rig: PlateRig, surface: Surface, rng: np.random.Generator) -> list[SeenStripe]:
    found = []
    for k in range(len(rig.postures)):
        points, _ = rig.stripe(k, surface)
        q = project(thesis_rig().camera, Pose(np.eye(3), np.zeros(3)), points)
        tangent = np.gradient(q, axis=0)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        noisy = q + STRIPE_PX * rng.normal(size=(len(q), 1)) * normal
        rotation, origin = rig.sensor_pose(k)
        profile = make_profile(f"image{k:02d}", [(noisy, normal)], STRIPE_PX)
        found.append(SeenStripe(k, profile, points @ rotation.T + origin))
    return found


def _points(seen: SeenStripe, sensor: SensorCalibration) -> StripePoints:
    points = triangulate_stripe(seen.profile, np.zeros(len(seen.profile), dtype=np.int64), sensor)
    assert len(points.row) == len(seen.profile)
    return points


def _pose_error(rng: np.random.Generator, noise: RigNoise) -> FloatArray:
    shift = np.hypot(noise.posture_mm, noise.exposure_mm)
    turn = np.hypot(noise.posture_rad, noise.exposure_rad)
    return rng.normal(size=6) * np.array([turn] * 3 + [shift] * 3)
