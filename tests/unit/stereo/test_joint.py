# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the joint adjustment's predictions."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.calibration.cameras.joint import (
    N_SHARED,
    Predicted,
    StereoState,
    predict_left,
    predict_right,
    retract_state,
    stack_pair_observations,
)
from rigs.stereo_rig import CONVERGING, LEFT, RIGHT, StereoScene, make_pairs

PAIRS, POSES = make_pairs(StereoScene(n_pairs=2), 0)
OBSERVATIONS = stack_pair_observations(PAIRS, ("pinhole", "pinhole"))
STATE = StereoState(
    np.concatenate([LEFT.parameters, RIGHT.parameters]),
    CONVERGING,
    np.array([pose.rotation for pose in POSES]),
    np.array([pose.translation_mm for pose in POSES]),
)
STEPS = (*2 * (*(4 * [1e-3]), *(5 * [1e-5])), *(3 * [1e-6]), *(3 * [1e-4]))


def predicted(state: StereoState, side: int) -> Predicted:
    found = (predict_left(OBSERVATIONS.left, state), predict_right(OBSERVATIONS.right, state))[side]
    assert found is not None
    return found


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("number", range(N_SHARED))
def test_derivatives_by_shared_unknowns(side: int, number: int) -> None:
    step, still = np.zeros(N_SHARED), np.zeros((2, 6))
    step[number] = STEPS[number]
    ends = [
        predicted(retract_state(STATE, np.eye(N_SHARED), sign * step, still), side).points_px
        for sign in (1.0, -1.0)
    ]
    expected = (ends[0] - ends[1]) / (2.0 * STEPS[number])
    found = predicted(STATE, side).by_shared[:, :, number]
    assert np.abs(found - expected).max() <= 1e-6 * max(float(np.abs(expected).max()), 1.0)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("number", range(6))
def test_derivatives_by_the_boards_pose(side: int, number: int) -> None:
    steps, size = np.zeros((2, 6)), (1e-6, 1e-4)[number // 3]
    steps[1, number] = size
    ends = [
        predicted(
            retract_state(STATE, np.zeros((24, 0)), np.zeros(0), sign * steps), side
        ).points_px
        for sign in (1.0, -1.0)
    ]
    expected = (ends[0] - ends[1]) / (2.0 * size)
    of_board = (OBSERVATIONS.left, OBSERVATIONS.right)[side].rows(1)
    found = predicted(STATE, side).by_pose[of_board, :, number]
    assert np.abs(found - expected[of_board]).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(np.delete(expected, np.r_[of_board], axis=0)).max() == 0.0
