# SPDX-License-Identifier: Apache-2.0
"""Size, shape and common centre of two circles, against projections written out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.vision.rings import (
    RingOptions,
    common_centres,
    perimeter_limits,
    perimeters_px,
    roundness,
)
from armscan.vision.targets.ellipse import Ellipses, fit_ellipses

FOCAL_PX, DISTANCE_MM = 5000.0, 140.0
N_POINTS = 60


def rim(radius_mm: float, tilt_rad: float, azimuth_rad: float) -> FloatArray:
    """Points of a circle around (4, -3, 140) mm, tilted, seen by a pinhole."""
    angle = 2.0 * np.pi * np.arange(N_POINTS) / N_POINTS
    flat = radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])
    axis = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    across = np.array([-axis[1], axis[0]])
    x = (flat @ axis)[:, None] * axis + np.cos(tilt_rad) * (flat @ across)[:, None] * across
    z = DISTANCE_MM + np.sin(tilt_rad) * (flat @ across)
    return FOCAL_PX * (x + np.array([4.0, -3.0])) / z[:, None]


TRUE_CENTRE = FOCAL_PX * np.array([4.0, -3.0]) / DISTANCE_MM


def fitted(points: FloatArray, sigma_px: float = 1.0) -> Ellipses:
    return fit_ellipses(points[None], np.full((1, N_POINTS), sigma_px**-2))


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 45.0, 60.0])
def test_the_common_centre_is_the_image_of_the_centre(tilt_deg: float) -> None:
    tilt = np.deg2rad(tilt_deg)
    outer, inner = (fitted(rim(r, tilt, 0.7)) for r in (2.5, 1.3))
    centre, _, mismatch = common_centres(outer, inner)
    np.testing.assert_allclose(centre[0], TRUE_CENTRE, atol=1e-6)
    assert mismatch[0] < 1e-6
    if tilt_deg == 45.0:
        # The ellipse's centre is off by f r^2 sin(t) cos(t) / Z^2 times less than 2.
        assert np.linalg.norm(outer.centres()[0][0] - TRUE_CENTRE) > 0.3


def test_covariance_of_the_common_centre_is_that_of_repeats() -> None:
    sigma, rng = 0.05, np.random.default_rng(1)
    clean = [rim(r, np.deg2rad(45.0), 0.7) for r in (2.5, 1.3)]
    found = []
    for _ in range(400):
        outer, inner = (fitted(c + sigma * rng.standard_normal(c.shape), sigma) for c in clean)
        centre, covariance, _ = common_centres(outer, inner)
        found.append(np.linalg.solve(np.linalg.cholesky(covariance[0]), centre[0] - TRUE_CENTRE))
    # Mean of 400 chi-square variables of 2 degrees of freedom: 2 +- 0.1.
    assert np.mean(np.sum(np.square(found), axis=1)) == pytest.approx(2.0, abs=0.3)


def test_mismatch_tells_other_shapes() -> None:
    outer, inner = fitted(rim(2.5, 0.8, 0.7)), fitted(rim(1.3, 0.8, 0.7 + np.pi / 2.0))
    # Axis ratios of cos(0.8) and of its inverse: squared, (1 - c^4) / (1 + c^4).
    c4 = np.cos(0.8) ** 4
    assert common_centres(outer, inner)[2][0] == pytest.approx((1 - c4) / (1 + c4), rel=0.05)


def test_roundness_is_the_inverse_cosine_of_the_tilt() -> None:
    """Thesis: 1.7 belongs to about 50 degrees; 1 / cos(54 degrees) = 1.70."""
    for tilt_deg in (0.0, 30.0, 50.0, 54.0):
        half = fitted(rim(0.1, np.deg2rad(tilt_deg), 0.3)).axes()[0]
        # The ring stands 2 degrees off the axis: the angle to the ray is not the tilt exactly.
        assert roundness(half)[0] == pytest.approx(1.0 / np.cos(np.deg2rad(tilt_deg)), rel=0.06)
    assert roundness(np.array([[3.0, 3.0]]))[0] == 1.0
    np.testing.assert_allclose(perimeters_px(np.array([[1.0, 10.0]])), 20.0 * np.pi)


def test_perimeter_limits_by_hand() -> None:
    """3 mm at 300 mm with 8 mm and pixels of 2.4 um: 105 px, widened by a tenth."""
    low, high = perimeter_limits(3.0, 8.0 / 0.0024, (300.0, 300.0))
    assert low == pytest.approx(0.9 * 104.72, rel=1e-4)
    assert high == pytest.approx(1.1 * 104.72, rel=1e-4)
    assert perimeter_limits(3.0, 5000.0, (100.0, 200.0), 0.0) == pytest.approx(
        (np.pi * 75.0, np.pi * 150.0)
    )
    with pytest.raises(OptionError, match="nearer distance first"):
        perimeter_limits(3.0, 5000.0, (200.0, 100.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_perimeter_px": 10.0}, "at least 30"),
        ({"max_perimeter_px": 35.0}, "below the largest"),
        ({"max_roundness": 1.0}, "lets no ring pass"),
        ({"min_contrast": 0.0}, "between 0 and 1"),
        ({"disc": "grey"}, "light or dark"),
    ],
)
def test_options_are_checked(change: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        RingOptions(**change)  # type: ignore[arg-type]
