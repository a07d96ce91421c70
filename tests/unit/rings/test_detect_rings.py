# SPDX-License-Identifier: Apache-2.0
"""Rings found in images that an independent renderer drew, and their errors beside their sigma."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.records.exposure import Exposure, SensorWindow
from armscan.vision.rings import RingDetection, RingOptions, detect_rings
from rigs.ring_scenes import GROUND, Mark, Rendered, render, tilted

DISTANCE_MM = 300.0
BIAS_PX = 0.003
"""Share of a bias that the sampling of the renderer may have; a tenth of what is corrected."""


def one_ring(tilt_deg: float, azimuth_deg: float, seed: int = 0, **options: float) -> Rendered:
    place = np.random.default_rng(seed).uniform(-0.05, 0.05, 2)
    return render(
        [Mark("ring", float(place[0]), float(place[1]))],
        tilted(tilt_deg, azimuth_deg),
        np.array([0.0, 0.0, DISTANCE_MM]),
        (150, 150),
        **options,  # type: ignore[arg-type]
    )


def clutter(seed: int) -> tuple[Rendered, int]:
    """Six rings and ten other things on a tilted plate; the rings come first."""
    rng = np.random.default_rng(seed)
    kinds = ["ring"] * 6 + ["disc", "disc", "square", "square", "stripes", "letter"] + ["disc"] * 4
    cells = rng.permutation([(x, y) for x in range(-2, 3) for y in range(-2, 2)])
    marks = [
        Mark(kind, 9.0 * x, 9.0 * y + 4.5, 3.0, 1.5 if kind != "stripes" else 1.0)
        for kind, (x, y) in zip(kinds, cells, strict=False)
    ]
    rendered = render(
        marks,
        tilted(float(rng.uniform(0.0, 45.0)), float(rng.uniform(0.0, 360.0))),
        np.array([0.0, 0.0, DISTANCE_MM]),
        (640, 560),
        focal_px=3500.0,
        rays=3,
    )
    return rendered, 6


@pytest.mark.parametrize("azimuth_deg", [0.0, 65.0, 130.0])
def test_no_bias_at_45_degrees(azimuth_deg: float) -> None:
    """The outer ellipse's centre is off by f r^2 sin t cos t / Z^2 = 0.26 px; the ring's is not."""
    rendered = one_ring(45.0, azimuth_deg)
    found = [detect_rings(rendered.exposure(s, noise=0.5)).rings.centres_px for s in range(3)]
    assert all(len(centres) == 1 for centres in found)
    np.testing.assert_allclose(
        np.mean(found, axis=0)[0], rendered.centres_px[0], atol=BIAS_PX + 3.0 * 0.002
    )


def test_errors_are_what_the_covariance_says() -> None:
    """Normalised error squared, mean 2 for an honest covariance; 48 rings, 0 to 50 degrees."""
    squares = []
    for k in range(16):
        rendered = one_ring(50.0 * k / 15.0, 77.0 * k, k)
        for s in range(3):
            rings = detect_rings(rendered.exposure(100 * k + s)).rings
            assert len(rings) == 1
            error = rings.centres_px[0] - rendered.centres_px[0]
            squares.append(error @ np.linalg.solve(rings.covariance_px2[0], error))
    # Standard deviation of the mean of 48: 0.29.
    assert 1.2 < np.mean(squares) < 2.9


def test_size_and_shape_are_those_of_the_ring() -> None:
    rings = detect_rings(one_ring(40.0, 30.0).exposure(0)).rings
    # 3 mm of radius at 300 mm: 51.5 px, and the longer half axis does not shrink.
    assert rings.perimeter_px[0] == pytest.approx(2.0 * np.pi * 51.5, rel=0.01)
    assert rings.roundness[0] == pytest.approx(1.0 / np.cos(np.deg2rad(40.0)), rel=0.01)
    np.testing.assert_allclose(rings.inner_half_px / rings.outer_half_px, 0.5, rtol=0.01)
    assert rings.contrast[0] == pytest.approx((210.0 - 40.0) / 255.0, rel=0.02)
    assert np.rad2deg(rings.direction_rad[0]) % 180.0 == pytest.approx(30.0, abs=1.0)


def test_filters_drop_and_say_why() -> None:
    def result(tilt_deg: float, options: RingOptions) -> RingDetection:
        return detect_rings(one_ring(tilt_deg, 20.0).exposure(0), options)

    assert result(58.0, RingOptions()).reasons == ("roundness",)
    assert len(result(58.0, RingOptions(max_roundness=2.2)).rings) == 1
    assert result(0.0, RingOptions(max_perimeter_px=310.0)).reasons == ("perimeter",)
    assert result(0.0, RingOptions(min_perimeter_px=340.0)).reasons == ("perimeter",)
    assert len(result(0.0, RingOptions(min_perimeter_px=310.0, max_perimeter_px=340.0)).rings) == 1


@pytest.mark.parametrize("seed", range(6))
def test_rings_among_other_things(seed: int) -> None:
    """Every ring, and no disc, frame, stripe or letter; a square frame nests like a ring."""
    rendered, n_rings = clutter(seed)
    found = detect_rings(rendered.exposure(seed)).rings.centres_px
    truth = rendered.centres_px[:n_rings]
    distance = np.linalg.norm(found[:, None] - truth, axis=2)
    assert len(found) == n_rings
    assert distance.min(axis=0).max() < 0.05


def test_dark_discs_in_light_rings_on_request() -> None:
    image = one_ring(20.0, 0.0).exposure(0).image
    inverted = Exposure(np.asarray(255 - image, np.uint8), "inverted")
    assert len(detect_rings(inverted).rings) == 0
    assert len(detect_rings(inverted, RingOptions(disc="dark")).rings) == 1


def test_centres_are_full_sensor_pixels() -> None:
    rendered = one_ring(20.0, 0.0)
    plain = rendered.exposure(0)
    window = SensorWindow(200, 100, 2)
    shifted = Exposure(plain.image, "window", window=window)
    first, second = detect_rings(plain).rings, detect_rings(shifted, RingOptions(50, 2400)).rings
    np.testing.assert_allclose(second.centres_px, window.to_full_sensor(first.centres_px))
    np.testing.assert_allclose(second.covariance_px2, 4.0 * first.covariance_px2)
    np.testing.assert_allclose(second.perimeter_px, 2.0 * first.perimeter_px)


def test_an_image_without_rings_gives_none() -> None:
    flat = Exposure(np.full((80, 90), int(GROUND), np.uint8), "flat")
    found = detect_rings(flat)
    assert len(found.rings) == 0
    assert found.reasons == ()
