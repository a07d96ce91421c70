# SPDX-License-Identifier: Apache-2.0
"""Observations beside a calibration come back exactly."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.errors import FileFormatError
from armscan.geometry.poses import Pose
from armscan.records.profile import Profile
from armscan.storage.observations import pack_observations, pack_posed_stripes, read_observations
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


def test_stripes_of_a_hand_eye_come_back_exactly(tmp_path: Path) -> None:
    """One of one camera and one of two, whose points have more noises."""
    rng = np.random.default_rng(3)
    stripes = [
        PosedStripe(
            source=f"{n}.png",
            posture=f"p{n}",
            base_from_tool=Pose(np.eye(3)[[1, 2, 0]], rng.normal(size=3)),
            points_mm=rng.normal(size=(n, 3)),
            noise_mm=rng.normal(size=(n, 3, n_noises)),
            sheet=np.arange(n) % 2,
        )
        for n, n_noises in ((4, 1), (7, 3))
    ]
    path = tmp_path / "scanner.npz"
    path.write_bytes(pack_posed_stripes(stripes, {}))
    found = read_observations(path).stripes
    for before, after in zip(stripes, found, strict=True):
        assert (before.source, before.posture) == (after.source, after.posture)
        np.testing.assert_array_equal(before.points_mm, after.points_mm)
        np.testing.assert_array_equal(before.sheet, after.sheet)
        np.testing.assert_array_equal(before.base_from_tool.rotation, after.base_from_tool.rotation)
        np.testing.assert_array_equal(
            before.noise_mm @ before.noise_mm.transpose(0, 2, 1),
            after.noise_mm @ after.noise_mm.transpose(0, 2, 1),
        )


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    """Three megabytes that are three gigabytes, and a header that claims a terabyte."""
    path = tmp_path / "camera.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(6):
            archive.writestr(f"a{k}.npy", bytes(100 * 2**20))
    with pytest.raises(FileFormatError):
        read_observations(path)
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    claiming = stream.getvalue().replace(b"(3,), ", b"(3000000000000,), ")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("view_n_points.npy", claiming)
    with pytest.raises(FileFormatError):
        read_observations(path)
