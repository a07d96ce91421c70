# SPDX-License-Identifier: Apache-2.0
"""What must not depend on how the image lies on the sensor or on its bit depth."""

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure, SensorWindow
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from rigs.stripe_image import SimulatedStripe, StraightCurve, StripeScene

ANGLES_DEG = (8.0, 37.0, 71.0, 102.0)
SAME_PX = 0.03
"""Far below the noise of a smoothed point; only the split of the diagonal may differ."""


@pytest.fixture(params=ANGLES_DEG)
def exposure(request: pytest.FixtureRequest) -> Exposure:
    stripe = SimulatedStripe(StraightCurve(110.2, 90.4, request.param))
    return StripeScene((stripe,), 220, 180).expose(5)


def accepted(profile: Profile) -> FloatArray:
    return profile.points_px[profile.is_accepted]


def distance_to_curve(points: FloatArray, curve: FloatArray) -> FloatArray:
    """Distance (N,) of points to the polyline through the points of ``curve``."""
    start, step = curve[:-1], np.diff(curve, axis=0)
    length = np.maximum((step**2).sum(axis=1), 1e-12)
    share = np.clip(((points[:, None] - start) * step).sum(axis=2) / length, 0.0, 1.0)
    foot = start + share[..., None] * step
    return np.asarray(np.hypot(*np.moveaxis(points[:, None] - foot, 2, 0)).min(axis=1))


def assert_same_line(a: FloatArray, b: FloatArray) -> None:
    assert abs(len(a) - len(b)) <= 0.02 * len(a)
    inner = distance_to_curve(a, b)
    assert np.quantile(inner, 0.98) < SAME_PX


def test_transposing_swaps_coordinates(exposure: Exposure) -> None:
    turned = extract_stripes(Exposure(exposure.image.T, "turned"))
    assert_same_line(accepted(extract_stripes(exposure)), accepted(turned)[:, ::-1])


def test_mirroring_mirrors(exposure: Exposure) -> None:
    mirrored = accepted(extract_stripes(Exposure(exposure.image[:, ::-1], "mirrored")))
    width = exposure.width_px
    assert_same_line(
        accepted(extract_stripes(exposure)),
        np.column_stack([width - 1 - mirrored[:, 0], mirrored[:, 1]]),
    )


def test_window_offset_shifts_and_binning_scales(exposure: Exposure) -> None:
    plain = extract_stripes(exposure)
    window = SensorWindow(x_px=300, y_px=41)
    shifted = extract_stripes(Exposure(exposure.image, "shifted", window=window))
    assert np.array_equal(shifted.points_px, plain.points_px + np.array([300.0, 41.0]))
    binned = extract_stripes(Exposure(exposure.image, "binned", window=SensorWindow(binning=2)))
    assert np.allclose(binned.points_px, 2.0 * plain.points_px + 0.5, atol=1e-9)
    assert np.allclose(binned.sigma_px, 2.0 * plain.sigma_px)
    assert np.allclose(binned.width_px, 2.0 * plain.width_px)


def test_bit_depth_is_neutral(exposure: Exposure) -> None:
    deep = np.round(exposure.image.astype(np.float64) * 4095.0 / 255.0).astype(np.uint16)
    plain = extract_stripes(exposure)
    twelve = extract_stripes(Exposure(deep, "deep", bits_used=12))
    assert len(plain) == len(twelve)
    assert np.abs(plain.points_px - twelve.points_px).max() < SAME_PX
    assert np.median(twelve.intensity / plain.intensity) == pytest.approx(4095.0 / 255.0, rel=0.01)


def test_points_of_a_segment_follow_each_other(exposure: Exposure) -> None:
    profile = extract_stripes(exposure)
    step = np.hypot(*np.diff(profile.points_px, axis=0).T)
    same = np.diff(profile.segment) == 0
    assert step[same].max() < 4.0
    assert np.allclose(np.hypot(*profile.normals_px.T), 1.0)


def test_a_gap_is_not_bridged(exposure: Exposure) -> None:
    image = exposure.image.copy()
    image[80:100, 95:125] = 4
    profile = extract_stripes(Exposure(image, "gap"))
    inside = np.abs(profile.points_px - [110.0, 89.5]) < [12.0, 7.0]
    assert not inside.all(axis=1).any()
    long = [s for s in np.unique(profile.segment) if (profile.segment == s).sum() > 20]
    assert len(long) == 2
