# SPDX-License-Identifier: Apache-2.0
"""Calibration documents: ``camera.json``, ``sensor.json``, ``stereo.json``, ``scanner.json`` and
``registration.json``; exact, written once, with a SHA-256 of their content.

The keys are the fields of the classes in `armscan.models`; `LAYOUTS` says what stands otherwise.
A new field with a default is read from older documents without further ado.
"""

from __future__ import annotations

import json
import math
from ast import literal_eval
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args
from uuid import uuid4

import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.registration import REGISTRATION_PARAMETERS
from armscan.geometry.shapes import Plane
from armscan.models.calibration import (
    HAND_EYE_PARAMETER_NAMES,
    ArmNoise,
    CameraCalibration,
    CameraDiagnostics,
    FTest,
    HandEyeCalibration,
    HandEyeDiagnostics,
    InputFile,
    LaserColour,
    Provenance,
    ScannerCalibration,
    SecondCamera,
    SensorCalibration,
    SensorDiagnostics,
    SheetCalibration,
    SheetDiagnostics,
)
from armscan.models.camera import PARAMETER_NAMES, CameraModel, Lens
from armscan.models.light_sheet import BOW_TERMS, LightSheet
from armscan.models.two_views import (
    STEREO_PARAMETER_NAMES,
    StereoCalibration,
    StereoDiagnostics,
)
from armscan.storage.codec import (
    FieldCodec,
    Layout,
    MismatchError,
    RecordCodec,
    is_json,
    json_bytes,
    matrix_tree,
    named,
    parse_json,
    read_matrix,
)
from armscan.storage.files import path_text, read_bytes, sha256_of
from armscan.storage.foreign import parse_foreign_camera
from armscan.storage.tables import LARGEST_MM

T = TypeVar("T")

SCHEMA_VERSION = 1
CAMERA_SCHEMA = "armscan/camera-calibration"
SENSOR_SCHEMA = "armscan/sensor-calibration"
SCANNER_SCHEMA = "armscan/scanner-calibration"
STEREO_SCHEMA = "armscan/stereo-calibration"
REGISTRATION_SCHEMA = "armscan/registration"
KINDS = {
    CAMERA_SCHEMA: ("camera calibration", "calibrate camera"),
    SENSOR_SCHEMA: ("sensor calibration", "calibrate laser"),
    SCANNER_SCHEMA: ("scanner calibration", "calibrate hand-eye"),
    STEREO_SCHEMA: ("stereo calibration", "calibrate stereo"),
    REGISTRATION_SCHEMA: ("registration", "register"),
}
"""What a document is, and the command that writes it."""
ENVELOPE = ("schema", "schema_version", "observations", "sha256")
BOW_KEYS = tuple(f"u{i}_v{j}" for i, j in BOW_TERMS)
REGION_KEYS = ("x_min_px", "y_min_px", "x_max_px", "y_max_px")
COUPLING_NAMES = ("row_names", "column_names")
LARGEST_LATENCY_NS = 10**12


@dataclass(frozen=True, slots=True, eq=False)
class ScanTransform:
    """Where one scan lies in the common frame, and how well its markers fit.

    Parameters
    ----------
    name, markers, own_frame
        Of the scan, of its list of markers, and of the frame of both.
    rotation_rows, translation_mm
        (3, 3) and (3,): from the scan's own frame to the common one.
    covariance
        (6, 6) of `REGISTRATION_PARAMETERS`.
    n_markers, rms_mm
        Markers in common, and how far they are apart; NaN where that is not known.
    cloud
        File of the moved cloud, or None.
    """

    name: str
    markers: str
    own_frame: str
    rotation_rows: FloatArray
    translation_mm: FloatArray
    covariance: FloatArray
    n_markers: int
    rms_mm: float
    cloud: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MarkerResidual:
    """One marker of one scan against where it is in the common frame."""

    name: str
    id: int
    common_id: int
    residual_mm: FloatArray
    is_used: bool


