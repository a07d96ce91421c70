# SPDX-License-Identifier: Apache-2.0
"""What a recording, a scanner, an arm or probed points are, in a few lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import ArmscanError
from armscan.geometry.arrays import IntArray
from armscan.models.calibration import SecondCamera
from armscan.models.scanner import HAND_EYE_PARAMETER_NAMES, ScannerCalibration
from armscan.reconstruction.sync import SyncOptions, exposure_poses, largest_gap_ns
from armscan.records.arm_track import NO_TRIGGER, ArmTrack
from armscan.records.session import CameraSetup
from armscan.report.numbers import with_sigma
from armscan.storage.arm_files import read_arm_model
from armscan.storage.probe_files import read_probe_tip
from armscan.storage.probed_points import read_probed_points
from armscan.storage.recording_reader import FolderRecording, read_arm_track, read_recording

NS_PER_S = 1e9
NS_PER_MS = 1e6


def describe_recording(folder: Path) -> dict[str, Any]:
    """Count exposures and samples, and say what is odd or was assumed."""
    scan = read_recording(folder)
    times = [row.t_ns for row in scan.rows]
    lasers = sorted({name for row in scan.rows for name in row.lasers})
    content: dict[str, Any] = {
        "what": f"recording ({scan.session.kind}), {len(scan.rows)} exposures"
        + (", simulated" if scan.is_simulated else ""),
        "kind": scan.session.kind,
        "simulated": scan.is_simulated,
        "exposures": len(scan.rows),
        "views": _n_views(scan),
        "seconds": round((max(times) - min(times)) / NS_PER_S, 3),
        **_steps("exposure", np.unique(np.array(times, dtype=np.int64))),
        **({"lasers": lasers} if lasers else {}),
        "cameras": [_camera_line(setup) for setup in scan.session.cameras],
    }
    if scan.arm is not None:
        content |= {"pose_form": scan.session.pose_form, "clock": scan.session.clock}
        content |= _track(scan.arm) | _poses(scan, scan.arm)
    return content | _notes(scan.session.assumed, scan.warnings)


def describe_touches(folder: Path) -> dict[str, Any]:
    """Describe a folder of the arm's samples without images, as a probing is."""
    track, notes = read_arm_track(folder)
    tip = folder / "probe.toml"
    what = "touches of a probe" if tip.is_file() else "an arm's samples"
    content = {"what": f"{what}, {len(track)} samples", **_track(track)}
    if tip.is_file():
        content |= {key: value for key, value in describe_probe(tip).items() if key != "what"}
    return content | _notes((), notes)


def describe_scanner(calibration: ScannerCalibration) -> dict[str, Any]:
    """Values of the hand-eye with their uncertainty, and what it rests on."""
    hand_eye = calibration.hand_eye
    sensor = calibration.sensor
    second = None if sensor is None else sensor.second
    sheets = "no images" if sensor is None else f"{len(sensor.sheets)} light sheets"
    sigma = np.sqrt(np.diag(hand_eye.covariance))
    pose = hand_eye.tool_from_sensor
    values = [*pose.rotation_vector_rad, *pose.translation_mm]
    names = [name.replace("rotation_", "rotation_vector_") for name in HAND_EYE_PARAMETER_NAMES]
    known = hand_eye.diagnostics
    return {
        "what": f"scanner calibration, {sheets}",
        **({} if second is None else second_camera_facts(second)),
        **{
            name: with_sigma(float(value), float(spread))
            for name, value, spread in zip(names, values, sigma, strict=True)
        },
        "rms_mm": hand_eye.rms_mm,
        "postures": hand_eye.n_postures,
        "points": hand_eye.n_points,
        **({} if known is None else {"method": known.method, "condition": known.condition}),
        "latency_ns": calibration.latency_ns,
    }


def second_camera_facts(second: SecondCamera) -> dict[str, Any]:
    """The right camera of a stereo head, and how far and how turned it stands from the left."""
    camera, pose = second.camera.camera, second.right_from_sensor
    turn_deg = float(np.degrees(np.linalg.norm(pose.rotation_vector_rad)))
    return {
        "second_camera": f"{camera.width_px} x {camera.height_px} px, "
        f"fx {camera.fx_px:.2f} px, turned by {turn_deg:.3f} deg",
        "baseline_mm": round(float(np.linalg.norm(pose.translation_mm)), 4),
    }


