# SPDX-License-Identifier: Apache-2.0
"""Stripes predicted in the image: where they were, moved on as they moved."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.segments import REACH_PX, SIGMA_PX, WINDOW_PX, ImageMemory

NORMAL = np.array([0.6, 0.8])
ALONG = np.array([0.8, -0.6])
PEAK = np.log1p(WINDOW_PX * 0.36755 / SIGMA_PX)
"""Student's density with 3 degrees of freedom is 0.36755 in its middle."""


def stripe(offset_px: float) -> FloatArray:
    return np.array([900.0, 700.0]) + offset_px * NORMAL + np.arange(300.0)[:, None] * ALONG


def taught(*offsets: float) -> ImageMemory:
    memory = ImageMemory()
    for offset in offsets:
        points = stripe(offset)
        memory.remember(points, np.tile(NORMAL, (300, 1)), np.zeros(300, np.int64))
    return memory


def test_a_stripe_goes_on_as_it_went() -> None:
    memory = taught(0.0, 15.0)
    middle = slice(100, 200)
    moved = memory.log_gain(stripe(30.0)[middle], 0)
    stayed = memory.log_gain(stripe(15.0)[middle], 0)
    assert moved.min() > 3.0
    assert stayed.max() < moved.min() - 1.5
    assert memory.log_gain(stripe(30.0 + 1.1 * REACH_PX)[middle], 0) == pytest.approx(0.0)


def test_motion_along_a_stripe_is_not_seen_and_not_invented() -> None:
    memory = taught(0.0)
    memory.remember(stripe(0.0) + 9.0 * ALONG, np.tile(NORMAL, (300, 1)), np.zeros(300, np.int64))
    assert memory.log_gain(stripe(0.0)[100:200], 0).min() > 0.999 * PEAK


def test_a_sheet_that_was_not_seen_is_not_expected() -> None:
    memory = taught(0.0)
    assert memory.log_gain(stripe(0.0), 1).tolist() == [0.0] * 300
    memory.forget()
    assert memory.log_gain(stripe(0.0), 0).tolist() == [0.0] * 300
