# SPDX-License-Identifier: Apache-2.0
"""Profiles that a sensor delivers, placed in Base: where, with what covariance, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.errors import EstimationError, InputError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import euler_from_rotations
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.scan import ExposureStatus, place_profiles
from armscan.records.profile import PointProfile
from armscan.storage.clouds import read_ply
from armscan.storage.documents import scanner_document
from rigs import placing_rig as rig

NOISE_MM = 0.01
N = 12


def device() -> ScannerCalibration:
    """A scanner without camera, its hand-eye known to 0.01 mm and 0.1 mrad."""
    scanner = rig.scanner()
    covariance = np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01]) ** 2
    hand_eye = replace(scanner.hand_eye, dhand_eye_dsensor=None, covariance=covariance)
    return replace(scanner, sensor=None, hand_eye=hand_eye)


def scan() -> tuple[list[PointProfile], list[Pose[Base, Tool]], FloatArray]:
    """Profiles across a bent surface, 1 mm apart, and the true points in Base."""
    rng = np.random.default_rng(2)
    profiles, poses, truth = [], [], []
    for k in range(N):
        x = np.arange(-10.0, 10.0, 0.1)
        points = np.column_stack([x, np.zeros_like(x), 150.0 + 0.02 * x**2])
        shift = np.array([0.0, float(k), 0.0])
        pose: Pose[Base, Tool] = Pose(
            rig.BASE_FROM_TOOL.rotation, rig.BASE_FROM_TOOL.translation_mm + shift
        )
        truth.append((pose @ device().hand_eye.tool_from_sensor).apply(points))
        noisy = points + NOISE_MM * rng.normal(size=len(x))[:, None] * [0.0, 0.0, 1.0]
        profiles.append(PointProfile(source=f"{k}.csv", points_mm=noisy))
        poses.append(pose)
    return profiles, poses, np.concatenate(truth)


def test_points_are_placed_with_their_own_noise_the_hand_eyes_and_the_arms() -> None:
    profiles, poses, truth = scan()
    found = place_profiles(profiles, poses, device())
    cloud = found.cloud
    assert cloud.frame == "Base"
    assert np.abs(cloud.points_mm - truth).max() < 6.0 * NOISE_MM
    # the scatter of each profile tells its noise to about 5 %
    assert np.median(cloud.sigma_noise_mm) == pytest.approx(NOISE_MM, rel=0.15)
    least = np.hypot(np.median(cloud.sigma_noise_mm), 0.01)
    assert np.median(cloud.sigma_mm) > least
    assert cloud.exposure_sources == tuple(profile.source for profile in profiles)
    assert found.count(ExposureStatus.PLACED) == N
    assert cloud.normals is not None
    assert cloud.normals.any(axis=1).mean() > 0.9
    assert found.poses.how == "one for each, in order"


def test_a_volume_cuts_and_nothing_in_it_is_refused() -> None:
    profiles, poses, truth = scan()
    middle = truth.mean(axis=0)
    box = Box(middle - 4.0, middle + 4.0)
    found = place_profiles(profiles, poses, device(), box)
    assert 0 < len(found.cloud) < len(truth)
    assert sum(one.n_outside_volume for one in found.exposures) == len(truth) - len(found.cloud)
    with pytest.raises(EstimationError):
        place_profiles(profiles, poses, device(), Box(middle + 900.0, middle + 901.0))


def test_a_pose_that_hung_is_left_out() -> None:
    profiles, poses, _ = scan()
    lower = replace(profiles[5], points_mm=profiles[5].points_mm + np.array([0.0, 0.0, 3.0]))
    found = place_profiles([*profiles, lower], [*poses, poses[5]], device())
    assert [one.row.source for one in found.of(ExposureStatus.EQUAL_POSE)] == ["5.csv"]


def test_poses_that_do_not_pair_and_scanners_with_a_camera_are_refused() -> None:
    profiles, poses, _ = scan()
    with pytest.raises(InputError):
        place_profiles(profiles, poses[:-1], device())
    with pytest.raises(InputError):
        place_profiles(profiles, poses, rig.scanner())


def test_the_command_places_a_folder_of_profiles(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    profiles, poses, truth = scan()
    folder = tmp_path / "profiles"
    folder.mkdir()
    for k, profile in enumerate(profiles):
        rows = "\n".join(f"{x:.9f},{z:.9f}" for x, _, z in profile.points_mm.tolist())
        (folder / f"p{k}.csv").write_text(f"x_mm,z_mm\n{rows}\n", "utf-8")
    lines = []
    for pose in poses:
        angles = np.degrees(euler_from_rotations(pose.rotation[None], "extrinsic-xyz")[0])
        lines.append(" ".join(f"{value:.12f}" for value in (*pose.translation_mm, *angles)))
    (tmp_path / "poses.txt").write_text("\n".join(lines), "utf-8")
    (tmp_path / "scanner.json").write_bytes(scanner_document(device()))
    words = ["reconstruct", folder, "--poses", tmp_path / "poses.txt", "--scanner"]
    words += [tmp_path / "scanner.json", "-o", tmp_path / "cloud.ply", "--json"]
    assert main([str(word) for word in words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["n_points"] == len(truth)
    assert told["frame"] == "Base"
    cloud = read_ply(tmp_path / "cloud.ply")
    assert np.abs(cloud.points_mm - truth).max() < 6.0 * NOISE_MM
    assert (tmp_path / "cloud.html").is_file()
    words[-2] = tmp_path / "fused.ply"
    assert main([*map(str, words), "--voxel", "2"]) == 0
    fused = json.loads(capsys.readouterr().out)
    assert not any("share the stripe's noise" in text for text in told["warnings"])
    (warned,) = (text for text in fused["warnings"] if "share the stripe's noise" in text)
    assert "delivers profiles does not tell" in warned
    assert "share the stripe" in (tmp_path / "fused.html").read_text("utf-8")
