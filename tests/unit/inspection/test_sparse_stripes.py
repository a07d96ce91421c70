# SPDX-License-Identifier: Apache-2.0
"""Features on walls that few stripes cross, and descriptions that find nothing or the same."""

from __future__ import annotations

import re

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.features import FeatureInspection, inspect_feature, relate
from armscan.inspection.search import WantedFeature
from armscan.records.cloud import PointCloud
from rigs.inspection_clouds import cloud_of

BORE_MM, APART_MM, STEP_MM, NOISE_MM = 20.0, 2.7, 0.05, 0.006
ARC_DEG = 196.0
"""What the five stripes that cross the bore's wall see of it, by their places below."""


@pytest.fixture(scope="module")
def block() -> PointCloud:
    """A block 60 x 42 mm with a bore 12 mm deep: stripes along x, 2.7 mm apart, one an exposure.

    Each runs over the face z = 0 and down the wall, of which only y > -2 is seen.
    """
    rng = np.random.default_rng(5)
    points: list[FloatArray] = []
    numbers: list[FloatArray] = []
    for k in range(-7, 8):
        y = -1.4 + APART_MM * k
        x = np.arange(-30.0, 30.0, STEP_MM)
        half = np.sqrt(max(BORE_MM**2 / 4.0 - y**2, 0.0))
        x = x[np.abs(x) >= half]
        parts = [np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1)]
        if half and y > -2.0:
            z = -np.arange(STEP_MM, 12.0, 2.0 * STEP_MM)
            for side in (-1.0, 1.0):
                parts.append(
                    np.stack([np.full_like(z, side * half), np.full_like(z, y), z], axis=1)
                )
        stripe = np.concatenate(parts)
        points.append(stripe)
        numbers.append(np.full(len(stripe), k + 7))
    exact = np.concatenate(points)
    noisy = exact + rng.normal(0.0, NOISE_MM, exact.shape)
    return cloud_of(noisy, np.concatenate(numbers).astype(np.int64), sigma_mm=NOISE_MM)


def found(cloud: PointCloud, wanted: WantedFeature) -> FeatureInspection:
    result = inspect_feature(cloud, wanted)
    assert not isinstance(result, FitFailure), result
    return result


@pytest.mark.parametrize(
    "wanted",
    [
        WantedFeature("cylinder", diameter_mm=BORE_MM),
        WantedFeature("cylinder", diameter_mm=BORE_MM, axis=(0.1, 0.0, 1.0)),
        WantedFeature("cylinder", seed_mm=(9.9, 1.3, -6.0)),
        WantedFeature("cylinder", diameter_mm=BORE_MM, region=Box([-14, -4, -14], [14, 14, 1])),
    ],
)
def test_a_bore_is_found_by_lone_stripes_down_its_wall(
    block: PointCloud, wanted: WantedFeature
) -> None:
    """Neighbours of a point lie along its stripe: their plane is no plane of the wall."""
    bore = found(block, wanted)
    assert bore.diameter is not None
    assert bore.diameter.value_mm == pytest.approx(BORE_MM, abs=4.0 * bore.diameter.sigma_mm)
    assert bore.diameter.sigma_mm < 0.01
    assert bore.shape.point_mm[:2] == pytest.approx([0.0, 0.0], abs=0.01)
    assert abs(bore.shape.direction[2]) > np.cos(np.radians(0.1))
    assert bore.seen_deg == pytest.approx(ARC_DEG, abs=1.0)


def test_one_feature_is_not_measured_against_itself(block: PointCloud) -> None:
    face = found(block, WantedFeature("plane"))
    again = found(block, WantedFeature("plane", axis=(0.0, 0.0, 1.0)))
    with pytest.raises(OptionError, match="both features are one") as caught:
        relate(block, face, again)
    place = caught.value.what.rpartition("about ")[2]
    assert re.fullmatch(r"(-?\d+(\.\d{1,3})?,?){3}", place), "as --seed takes it"
    bore = found(block, WantedFeature("cylinder", diameter_mm=BORE_MM))
    angle = relate(block, face, bore).angle
    assert angle is not None
    assert angle.value_rad == pytest.approx(np.pi / 2.0, abs=0.002)


def test_a_cone_that_is_not_there_has_no_nearest(block: PointCloud) -> None:
    result = inspect_feature(block, WantedFeature("cone", half_angle_deg=25.0))
    assert isinstance(result, FitFailure)
    assert "there is no cone of 25 degrees" in result.reason
    assert "nearest" not in result.reason


@pytest.mark.parametrize("kind", ["line", "circle"])
def test_lines_and_circles_are_shown_where_they_are(kind: str) -> None:
    with pytest.raises(OptionError, match="not looked for in a whole cloud"):
        WantedFeature(kind)  # type: ignore[arg-type]
