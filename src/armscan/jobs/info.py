# SPDX-License-Identifier: Apache-2.0
"""What files and folders are, and what is in them."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import ArmscanError, FileFormatError, listed
from armscan.geometry.arrays import IntArray
from armscan.geometry.least_squares import p_text
from armscan.geometry.rotations import vector_sigma
from armscan.models.calibration import (
    HAND_EYE_PARAMETER_NAMES,
    CameraCalibration,
    Provenance,
    SecondCamera,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.reconstruction.sync import exposure_poses, largest_gap_ns
from armscan.records.cloud import PointCloud, largest_eigenvalue
from armscan.records.points import ProbedPoints
from armscan.records.recording import LASER_UNKNOWN, NO_TRIGGER, ArmTrack, CameraSetup
from armscan.report.quantity import Summary, fact, plural, with_sigma
from armscan.storage.arm import ARM_FILE, ARM_MODEL_FILE, PROBE_FILE, read_arm_model, read_probe_tip
from armscan.storage.clouds import BY_SUFFIX, CloudFile, parse_ply, read_cloud_file, read_ply
from armscan.storage.codec import parse_json
from armscan.storage.documents import (
    REGISTRATION_SCHEMA,
    SCANNER_SCHEMA,
    STEREO_SCHEMA,
    read_calibration,
    read_camera_calibration,
    read_registration,
    read_scanner_calibration,
    read_stereo_calibration,
)
from armscan.storage.files import damaged_images, files_in, holds_files, is_file, read_bytes
from armscan.storage.formats.columns import COVARIANCE
from armscan.storage.formats.text import words_of
from armscan.storage.image_paths import expand_paths
from armscan.storage.images import image_format, read_exposure
from armscan.storage.observations import read_observations
from armscan.storage.parts.meshes import read_part
from armscan.storage.points import (
    SCAN_LINE,
    has_rotations,
    is_plane,
    read_marker_list,
    read_points_or_plane,
    read_profiles,
)
from armscan.storage.recording import FolderRecording, is_recording, read_arm_track, read_recording
from armscan.storage.recording_session import EXPOSURES_FILE, SESSION_FILE
from armscan.storage.recordings.robot_poses import read_robot_poses
from armscan.storage.tables import COORDINATES, reads_as_float


def describe_registration(path: Path) -> dict[str, Any]:
    """Scans, markers and evidence of ``registration.json``."""
    document = read_registration(path)
    return {
        "what": f"registration by markers ({document.kind}), {len(document.transforms)} scans in "
        f"the {document.common_frame} frame of {document.common_frame_of}",
        "scans": [one.name for one in document.transforms],
        "shared_markers": [one.n_markers for one in document.transforms],
        "rms_mm": [one.rms_mm for one in document.transforms],
        "moved_markers": [one.id for one in document.moved],
        "not_joined": [one.name for one in document.not_joined],
        "simulated": document.simulated,
        "created_utc": document.provenance.created_utc,
        "command": shlex.join(document.provenance.command),
    }


def describe_stereo(path: Path) -> dict[str, Any]:
    """Cameras, relative pose, evidence and origin of ``stereo.json``."""
    calibration = read_stereo_calibration(path)
    left, right = calibration.left.camera, calibration.right.camera
    pose = calibration.right_from_left
    angle = float(np.rad2deg(np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0))))
    known = calibration.diagnostics
    content: dict[str, Any] = {
        "what": f"stereo calibration, cameras {left.width_px} x {left.height_px} px and "
        f"{right.width_px} x {right.height_px} px",
        "baseline_mm": round(float(np.linalg.norm(pose.translation_mm)), 4),
        "angle_between_axes_deg": round(angle, 4),
        "translation_right_mm": [round(float(value), 4) for value in pose.translation_mm],
        "rms_px": calibration.rms_px,
        "pairs": calibration.n_pairs,
        "points": calibration.n_points,
    }
    for word, camera in (("left", left), ("right", right)):
        values = zip(PARAMETER_NAMES, camera.parameters, strict=True)
        told = (f"{name} {value:.6g}" for name, value in values if name in camera.parameter_names)
        content[word] = f"{camera.lens}, {', '.join(told)}"
    if known is not None:
        content["epipolar_rms_px"] = known.epipolar_rms_px
        content["epipolar_mean_px"] = known.epipolar_mean_px
        if known.hold_out_rms_px is not None:
            content["hold_out_rms_px"] = known.hold_out_rms_px
        content["intrinsics"] = known.intrinsics
        content["taken_apart"] = [name for name, _ in known.left_out]
    return content | _origin(calibration.provenance)


LISTED = 5
"""Damaged images told by name."""


def describe_recording(folder: Path) -> dict[str, Any]:
    """Count exposures and samples, and say what is odd or was assumed."""
    scan = read_recording(folder)
    times = [row.t_ns for row in scan.rows]
    lasers = sorted({name for row in scan.rows for name in row.lasers})
    n_unknown = sum(LASER_UNKNOWN in row.flags for row in scan.rows)
    damaged = damaged_images(folder)
    content: dict[str, Any] = {
        "what": f"recording ({scan.session.kind}), {len(scan.rows)} exposures"
        + (", damaged" if damaged else "")
        + (", simulated" if scan.is_simulated else ""),
        "kind": scan.session.kind,
        "simulated": scan.is_simulated,
        "exposures": len(scan.rows),
        # a row without a view is an arrangement of its own
        "views": len({row if row.view is None else row.view for row in scan.rows}),
        "seconds": round((max(times) - min(times)) / 1e9, 3),
        **_steps("exposure", np.unique(np.array(times, dtype=np.int64))),
        **({"lasers": lasers} if lasers else {}),
        **({"exposures_with_lasers_unknown": n_unknown} if n_unknown else {}),
        "cameras": [_camera_line(setup) for setup in scan.session.cameras],
    }
    if scan.session.is_stripe_band:
        content["pixels"] = "stripe band: zero away from what could be a stripe"
    if scan.arm is not None:
        content |= {"pose_form": scan.session.pose_form, "clock": scan.session.clock}
        content |= _track(scan.arm) | _poses(scan, scan.arm)
    return content | _notes(scan.session.assumed, (*_damage(damaged, folder), *scan.warnings))


def _damage(images: tuple[str, ...], path: Path) -> tuple[str, ...]:
    if not images:
        return ()
    return (
        f"the file is damaged: {plural(len(images), 'image')} cannot be read "
        f"({listed(images, LISTED)}): armscan recover {path} -o FOLDER",
    )


def describe_touches(folder: Path) -> dict[str, Any]:
    """Describe a folder of the arm's samples without images, as a probing is."""
    track, notes = read_arm_track(folder)
    tip = folder / "probe.toml"
    what = "touches of a probe" if is_file(tip) else "an arm's samples"
    content = {"what": f"{what}, {len(track)} samples", **_track(track)}
    if is_file(tip):
        content |= {key: value for key, value in describe_probe(tip).items() if key != "what"}
    return content | _notes((), notes)


