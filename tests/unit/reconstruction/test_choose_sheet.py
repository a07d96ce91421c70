# SPDX-License-Identifier: Apache-2.0
"""Which sheet drew a stripe on an object."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import EstimationError, InputError, OptionError
from armscan.models.calibration import SensorCalibration, SheetCalibration
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.pipeline.measure import MeasureOptions, labeller_for, laser_warnings
from armscan.reconstruction.labels import LabelledProfile, PointStatus, SingleLabeller
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


def two_sheets(right_mm: tuple[float, float] = RANGE_MM) -> SensorCalibration:
    camera = certain_camera(CAMERA, PROVENANCE)
    sheets = tuple(
        SheetCalibration(
            name=name,
            sheet=leaning(sign),
            rms_mm=0.01,
            n_boards=4,
            n_points=99,
            depth_range_mm=depths_mm,
            is_redundant=True,
        )
        for name, sign, depths_mm in (("left", 1.0, RANGE_MM), ("right", -1.0, right_mm))
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
    reach: DepthRange | None = None,
) -> LabelledProfile:
    labeller = SingleLabeller(sensor, depths, sheet_name, reach or depths)
    (found,) = labeller.label([profile], lasers).profiles
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


@pytest.mark.parametrize("lasers", [("left",), ("left", "right"), ("right", "C"), ("left", "C")])
def test_the_users_word_gives_way_to_calibrated_lasers_that_were_on(
    lasers: tuple[str, ...],
) -> None:
    sensor = two_sheets()
    choice = labelled(stripes(0.0), sensor, DepthRange(), sheet_name="right", lasers=lasers)
    assert choice.count(PointStatus.STRAY) == len(choice.profile)
    assert set(choice.sheet.tolist()) == {-1}
    options = MeasureOptions(sheet="right")
    labeller = labeller_for(sensor, options)
    (told,) = laser_warnings([("right",), lasers, lasers], labeller, sensor, options)
    assert told == f"2 exposures were left out: {choice.reason}"
    with pytest.raises(InputError, match="no exposure can be measured: ") as caught:
        laser_warnings([lasers], labeller, sensor, options)
    assert "leave --sheet out" in str(caught.value.remedy)


def test_the_users_word_names_a_laser_that_the_calibration_does_not_know() -> None:
    sensor, options = two_sheets(), MeasureOptions(sheet="right")
    for lasers in ((), ("right",), ("red",)):
        choice = labelled(stripes(0.0), sensor, DepthRange(), sheet_name="right", lasers=lasers)
        assert set(choice.sheet.tolist()) == {1}
        assert not laser_warnings([lasers], labeller_for(sensor, options), sensor, options)


def test_a_scan_that_names_no_laser_is_told_of_those_without_sheet() -> None:
    """A stripe of one camera that meets a sheet may be any laser's; the user's word settles it."""
    sensor, options = replace(two_sheets(), lasers_without_sheet=("far",)), MeasureOptions()
    labeller = labeller_for(sensor, options)
    (told,) = laser_warnings([(), ("left",), ()], labeller, sensor, options)
    assert told.startswith("2 exposures do not name their lasers, and of the laser far the cal")
    assert not laser_warnings([("left",), ("right",)], labeller, sensor, options)
    assert not laser_warnings([()], labeller, two_sheets(), options)
    assert not laser_warnings([()], labeller, sensor, MeasureOptions(sheet="left"))


def test_a_laser_without_sheet_beside_a_calibrated_one_is_not_taken_for_it() -> None:
    choice = labelled(stripes(0.13), two_sheets(), DepthRange(1.0), lasers=("left", "C"))
    assert choice.reason == "of C, which was on, too, the calibration has no sheet"
    assert set(choice.sheet.tolist()) == {-1}


def test_sheets_of_one_source_are_known_by_its_name() -> None:
    """Without the name the third sheet, as the first, would explain the stripe."""
    sensor = two_sheets((262.0, 284.0))
    names = ("A.1", "A.2", "B")
    three = zip(names, (*sensor.sheets, sensor.sheets[0]), strict=True)
    named = replace(
        sensor,
        sheets=tuple(replace(sheet, name=name) for name, sheet in three),
        covariance=np.zeros((33, 33)),
    )
    choice = labelled(stripes(IN_LEFT), named, DepthRange(0.0), lasers=("A",))
    assert set(choice.sheet.tolist()) == {0}


def test_the_only_laser_that_was_on() -> None:
    choice = labelled(stripes(0.0), two_sheets(), DepthRange(), lasers=("left",))
    assert set(choice.sheet.tolist()) == {0}


def test_depth_names_a_stripe_that_one_sheet_alone_puts_in_range() -> None:
    """At x/z = 0.13: left z = 344.8, right z = 265.5. Range of right widened to 262 only."""
    choice = labelled(stripes(0.13), two_sheets((262.0, 320.0)), DepthRange(0.0))
    assert set(choice.sheet.tolist()) == {1}
    assert "right" in choice.reason


def test_the_words_tell_the_calibrated_depths_from_those_accepted() -> None:
    """At x/z = -0.25: left z = 240, 40 mm before its range, and right z = 400, 80 mm behind."""
    choice = labelled(stripes(-0.25), two_sheets(), DepthRange(1.5))
    assert set(choice.sheet.tolist()) == {0}
    assert "left (calibrated Z 280 to 320 mm, accepted 220 to 380 mm)" in choice.reason


IN_LEFT = 0.05
"""Left z = 315.8, calibrated; right z = 285.7, 4.3 mm before its range of 290 to 320 mm."""
FAR_OF_RIGHT = -0.05
"""Left z = 285.7, calibrated; right z = 315.8, 15.8 mm behind its range of 280 to 300 mm."""


def test_what_another_sheet_reaches_beyond_its_own_depths_is_dropped() -> None:
    """A surface before the right line's depths would be measured on the left line's sheet."""
    sensor, within = two_sheets((290.0, 320.0)), DepthRange(0.0)
    seen = stripes(IN_LEFT, 0.13)
    choice = labelled(seen, two_sheets((262.0, 284.0)), within, reach=DepthRange(0.1))
    assert choice.sheet.tolist() == [-1] * 40 + [1] * 40
    assert choice.count(PointStatus.AMBIGUOUS) == 40
    assert "others reach" in choice.reason
    with pytest.raises(EstimationError, match="left 100%, right 100%"):
        labelled(stripes(IN_LEFT), sensor, within, reach=DepthRange(0.5))


def test_others_are_looked_for_beyond_the_depths_accepted_unless_a_margin_is_given() -> None:
    sensor, both = two_sheets((290.0, 320.0)), stripes(IN_LEFT)
    with pytest.raises(EstimationError, match="--depth-margin 0"):
        labeller_for(sensor, MeasureOptions()).label([both])
    (given,) = labeller_for(sensor, MeasureOptions(depths=DepthRange(0.0))).label([both]).profiles
    assert set(given.sheet.tolist()) == {0}


def test_no_reach_leaves_the_calibrated_depths_to_decide() -> None:
    sensor, within = two_sheets((290.0, 320.0)), DepthRange(0.0)
    choice = labelled(stripes(IN_LEFT), sensor, within)
    assert set(choice.sheet.tolist()) == {0}
    near = labelled(
        stripes(FAR_OF_RIGHT), two_sheets((280.0, 300.0)), within, reach=DepthRange(0.5)
    )
    assert set(near.sheet.tolist()) == {0}


def test_a_stripe_that_both_sheets_put_in_range_is_not_guessed() -> None:
    with pytest.raises(EstimationError, match="--sheet"):
        labelled(stripes(0.0), two_sheets(), DepthRange())


def test_a_stripe_in_no_range_gets_no_sheet() -> None:
    choice = labelled(stripes(FAR, NEAR), two_sheets(), DepthRange(0.0))
    assert set(choice.sheet.tolist()) == {-1}
    assert choice.count(PointStatus.OUT_OF_DEPTH) == len(choice.profile)
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
    assert choice.count(PointStatus.FLAGGED) == len(profile)


def test_depth_margin_by_hand() -> None:
    assert DepthRange(0.25).limits_mm(two_sheets().sheets[0]) == (270.0, 330.0)
    with pytest.raises(OptionError):
        DepthRange(-0.1)
