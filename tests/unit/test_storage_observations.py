# SPDX-License-Identifier: Apache-2.0
"""Observations beside a calibration come back exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.records.profile import Profile
from armscan.storage.observations import pack_observations, read_observations
from armscan.vision.targets.target import TargetView

VIEW_FIELDS = ("point_index", "points_px", "covariance_px2", "points_board_mm")
PROFILE_FIELDS = (
    "points_px", "normals_px", "sigma_px", "width_px", "intensity", "flags", "segment",
)  # fmt: skip


def views() -> tuple[TargetView, ...]:
    rng = np.random.default_rng(1)
    return tuple(
        TargetView(
            source=f"größe {k}.png",
            width_px=640,
            height_px=480,
            point_index=np.arange(k, 2 * k),
            points_px=rng.normal(size=(k, 2)),
            covariance_px2=np.tile(np.eye(2), (k, 1, 1)) * 1e-4,
            points_board_mm=rng.normal(size=(k, 3)),
            is_ambiguous=k == 4,
        )
        for k in (4, 0, 7)
    )


def profiles() -> tuple[Profile, ...]:
    rng = np.random.default_rng(2)
    return tuple(
        Profile(
            source=f"{n}.png",
            points_px=rng.normal(size=(n, 2)),
            normals_px=rng.normal(size=(n, 2)),
            sigma_px=rng.uniform(0.1, 1, n),
            width_px=rng.uniform(1, 3, n),
            intensity=rng.uniform(1, 200, n),
            flags=rng.integers(0, 64, n),
            segment=np.arange(n) // 3,
        )
        for n in (5, 9)
    )


@pytest.mark.parametrize("has_profiles", [True, False])
def test_round_trip_is_exact(tmp_path: Path, has_profiles: bool) -> None:
    path = tmp_path / "camera.npz"
    stripes = profiles() if has_profiles else ()
    path.write_bytes(pack_observations(views(), stripes, {"größe 4.png": "ab" * 32}))
    found = read_observations(path)
    assert found.sha256 == {"größe 4.png": "ab" * 32}
    for before, after in zip(views(), found.views, strict=True):
        assert (before.source, before.width_px, before.height_px, before.is_ambiguous) == (
            after.source, after.width_px, after.height_px, after.is_ambiguous,
        )  # fmt: skip
        for name in VIEW_FIELDS:
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    for before_p, after_p in zip(stripes, found.profiles, strict=True):
        assert before_p.source == after_p.source
        for name in PROFILE_FIELDS:
            np.testing.assert_array_equal(getattr(before_p, name), getattr(after_p, name))


def test_broken_files_have_a_reason(tmp_path: Path) -> None:
    content = pack_observations(views(), (), {})
    path = tmp_path / "camera.npz"
    for broken in (
        content[: len(content) // 2],
        b"PK",
        content.replace(b"view_source", b"view_sourcf"),
    ):
        path.write_bytes(broken)
        with pytest.raises(FileFormatError, match="not a complete file of observations"):
            read_observations(path)
