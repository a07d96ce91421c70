# SPDX-License-Identifier: Apache-2.0
"""Calibration documents: every bit comes back, and every broken file has a reason."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.jobs.info import describe_files
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import CameraModel
from armscan.storage.codec import RecordCodec
from armscan.storage.documents import (
    camera_document,
    read_calibration,
    read_camera_calibration,
    read_scanner_calibration,
    read_sensor_calibration,
    scanner_document,
    sensor_document,
)
from rigs.calibration_documents import (
    assert_same,
    camera_calibration,
    scanner_calibration,
    sensor_calibration,
    stereo_sensor_calibration,
)
from rigs.fisheye import TANGENTIAL, as_fisheye

GOLDEN = Path(__file__).parents[1] / "golden"


def test_camera_document_round_trip_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(camera_calibration()))
    assert_same(read_camera_calibration(path), camera_calibration())
    assert_same(read_calibration(path), camera_calibration())


def test_sensor_document_round_trip_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "sensor.json"
    path.write_bytes(sensor_document(sensor_calibration(), ("sensor.npz", b"abc")))
    assert_same(read_sensor_calibration(path), sensor_calibration())
    assert json.loads(path.read_text("utf-8"))["observations"]["file"] == "sensor.npz"


@pytest.mark.parametrize("seed", range(20))
def test_floats_of_any_size_survive(tmp_path: Path, seed: int) -> None:
    """All 64 bits, drawn at random, of the five distortion coefficients, up to their limit."""
    bits = np.random.default_rng(seed).integers(0, 2**63, 40, dtype=np.uint64)
    numbers = bits.view(np.float64)
    size = np.abs(numbers)
    usable = numbers[(size > 1e-300) & (size < 1e7)][:5]
    known = camera_calibration()
    changed = CameraModel(
        fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, distortion=usable, width_px=1, height_px=1
    )
    values = {item.name: getattr(known, item.name) for item in fields(known)} | {"camera": changed}
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(CameraCalibration(**values)))
    np.testing.assert_array_equal(read_camera_calibration(path).camera.distortion, usable)


def test_unknown_figures_of_foreign_calibrations_are_null(tmp_path: Path) -> None:
    known = camera_calibration()
    values = {item.name: getattr(known, item.name) for item in fields(known)}
    values |= {"rms_px": math.nan, "sigma_point_px": math.nan, "has_covariance": False}
    values["diagnostics"] = None
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(CameraCalibration(**values)))
    assert json.loads(path.read_text("utf-8"))["camera"]["rms_px"] is None
    assert math.isnan(read_camera_calibration(path).rms_px)
    assert read_camera_calibration(path).diagnostics is None


@pytest.mark.parametrize("name", ["camera_v1.json", "sensor_v1.json"])
def test_released_schema_is_still_read(name: str) -> None:
    """Written by the first release; only a new schema version may add a file here."""
    expected = camera_calibration() if name.startswith("camera") else sensor_calibration()
    assert_same(read_calibration(GOLDEN / name), expected)


def test_documents_are_written_as_they_were_released() -> None:
    """Every key and every digit; only the SHA-256 is new."""
    for written, name in (
        (camera_document(camera_calibration()), "camera_v1.json"),
        (sensor_document(sensor_calibration()), "sensor_v1.json"),
        (scanner_document(scanner_calibration()), "scanner_v1.json"),
    ):
        content = json.loads(written)
        assert len(content.pop("sha256")) == 64
        assert content == json.loads((GOLDEN / name).read_bytes())


def unsigned(document: bytes) -> dict[str, Any]:
    """Content as of a release before the SHA-256, or with its line removed by hand."""
    content: dict[str, Any] = json.loads(document)
    del content["sha256"]
    return content


def broken(path: tuple[str, ...], value: Any) -> bytes:
    content = unsigned(camera_document(camera_calibration()))
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return json.dumps(content).encode()


BROKEN = {
    "NaN": (broken(("camera", "intrinsics", "fx_px"), math.nan), "holds NaN"),
    "overflow": (
        camera_document(camera_calibration()).replace(b'"cy_px": ', b'"cy_px": 1e999, "x": '),
        "finite",
    ),
    "text for a number": (broken(("camera", "intrinsics", "k1"), "0.1"), "k1.*no number"),
    "negative focal length": (broken(("camera", "intrinsics", "fx_px"), -3.0), "positive"),
    "unknown key": (broken(("camera", "focal"), 1.0), "camera.focal.*not known"),
    "missing": (broken(("camera",), {}), "camera.intrinsics.*missing"),
    "newer": (broken(("schema_version",), 2), "schema version 2.*update armscan"),
    "other pixel origin": (
        broken(("camera", "intrinsics", "pixel_origin"), "corner"),
        "pixel_origin",
    ),
    "other schema": (broken(("schema",), "other/thing"), "not a camera calibration of armscan"),
    "lopsided": (broken(("camera", "covariance", "matrix"), [[1.0] * 9] * 8), "9 x 9 matrix"),
    "not symmetric": (
        broken(("camera", "covariance", "matrix"), (np.eye(9) + np.eye(9, k=1)).tolist()),
        "not symmetric",
    ),
    "reordered": (
        broken(("camera", "covariance", "parameter_names"), list("abcdefghi")),
        "parameter names",
    ),
    "list": (b"[1, 2]", "not a camera calibration|not a JSON object"),
    "twice": (
        camera_document(camera_calibration()).replace(b'"k1"', b'"k2"'),
        "'k2' appears twice",
    ),
    "empty": (b"", "empty"),
    "binary": (b"{\xff\xfe\x00", "not a JSON document"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_documents_have_a_reason(tmp_path: Path, case: str) -> None:
    content, message = BROKEN[case]
    path = tmp_path / "camera.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_camera_calibration(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", range(60))
def test_a_flipped_bit_is_refused_or_without_effect(tmp_path: Path, seed: int) -> None:
    """Before documents had a SHA-256, one in six was read as another calibration."""
    content = bytearray(scanner_document(scanner_calibration()))
    rng = np.random.default_rng(seed)
    content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    path = tmp_path / "scanner.json"
    path.write_bytes(content)
    try:
        found = read_scanner_calibration(path)
    except FileFormatError:
        return
    assert_same(found, scanner_calibration())


def test_a_changed_document_is_refused_and_read_without_its_hash(tmp_path: Path) -> None:
    content = json.loads(camera_document(camera_calibration()))
    content["camera"]["intrinsics"]["fx_px"] = 500.0
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content), "utf-8")
    with pytest.raises(FileFormatError, match=r"SHA-256.*remove its line sha256"):
        read_camera_calibration(path)
    del content["sha256"]
    path.write_text(json.dumps(content), "utf-8")
    assert read_camera_calibration(path).camera.fx_px == 500.0


def test_blanks_and_line_ends_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(camera_calibration()).replace(b"\n", b"\r\n  "))
    assert_same(read_camera_calibration(path), camera_calibration())


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("intrinsics", "width_px"), 10**30),
        (("intrinsics", "fx_px"), 1e300),
        (("valid_region", "x_min_px"), 1e6),
        (("rms_px",), -0.1),
        (("covariance", "matrix", 0, 0), 1e300),
        (("n_views",), -1),
        (("n_views",), True),
    ],
)
def test_magnitudes_that_cannot_be_are_refused(
    tmp_path: Path, place: tuple[str | int, ...], value: float
) -> None:
    content = unsigned(camera_document(camera_calibration()))
    inner = content["camera"]
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content), "utf-8")
    with pytest.raises(FileFormatError):
        read_camera_calibration(path)


@pytest.mark.parametrize("share", np.linspace(0.01, 0.99, 12))
def test_a_cut_document_is_noticed(tmp_path: Path, share: float) -> None:
    content = camera_document(camera_calibration())
    path = tmp_path / "camera.json"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FileFormatError, match="not a complete JSON document"):
        read_camera_calibration(path)


def test_swapped_files_are_noticed(tmp_path: Path) -> None:
    camera, sensor = tmp_path / "camera.json", tmp_path / "sensor.json"
    camera.write_bytes(camera_document(camera_calibration()))
    sensor.write_bytes(sensor_document(sensor_calibration()))
    with pytest.raises(FileFormatError, match="is a sensor calibration, and a camera calibration"):
        read_camera_calibration(sensor)
    with pytest.raises(FileFormatError, match="is a camera calibration, and a sensor calibration"):
        read_sensor_calibration(camera)


def test_a_second_camera_comes_back_exactly_and_alone_adds_a_key(tmp_path: Path) -> None:
    path = tmp_path / "sensor.json"
    path.write_bytes(sensor_document(stereo_sensor_calibration()))
    assert_same(read_sensor_calibration(path), stereo_sensor_calibration())
    content = json.loads(path.read_text("utf-8"))
    assert content["covariance"]["parameter_names"][25] == "right.fx_px"
    assert set(content) - set(json.loads(sensor_document(sensor_calibration()))) == {"second"}


def test_a_scanner_keeps_its_second_camera(tmp_path: Path) -> None:
    path = tmp_path / "scanner.json"
    known = scanner_calibration()
    coupling = np.arange(240).reshape(6, 40) / 7
    stereo = replace(
        known,
        sensor=stereo_sensor_calibration(),
        hand_eye=replace(known.hand_eye, dhand_eye_dsensor=coupling),
    )
    path.write_bytes(scanner_document(stereo))
    assert_same(read_scanner_calibration(path), stereo)
    described = describe_files([str(path)]).data["items"][0]
    assert described["baseline_mm"] == pytest.approx(np.linalg.norm([117.4, 1 / 3, 63.2]), abs=1e-4)


def test_a_scanner_without_a_turn_about_tool_is_read(tmp_path: Path) -> None:
    """Documents from before it state none: their key is left out, and means a scatter of zero."""
    path, known = tmp_path / "scanner.json", scanner_calibration()
    path.write_bytes(scanner_document(known))
    assert b"tool_rotation" not in path.read_bytes()
    assert read_scanner_calibration(path).hand_eye.arm_noise.tool_rotation_rad == 0.0
    arm = replace(
        known.hand_eye.arm_noise, tool_rotation_rad=1e-4 / 3, exposure_tool_rotation_rad=1e-5 / 7
    )
    turning = replace(known, hand_eye=replace(known.hand_eye, arm_noise=arm))
    path.write_bytes(scanner_document(turning))
    assert_same(read_scanner_calibration(path), turning)


def test_a_scanner_keeps_the_factor_of_its_region(tmp_path: Path) -> None:
    scanner = scanner_calibration()
    assert scanner.hand_eye.diagnostics is not None
    few = replace(scanner.hand_eye.diagnostics, region_factor=1.5, is_arm_given=True)
    scanner = replace(scanner, hand_eye=replace(scanner.hand_eye, diagnostics=few))
    path = tmp_path / "scanner.json"
    path.write_bytes(scanner_document(scanner))
    assert_same(read_scanner_calibration(path), scanner)


def test_a_covariance_of_another_count_of_cameras_is_refused(tmp_path: Path) -> None:
    content = unsigned(sensor_document(stereo_sensor_calibration()))
    del content["second"]
    path = tmp_path / "sensor.json"
    path.write_bytes(json.dumps(content).encode())
    with pytest.raises(FileFormatError, match=r"covariance"):
        read_sensor_calibration(path)


def fisheye_calibration() -> CameraCalibration:
    known = camera_calibration()
    covariance = known.covariance.copy()
    covariance[TANGENTIAL] = covariance[:, TANGENTIAL] = 0.0
    return replace(known, camera=as_fisheye(known.camera), covariance=covariance)


def test_a_fisheye_comes_back_exactly_and_is_told(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(fisheye_calibration()))
    assert_same(read_camera_calibration(path), fisheye_calibration())
    told = describe_files([str(path)]).data["items"][0]
    assert told["lens"] == "fisheye"
    assert "p1" not in told and "k3" in told


@pytest.mark.parametrize("model", [None, "", 3, "mirror", "pinhole"])
def test_a_document_says_which_lens_it_is_of(tmp_path: Path, model: Any) -> None:
    """Nothing is taken for granted: the same numbers mean another camera."""
    tree = json.loads(camera_document(fisheye_calibration()))
    del tree["sha256"]
    if model == "":
        del tree["camera"]["intrinsics"]["model"]
    else:
        tree["camera"]["intrinsics"]["model"] = model
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match="model"):
        read_camera_calibration(path)


def test_a_fisheye_has_no_variance_of_tangential_distortion(tmp_path: Path) -> None:
    known = fisheye_calibration()
    wrong = replace(known, covariance=known.covariance + np.diag([0, 0, 0, 0, 0, 0, 1e-8, 0, 0]))
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(wrong))
    with pytest.raises(FileFormatError, match="tangential"):
        read_camera_calibration(path)


def test_a_figure_of_numpy_that_is_not_known_is_written_as_null() -> None:
    """Only Python's NaN was; numpy's ended in a ValueError of JSON."""

    @dataclass
    class Record:
        rms_mm: float

    assert RecordCodec().write(Record(np.float64("nan"))) == {"rms_mm": None}
    assert RecordCodec().write(Record(np.float64(1.5))) == {"rms_mm": 1.5}