@dataclass(frozen=True, slots=True, eq=False)
class MovedMarker:
    """A marker that is not where the others say: its numbers and by how much, common frame."""

    id: int
    common_id: int
    offset_mm: FloatArray


@dataclass(frozen=True, slots=True)
class ScanNotJoined:
    """A scan that could not be joined."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """``registration.json``: how scans were joined by markers.

    Parameters
    ----------
    kind, simulated
        What was joined, and whether of rendered images.
    common_frame, common_frame_of
        Frame of the results, and the list of markers that defines it.
    transforms, residuals, moved, not_joined
        Scans that were joined, their markers, markers that moved, and scans that could not be.
    chi2, degrees_of_freedom
        Squared residuals in units of their covariances.
    """

    kind: Literal["views", "moved arm"]
    simulated: bool
    common_frame: str
    common_frame_of: str
    transforms: tuple[ScanTransform, ...]
    residuals: tuple[MarkerResidual, ...]
    moved: tuple[MovedMarker, ...]
    not_joined: tuple[ScanNotJoined, ...]
    chi2: float
    degrees_of_freedom: int
    provenance: Provenance


def _texts(content: Any, key: str) -> tuple[tuple[str, str], ...]:
    if not isinstance(content, dict) or not all(isinstance(text, str) for text in content.values()):
        raise MismatchError(key, "is no table of texts")
    return tuple(content.items())


def _left_out(content: Any, key: str) -> tuple[tuple[str, str], ...]:
    if not isinstance(content, list):
        raise MismatchError(key, "is no list")
    pairs = [dict(_texts(item, f"{key}.{k}")) for k, item in enumerate(content)]
    if any(pair.keys() != {"images", "reason"} for pair in pairs):
        raise MismatchError(key, "needs images and reason of each entry")
    return tuple((pair["images"], pair["reason"]) for pair in pairs)


def _sensor_tree(sensor: SensorCalibration) -> dict[str, Any]:
    head = {"schema": SENSOR_SCHEMA, "schema_version": SCHEMA_VERSION, "observations": None}
    return head | CODEC.write(sensor)


def _sensor_of_tree(content: Any, key: str) -> SensorCalibration:
    if not isinstance(content, dict) or content.get("schema") != SENSOR_SCHEMA:
        raise MismatchError(key, "is no sensor's document")
    inner = {name: value for name, value in content.items() if name not in ENVELOPE}
    return CODEC.read(SensorCalibration, inner, key)


def _fault_of_camera(camera: CameraCalibration) -> str:
    x_min, y_min, x_max, y_max = camera.covered_px
    has_name = np.isin(PARAMETER_NAMES, camera.camera.parameter_names)
    if np.any(camera.covariance[~has_name] != 0.0):
        return "has a fisheye lens and a covariance of tangential distortion, which that has not"
    return "" if x_min <= x_max and y_min <= y_max else "has a valid region that is turned round"


def _fault_of_sheet(sheet: SheetCalibration) -> str:
    low, high = sheet.depth_range_mm
    if not sheet.name:
        return "has no name"
    return "" if low <= high else "has depths that are turned round"


def _fault_of_plane(plane: Plane) -> str:
    is_triad = float(np.abs(plane.axes @ plane.axes.T - np.eye(3)).max()) <= 1e-6
    return "" if is_triad else "has axes that are not unit vectors at right angles"


def _fault_of_colour(sensor: SensorCalibration) -> str:
    colours = get_args(LaserColour)
    return "" if sensor.laser_colour in colours else f"has a laser_colour not of {colours}"


LENS_TEXTS: Mapping[Lens, str] = {
    "pinhole": "pinhole k1 k2 p1 p2 k3",
    "fisheye": "fisheye k1 k2 k3",
}


def _lens(text: Any, key: str) -> Lens:
    named = {shown: lens for lens, shown in LENS_TEXTS.items()}
    if not isinstance(text, str) or text not in named:
        raise MismatchError(key, f"is none of {', '.join(map(repr, named))}")
    return named[text]


EVIDENCE = Layout(is_evidence=True)
LAYOUTS: Mapping[type, Layout] = {
    CameraModel: Layout(
        keys={"lens": "model"},
        codecs={"lens": FieldCodec(LENS_TEXTS.__getitem__, _lens)},
        required=("lens",),
        spread={"distortion": PARAMETER_NAMES[4:]},
        constants={"pixel_origin": "centre of the top-left pixel"},
    ),
    CameraCalibration: Layout(
        keys={"camera": "intrinsics", "covered_px": "valid_region"},
        codecs={"covered_px": named(*REGION_KEYS)},
        given=("provenance",),
        covariance_names=lambda _: PARAMETER_NAMES,
        check=_fault_of_camera,
    ),
    LightSheet: Layout(
        keys={"origin_mm": "origin_sensor_mm"},
        codecs={
            "axes": named("u_sensor", "v_sensor", "normal_sensor"),
            "bow_mm": named(*BOW_KEYS),
            "fan": named("lean", "spread"),
        },
        optional=("fan",),
    ),
    SheetCalibration: Layout(
        flat=("sheet",),
        optional=("shape_mm",),
        spread={"depth_range_mm": ("depth_min_sensor_mm", "depth_max_sensor_mm")},
        check=_fault_of_sheet,
    ),
    SecondCamera: Layout(lends={"camera": "camera_provenance"}),
    SensorCalibration: Layout(
        lends={"camera": "camera_provenance"},
        optional=("second", "laser_colour", "lasers_without_sheet"),
        covariance_names=lambda sensor: sensor.parameter_names,
        check=_fault_of_colour,
    ),
    StereoCalibration: Layout(
        keys={"right_from_left": "right_from_sensor"},
        lends={"left": "provenance", "right": "provenance"},
        covariance_names=lambda _: STEREO_PARAMETER_NAMES,
    ),
    StereoDiagnostics: Layout(
        codecs={
            "left_out": FieldCodec(
                lambda pairs: [{"images": name, "reason": why} for name, why in pairs], _left_out
            )
        },
        is_evidence=True,
    ),
    HandEyeCalibration: Layout(
        keys={"dhand_eye_dsensor": "sensor_coupling"},
        codecs={
            "dhand_eye_dsensor": FieldCodec(
                lambda matrix: matrix_tree(
                    matrix, row_names=HAND_EYE_PARAMETER_NAMES, column_names=()
                ),
                lambda content, key: read_matrix(content, key, *COUPLING_NAMES),
            )
        },
        covariance_names=lambda _: HAND_EYE_PARAMETER_NAMES,
    ),
    ScannerCalibration: Layout(
        codecs={"sensor": FieldCodec(_sensor_tree, _sensor_of_tree)},
        limits={
            "latency_ns": (-LARGEST_LATENCY_NS, LARGEST_LATENCY_NS),
            "latency_sigma_ns": (0.0, LARGEST_LATENCY_NS),
        },
        optional=("latency_sigma_ns",),
    ),
    Plane: Layout(
        keys={"point_mm": "point_base_mm"},
        spread={"axes": ("along_base", "across_base", "normal_base")},
        check=_fault_of_plane,
    ),
    ArmNoise: Layout(
        limits=dict.fromkeys(ArmNoise.__dataclass_fields__, (0.0, LARGEST_MM)),
        optional=("tool_rotation_rad", "exposure_tool_rotation_rad"),
    ),
    CameraDiagnostics: EVIDENCE,
    SheetDiagnostics: EVIDENCE,
    SensorDiagnostics: EVIDENCE,
    HandEyeDiagnostics: Layout(is_evidence=True, optional=("region_factor", "is_arm_given")),
    FTest: EVIDENCE,
    ScanTransform: Layout(covariance_names=lambda _: REGISTRATION_PARAMETERS),
    Provenance: Layout(
        codecs={"options": FieldCodec(dict, _texts)}, optional=("forced", "is_simulated")
    ),
}
CODEC = RecordCodec(LAYOUTS)


Observations = tuple[str, bytes] | None
"""Name and content of the file of observations beside a document."""


def camera_document(calibration: CameraCalibration, observations: Observations = None) -> bytes:
    """Text of ``camera.json``."""
    tree = {
        "camera": CODEC.write(calibration),
        "provenance": CODEC.write(calibration.provenance),
    }
    return _text(CAMERA_SCHEMA, tree, observations)


def sensor_document(calibration: SensorCalibration, observations: Observations = None) -> bytes:
    """Text of ``sensor.json``."""
    return _text(SENSOR_SCHEMA, CODEC.write(calibration), observations)


def stereo_document(calibration: StereoCalibration, observations: Observations = None) -> bytes:
    """Text of ``stereo.json``."""
    return _text(STEREO_SCHEMA, CODEC.write(calibration), observations)


def scanner_document(calibration: ScannerCalibration, observations: Observations = None) -> bytes:
    """Text of ``scanner.json``.

    Raises
    ------
    InputError
        If the hand-eye depends on a sensor that is not given.
    """
    tree = CODEC.write(calibration)
    coupling, sensor = calibration.hand_eye.dhand_eye_dsensor, calibration.sensor
    if coupling is not None:
        if sensor is None:
            raise InputError("the hand-eye depends on a sensor's parameters that have no names")
        tree["hand_eye"]["sensor_coupling"]["column_names"] = list(sensor.parameter_names)
    return _text(SCANNER_SCHEMA, tree, observations)


def registration_document(registration: Registration) -> bytes:
    """Text of ``registration.json``."""
    return _text(REGISTRATION_SCHEMA, CODEC.write(registration))


def _text(schema: str, tree: dict[str, Any], observations: Observations = None) -> bytes:
    content: dict[str, Any] = {"schema": schema, "schema_version": SCHEMA_VERSION, **tree}
    if schema != REGISTRATION_SCHEMA:
        content["observations"] = None
    if observations is not None:
        name, data = observations
        content["observations"] = {"file": name, "sha256": sha256(data).hexdigest()}
    return json_bytes(content | {"sha256": content_hash(content)})


def content_hash(content: Mapping[str, Any]) -> str:
    """SHA-256 of what a document says, without its own key ``sha256``.

    It is that of the compact JSON text with sorted keys, so that blanks and line ends do not count.
    """
    rest = {key: value for key, value in content.items() if key != "sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return sha256(text.encode()).hexdigest()


def document_schema(path: Path) -> str | None:
    """Name of the schema that a document says it has; None for a file without one."""
    data = read_bytes(path)
    found = parse_json(data, path_text(path)).get("schema") if is_json(data) else None
    return found if isinstance(found, str) else None


def observations_named(path: Path) -> Path | None:
    """Where a document's file of observations should be; None if it names none."""
    entry = _observations_entry(path)
    return None if entry is None else _beside(path, entry)


