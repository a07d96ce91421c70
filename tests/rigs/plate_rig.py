# SPDX-License-Identifier: Apache-2.0
"""Stripes on an uneven plate as a head on a noisy arm would measure them, without any image.

The places of the postures, the plate's surface and the errors are drawn here, by other means than
the calibration's: the surface is a sum of waves, pose errors turn the arm about a point of Tool
that the rig is told.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.shapes import Plane, fit_plane

TOOL_FROM_SENSOR: Pose[Tool, Sensor] = Pose(
    Rotation.from_euler("XYZ", [35.0, -20.0, 80.0], degrees=True).as_matrix(),
    np.array([-42.0, 58.0, 91.0]),
)
SHEET = np.array([-0.0042275, 0.73558, -0.67742, 91.78])
"""The thesis's light sheet (5.1.2)."""
PLATE_NORMAL = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])
PLATE_CENTRE = np.array([420.0, 130.0, 60.0])
SCAN_POINT_MM = np.array([0.0, 0.0, 140.0])
"""In Sensor."""
STRIPE_MM = 33.0
PLATE_HALF_MM = 130.0
MEAN_PEAK_TO_VALLEY = 5.0
"""Peak to valley over standard deviation, on average, of a surface of the waves drawn here."""


@dataclass(frozen=True)
class RigNoise:
    """Standard deviations of everything that errs."""

    posture_mm: float = 0.0051
    posture_rad: float = np.radians(0.0011)
    exposure_mm: float = 0.0015
    exposure_rad: float = np.radians(0.0003)
    flatness_mm: float = 0.015 / MEAN_PEAK_TO_VALLEY
    stripe_mm: float = 0.002
    probing_mm: float = 0.0053

    def scaled(self, factor: float) -> RigNoise:
        """All of it, larger or smaller."""
        return RigNoise(*(factor * value for value in vars(self).values()))


SILENT = RigNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Postures:
    """Tilts and azimuths of the optical axis, rolls (rad), stand-offs and places (mm)."""

    tilt: FloatArray
    azimuth: FloatArray
    roll: FloatArray
    stand_off: FloatArray
    place: FloatArray

    def __len__(self) -> int:
        return len(self.tilt)


def good_postures(count: int, rng: np.random.Generator) -> Postures:
    """Postures as they are recommended: tilted up to 40 degrees all round, distances varied."""
    return Postures(
        np.radians(rng.uniform(10.0, 40.0, count)),
        2.0 * np.pi * (np.arange(count) + rng.uniform(0.0, 1.0, count)) / count,
        rng.uniform(-3.0, 3.0, count),
        rng.uniform(122.0, 160.0, count),
        rng.uniform(-80.0, 80.0, (count, 2)),
    )


@dataclass(frozen=True)
class Surface:
    """An uneven plate: heights over its plane, a sum of waves 70 to 220 mm long."""

    waves: FloatArray
    amplitudes: FloatArray
    phases: FloatArray

    @staticmethod
    def draw(rng: np.random.Generator, sigma_mm: float, count: int = 24) -> Surface:
        return Surface(
            draw_waves(rng, count),
            sigma_mm * np.sqrt(1.0 / count) * rng.normal(size=(count, 2)),
            np.zeros(count),
        )

    def height(self, places: FloatArray) -> FloatArray:
        angle = places @ self.waves.T
        return np.asarray(np.cos(angle) @ self.amplitudes[:, 0]) + np.asarray(
            np.sin(angle) @ self.amplitudes[:, 1]
        )


