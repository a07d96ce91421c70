# SPDX-License-Identifier: Apache-2.0
"""``scanner.json``: every bit comes back, and every broken file has a reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.errors import FileFormatError, InputError
from armscan.storage.documents import (
    camera_document,
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
)

GOLDEN = Path(__file__).parents[2] / "golden" / "scanner_v1.json"


@pytest.mark.parametrize("has_sensor", [True, False])
def test_round_trip_is_exact(tmp_path: Path, has_sensor: bool) -> None:
    path = tmp_path / "scanner.json"
    expected = scanner_calibration(has_sensor=has_sensor)
    path.write_bytes(scanner_document(expected, ("scanner.npz", b"abc")))
    assert_same(read_scanner_calibration(path), expected)
    content = json.loads(path.read_text("utf-8"))
    assert content["observations"]["file"] == "scanner.npz"
    assert (content["sensor"] is None) is not has_sensor


def test_what_is_not_known_stays_unknown(tmp_path: Path) -> None:
    known = scanner_calibration()
    bare = replace(
        known,
        hand_eye=replace(known.hand_eye, plate=None, diagnostics=None, dhand_eye_dsensor=None),
    )
    path = tmp_path / "scanner.json"
    path.write_bytes(scanner_document(bare))
    assert_same(read_scanner_calibration(path), bare)


def test_released_schema_is_still_read() -> None:
    assert_same(read_scanner_calibration(GOLDEN), scanner_calibration())


def test_a_coupling_needs_the_names_of_a_sensor() -> None:
    known = scanner_calibration(has_sensor=False)
    coupled = replace(known, hand_eye=replace(known.hand_eye, dhand_eye_dsensor=np.ones((6, 25))))
    with pytest.raises(InputError, match="no names"):
        scanner_document(coupled)


def set_value(*path: Any) -> Callable[[Any], None]:
    """Change of a document: the last of ``path`` is the value, the rest the keys to its place."""

    def change(content: Any) -> None:
        for key in path[:-2]:
            content = content[key]
        content[path[-2]] = path[-1]

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_value("hand_eye", "rms_mm", "0.1"), "hand_eye.rms_mm"),
        (set_value("hand_eye", "n_postures", 12.0), "hand_eye.n_postures"),
        (set_value("hand_eye", "offset_mm", 1.0), "hand_eye.offset_mm"),
        (set_value("latency_ns", 1.5), "latency_ns"),
        (set_value("latency_ns", 10**12 + 1), "latency"),
        (
            set_value("hand_eye", "tool_from_sensor", "translation_tool_mm", 0, 1.1e7),
            "hand_eye.tool_from_sensor.translation_tool_mm",
        ),
        (set_value("sensor", "camera", "intrinsics", "fx_px", 1.1e7), "fx_px"),
        (set_value("schema_version", 2), "update armscan"),
        (
            set_value("hand_eye", "tool_from_sensor", "rotation_rows", 0, [1, 0, 0]),
            "not a rotation",
        ),
        (set_value("hand_eye", "plate", "normal_base", [0, 0, 2]), "hand_eye.plate"),
        (set_value("hand_eye", "covariance", "parameter_names", 0, "x"), "parameter names"),
        (set_value("hand_eye", "covariance", "matrix", 0, 0, -1), "positive diagonal"),
        (
            set_value("hand_eye", "covariance", "matrix", (5.0 - 4.0 * np.eye(6)).tolist()),
            "'hand_eye.covariance' is no covariance",
        ),
        (set_value("hand_eye", "sensor_coupling", "column_names", 0, "x"), "sensor's parameters"),
        (set_value("hand_eye", "sensor_coupling", "matrix", [[1.0]]), "6 x 25"),
        (set_value("sensor", None), "sensor's parameters"),
    ],
)
def test_broken_documents_have_a_reason(
    tmp_path: Path, change: Callable[[Any], None], said: str
) -> None:
    content = json.loads(scanner_document(scanner_calibration()))
    del content["sha256"]
    change(content)
    path = tmp_path / "scanner.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(FileFormatError) as caught:
        read_scanner_calibration(path)
    assert said in str(caught.value)


def test_documents_of_other_stages_are_named(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.json" for name in ("camera", "sensor", "scanner")]
    documents = (
        camera_document(camera_calibration()),
        sensor_document(sensor_calibration()),
        scanner_document(scanner_calibration()),
    )
    for path, content in zip(paths, documents, strict=True):
        path.write_bytes(content)
    for path in paths[:2]:
        with pytest.raises(FileFormatError, match="calibrate hand-eye"):
            read_scanner_calibration(path)
    for read in (read_camera_calibration, read_sensor_calibration):
        with pytest.raises(FileFormatError, match="this is a scanner calibration"):
            read(paths[2])


def test_a_cut_document_is_noticed(tmp_path: Path) -> None:
    content = scanner_document(scanner_calibration())
    path = tmp_path / "scanner.json"
    for share in (0.1, 0.5, 0.999):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(FileFormatError, match="not a complete JSON document"):
            read_scanner_calibration(path)