def _observations_entry(path: Path) -> dict[str, Any] | None:
    entry = parse_json(read_bytes(path), path_text(path)).get("observations")
    return entry if isinstance(entry, dict) else None


def _beside(path: Path, entry: dict[str, Any]) -> Path:
    return path.parent / Path(str(entry.get("file"))).name


def observations_of(path: Path) -> Path:
    """The file of observations beside a document, as the document says it was written."""
    entry = _observations_entry(path)
    if entry is None:
        raise FileFormatError(
            "the document names no observations from which it could be solved again",
            where=path_text(path),
            remedy="calibrate again from the images",
        )
    beside = _beside(path, entry)
    if sha256(read_bytes(beside)).hexdigest() != entry.get("sha256"):
        raise FileFormatError(
            f"these are not the observations that {path.name} was solved from",
            where=path_text(beside),
            remedy="keep both files together as they were written",
        )
    return beside


def is_scanner_document(path: Path) -> bool:
    """True if a file says that it is a scanner's document; it need not be whole."""
    return bool(parse_json(read_bytes(path), path_text(path)).get("schema") == SCANNER_SCHEMA)


def read_calibration(path: Path) -> CameraCalibration | SensorCalibration:
    """Read a camera's or a sensor's document.

    Raises
    ------
    FileFormatError
        If the file is cut or changed, of another kind, of a newer version, or holds values that
        cannot be.
    """
    is_sensor = document_schema(path) == SENSOR_SCHEMA
    return read_sensor_calibration(path) if is_sensor else _read_camera(path)