def draw_waves(rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 2) wave vectors in rad/mm."""
    length, direction = rng.uniform(70.0, 220.0, count), rng.uniform(0.0, np.pi, count)
    vectors = np.column_stack([np.cos(direction), np.sin(direction)])
    return np.asarray(2.0 * np.pi / length[:, None] * vectors)


@dataclass(frozen=True)
class PlateRig:
    """Everything about one simulated calibration but its random errors.

    ``bow_mm`` bends every stripe alike; ``form_mm`` is the rise of the sheet's own surface at the
    edge of its working range. Pose errors shift ``turns_about_mm``, a point of Tool, and turn the
    arm about it.
    """

    postures: Postures
    noise: RigNoise = field(default_factory=RigNoise)
    exposures_per_posture: int = 1
    points_per_stripe: int = 150
    half_stripe_mm: float = STRIPE_MM
    bow_mm: float = 0.0
    form_mm: float = 0.0
    sheet_turn_rad: float = 0.0
    tool_from_sensor: Pose[Tool, Sensor] = TOOL_FROM_SENSOR
    turns_about_mm: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def plate_axes(self) -> FloatArray:
        first = np.cross(PLATE_NORMAL, [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(PLATE_NORMAL, first), PLATE_NORMAL])

    @property
    def plane(self) -> Plane:
        return Plane(PLATE_CENTRE, self.plate_axes)

    @property
    def sheet(self) -> FloatArray:
        """(4,) light sheet, or another one through (0, 0, 140), turned about the optical axis."""
        sheet = SHEET / np.linalg.norm(SHEET[:3])
        if not self.sheet_turn_rad:
            return np.asarray(sheet)
        normal = Rotation.from_rotvec([0.0, 0.0, self.sheet_turn_rad]).as_matrix() @ sheet[:3]
        return np.array([*normal, -140.0 * normal[2]])

    def sensor_pose(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Rotation and origin of the Sensor in Base at posture ``k``."""
        p = self.postures
        first, second, normal = self.plate_axes
        away = np.cos(p.azimuth[k]) * first + np.sin(p.azimuth[k]) * second
        z = -(np.cos(p.tilt[k]) * normal + np.sin(p.tilt[k]) * away)
        x = np.cross([0.3, 1.0, 0.2], z)
        x /= np.linalg.norm(x)
        turned = np.column_stack([x, np.cross(z, x), z])
        rotation = turned @ Rotation.from_rotvec([0.0, 0.0, p.roll[k]]).as_matrix()
        target = PLATE_CENTRE + p.place[k] @ self.plate_axes[:2]
        return rotation, target - rotation[:, 2] * p.stand_off[k]

    def stripe(self, k: int, surface: Surface) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) in Sensor and the unit vector within the sheet across the stripe."""
        rotation, origin = self.sensor_pose(k)
        sheet = self.sheet
        normal = rotation.T @ PLATE_NORMAL
        height = float(PLATE_NORMAL @ (PLATE_CENTRE - origin))
        along = np.cross(normal, sheet[:3])
        along /= np.linalg.norm(along)
        across = np.cross(sheet[:3], along)
        start = np.linalg.solve(
            np.stack([normal, sheet[:3], along]), [height, -sheet[3], along[2] * height / normal[2]]
        )
        s = np.linspace(-1.0, 1.0, self.points_per_stripe) * self.half_stripe_mm
        points = start + s[:, None] * along
        if self.form_mm:
            flat, in_plate = points, np.cross(normal, along)
            for _ in range(4):
                rise = self.rise_mm(points) / (in_plate @ sheet[:3])
                points = flat + rise[:, None] * in_plate
        bow = self.bow_mm * (s / self.half_stripe_mm) ** 2
        points = points + bow[:, None] * sheet[:3]
        points -= (bow * (normal @ sheet[:3]) / (normal @ across))[:, None] * across
        places = (points @ rotation.T + origin - PLATE_CENTRE) @ self.plate_axes[:2].T
        points += (surface.height(places) / (normal @ across))[:, None] * across
        return points, across

    def rise_mm(self, points: FloatArray) -> FloatArray:
        """(N,) height of the sheet's true surface over its plane, a function of the place on it."""
        first = np.cross(self.sheet[:3], [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(self.sheet[:3], first)])
        u, v = axes @ (points - [0.0, 0.0, 140.0]).T
        return np.asarray(self.form_mm * (u**2 + 0.3 * u * v + 0.5 * v**2) / STRIPE_MM**2)

    def on_sheet(self, points: FloatArray) -> FloatArray:
        """Where the rays (N, 3) from the camera through some points meet the sheet's surface."""
        found = points
        for _ in range(5):
            height = found @ self.sheet[:3] + self.sheet[3] - self.rise_mm(found)
            found = found - (height / (found @ self.sheet[:3]))[:, None] * found
        return found

    def draw(self, seed: int) -> tuple[list[PosedStripe], PlateReference]:
        """Stripes and probed plate with errors drawn from a seed."""
        rng = np.random.default_rng(seed)
        surface = Surface.draw(rng, self.noise.flatness_mm)
        plate = self.probe(rng, surface)
        stripes = []
        for k in range(len(self.postures)):
            common = self._pose_error(rng, self.noise.posture_mm, self.noise.posture_rad)
            clean, across = self.stripe(k, surface)
            for number in range(self.exposures_per_posture):
                own = self._pose_error(rng, self.noise.exposure_mm, self.noise.exposure_rad)
                noise = self.noise.stripe_mm * rng.normal(size=(len(clean), 1)) * across
                stripes.append(
                    PosedStripe(
                        source=f"image{k:02d}-{number}",
                        posture=f"posture{k:02d}",
                        base_from_tool=self.reported_pose(k, common + own),
                        points_mm=clean + noise,
                        noise_mm=np.tile(max(self.noise.stripe_mm, 1e-4) * across, (len(clean), 1))[
                            :, :, None
                        ],
                        sheet=np.zeros(len(clean), dtype=np.int64),
                    )
                )
        return stripes, plate

    def reported_pose(self, k: int, error: FloatArray) -> Pose[Base, Tool]:
        """Pose of the arm with an error (6,): turn about `turns_about_mm` (rad), shift (mm)."""
        base_from_sensor: Pose[Base, Sensor] = Pose(*self.sensor_pose(k))
        true = base_from_sensor @ self.tool_from_sensor.inverse()
        centre = true.apply(self.turns_about_mm)
        turn = Rotation.from_rotvec(error[:3]).as_matrix()
        moved = turn @ (true.translation_mm - centre) + centre + error[3:]
        return Pose(turn @ true.rotation, moved)

    def probe(self, rng: np.random.Generator, surface: Surface) -> PlateReference:
        """The plate as 64 touches all over it show it."""
        places = self.probed_places
        heights = surface.height(places) + self.noise.probing_mm * rng.normal(size=len(places))
        points = PLATE_CENTRE + np.column_stack([places, heights]) @ self.plate_axes
        fitted = fit_plane(points)
        assert isinstance(fitted, Estimate)
        plane = fitted.value
        if plane.normal @ PLATE_NORMAL < 0.0:
            plane = Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))
        rms = float(np.sqrt((fitted.residuals**2).mean()))
        return PlateReference(
            plane=plane,
            covariance=fitted.covariance,
            rms_mm=rms,
            n_points=len(points),
        )

    @property
    def probed_places(self) -> FloatArray:
        """(64, 2) touched places on the plate."""
        line = np.linspace(-PLATE_HALF_MM + 10.0, PLATE_HALF_MM - 10.0, 8)
        return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)

    @staticmethod
    def _pose_error(rng: np.random.Generator, shift_mm: float, turn_rad: float) -> FloatArray:
        return rng.normal(size=6) * np.array([turn_rad] * 3 + [shift_mm] * 3)
