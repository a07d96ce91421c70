# SPDX-License-Identifier: Apache-2.0
"""One posture's name, one pose of the arm: exposures that moved under one name are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import HandEyeOptions, PosedStripe, check_postures
from armscan.calibration.hand_eye.on_board import calibrate_on_board
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.errors import InputError
from armscan.geometry.poses import Pose, Tool
from armscan.pipeline.hand_eye import repeated_postures, standing_postures
from rigs.board_postures import board_rig
from rigs.plate_rig import PlateRig, good_postures

STANDING_MM, STANDING_RAD = 0.02, np.radians(0.002)


def _moved(stripe: PosedStripe, shift_mm: float, turn_rad: float) -> PosedStripe:
    step: Pose[Tool, Tool] = Pose.from_vectors([0.0, turn_rad, 0.0], [shift_mm, 0.0, 0.0])
    return replace(stripe, base_from_tool=stripe.base_from_tool @ step)


def test_two_postures_of_one_name_are_refused_on_a_plate() -> None:
    """Taken for one posture, the second one's pose would count as known by the first one's."""
    stripes, plate = PlateRig(good_postures(8, np.random.default_rng(1))).draw(1)
    named = [replace(stripe, posture=f"view{k // 2}") for k, stripe in enumerate(stripes)]
    with pytest.raises(
        InputError, match=r"'view0' has different poses.*image00-0 to image01-0"
    ) as e:
        calibrate_on_plate(named, plate)
    assert "a view of its own" in str(e.value)


def test_two_postures_of_one_name_are_refused_before_a_target() -> None:
    """Taken for one posture, two poses that err by themselves would share one error."""
    rig = board_rig(1, 8)
    named = [replace(look, posture=f"view{k // 2}") for k, look in enumerate(rig.looks)]
    with pytest.raises(InputError, match=r"'view0' has different poses.*0\.png to 1\.png"):
        calibrate_on_board(named, rig.camera)


def test_looks_that_share_a_pose_share_a_posture_s_name() -> None:
    """By the rule of a recording and by that of a table, also where encoders jitter by 2 um."""
    rig = board_rig(2, 6, images=3)
    step = np.array([0.0, 0.0, 0.0, 0.002, 0.0, 0.0])
    names = [look.source for look in rig.looks]
    poses = [look.base_from_tool.retract((-1) ** k * step) for k, look in enumerate(rig.looks)]
    first_of_each = [names[k - k % 3] for k in range(len(names))]
    assert repeated_postures(names, poses) == first_of_each
    standing, notes = standing_postures([None] * len(names), poses, names)
    assert standing == first_of_each
    assert notes[0].startswith("12 exposures were taken where the one before was")
    # a table is in any order, an arm that comes back along another way errs anew
    again = [*poses[:3], *poses[3:6], *poses[:3]]
    assert repeated_postures(names[:9], again) == [names[k] for k in (0, 0, 0, 3, 3, 3, 0, 0, 0)]
    back, _ = standing_postures([None] * 9, again, names[:9])
    assert back == [names[k] for k in (0, 0, 0, 3, 3, 3, 6, 6, 6)]


def test_an_arm_that_stands_still_is_one_posture() -> None:
    """Encoder noise, five sigmas of it, is no movement; 0.6 degrees or 1.5 mm are."""
    rig = PlateRig(good_postures(8, np.random.default_rng(1)), exposures_per_posture=2)
    stripes, plate = rig.draw(1)
    still = [
        _moved(stripe, 5.0 * STANDING_MM * (k % 2), 5.0 * STANDING_RAD * (k % 2))
        for k, stripe in enumerate(stripes)
    ]
    assert isinstance(calibrate_on_plate(still, plate), HandEyeFit)
    for shift_mm, turn_deg in ((1.5, 0.0), (0.0, 0.6)):
        moved = [stripes[0], _moved(stripes[1], shift_mm, np.radians(turn_deg))]
        with pytest.raises(InputError, match=f"by {shift_mm:.1f} mm and {turn_deg:.1f} deg"):
            calibrate_on_plate(moved, plate)


def test_a_worse_arm_that_was_stated_may_move_more() -> None:
    stripes, _ = PlateRig(good_postures(2, np.random.default_rng(1)), exposures_per_posture=2).draw(
        1
    )
    moved = [stripes[0], _moved(stripes[1], 1.5, 0.0)]
    check_postures(moved, HandEyeOptions(exposure_position_mm=0.3))


def test_an_arm_whose_every_posture_scatters_so_stands_still_all_the_same() -> None:
    """Some of whose pairs lie beyond the fixed limits; but
    one posture that moved beyond it, or all by degrees, did move.
    """
    rig = PlateRig(good_postures(12, np.random.default_rng(1)), exposures_per_posture=2)
    stripes, _ = rig.draw(1)
    rng = np.random.default_rng(4)
    sizes = [(0.5 * abs(rng.normal()), np.radians(0.3) * abs(rng.normal())) for _ in range(12)]
    moved = [s if k % 2 == 0 else _moved(s, *sizes[k // 2]) for k, s in enumerate(stripes)]
    assert max(size[1] for size in sizes) > np.radians(0.5)
    check_postures(moved, HandEyeOptions())
    for shift_mm, turn_deg in ((0.0, 1.2), (3.5, 0.0)):
        one = [*moved[:-1], _moved(stripes[-1], shift_mm, np.radians(turn_deg))]
        with pytest.raises(InputError, match="has different poses"):
            check_postures(one, HandEyeOptions())
    few = [stripes[0], _moved(stripes[1], 0.0, np.radians(0.6)), *stripes[2:4]]
    with pytest.raises(InputError, match="has different poses"):
        check_postures(few, HandEyeOptions())


def test_one_posture_of_many_exposures_is_no_majority() -> None:
    """One that creeps over eight exposures, beside two that stand still."""
    rig = PlateRig(good_postures(10, np.random.default_rng(1)), exposures_per_posture=8)
    stripes, _ = rig.draw(1)
    kept = [s for k, s in enumerate(stripes) if k < 8 or (k // 8 < 3 and k % 8 < 2) or k % 8 == 0]
    crept = [_moved(s, 0.4 * k, 0.0) if k < 8 else s for k, s in enumerate(kept)]
    with pytest.raises(InputError, match="has different poses"):
        check_postures(crept, HandEyeOptions())