def describe_arm(path: Path) -> dict[str, Any]:
    """Name and size of an arm."""
    arm = read_arm_model(path)
    reach = float(np.abs(arm.offset_mm).sum() + np.abs(arm.length_mm).sum())
    return {
        "what": f"arm '{arm.name}', {arm.n_axes} joints",
        "joints": arm.n_axes,
        "longest_reach_mm": round(reach, 3),
    }


def describe_probe(path: Path) -> dict[str, Any]:
    """Size and place of a probe's tip."""
    tip = read_probe_tip(path)
    return {
        "what": f"probe, tip of {tip.diameter_mm:g} mm",
        "tip_diameter_mm": tip.diameter_mm,
        "centre_tool_mm": [round(float(value), 4) for value in tip.centre_tool_mm],
    }


def describe_points(path: Path) -> dict[str, Any]:
    """Count and extent of probed points."""
    points = read_probed_points(path)
    kind = "centres of the tip" if points.are_tip_centres else "on the surface"
    low, high = points.points_mm.min(axis=0), points.points_mm.max(axis=0)
    return {
        "what": f"{len(points)} probed points, {kind}",
        "points": len(points),
        "tip_diameter_mm": points.tip_diameter_mm,
        "features": sorted(set(points.features)),
        **{
            f"{axis}_range_mm": [round(float(low[k]), 4), round(float(high[k]), 4)]
            for k, axis in enumerate("xyz")
        },
    }


def _camera_line(setup: CameraSetup) -> str:
    window = setup.window
    place = f" at {window.x_px}, {window.y_px}" if window.x_px or window.y_px else ""
    return f"{setup.width_px} x {setup.height_px} px{place}, {setup.bits_used} bits, {setup.colour}"


def _n_views(scan: FolderRecording) -> int:
    """Arrangements that were seen: a row without a view is one of its own."""
    named = {row.view for row in scan.rows if row.view is not None}
    return len(named) + sum(row.view is None for row in scan.rows)


def _track(track: ArmTrack) -> dict[str, Any]:
    known = track.translations_mm[track.is_known]
    content: dict[str, Any] = {
        "arm_samples": len(track),
        "arm_samples_without_pose": int((~track.is_known).sum()),
        **_steps("arm", track.t_ns),
        "has_joints": track.joints_rad is not None,
        "has_triggers": track.trigger_ids is not None
        and bool((track.trigger_ids != NO_TRIGGER).any()),
    }
    if len(known):
        extent = np.linalg.norm(known.max(axis=0) - known.min(axis=0))
        content["arm_extent_mm"] = round(float(extent), 3)
    return content


def _steps(what: str, t_ns: IntArray) -> dict[str, float]:
    """Median and longest step between times; nothing for a single one."""
    if len(t_ns) < 2:
        return {}
    steps_ms = np.diff(t_ns) / NS_PER_MS
    return {
        f"{what}_median_period_ms": round(float(np.median(steps_ms)), 6),
        f"{what}_longest_step_ms": round(float(steps_ms.max()), 6),
    }


def _poses(scan: FolderRecording, track: ArmTrack) -> dict[str, Any]:
    """How many exposures have a pose, how it is found, and why the others have none."""
    limit_ns = largest_gap_ns(track, SyncOptions())
    gaps = {
        "arm_gap_limit_ms": limit_ns / NS_PER_MS,
        "arm_steps_above_gap_limit": int((np.diff(track.t_ns) > limit_ns).sum()),
    }
    try:
        poses = exposure_poses(scan.rows, track, scan.session.clock)
    except ArmscanError as error:
        return {**gaps, "exposures_with_pose": 0, "exposures_without_pose": error.what}
    return {
        **gaps,
        "exposures_with_pose": int(poses.has_pose.sum()),
        "poses_found": poses.how,
        **({"exposures_without_pose": poses.missing} if poses.missing else {}),
        **({"poses_doubtful": list(poses.warnings)} if poses.warnings else {}),
    }


def _notes(assumed: tuple[str, ...], warnings: tuple[str, ...]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    if assumed:
        content["assumed"] = list(assumed)
    if warnings:
        content["warnings"] = list(warnings)
    return content
