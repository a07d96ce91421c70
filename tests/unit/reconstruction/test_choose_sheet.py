# SPDX-License-Identifier: Apache-2.0
"""Which sheet drew a stripe on an object."""

import numpy as np
import pytest

from armscan.errors import EstimationError, OptionError
from armscan.models.calibration import SensorCalibration, SheetCalibration
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.reconstruction.labels import LabelledProfile, SingleLabeller
from armscan.reconstruction.triangulate import DepthRange
from armscan.records.profile import Profile, StripeFlag
from rigs.sheet_rig import PROVENANCE, make_profile
from rigs.true_scanner import certain_camera

CAMERA = CameraModel(
    fx_px=1000.0,
    fy_px=1000.0,
    cx_px=500.0,
    cy_px=400.0,
    distortion=np.zeros(5),
    width_px=1001,
    height_px=801,
)
RANGE_MM = (280.0, 320.0)


def leaning(sign: float) -> LightSheet:
    """Vertical sheet through (0, 0, 300) at 45 degrees: x = sign * (z - 300)."""
    normal = np.array([1.0, 0.0, -sign]) / np.sqrt(2.0)
    axes = np.stack([[0.0, 1.0, 0.0], np.cross(normal, [0.0, 1.0, 0.0]), normal])
    return LightSheet(
        origin_mm=np.array([0.0, 0.0, 300.0]), axes=axes, scale_mm=40.0, bow_mm=np.zeros(5)
    )


def two_sheets() -> SensorCalibration:
    camera = certain_camera(CAMERA, PROVENANCE)
    sheets = tuple(
        SheetCalibration(
            name=name,
            sheet=leaning(sign),
            rms_mm=0.01,
            n_boards=4,
            n_points=99,
            depth_range_mm=RANGE_MM,
            is_redundant=True,
        )
        for name, sign in (("left", 1.0), ("right", -1.0))
    )
    return SensorCalibration(
        camera=camera, sheets=sheets, covariance=np.zeros((25, 25)), provenance=PROVENANCE
    )


def stripes(*x_over_z: float) -> Profile:
    """Vertical stripes at the columns of x / z; both sheets meet them at some depth."""
    parts = []
    for tangent in x_over_z:
        q = np.stack([np.full(40, 500.0 + 1000.0 * tangent), np.linspace(300, 500, 40)], axis=1)
        parts.append((q, np.tile([1.0, 0.0], (40, 1))))
    return make_profile("object.png", parts, 0.1)


def labelled(
    profile: Profile,
    sensor: SensorCalibration,
    depths: DepthRange,
    *,
    sheet_name: str = "",
    lasers: tuple[str, ...] = (),
) -> LabelledProfile:
    (found,) = SingleLabeller(sensor, depths, sheet_name).label([profile], lasers).profiles
    return found


FAR = -60.0 / 360.0
"""Left meets this column at z = 257 (outside), right at z = 360 (outside)."""
NEAR = 0.25
"""Left meets it at z = 400, right at z = 240: outside, too."""


def test_the_users_word_comes_first() -> None:
    choice = labelled(stripes(0.0), two_sheets(), DepthRange(), sheet_name="right")
    assert set(choice.sheet.tolist()) == {1}
    assert "as asked" in choice.reason
    with pytest.raises(OptionError, match="left, right"):
        labelled(stripes(0.0), two_sheets(), DepthRange(), sheet_name="middle")


def test_the_only_laser_that_was_on() -> None:
    choice = labelled(stripes(0.0), two_sheets(), DepthRange(), lasers=("left",))
    assert set(choice.sheet.tolist()) == {0}


