# SPDX-License-Identifier: Apache-2.0
"""The probe's tip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.poses import Pose
from armscan.models.arm import compensate_tip, tip_centres, tool_from_probe
from armscan.records.recording import ArmTrack


def test_turning_about_the_tips_centre_does_not_move_it() -> None:
    tip = np.array([3.0, -12.0, 150.0])
    rng = np.random.default_rng(2)
    touched = np.array([400.0, 100.0, 50.0])
    rotations = np.array(
        [Pose.from_vectors(v, [0, 0, 0]).rotation for v in rng.normal(size=(5, 3))]
    )
    track = ArmTrack(
        t_ns=np.arange(5),
        rotations=rotations,
        translations_mm=touched - rotations @ tip,
        is_known=[True, True, False, True, True],
    )
    centres = tip_centres(track, tool_from_probe(tip))
    assert centres.shape == (4, 3)
    np.testing.assert_allclose(centres, np.tile(touched, (4, 1)), atol=1e-12)
    with pytest.raises(InputError, match="no pose"):
        tip_centres(replace(track, is_known=np.zeros(5, bool)), tool_from_probe(tip))


def test_compensation_goes_half_a_diameter_against_the_normal() -> None:
    centres = np.array([[0.0, 0.0, 3.0], [5.0, 0.0, 3.0]])
    surface = compensate_tip(centres, np.array([0.0, 0.0, 17.0]), 6.0)
    np.testing.assert_allclose(surface[:, 2], 0.0, atol=1e-15)
    each = compensate_tip(centres, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), 6.0)
    np.testing.assert_allclose(each, [[0.0, 0.0, 0.0], [2.0, 0.0, 3.0]], atol=1e-15)
    with pytest.raises(InputError, match="normal"):
        compensate_tip(centres, np.zeros(3), 6.0)
    with pytest.raises(InputError, match="normals of shape"):
        compensate_tip(centres, np.ones((3, 3)), 6.0)
