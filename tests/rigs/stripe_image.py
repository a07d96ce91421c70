# SPDX-License-Identifier: Apache-2.0
"""Synthetic stripe images with known centres, for tests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.exposure import Exposure, SensorWindow

NEWTON_STEPS = 12


class Curve(Protocol):
    """A centre line in image pixels."""

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance (N,) of points (N, 2) to the curve, and arc length (N,) of the foot."""
        ...


@dataclass(frozen=True, slots=True)
class StraightCurve:
    """A straight line through ``(x_px, y_px)`` at ``angle_deg`` from the x axis towards y."""

    x_px: float
    y_px: float
    angle_deg: float

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance and arc length from the given point."""
        angle = math.radians(self.angle_deg)
        c, s = math.cos(angle), math.sin(angle)
        dx, dy = points_px[:, 0] - self.x_px, points_px[:, 1] - self.y_px
        return c * dy - s * dx, c * dx + s * dy


@dataclass(frozen=True, slots=True)
class CircleCurve:
    """A full circle; distances are positive outside."""

    x_px: float
    y_px: float
    radius_px: float

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance and arc length from the x axis."""
        dx, dy = points_px[:, 0] - self.x_px, points_px[:, 1] - self.y_px
        return np.hypot(dx, dy) - self.radius_px, np.arctan2(dy, dx) * self.radius_px


@dataclass(frozen=True, slots=True)
class WaveCurve:
    """A sine wave along a straight line.

    Parameters
    ----------
    x_px, y_px, angle_deg
        The wave's axis, as in `StraightCurve`.
    amplitude_px, period_px
        Height and period of the wave.
    """

    x_px: float
    y_px: float
    angle_deg: float
    amplitude_px: float
    period_px: float

    @property
    def crest_radius_px(self) -> float:
        """Radius of curvature at a crest."""
        return (self.period_px / (2.0 * math.pi)) ** 2 / self.amplitude_px

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance to the nearest point, and its position along the axis."""
        v, u = StraightCurve(self.x_px, self.y_px, self.angle_deg).locate(points_px)
        k = 2.0 * math.pi / self.period_px
        t = u.copy()
        for _ in range(NEWTON_STEPS):
            f = self.amplitude_px * np.sin(k * t)
            slope = self.amplitude_px * k * np.cos(k * t)
            error = (u - t) + (v - f) * slope
            bend = -1.0 - slope**2 - (v - f) * k * k * f
            t = t - np.clip(error / np.where(bend < -0.2, bend, -1.0 - slope**2), -3.0, 3.0)
        f = self.amplitude_px * np.sin(k * t)
        slope = self.amplitude_px * k * np.cos(k * t)
        distance = np.hypot(u - t, v - f) * np.sign(v - f)
        return distance, t


REACH_SIGMAS = 6.0
HALO_SIGMAS = 3.0
GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(3)
UNIT = 255.0


@dataclass(frozen=True, slots=True)
class SimulatedStripe:
    """One laser line.

    Parameters
    ----------
    curve
        Its true centre line.
    sigma_px
        Sigma of the Gaussian cross-section (eq. 2.40).
    peak
        Grey level of the crest above the background; full scale is 255.
    modulation, modulation_px
        Share and period of a sinusoidal change of the peak along the line.
    skew
        Third-order part of the cross-section: the Gaussian is multiplied by
        ``1 + skew (u^3 - 3 u) / 6``.
    reflectance_gradient
        Relative change of reflectance per sigma across the line.
    lopsided
        Part by which sigma is larger on the positive side and smaller on the other; the brightest
        place stays on the curve.
    tail
        Part of the peak that belongs, on the positive side, to a Gaussian twice as broad.
    """

    curve: Curve
    sigma_px: float = 3.0
    peak: float = 150.0
    modulation: float = 0.0
    modulation_px: float = 400.0
    skew: float = 0.0
    reflectance_gradient: float = 0.0
    lopsided: float = 0.0
    tail: float = 0.0

    @property
    def centroid_px(self) -> float:
        """Distance of the section's centre of gravity from the curve."""
        low, high = 1.0 - self.lopsided, 1.0 + self.lopsided
        area = low + (1.0 - self.tail) * high + 2.0 * self.tail * high
        moment = -(low**2) + (1.0 - self.tail) * high**2 + 4.0 * self.tail * high**2
        return self.sigma_px * math.sqrt(2.0 / math.pi) * moment / area

    def profile(self, points_px: FloatArray) -> FloatArray:
        """Irradiance (N,) at points (N, 2)."""
        distance, along = self.curve.locate(points_px)
        u = distance / self.sigma_px
        is_high = u > 0.0
        u = u / np.where(is_high, 1.0 + self.lopsided, 1.0 - self.lopsided)
        peak = self.peak * (
            1.0 + self.modulation * np.sin(2.0 * np.pi * along / self.modulation_px)
        )
        section = np.exp(-0.5 * u * u)
        section += np.where(is_high, self.tail, 0.0) * (np.exp(-0.125 * u * u) - section)
        shape = section * (1.0 + self.skew * (u**3 - 3.0 * u) / 6.0)
        lit = shape * np.maximum(1.0 + self.reflectance_gradient * u, 0.0)
        return np.asarray(peak * np.maximum(lit, 0.0))


@dataclass(frozen=True, slots=True)
class StripeNoise:
    """Noise of laser and camera, for grey levels with full scale 255.

    Parameters
    ----------
    speckle
        Contrast of the speckle: standard deviation over mean of the stripe's own light.
    grain_px
        Sigma of the speckle's grains; 0 makes it independent from pixel to pixel.
    electrons_per_level
        Photo-electrons per grey level, for the shot noise.
    read
        Read noise in grey levels.
    """

    speckle: float = 0.2
    grain_px: float = 0.0
    electrons_per_level: float = 10.0
    read: float = 1.0


