# SPDX-License-Identifier: Apache-2.0
"""What a file or folder is, in a few lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError
from armscan.models.calibration import (
    CameraCalibration,
    Provenance,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.camera import PARAMETER_NAMES
from armscan.report.numbers import with_sigma
from armscan.report.registration_info import describe_registration
from armscan.report.scan_info import (
    describe_arm,
    describe_points,
    describe_probe,
    describe_recording,
    describe_scanner,
    describe_touches,
    second_camera_facts,
)
from armscan.report.stereo_info import describe_stereo
from armscan.report.summary import Summary
from armscan.storage.arm_files import ARM_MODEL_FILE
from armscan.storage.calibration_files import (
    read_calibration,
    read_camera_calibration,
)
from armscan.storage.calibration_schema import (
    REGISTRATION_SCHEMA,
    SCANNER_SCHEMA,
    STEREO_SCHEMA,
)
from armscan.storage.clouds import read_ply
from armscan.storage.image_format import image_format
from armscan.storage.image_paths import expand_paths
from armscan.storage.images import read_bytes, read_exposure
from armscan.storage.json_text import parse_json
from armscan.storage.observations import read_observations
from armscan.storage.ply_format import parse_ply
from armscan.storage.probe_files import PROBE_FILE
from armscan.storage.recording_arm import ARM_FILE
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_reader import is_recording
from armscan.storage.recording_session import SESSION_FILE
from armscan.storage.registration_files import read_registration
from armscan.storage.scanner_files import read_scanner_calibration
from armscan.storage.stereo_files import read_stereo_calibration

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
    """Describe files, folders and quoted patterns.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged, or nothing that armscan knows.
    """
    facts: Facts = []
    data: list[dict[str, Any]] = []
    for name in names:
        paths = [Path(name)] if Path(name).is_dir() else expand_paths([name])
        for path in paths:
            described = _folder(path) if path.is_dir() else _file(path)
            facts += [(str(path), "\n".join(_line(key, value) for key, value in described.items()))]
            data.append({"path": path.as_posix(), **described})
    count = f"{len(data)} item" + ("s" if len(data) != 1 else "")
    return Summary(title=count, facts=tuple(facts), data={"kind": "info", "items": data})


def _line(key: str, value: Any) -> str:
    if key == "what":
        return str(value)
    if isinstance(value, list):
        return f"{key.replace('_', ' ')}: " + ", ".join(str(item) for item in value)
    return f"{key.replace('_', ' ')}: {f'{value:.6g}' if isinstance(value, float) else value}"


def _file(path: Path) -> dict[str, Any]:
    data = read_bytes(path)
    if image_format(data):
        return _image(path)
    if data.startswith(b"ply"):
        return _ply(path, data)
    if data.startswith(b"PK"):
        return _observations(path)
    return _text(path, data)


def _text(path: Path, data: bytes) -> dict[str, Any]:
    stripped = data.lstrip(b"\xef\xbb\xbf \t\r\n")
    if stripped.startswith(b"{") and "schema" in (content := parse_json(data, str(path))):
        return DESCRIBE_SCHEMA.get(content["schema"], _calibration)(path)
    if path.name in DESCRIBE_NAMED:
        return DESCRIBE_NAMED[path.name](path)
    if path.suffix.lower() == ".csv":
        return describe_points(path)
    if path.suffix.lower() in (".json", ".yaml", ".yml", ".xml"):
        return _camera(read_camera_calibration(path), "camera calibration of another program")
    raise FileFormatError(
        "armscan does not know this kind of file",
        where=str(path),
        remedy="give an image, a calibration, a PLY cloud, probed points or a folder",
    )


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
    content: dict[str, Any] = {"what": f"point cloud, {len(vertices.table)} points"}
    if "cov_xx_mm2" in fields:
        cloud = read_ply(path)
        content["frame"] = cloud.frame
        content["simulated"] = cloud.is_simulated
        content |= {"forced": list(cloud.forced)} if cloud.forced else {}
        content["sheets"] = list(cloud.sheet_names)
        content["exposures"] = list(cloud.exposure_sources)
        content["median_sigma_mm"] = float(np.median(cloud.sigma_mm)) if len(cloud) else 0.0
    if len(vertices.table) and {"x", "y", "z"} <= set(fields):
        for axis in "xyz":
            values = vertices.table[axis]
            content[f"{axis}_range"] = [
                round(float(values.min()), 4),
                round(float(values.max()), 4),
            ]
    content["properties"] = fields
    return content


def _observations(path: Path) -> dict[str, Any]:
    found = read_observations(path)
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


def _scanner(path: Path) -> dict[str, Any]:
    document = read_scanner_calibration(path)
    return {**describe_scanner(document), **_origin(document.provenance)}


def _stereo(path: Path) -> dict[str, Any]:
    document = read_stereo_calibration(path)
    return {**describe_stereo(document), **_origin(document.provenance)}


def _registration(path: Path) -> dict[str, Any]:
    return describe_registration(read_registration(path))


DESCRIBE_SCHEMA: dict[str, Callable[[Path], dict[str, Any]]] = {
    SCANNER_SCHEMA: _scanner,
    STEREO_SCHEMA: _stereo,
    REGISTRATION_SCHEMA: _registration,
}


def _camera(calibration: CameraCalibration, what: str) -> dict[str, Any]:
    camera = calibration.camera
    sigma = np.sqrt(np.diag(calibration.covariance))
    values = {
        name: with_sigma(value, spread if calibration.has_covariance else 0.0)
        for name, value, spread in zip(PARAMETER_NAMES, camera.parameters, sigma, strict=True)
    }
    return {
        "what": f"{what}, {camera.width_px} x {camera.height_px} px",
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


def _sensor(calibration: SensorCalibration) -> dict[str, Any]:
    camera = calibration.camera.camera
    sheets = [_sheet_line(sheet) for sheet in calibration.sheets]
    return {
        "what": f"sensor calibration, {len(sheets)} light sheets, camera "
        f"{camera.width_px} x {camera.height_px} px",
        "sheets": sheets,
        **({} if calibration.second is None else second_camera_facts(calibration.second)),
        **_origin(calibration.provenance),
    }


def _sheet_line(sheet: SheetCalibration) -> str:
    low, high = sheet.depth_range_mm
    known = sheet.diagnostics
    fit = f", lack of fit p = {known.final_test.p_value:.2g}" if known else ""
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
    if (path / ARM_FILE).is_file():
        return describe_touches(path)
    items = sorted(item for item in path.iterdir() if not item.name.startswith("."))
    if not items:
        raise FileFormatError("the folder is empty", where=str(path), remedy="name another folder")
    kinds = Counter(item.suffix.lower() or "other" for item in items if item.is_file())
    n_folders = sum(item.is_dir() for item in items)
    content: dict[str, Any] = {
        "what": f"folder with {sum(kinds.values())} files and {n_folders} folders"
    }
    for kind, count in sorted(kinds.items()):
        content[f"files_{kind.lstrip('.')}"] = count
    return content