def read_camera_calibration(path: Path) -> CameraCalibration:
    """Read ``camera.json``, or a calibration that OpenCV or ROS wrote."""
    data = read_bytes(path)
    if is_json(data) and "schema" in parse_json(data, path_text(path)):
        return _read_camera(path)
    return read_foreign_camera(path)


def read_foreign_camera(path: Path) -> CameraCalibration:
    """Read a camera that OpenCV (YAML, XML, JSON) or ROS (``camera_info`` YAML) calibrated.

    Such files bring no covariance: ``has_covariance`` is False and the uncertainty figures are
    NaN. Coefficients beyond ``k1 k2 p1 p2 k3`` are accepted when they are zero.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, cut short, has no camera matrix or image size, or describes
        a lens by another model.
    """
    camera, rms_px = parse_foreign_camera(read_bytes(path), path_text(path))
    return CameraCalibration(
        camera=camera,
        covariance=np.zeros((9, 9)),
        has_covariance=False,
        rms_px=rms_px,
        sigma_point_px=math.nan,
        n_views=0,
        n_points=0,
        covered_px=np.array([0.0, 0.0, camera.width_px - 1.0, camera.height_px - 1.0]),
        provenance=new_provenance([path], command=()),
    )


def read_sensor_calibration(path: Path) -> SensorCalibration:
    """Read ``sensor.json``."""
    return _record(SensorCalibration, SENSOR_SCHEMA, path)