FULL_SENSOR = SensorWindow()
NO_NOISE = StripeNoise(speckle=0.0, electrons_per_level=1e12, read=0.0)


@dataclass(frozen=True, slots=True)
class StripeScene:
    """A camera's view of lines on a surface.

    Parameters
    ----------
    stripes
        The lines.
    width_px, height_px
        Size of the image.
    background
        Grey level beside the lines, full scale 255.
    background_step
        Added on the positive side of the first line's centre.
    noise
        Noise model.
    bits
        Bits of the camera, 8 to 16.
    window
        Position of the image on the sensor; curves are in image pixels.
    """

    stripes: tuple[SimulatedStripe, ...]
    width_px: int = 400
    height_px: int = 300
    background: float = 4.0
    background_step: float = 0.0
    noise: StripeNoise = StripeNoise()
    bits: int = 8
    window: SensorWindow = FULL_SENSOR

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16 or min(self.width_px, self.height_px) < 1:
            raise InputError(
                f"a camera of {self.width_px} x {self.height_px} px and {self.bits} bits",
                remedy="give at least one pixel and 8 to 16 bits",
            )

    def irradiance(self) -> tuple[FloatArray, FloatArray]:
        """Noise-free light (H, W) of the lines and of the background, averaged over each pixel."""
        y, x = np.mgrid[: self.height_px, : self.width_px]
        centres = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        light = np.zeros(len(centres))
        for stripe in self.stripes:
            distance, _ = stripe.curve.locate(centres)
            near = np.flatnonzero(np.abs(distance) < REACH_SIGMAS * stripe.sigma_px + 1.0)
            light[near] += _pixel_mean(stripe, centres[near])
        base = np.full(len(centres), self.background)
        if self.background_step and self.stripes:
            distance, _ = self.stripes[0].curve.locate(centres)
            base += self.background_step * np.clip(distance + 0.5, 0.0, 1.0)
        shape = (self.height_px, self.width_px)
        return light.reshape(shape), base.reshape(shape)

    def expose(self, seed: int, source: str = "simulated") -> Exposure:
        """Take one grey exposure with noise from ``seed``."""
        rng = np.random.default_rng(seed)
        light, base = self.irradiance()
        levels = _camera(light * _speckle(light.shape, self.noise, rng) + base, self.noise, rng)
        return Exposure(self._digitise(levels), source, bits_used=self.bits, window=self.window)

    def expose_red(
        self, seed: int, overdrive: float, halo: float = 0.15, source: str = "simulated"
    ) -> Exposure:
        """Take one colour exposure of a red laser.

        Parameters
        ----------
        seed
            Seed of the noise.
        overdrive
            Factor on the red channel; its core saturates where the product exceeds 255.
        halo
            Height of a halo as a share of the line's; its sigma is three times the line's.
        source
            Name of the exposure.
        """
        rng = np.random.default_rng(seed)
        light, base = self.irradiance()
        light = light * _speckle(light.shape, self.noise, rng)
        wide = [
            replace(s, sigma_px=HALO_SIGMAS * s.sigma_px, peak=halo * s.peak) for s in self.stripes
        ]
        red = overdrive * (light + replace(self, stripes=tuple(wide)).irradiance()[0])
        planes = [_camera(c + base, self.noise, rng) for c in (red, 0.35 * light, 0.5 * light)]
        image = self._digitise(np.stack(planes, axis=2))
        return Exposure(image, source, bits_used=self.bits, window=self.window)

    def _digitise(self, levels: FloatArray) -> NDArray[np.uint8] | NDArray[np.uint16]:
        full = (1 << self.bits) - 1
        counts = np.clip(np.rint(levels * (full / UNIT)), 0, full)
        return counts.astype(np.uint8) if self.bits == 8 else counts.astype(np.uint16)

    def errors(self, points_px: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Compare found points with the truth.

        Parameters
        ----------
        points_px
            (N, 2) full-sensor pixels.

        Returns
        -------
        distance_px
            (N,) signed distance to the nearest centre line.
        stripe
            (N,) index of that line.
        along_px
            (N,) position of the foot along it.
        """
        points = self.window.to_image(points_px)
        found = [stripe.curve.locate(points) for stripe in self.stripes]
        distance = np.stack([f[0] for f in found])
        stripe = np.argmin(np.abs(distance), axis=0)
        rows = np.arange(len(points))
        return distance[stripe, rows], stripe, np.stack([f[1] for f in found])[stripe, rows]


def _pixel_mean(stripe: SimulatedStripe, centres: FloatArray) -> FloatArray:
    total = np.zeros(len(centres))
    for u, a in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True):
        for v, b in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True):
            total += 0.25 * a * b * stripe.profile(centres + 0.5 * np.array([u, v]))
    return total


def _speckle(shape: tuple[int, ...], noise: StripeNoise, rng: np.random.Generator) -> FloatArray:
    if noise.speckle == 0.0:
        return np.ones(shape)
    if noise.grain_px == 0.0:
        share = noise.speckle**-2
        return rng.gamma(share, 1.0 / share, shape)
    field = gaussian_filter(rng.standard_normal(shape), noise.grain_px)
    variance = np.log1p(noise.speckle**2)
    return np.asarray(np.exp(field / field.std() * np.sqrt(variance) - 0.5 * variance))


def _camera(light: FloatArray, noise: StripeNoise, rng: np.random.Generator) -> FloatArray:
    shot = np.sqrt(np.maximum(light, 0.0) / noise.electrons_per_level)
    total = light + shot * rng.standard_normal(light.shape)
    return np.asarray(total + noise.read * rng.standard_normal(light.shape))