def test_depth_names_a_stripe_that_one_sheet_alone_puts_in_range() -> None:
    """At x/z = 0.13: left z = 344.8, right z = 265.5. Range of right widened to 265 only."""
    sensor = two_sheets()
    wide = SheetCalibration(
        name="right",
        sheet=leaning(-1.0),
        rms_mm=0.01,
        n_boards=4,
        n_points=99,
        depth_range_mm=(262.0, 320.0),
        is_redundant=True,
    )
    sensor = SensorCalibration(
        camera=sensor.camera,
        sheets=(sensor.sheets[0], wide),
        covariance=sensor.covariance,
        provenance=PROVENANCE,
    )
    choice = labelled(stripes(0.13), sensor, DepthRange(0.0))
    assert set(choice.sheet.tolist()) == {1}
    assert "right" in choice.reason


def test_the_words_tell_the_calibrated_depths_from_those_accepted() -> None:
    """At x/z = -0.25: left z = 240, 40 mm before its range, and right z = 400, 80 mm behind."""
    choice = labelled(stripes(-0.25), two_sheets(), DepthRange(1.5))
    assert set(choice.sheet.tolist()) == {0}
    assert "left (calibrated Z 280 to 320 mm, accepted 220 to 380 mm)" in choice.reason
    assert "within reach" in choice.reason


def test_the_calibrated_depths_decide_before_the_widened_ones() -> None:
    """At x/z = 0.05: left z = 315.8, calibrated; right z = 285.7, outside its 290 to 320 mm."""
    sensor = two_sheets()
    right = SheetCalibration(
        name="right",
        sheet=leaning(-1.0),
        rms_mm=0.01,
        n_boards=4,
        n_points=99,
        depth_range_mm=(290.0, 320.0),
        is_redundant=True,
    )
    sensor = SensorCalibration(
        camera=sensor.camera,
        sheets=(sensor.sheets[0], right),
        covariance=sensor.covariance,
        provenance=PROVENANCE,
    )
    choice = labelled(stripes(0.05), sensor, DepthRange(3.0))
    assert set(choice.sheet.tolist()) == {0}
    assert "within its calibrated depths: left" in choice.reason
    assert "within reach" not in choice.reason


def test_only_segments_outside_all_calibrated_depths_ask_the_widened_ones() -> None:
    """Left's first stripe as above; the second (z = 240 or 400) is reached by left alone."""
    sensor = two_sheets()
    right = SheetCalibration(
        name="right",
        sheet=leaning(-1.0),
        rms_mm=0.01,
        n_boards=4,
        n_points=99,
        depth_range_mm=(290.0, 320.0),
        is_redundant=True,
    )
    sensor = SensorCalibration(
        camera=sensor.camera,
        sheets=(sensor.sheets[0], right),
        covariance=sensor.covariance,
        provenance=PROVENANCE,
    )
    choice = labelled(stripes(0.05, -0.25), sensor, DepthRange(1.5))
    assert set(choice.sheet.tolist()) == {0}
    assert choice.reason.count("left") == 2
    assert "within reach" in choice.reason


def test_a_stripe_that_both_sheets_put_in_range_is_not_guessed() -> None:
    with pytest.raises(EstimationError, match="--sheet"):
        labelled(stripes(0.0), two_sheets(), DepthRange())


def test_a_stripe_in_no_range_gets_no_sheet() -> None:
    choice = labelled(stripes(FAR, NEAR), two_sheets(), DepthRange(0.0))
    assert set(choice.sheet.tolist()) == {-1}
    assert choice.reason.startswith("no sheet")


def test_flagged_points_do_not_vote() -> None:
    profile = stripes(0.0)
    flags = np.full(len(profile), int(StripeFlag.NEIGHBOUR))
    flagged = Profile(
        source=profile.source,
        points_px=profile.points_px,
        normals_px=profile.normals_px,
        sigma_px=profile.sigma_px,
        width_px=profile.width_px,
        intensity=profile.intensity,
        flags=flags,
        segment=profile.segment,
    )
    choice = labelled(flagged, two_sheets(), DepthRange())
    assert set(choice.sheet.tolist()) == {-1}


def test_depth_margin_by_hand() -> None:
    assert DepthRange(0.25).limits_mm(two_sheets().sheets[0]) == (270.0, 330.0)
    with pytest.raises(OptionError):
        DepthRange(-0.1)