def read_stereo_calibration(path: Path) -> StereoCalibration:
    """Read ``stereo.json``; raises as `read_calibration`."""
    return _record(StereoCalibration, STEREO_SCHEMA, path)


def read_scanner_calibration(path: Path) -> ScannerCalibration:
    """Read ``scanner.json``; raises as `read_calibration`."""
    return _record(ScannerCalibration, SCANNER_SCHEMA, path)


def read_registration(path: Path) -> Registration:
    """Read ``registration.json``; raises as `read_calibration`."""
    return _record(Registration, REGISTRATION_SCHEMA, path)


def _read_camera(path: Path) -> CameraCalibration:
    tree = _opened(path, CAMERA_SCHEMA)
    with _explained(path, CAMERA_SCHEMA):
        if tree.keys() != {"camera", "provenance"}:
            raise MismatchError("", "the keys are not camera, observations and provenance")
        provenance = CODEC.read(Provenance, tree["provenance"], "provenance")
        return CODEC.read(CameraCalibration, tree["camera"], "camera", provenance=provenance)


def _record(kind: type[T], schema: str, path: Path) -> T:
    tree = _opened(path, schema)
    with _explained(path, schema):
        record = CODEC.read(kind, tree)
        if isinstance(record, ScannerCalibration):
            _check_coupling(record, tree)
        return record


def _check_coupling(scanner: ScannerCalibration, tree: dict[str, Any]) -> None:
    if scanner.hand_eye.dhand_eye_dsensor is None:
        return
    key, coupling = "hand_eye.sensor_coupling", tree["hand_eye"]["sensor_coupling"]
    names = () if scanner.sensor is None else scanner.sensor.parameter_names
    if tuple(coupling["row_names"]) != HAND_EYE_PARAMETER_NAMES:
        raise MismatchError(key, "has not the names of the hand-eye's parameters")
    if tuple(coupling["column_names"]) != names:
        raise MismatchError(key, "has not the names of the sensor's parameters")