def describe_scanner(path: Path) -> dict[str, Any]:
    """Values of the hand-eye with their uncertainty, what it rests on, and its origin."""
    calibration = read_scanner_calibration(path)
    hand_eye = calibration.hand_eye
    sensor = calibration.sensor
    second = None if sensor is None else sensor.second
    sheets = "no images" if sensor is None else f"{len(sensor.sheets)} light sheets"
    n, pose = len(HAND_EYE_PARAMETER_NAMES), hand_eye.tool_from_sensor
    covariance = calibration.covariance[-n:, -n:]
    turn_sigma = vector_sigma(pose.rotation_vector_rad, covariance[:3, :3])
    sigma = [*turn_sigma, *np.sqrt(np.diag(covariance)[3:])]
    values = [*pose.rotation_vector_rad, *pose.translation_mm]
    names = [name.replace("rotation_", "rotation_vector_") for name in HAND_EYE_PARAMETER_NAMES]
    known, timed = hand_eye.diagnostics, calibration.latency_sigma_ns
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
        **({} if timed is None else {"latency_sigma_ns": timed}),
        **_origin(calibration.provenance),
    }


def second_camera_facts(second: SecondCamera) -> dict[str, Any]:
    """The right camera of a stereo head, and how far and how turned it stands from the left."""
    camera, pose = second.camera.camera, second.right_from_sensor
    turn_deg = float(np.degrees(np.linalg.norm(pose.rotation_vector_rad)))
    return {
        "second_camera": f"{_size_of(camera)}, "
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
    """Count and extent of probed points, or a plane's four numbers."""
    points = read_points_or_plane(path)
    if not isinstance(points, ProbedPoints):
        return {"what": "plane A x + B y + C z + D = 0, in mm", "abcd": points.tolist()}
    kind = "centres of the tip" if points.are_tip_centres else "on the surface"
    return {
        "what": f"{len(points)} probed points, {kind}",
        "points": len(points),
        "tip_diameter_mm": points.tip_diameter_mm,
        "features": sorted(set(points.features)),
        **{f"{axis}_mm": limits for axis, limits in _ranges(points.points_mm.T).items()},
    }


def describe_markers(path: Path) -> dict[str, Any]:
    """Count, frame, certainty and extent of markers."""
    found = read_marker_list(path, frame="not named")
    markers = found.markers
    return {
        "what": plural(len(markers), "marker"),
        "frame": markers.frame,
        "simulated": found.is_simulated,
        "median_sigma_mm": float(np.sqrt(np.median(largest_eigenvalue(markers.covariance_mm2)))),
        **_ranges(markers.points_mm.T),
    }


def _ranges(axes: Iterable[NDArray[Any]]) -> dict[str, list[float]]:
    """Least and greatest of values (N,) along x, y and z; nothing of none."""
    return {
        f"{name}_range": [round(float(values.min()), 4), round(float(values.max()), 4)]
        for name, values in zip("xyz", axes, strict=True)
        if len(values)
    }


def _camera_line(setup: CameraSetup) -> str:
    window = setup.window
    place = f" at {window.x_px}, {window.y_px}" if window.x_px or window.y_px else ""
    return f"{setup.width_px} x {setup.height_px} px{place}, {setup.bits_used} bits, {setup.colour}"


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
    steps_ms = np.diff(t_ns) / 1e6
    return {
        f"{what}_median_period_ms": round(float(np.median(steps_ms)), 6),
        f"{what}_longest_step_ms": round(float(steps_ms.max()), 6),
    }


def _poses(scan: FolderRecording, track: ArmTrack) -> dict[str, Any]:
    """How many exposures have a pose, how it is found, and why the others have none."""
    limit_ns = largest_gap_ns(track)
    gaps = {
        "arm_gap_limit_ms": limit_ns / 1e6,
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


Facts = list[tuple[str, str]]


def _parent(path: Path) -> dict[str, Any]:
    """A table of a recording is described with its recording."""
    return _folder(path.parent)


DESCRIBE_NAMED: dict[str, Callable[[Path], dict[str, Any]]] = {
    ARM_MODEL_FILE: describe_arm,
    PROBE_FILE: describe_probe,
    SESSION_FILE: _parent,
    EXPOSURES_FILE: _parent,
    ARM_FILE: _parent,
}


def describe_files(names: Sequence[str]) -> Summary:
    """Describe files, folders and quoted patterns; of what cannot be read, say why.

    ``n_failed`` of the summary's data is how many could not be read; each has the key ``failed``.

    Raises
    ------
    FileFormatError
        If there is one file alone, and it is missing, damaged, or nothing that armscan knows.
    """
    found = [one for name in names for one in _described(name)]
    failed = [one for _, one in found if isinstance(one, Exception)]
    if len(found) == 1 and failed:
        raise failed[0]
    items = [(path, _facts_of(path, one)) for path, one in found]
    n_failed = len(failed)
    return Summary(
        title=plural(len(items), "item") + (f", {n_failed} not read" if n_failed else ""),
        quantities=tuple(
            fact(str(path), "\n".join(_line(key, value) for key, value in facts.items()))
            for path, facts in items
        ),
        extra={
            "kind": "info",
            "n_failed": n_failed,
            "items": [{"path": path.as_posix(), **facts} for path, facts in items],
        },
    )


def _described(name: str) -> list[tuple[Path, dict[str, Any] | ArmscanError | OSError]]:
    """What a name stands for: paths with their facts, or with why they cannot be read."""
    place = Path(name)
    try:
        paths = [place] if holds_files(place) else expand_paths([name])
    except (ArmscanError, OSError) as error:
        return [(place, error)]
    found: list[tuple[Path, dict[str, Any] | ArmscanError | OSError]] = []
    for path in paths:
        try:
            found.append((path, _folder(path) if holds_files(path) else _file(path)))
        except (ArmscanError, OSError) as error:
            found.append((path, error))
    return found


def _facts_of(path: Path, found: dict[str, Any] | ArmscanError | OSError) -> dict[str, Any]:
    if isinstance(found, dict):
        return found
    reason = found.strerror if isinstance(found, OSError) else str(found)
    return {"failed": str(reason or found).removeprefix(f"{path}: ")}


MOST_LISTED = 20
"""Names that are listed for a reader; --json lists all."""


def _line(key: str, value: Any) -> str:
    if key == "what":
        return str(value)
    if isinstance(value, list) and len(value) > MOST_LISTED and isinstance(value[0], str):
        return f"{key.replace('_', ' ')}: {len(value)}, {value[0]} to {value[-1]}"
    if value == []:
        return f"{key.replace('_', ' ')}: none"
    if isinstance(value, list):
        unit = " mm" if key.endswith("_range") else ""
        return f"{key.replace('_', ' ')}: " + ", ".join(str(item) for item in value) + unit
    if value is None:
        return f"{key.replace('_', ' ')}: not known"
    told = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{key.replace('_', ' ')}: {told}"


CLOUDS = tuple(suffix for suffix in BY_SUFFIX if suffix not in (".ply", ".csv", ".txt"))
"""Suffixes of files that are clouds; what the others hold tells it."""


def _file(path: Path) -> dict[str, Any]:
    data = read_bytes(path)
    if image_format(data):
        return _image(path)
    if data.startswith(b"ply"):
        return _ply(path, data)
    if data.startswith(b"PK"):
        return _observations(path)
    if path.suffix.lower() == ".stl":
        part = read_part(path)
        return {
            "what": f"model of a part, {plural(len(part.triangles), 'triangle')}, "
            f"{plural(len(part.vertices_mm), 'corner')}",
            **_ranges(part.vertices_mm.T),
        }
    if path.suffix.lower() in CLOUDS:
        return _cloud(read_cloud_file(path))
    return _text(path, data)


OWN_TABLES = {
    "image,x_px": "stripe points of images",
    "face,n": "faces of a part beside their model",
    "part,cloud": "parts inspected by a recipe",
}
POINT_COLUMNS = {*COORDINATES, *COVARIANCE, "id", "feature"}


def _table(path: Path, data: bytes) -> dict[str, Any]:
    """A table by its heading: one of armscan's own, poses, a profile, markers, points, a cloud."""
    lines = data[:10_000].decode("utf-8-sig", "replace").splitlines()
    heading = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    names = {name.strip().lower() for name in heading.split(",")}
    if own := OWN_TABLES.get(",".join(heading.split(",")[:2])):
        return {"what": f"table of {own}"}
    if any(name[:1] == "x" for name in names) and has_rotations(names):
        n_poses = len(read_robot_poses(path, "extrinsic-xyz"))
        return {"what": f"{plural(n_poses, 'pose')} of an arm, for --poses"}
    is_flat = {"x_mm", "z_mm"} <= names and "y_mm" not in names
    if is_flat or path.suffix.lower() in (".yml", ".yaml"):
        return _profile(path)
    if is_plane(data) or set(COORDINATES) <= names <= POINT_COLUMNS:
        return describe_markers(path) if _are_markers(path) else describe_points(path)
    content = _cloud(read_cloud_file(path))
    if len(words := words_of(heading)) == 6 and all(map(reads_as_float, words)):
        content["what"] += " (or poses of an arm: six numbers a line without names)"
    return content


def _profile(path: Path) -> dict[str, Any]:
    (profile,) = read_profiles([path])
    what = f"profile of a sensor, {plural(len(profile.points_mm), 'point')}"
    return {"what": what, "gaps": profile.n_gaps, **_ranges(profile.points_mm.T)}


def _are_markers(path: Path) -> bool:
    """Whether this is a list of numbered markers, with sigmas or a frame."""
    with suppress(ArmscanError):
        found = read_marker_list(path, frame="")
        return found.has_ids and (bool(found.markers.frame) or not found.is_sigma_assumed)
    return False


OWN_PAGE = b'<meta name="generator" content="armscan">'


def _text(path: Path, data: bytes) -> dict[str, Any]:
    stripped = data.lstrip(b"\xef\xbb\xbf \t\r\n")
    content = parse_json(data, str(path)) if stripped.startswith(b"{") else {}
    if "schema" in content:
        return DESCRIBE_SCHEMA.get(str(content["schema"]), _calibration)(path)
    if what := _by_product(path, data, content):
        return {"what": what}
    if path.name in DESCRIBE_NAMED:
        return DESCRIBE_NAMED[path.name](path)
    is_table = path.suffix.lower() == ".csv" or SCAN_LINE.search(data.decode("utf-8", "replace"))
    with suppress(*(() if is_table else (FileFormatError,))):
        if is_table or path.suffix.lower() == ".txt":
            return _table(path, data)
    if path.suffix.lower() in (".json", ".yaml", ".yml", ".xml"):
        return _camera(read_camera_calibration(path), "camera calibration of another program")
    raise FileFormatError(
        "armscan does not know this kind of file",
        where=str(path),
        remedy="give an image, a calibration, a cloud, probed points, a recording or a folder",
    )


def _by_product(path: Path, data: bytes, content: dict[str, Any]) -> str:
    """What a file is in which armscan looks for no facts; empty for others."""
    if {"kind", "simulated"} <= content.keys():
        return f"what `armscan` says with --json ({content['kind']})"
    if {"head", "preset", "seed", "simulated"} <= content.keys():
        return f"truth of a simulation ({content['head']})"
    for is_it, what in (
        (OWN_PAGE in data[:2000], "page of armscan; open it in a browser"),
        (path.name == "batch.json", "list of what was made of a folder of recordings"),
        (data.startswith(b"ISO-10303-21"), "STEP model of a part, for `armscan inspect cad`"),
        (path.name == "rig.toml", "devices of a rig, for `armscan record` and `console`"),
    ):
        if is_it:
            return what
    first = data[:1000].decode("utf-8", "replace").splitlines()[:5]
    if path.name == "files.txt" and all(is_file(path.parent / name) for name in first):
        return "list of the files that stand beside it"
    return ""


def _image(path: Path) -> dict[str, Any]:
    exposure = read_exposure(path)
    image = exposure.image
    saturated = float(np.mean(image.reshape(-1) >= exposure.full_scale))
    return {
        "what": f"image, {exposure.width_px} x {exposure.height_px} px, "
        f"{'grey' if exposure.colour == 'mono' else 'colour'}, {exposure.bits_used} bits",
        "width_px": exposure.width_px,
        "height_px": exposure.height_px,
        "colour": exposure.colour,
        "bits_used": exposure.bits_used,
        "mean_level": round(float(image.mean()), 2),
        "highest_level": int(image.max()),
        "saturated_fraction": round(saturated, 6),
    }


def _ply(path: Path, data: bytes) -> dict[str, Any]:
    vertices = parse_ply(data, str(path))
    fields = list(vertices.table.dtype.names or ())
    n, n_faces = len(vertices.table), vertices.n_faces
    what = f"mesh, {n} vertices and {n_faces} faces" if n_faces else f"point cloud, {n} points"
    content: dict[str, Any] = {"what": what}
    if own := "cov_xx_mm2" in fields:
        content |= _carried(read_ply(path))
    if {"x", "y", "z"} <= set(fields):
        content |= _ranges(vertices.table[axis] for axis in "xyz")
        content |= _notes((), () if own else read_cloud_file(path).doubts)
    content["properties"] = fields
    return content


def _cloud(found: CloudFile) -> dict[str, Any]:
    cloud = found.cloud
    return {
        "what": f"point cloud, {len(cloud)} points",
        **_carried(cloud),
        **_ranges(cloud.points_mm.T),
        **_notes((), (*found.remarks, *found.doubts)),
    }


def _carried(cloud: PointCloud) -> dict[str, Any]:
    return {
        "frame": cloud.frame,
        "simulated": cloud.is_simulated,
        **({"forced": list(cloud.forced)} if cloud.forced else {}),
        "sheets": list(cloud.sheet_names),
        "exposures": list(cloud.exposure_sources),
        "median_sigma_mm": float(np.median(cloud.sigma_mm)) if cloud.covariance_mm2.any() else None,
    }


def _observations(path: Path) -> dict[str, Any]:
    found = read_observations(path)
    if found.stripes:
        postures = {one.posture for one in found.stripes}
        return {
            "what": f"observations of a hand-eye: {len(found.stripes)} exposures with points and "
            f"the arm's pose, of {len(postures)} postures",
            "exposures": len(found.stripes),
            "postures": len(postures),
            "points": sum(len(one.points_mm) for one in found.stripes),
        }
    return {
        "what": f"observations of a calibration: {len(found.views)} target views, "
        f"{len(found.profiles)} stripe images",
        "target_points": sum(len(view) for view in found.views),
        "stripe_points": sum(len(profile) for profile in found.profiles),
    }


def _calibration(path: Path) -> dict[str, Any]:
    document = read_calibration(path)
    if isinstance(document, CameraCalibration):
        return _camera(document, "camera calibration")
    return _sensor(document)


DESCRIBE_SCHEMA: dict[str, Callable[[Path], dict[str, Any]]] = {
    SCANNER_SCHEMA: describe_scanner,
    STEREO_SCHEMA: describe_stereo,
    REGISTRATION_SCHEMA: describe_registration,
}


def _camera(calibration: CameraCalibration, what: str) -> dict[str, Any]:
    camera = calibration.camera
    sigma = np.sqrt(np.diag(calibration.covariance))
    values = {
        name: with_sigma(value, spread if calibration.has_covariance else 0.0)
        for name, value, spread in zip(PARAMETER_NAMES, camera.parameters, sigma, strict=True)
        if name in camera.parameter_names
    }
    return {
        "what": f"{what}, {camera.width_px} x {camera.height_px} px",
        **({} if camera.lens == "pinhole" else {"lens": camera.lens}),
        **values,
        **_evidence(calibration),
    }


def _evidence(calibration: CameraCalibration) -> dict[str, Any]:
    if not calibration.has_covariance:
        return {"uncertainty": "none given"}
    known = calibration.diagnostics
    hold_out = None if known is None else known.hold_out_rms_px
    return {
        "rms_px": calibration.rms_px,
        **({} if hold_out is None else {"hold_out_rms_px": hold_out}),
        "views": calibration.n_views,
        "points": calibration.n_points,
        **_origin(calibration.provenance),
    }


def _size_of(camera: CameraModel) -> str:
    lens = " with a fisheye lens" if camera.lens == "fisheye" else ""
    return f"{camera.width_px} x {camera.height_px} px{lens}"


def _sensor(calibration: SensorCalibration) -> dict[str, Any]:
    camera = calibration.camera.camera
    sheets = [_sheet_line(sheet) for sheet in calibration.sheets]
    unseen = calibration.lasers_without_sheet
    return {
        "what": f"sensor calibration, {len(sheets)} light sheets, camera {_size_of(camera)}",
        "sheets": sheets,
        **({"lasers_without_sheet": list(unseen)} if unseen else {}),
        **({} if calibration.second is None else second_camera_facts(calibration.second)),
        **_origin(calibration.provenance),
    }


def _sheet_line(sheet: SheetCalibration) -> str:
    low, high = sheet.depth_range_mm
    known = sheet.diagnostics
    fit = f", lack of fit {p_text(known.final_test.p_value)}" if known else ""
    return (
        f"{sheet.name} (rms {sheet.rms_mm:.4f} mm, Z {low:.1f} to {high:.1f} mm, "
        f"{sheet.n_boards} boards{fit})"
    )


def _origin(provenance: Provenance) -> dict[str, Any]:
    return {
        "id": provenance.document_id,
        "written": f"{provenance.created_utc} by armscan {provenance.armscan_version}",
        "from": f"{len(provenance.inputs)} files",
        **({"forced": list(provenance.forced)} if provenance.forced else {}),
    }


def _folder(path: Path) -> dict[str, Any]:
    if is_recording(path):
        return describe_recording(path)
    if is_file(path / ARM_FILE):
        return describe_touches(path)
    items = sorted(item for item in files_in(path) if not item.name.startswith("."))
    if not items:
        raise FileFormatError("the folder is empty", where=str(path), remedy="name another folder")
    kinds = Counter(item.suffix.lower() or "other" for item in items if is_file(item))
    n_folders = sum(item.is_dir() for item in items)
    return {
        "what": f"folder with {sum(kinds.values())} files and {n_folders} folders",
        **{f"files_{kind.lstrip('.')}": count for kind, count in sorted(kinds.items())},
    }