def _opened(path: Path, schema: str) -> dict[str, Any]:
    """Content of a document without its envelope, which is checked."""
    where = path_text(path)
    content = parse_json(read_bytes(path), where)
    wanted, writer = KINDS[schema]
    found = content.get("schema")
    if found != schema:
        fact = f"this is not a {wanted} of armscan"
        if isinstance(found, str) and found in KINDS:
            fact = f"this is a {KINDS[found][0]}, and a {wanted} is needed"
        raise FileFormatError(
            fact,
            where=where,
            remedy=f"name the file that `armscan {writer}` wrote",
        )
    number = content.get("schema_version")
    if isinstance(number, int) and number > SCHEMA_VERSION:
        raise FileFormatError(
            f"the file has schema version {number}, and this program reads up to {SCHEMA_VERSION}",
            where=where,
            remedy="update armscan",
        )
    if "sha256" in content and content["sha256"] != content_hash(content):
        raise FileFormatError(
            f"the {wanted} is not as it was written: its SHA-256 does not fit its content",
            where=where,
            remedy="copy the file again or calibrate again; if you changed it on purpose, remove "
            "its line sha256",
        )
    with _explained(path, schema):
        if number != SCHEMA_VERSION:
            raise MismatchError("schema_version", f"is not {SCHEMA_VERSION}")
        if content.get("observations") is not None:
            texts = _texts(content["observations"], "observations")
            if dict(texts).keys() != {"file", "sha256"}:
                raise MismatchError("observations", "needs the keys file and sha256")
    return {key: value for key, value in content.items() if key not in ENVELOPE}


@contextmanager
def _explained(path: Path, schema: str) -> Iterator[None]:
    """Say of which document a key is wrong."""
    try:
        yield
    except MismatchError as error:
        raise FileFormatError(
            f"the {KINDS[schema][0]} is not valid: {error}",
            where=path_text(path),
            remedy="use the file as it was written, or make it anew",
        ) from error


def fingerprint(path: Path) -> InputFile:
    """Path as given, with ``/``, and SHA-256 of the content."""
    return InputFile(path_text(path), sha256_of(path))


def new_provenance(
    inputs: Iterable[Path] = (),
    *,
    command: Sequence[str] = (),
    options: Iterable[Any] = (),
    parents: Sequence[Provenance] = (),
    warnings: Sequence[str] = (),
    forced: Sequence[str] = (),
) -> Provenance:
    """Describe a document that is about to be written.

    Files that went in are hashed. Of options dataclasses in force every field is recorded as
    ``Class.field``, one that is a dataclass itself by its own class and fields. Of ``parents``, the
    documents on which this one rests, the reasons for a refusal go on; ``forced`` is why this one
    was refused, if it is written all the same.
    """
    return Provenance(
        document_id=str(uuid4()),
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        armscan_version=version("armscan"),
        command=tuple(path_text(word) for word in command),
        inputs=tuple(fingerprint(path) for path in inputs),
        parent_ids=tuple(parent.document_id for parent in parents),
        options=tuple(entry for group in options for entry in _entries(group)),
        warnings=tuple(warnings),
        forced=tuple(
            dict.fromkeys((*(text for parent in parents for text in parent.forced), *forced))
        ),
    )


def _entries(group: Any) -> Iterator[tuple[str, str]]:
    for item in fields(group):
        value = getattr(group, item.name)
        if is_dataclass(value):
            yield from _entries(value)
        else:
            yield f"{type(group).__name__}.{item.name}", str(value)


def recorded_options(provenance: Provenance, kind: type) -> dict[str, Any]:
    """Fields of an options class as a document records them; those that it does not know lack."""
    recorded = dict(provenance.options)
    names = {item.name: f"{kind.__name__}.{item.name}" for item in fields(kind)}
    found: dict[str, Any] = {}
    for name, entry in names.items():
        if entry in recorded:
            try:
                found[name] = literal_eval(recorded[entry])
            except (ValueError, SyntaxError):
                found[name] = recorded[entry]
    return found
