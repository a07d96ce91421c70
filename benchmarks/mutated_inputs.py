# SPDX-License-Identifier: Apache-2.0
"""What armscan's readers do with damaged and hostile files: seeded mutations of valid ones.

Of each reader's valid files, bytes, numbers, words, lines or the name are changed. The reader must
return something or raise an `ArmscanError`. Any other exception, more than `LIMIT_S` seconds or
more than `LIMIT_MB` megabytes is a fault. The cases run in other processes whose memory is limited.

    python benchmarks/mutated_inputs.py                                 # 28 readers, 1500 each
    python benchmarks/mutated_inputs.py --readers ply png --cases 200
    python benchmarks/mutated_inputs.py --readers ply --first 37 --cases 1 --keep case
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import cv2
import numpy as np

from armscan.errors import ArmscanError
from armscan.geometry.poses import CameraRight, Pose, Sensor, Tool
from armscan.geometry.shapes import Plane, fit_plane
from armscan.jobs.info import describe_files
from armscan.models.calibration import (
    ArmNoise,
    CameraCalibration,
    CameraDiagnostics,
    FTest,
    HandEyeCalibration,
    HandEyeDiagnostics,
    Provenance,
    ScannerCalibration,
    SensorCalibration,
    SensorDiagnostics,
    SheetCalibration,
    SheetDiagnostics,
    WarpedBoard,
)
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.models.two_views import StereoCalibration, StereoDiagnostics
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile
from armscan.storage.arm import read_arm_model, read_probe_tip
from armscan.storage.clouds import ply_bytes, read_cloud
from armscan.storage.documents import (
    MarkerResidual,
    MovedMarker,
    Registration,
    ScanNotJoined,
    ScanTransform,
    camera_document,
    read_calibration,
    read_camera_calibration,
    read_registration,
    read_scanner_calibration,
    read_stereo_calibration,
    registration_document,
    scanner_document,
    sensor_document,
    stereo_document,
)
from armscan.storage.images import read_exposure
from armscan.storage.observations import pack_observations, read_observations
from armscan.storage.points import (
    read_marker_list,
    read_points_or_plane,
    read_probed_points,
    read_profiles,
)
from armscan.storage.poses import read_robot_poses
from armscan.storage.recording import read_arm_track, read_recording
from armscan.vision.targets.target import TargetView

LIMIT_S, LIMIT_MB = 5.0, 1000.0
SILENT_S = 20.0
"""A worker that says nothing for so long hangs in compiled code and is ended."""
LONG_SENTENCE = 400
SEED = 20261122

Files = dict[str, bytes]


@dataclass(frozen=True)
class Reader:
    """A reader with the valid files of which mutations are made.

    Parameters
    ----------
    files
        Sets of valid files, by their paths in the case's folder; one set a case, in turn.
    read
        Reads them, given that folder.
    is_text
        Whether words and lines are mutated, or bytes only.
    mutable
        Names of the files that are mutated; all if empty.
    """

    files: Sequence[Mapping[str, bytes]]
    read: Callable[[Path], object]
    is_text: bool = True
    mutable: tuple[str, ...] = ()


# mutations --------------------------------------------------------------------------------------

NUMBERS = (
    *("nan", "NaN", "inf", "-inf", "1e999", "-1e999", "1e308", "-1e300", "1e-320", "0", "-0", "-1"),
    *(
        "1e18",
        "9223372036854775808",
        "18446744073709551616",
        "4294967296",
        "2147483648",
        "900000000",
    ),
    *("0x10", "1_000", "1,5", "1.5.2", "--1", "+", "", "null", "true", '"1"', "[]", "{}", "\u00b2"),
    *("1" * 400, "9" * 6000, "0." + "3" * 6000, "\u0661\u0662"),
)
WORDS = (
    *(
        "",
        " ",
        "nan",
        "null",
        "schema",
        "\u00b2",
        "\u00fc",
        "\x00",
        "\x1b]0;x\x07",
        "../../x",
        "/etc/passwd",
    ),
    *(
        "C:\\x",
        "x" * 6000,
        "j300000000_rad",
        "j1000000_rad",
        "x_m",
        "{{7*7}}",
        "<script>",
        "=",
        "a.b.c",
    ),
    *(
        "[",
        "]",
        "{",
        "}",
        '"',
        "'",
        ",",
        ";",
        "\n",
        "#",
        "&#0;",
        "%",
        "[[",
        "]]",
        "-",
        ":",
        "\ufeff",
    ),
)
LINES = (
    *('operators = ["Anna","Bob"]', "[[lens]]", 'name = "x"', "[pose]", "[a.b.c]", "# comment"),
    *(
        "a = " + "[" * 3000,
        "{" * 3000,
        "[" * 5000,
        "<a>" * 3000,
        "a." * 3000 + "b = 1",
        "- " * 3000,
    ),
    *("comment sheet 0 " + "[" * 5000, "property list uchar int x", "property double x"),
    *("element vertex " + "9" * 30, "element vertex 1000000000000", "# point = x", "# frame = x"),
    *("1,2,3", "nan nan nan", ",,,,,,,,", "\t\t", "---", "...", "x: !!python/object:os.system y"),
)
TOKEN = re.compile(rb"[-+]?\d[\d.eE+-]*")
WORD = re.compile(rb"[A-Za-z_][\w./-]*")
FIELDS = (
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x7f\xff\xff\xff",
    b"\0\0\0\0",
    b"\0\0\x7d\0",
    b"\x80\0\0\0",
)


def mutated(data: bytes, rng: np.random.Generator, *, is_text: bool) -> bytes:
    """Content after one to three mutations."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        kinds = TEXT_MUTATIONS if is_text and rng.random() < 0.75 else BYTE_MUTATIONS
        data = kinds[int(rng.integers(len(kinds)))](data, rng)
    return data


def _span(data: bytes, rng: np.random.Generator, most: int) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, min(len(data), start + int(rng.integers(1, most + 1)))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    if not data:
        return data
    content = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 4, 16]))):
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _flip_head(data: bytes, rng: np.random.Generator) -> bytes:
    return _flip(data[:64], rng) + data[64:]


def _cut_end(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _cut_out(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 64)
    return data[:start] + data[end:]


def _zero(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 16)
    return data[:start] + bytes(end - start) + data[end:]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    start, _ = _span(data, rng, 1)
    return data[:start] + rng.bytes(int(rng.integers(1, 64))) + data[start:]


def _double(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 400)
    return data[:end] + data[start:end] * int(rng.choice([1, 2, 50])) + data[end:]


def _field(data: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(min(len(data), 256) + 1))
    value = FIELDS[int(rng.integers(len(FIELDS)))][: int(rng.choice([2, 4]))]
    return data[:start] + value + data[start + len(value) :]


def _odd_whole(data: bytes, rng: np.random.Generator) -> bytes:
    wholes = (
        b"",
        b"\n",
        b"\xff\xfe",
        data + data,
        b"\xef\xbb\xbf" + data,
        rng.bytes(300),
        data[::-1],
    )
    return wholes[int(rng.integers(len(wholes)))]


def _replace(
    data: bytes, rng: np.random.Generator, pattern: re.Pattern[bytes], by: Sequence[str]
) -> bytes:
    found = [item.span() for item in pattern.finditer(data)]
    if not found:
        return data
    start, end = found[int(rng.integers(len(found)))]
    return data[:start] + by[int(rng.integers(len(by)))].encode() + data[end:]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace(data, rng, TOKEN, NUMBERS)


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace(data, rng, WORD, WORDS)


def _scaled(data: bytes, rng: np.random.Generator) -> bytes:
    """All numbers of one length class larger: an absurd scale in place of one absurd number."""
    factor = float(rng.choice([1e-9, 1e-3, 1e3, 1e9, 1e150, -1.0]))

    def larger(found: re.Match[bytes]) -> bytes:
        try:
            return repr(float(found[0]) * factor).encode()
        except ValueError:
            return found[0]

    return re.sub(rb"[-+]?\d+\.\d+(?:e[-+]?\d+)?", larger, data)


def _line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    line, how = lines[k], int(rng.integers(6))
    if how == 0:
        lines[k : k + 1] = []
    elif how == 1:
        lines[k:k] = [line]
    elif how == 2:
        lines[k:k] = [line] * int(rng.choice([100, 5000]))
    elif how == 3:
        other = int(rng.integers(len(lines)))
        lines[k], lines[other] = lines[other], line
    elif how == 4:
        lines[k] = line.replace(b",", b";")
    else:
        lines[k:k] = [LINES[int(rng.integers(len(LINES)))].encode()]
    return b"\n".join(lines)


def _many_lines(data: bytes, rng: np.random.Generator) -> bytes:
    filler = (b"\n", b"#\n", b",,,\n", b"1,2,3\n", b"0 0 0\n")[int(rng.integers(5))]
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    return b"\n".join(lines[:k]) + filler * 60_000 + b"\n".join(lines[k:])


def _line_ends(data: bytes, rng: np.random.Generator) -> bytes:
    return data.replace(
        b"\n", (b"\r\n", b"\r", b"\x0b", b"\xe2\x80\xa8", b"\x1c")[int(rng.integers(5))]
    )


def _many_keys(data: bytes, rng: np.random.Generator) -> bytes:
    """Thousands of keys in the first object, columns in the header, or tables."""
    n = int(rng.choice([1000, 20_000]))
    if data.lstrip().startswith(b"{"):
        extra = b",".join(b'"k%d": %d' % (k, k) for k in range(n))
        return data.replace(b"{", b"{" + extra + b"," + b'"k0": 1,', 1)
    first, _, rest = data.partition(b"\n")
    if b"," in first:
        return first + b"".join(b",c%d" % k for k in range(n)) + b"\n" + rest
    return data + b"\n" + b"".join(b"[[t%d]]\n" % k for k in range(n))


TEXT_MUTATIONS: Sequence[Callable[[bytes, np.random.Generator], bytes]] = (
    *(_number, _number, _number, _number, _word, _word, _scaled, _line, _line, _line),
    *(_many_lines, _line_ends, _many_keys),
)
BYTE_MUTATIONS: Sequence[Callable[[bytes, np.random.Generator], bytes]] = (
    *(_flip, _flip, _flip, _flip_head, _flip_head, _cut_end, _cut_out, _zero, _insert, _double),
    *(_field, _field, _field, _odd_whole),
)


def write_case(folder: Path, reader: Reader, number: int, seed: int) -> None:
    """Write the files of case ``number`` into an empty folder: the same for equal arguments."""
    rng = np.random.default_rng([seed, number])
    files = dict(reader.files[number % len(reader.files)])
    names = reader.mutable or tuple(files)
    chosen = names[int(rng.integers(len(names)))]
    is_text = reader.is_text and not chosen.endswith(".png")
    files[chosen] = mutated(files[chosen], rng, is_text=is_text)
    place = int(rng.integers(60))
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if place == 6 and len(files) == 1:
            path = path.with_name(f"na\udcefve\n{path.suffix}")
        if name != chosen or place >= 5:
            path.write_bytes(content)
        elif place == 0:
            path.mkdir()
        elif place == 1:
            os.mkfifo(path)
        elif place == 2:
            path.symlink_to(path)
        elif place == 3:
            path.symlink_to("/dev/zero")


# valid files ------------------------------------------------------------------------------------

WIDTH_PX, HEIGHT_PX = 64, 48
AXES = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3


def _covariance(n: int) -> Any:
    values = 1.0 / np.arange(2, 2 + n)
    return np.outer(values, values) / 7 + np.diag(values) / 1e3


PROVENANCE = Provenance(
    document_id="3f0c1a9e-0000-4000-8000-000000000001",
    created_utc="2026-01-02T03:04:05+00:00",
    armscan_version="0.1.0",
    command=("armscan", "calibrate"),
    inputs=(),
)
TEST = FTest(f_ratio=1.5, degrees_of_freedom=3, p_value=0.25)
PLATE = "x_mm,y_mm,z_mm\n" + "".join(
    f"{30.0 * i:.1f},{40.0 * j:.1f},{500 + 0.01 * (i + j)}\n" for i in range(4) for j in range(3)
)


def _camera() -> CameraCalibration:
    return CameraCalibration(
        camera=CameraModel(
            fx_px=477.0,
            fy_px=478.0,
            cx_px=320.0,
            cy_px=240.0,
            distortion=np.array([0.1, -0.2, 0, 0, 0.3]),
            width_px=640,
            height_px=480,
        ),
        covariance=_covariance(9),
        has_covariance=True,
        rms_px=0.3,
        sigma_point_px=0.1,
        n_views=16,
        n_points=1056,
        covered_px=np.array([10.0, 20.0, 600.0, 400.0]),
        provenance=PROVENANCE,
        diagnostics=CameraDiagnostics(
            free_parameters=("fx_px", "k1"),
            model_reason="k2 does not pay",
            hold_out_rms_px=0.4,
            n_folds=8,
            condition=1e3,
            noise_scale=1.1,
            covered_fraction=0.7,
            board=WarpedBoard(bow_mm=(0.03, -0.2), sigma_mm=(1e-3, 2e-3), test=TEST),
        ),
    )


def _sensor() -> SensorCalibration:
    sheets = tuple(
        SheetCalibration(
            name=name,
            sheet=LightSheet(
                origin_mm=np.array([1.0, 2.0, 300.0]),
                axes=AXES,
                scale_mm=13.0,
                bow_mm=np.arange(5) / 70,
            ),
            rms_mm=0.03,
            n_boards=3,
            n_points=900,
            depth_range_mm=(212.0, 290.0),
            is_redundant=True,
            diagnostics=SheetDiagnostics(
                rms_px=0.1,
                plane_test=TEST,
                final_test=TEST,
                bow_decision="it pays",
                coplanarity_mm=0.01,
                coplanarity_sigma_mm=0.02,
                board_angle_deg=37.5,
            ),
        )
        for name in ("A", "B")
    )
    return SensorCalibration(
        camera=_camera(),
        sheets=sheets,
        covariance=_covariance(25),
        provenance=PROVENANCE,
        diagnostics=SensorDiagnostics(
            noise_factor=1.2, correlation_points=3.4, naming="one sheet in each image"
        ),
    )


def _scanner() -> ScannerCalibration:
    pose: Pose[Tool, Sensor] = Pose(AXES.T, np.array([-149.94, 714.56, 0.3]))
    hand_eye = HandEyeCalibration(
        tool_from_sensor=pose,
        covariance=_covariance(6),
        sensor_coupling=np.arange(150).reshape(6, 25) / 7,
        arm_noise=ArmNoise(position_mm=0.02, rotation_rad=1e-5),
        rms_mm=0.03,
        n_postures=12,
        n_exposures=36,
        n_points=9000,
        plate=Plane(point_mm=np.array([1.0, 2.0, 300.0]), axes=AXES),
        diagnostics=HandEyeDiagnostics(
            method="plate",
            rank=6,
            condition=1e3,
            weakest="along the laser line",
            plate_flatness_mm=0.01,
            flatness_length_mm=float("nan"),
            is_noise_estimated=True,
            left_out_rotation_deg=0.1,
            left_out_translation_mm=0.2,
            chi2_probability=0.3,
        ),
    )
    return ScannerCalibration(
        sensor=_sensor(), hand_eye=hand_eye, provenance=PROVENANCE, latency_ns=-1000
    )


def _stereo() -> StereoCalibration:
    pose: Pose[CameraRight, Sensor] = Pose(AXES, np.array([-117.4, 0.3, 63.2]))
    return StereoCalibration(
        left=_camera(),
        right=_camera(),
        right_from_left=pose,
        covariance=_covariance(24),
        rms_px=0.2,
        n_pairs=9,
        n_points=800,
        provenance=PROVENANCE,
        diagnostics=StereoDiagnostics(
            epipolar_rms_px=0.1, epipolar_mean_px=0.01, left_out=(("a and b", "too flat"),)
        ),
    )


def _pixels(*shape: int) -> Any:
    return np.random.default_rng(3).integers(0, 200, shape).astype(np.uint8)


def _encoded(ending: str, pixels: Any, *flags: int) -> bytes:
    return bytes(cv2.imencode(ending, pixels, list(flags))[1].tobytes())


def _netpbm() -> list[Files]:
    grey = _pixels(HEIGHT_PX, WIDTH_PX)
    head = f"{WIDTH_PX} {HEIGHT_PX}"
    text = "\n".join(" ".join(map(str, row)) for row in grey)
    wide = (grey.astype(">u2") * 16).tobytes()
    return [
        {"a.pgm": f"P5\n# made\n{head}\n255\n".encode() + grey.tobytes()},
        {"a.pgm": f"P5 {head} 4095\n".encode() + wide},
        {"a.pgm": f"P2\n{head}\n255\n{text}\n".encode()},
        {"a.ppm": f"P6 {head} 255\n".encode() + _pixels(HEIGHT_PX, WIDTH_PX, 3).tobytes()},
    ]


def _cloud() -> PointCloud:
    n = 50
    values = np.linspace(0.0, 1.0, n)
    return PointCloud(
        frame="Base",
        points_mm=np.stack([values * 20, values**2, 300 + values], axis=1),
        covariance_mm2=np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        sigma_noise_mm=np.full(n, 0.01),
        sheet=np.zeros(n, dtype=np.int64),
        sheet_names=("A",),
        exposure=np.arange(n) // 10,
        exposure_sources=tuple(f"images/{k}.png" for k in range(5)),
        segment=np.zeros(n, dtype=np.int64),
        intensity=values * 200,
    )


def _plys() -> list[Files]:
    header = "ply\nformat ascii 1.0\ncomment x\nelement vertex 3\nproperty float x\n"
    header += "property float y\nproperty float z\nproperty uchar red\nend_header\n"
    return [
        {"a.ply": ply_bytes(_cloud())},
        {"a.ply": f"{header}1 2 3 255\n4 5 6 0\n7 8 9 7\n".encode()},
    ]


def _opencv(ending: str) -> list[Files]:
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY
    storage = cv2.FileStorage(f"a{ending}", flags)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[477.0, 0, 320], [0, 478.0, 240], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", np.array([[0.1, -0.2, 0, 0, 0.3]]))
    storage.write("avg_reprojection_error", 0.3)
    return [{f"a{ending}": storage.releaseAndGetString().encode()}]


def _opencv_json() -> list[Files]:
    content = {
        "K": [[477.0, 0, 320], [0, 478.0, 240], [0, 0, 1.0]],
        "dist": [0.1],
        "dist_coeffs": [[0.1, -0.2, 0, 0, 0.3]],
        "image_size": [640, 480],
        "rms": 0.3,
    }
    return [{"a.json": json.dumps(content, indent=1).encode()}]


SESSION = f"""kind = "scan"
[pose]
form = "quaternion"
[time]
clock = "shared"
[[camera]]
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
bits_used = 8
colour = "mono"
"""
EXPOSURES = """index,t_ns,camera,file,lasers,view
0,1000,0,images/0.png,A,1
1,2000,0,images/1.png,,1
2,3000,0,images/2.png,A+B,2
"""
ARM = """t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz
500,900,0,400,1,0,0,0
1500,901,1,400,0.8,0.6,0,0
3500,902,2,400,0,0,1,0
"""
JOINTS = """t_ns,j1_rad,j2_rad,trigger_id
500,0.1,0.2,
1500,0.2,0.3,1
3500,0.3,0.4,2
"""
AXIS = """[[axis]]
theta_offset_rad = 0.1
offset_mm = 300.0
length_mm = 0.0
twist_rad = -1.5707963267948966
joint_min_rad = -3.1
joint_max_rad = 3.1
"""
ARM_MODEL = f"""name = "two joints"
{AXIS}
{AXIS}
[flange]
rotation_rows = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
translation_mm = [0.0, 0.0, 0.0]
"""
PROBE = "centre_tool_mm = [0.0, 0.0, 220.0]\ntip_diameter_mm = 6.0\n"
MARKERS = """# frame = Base
id,x_mm,y_mm,z_mm,cov_xx_mm2,cov_xy_mm2,cov_xz_mm2,cov_yy_mm2,cov_yz_mm2,cov_zz_mm2
1,10.5,20,30,1e-4,0,0,1e-4,0,1e-4
2,110.5,20,30,1e-4,0,0,1e-4,0,1e-4
3,10.5,120,30,1e-4,0,0,1e-4,0,1e-4
"""
POSES = (
    "x,y,z,w,p,r\n900.0,0.0,400.0,1.0,2.0,3.0\n901.0,10.0,400.0,10.0,20.0,30.0\n902.0,5,4,3,2,1\n"
)


def _recording(**changed: str) -> Files:
    files = {
        "session.toml": SESSION,
        "exposures.csv": EXPOSURES,
        "arm.csv": ARM,
        "truth.json": '{"simulated": true}',
    }
    files |= changed
    images = {f"images/{k}.png": _encoded(".png", _pixels(HEIGHT_PX, WIDTH_PX)) for k in range(3)}
    return {name: text.encode() for name, text in files.items()} | images


def _read_images(folder: Path) -> object:
    recording = read_recording(folder)
    return [recording.exposure(k) for k in range(len(recording.rows))]


def _observations() -> bytes:
    n = 6
    points = np.stack([np.linspace(10, 600, n), np.linspace(20, 400, n)], axis=1)
    view = TargetView(
        source="0.png",
        width_px=640,
        height_px=480,
        point_index=np.arange(n),
        points_px=points,
        covariance_px2=np.tile(0.01 * np.eye(2), (n, 1, 1)),
        points_board_mm=np.column_stack([points, np.zeros(n)]),
    )
    profile = Profile(
        source="0.png",
        points_px=points,
        normals_px=np.tile([1.0, 0.0], (n, 1)),
        sigma_px=np.full(n, 0.1),
        width_px=np.full(n, 2.0),
        intensity=np.full(n, 100.0),
        flags=np.zeros(n, dtype=np.int64),
        segment=np.zeros(n, dtype=np.int64),
    )
    return pack_observations([view, view], [profile, profile], {"0.png": "00" * 32})


def _read_touches(folder: Path) -> object:
    return read_arm_track(folder), read_probe_tip(folder / "probe.toml")


def _plane(folder: Path) -> object:
    found = read_points_or_plane(folder / "plate.csv")
    return found if isinstance(found, np.ndarray) else fit_plane(found.points_mm)


def _info(folder: Path) -> object:
    return describe_files([str(path) for path in folder.iterdir()])


def _registration() -> Registration:
    return Registration(
        kind="views",
        simulated=False,
        common_frame="Part",
        common_frame_of="a.csv",
        transforms=(
            ScanTransform(
                name="a",
                markers="a.csv",
                own_frame="Sensor",
                rotation_rows=np.eye(3),
                translation_mm=np.zeros(3),
                covariance=_covariance(6),
                n_markers=8,
                rms_mm=0.01,
            ),
        ),
        residuals=(
            MarkerResidual(name="a", id=1, common_id=1, residual_mm=np.ones(3), is_used=True),
        ),
        moved=(MovedMarker(id=2, common_id=2, offset_mm=np.ones(3)),),
        not_joined=(ScanNotJoined(name="b", reason="two markers in common"),),
        chi2=12.5,
        degrees_of_freedom=11,
        provenance=PROVENANCE,
    )


def _unsigned(document: bytes) -> bytes:
    """As of a release without the SHA-256: else hardly any mutation gets behind it."""
    return re.sub(rb",\n  \"sha256\": \"[0-9a-f]*\"\n}", b"\n}", document)


def _documents() -> dict[str, Reader]:
    kinds: dict[str, tuple[bytes, Callable[[Path], object]]] = {
        "camera.json": (camera_document(_camera()), read_camera_calibration),
        "sensor.json": (sensor_document(_sensor()), read_calibration),
        "scanner.json": (scanner_document(_scanner()), read_scanner_calibration),
        "stereo.json": (stereo_document(_stereo()), read_stereo_calibration),
        "registration.json": (registration_document(_registration()), read_registration),
    }
    return {
        name: Reader(
            files=[{name: document}, *[{name: _unsigned(document)}] * 3],
            read=lambda folder, name=name, read=read: read(folder / name),
        )
        for name, (document, read) in kinds.items()
    }


def _single(files: Sequence[Files], read: Callable[[Path], object], **options: Any) -> Reader:
    """Reader of the only file of a folder; without one, of a name that no system takes."""
    absent = "absent" * 60
    return Reader(files, lambda folder: read(next(folder.iterdir(), folder / absent)), **options)


def readers() -> dict[str, Reader]:
    """The 28 readers by their names."""
    joints = _recording(**{"arm.csv": JOINTS, "arm.toml": ARM_MODEL})
    euler = ARM.replace("qw,qx,qy,qz", "a_deg,b_deg,c_deg").replace("1,0,0,0", "1,0,0")
    euler = euler.replace("0.8,0.6,0,0", "0.8,0.6,0").replace("0,0,1,0", "0,0,1")
    scan = _recording()
    touches = {"arm.csv": scan["arm.csv"], "probe.toml": PROBE.encode()}
    profile = "x_mm,z_mm\n1.5,200.5\n2.5,201\n,\n3.5,202\n"
    yaml = "%YAML:1.0\n---\nscan_line: [ 1.5, 0., 200.5, 2.5, 0., 201., .Nan, .Nan, .Nan ]\n"
    xyz = "# x y z in frame Base\n1.0 2.0 3.0\n4.0 5.0 6.0\n7.5 8.5 9.5\n"
    rob = json.dumps({"RobPoses": [[900, 0, 400, 1, 2, 3], [901, 10, 400, 10, 20, 30.5]]})
    wide = _pixels(HEIGHT_PX, WIDTH_PX).astype(np.uint16) * 256
    colour = _pixels(HEIGHT_PX, WIDTH_PX, 3)
    pngs = [_encoded(".png", _pixels(HEIGHT_PX, WIDTH_PX)), _encoded(".png", wide)]
    tiffs = [_encoded(".tif", _pixels(HEIGHT_PX, WIDTH_PX)), _encoded(".tif", wide)]
    camera = _documents()["camera.json"].files[0]["camera.json"]
    anything: list[Files] = [
        {"camera.json": camera},
        {"a.ply": ply_bytes(_cloud())},
        {"a.npz": _observations()},
        {"a.csv": PLATE.encode()},
        {"a.png": pngs[0]},
        {"arm.toml": ARM_MODEL.encode()},
        *_opencv(".yml"),
    ]
    return {
        **_documents(),
        "session.toml": Reader([scan, joints], read_recording, mutable=("session.toml",)),
        "exposures.csv": Reader([scan], read_recording, mutable=("exposures.csv",)),
        "arm.csv": Reader(
            [scan, joints, _recording(**{"arm.csv": euler})], read_recording, mutable=("arm.csv",)
        ),
        "recording": Reader([scan, joints], _read_images),
        "touches": Reader([touches], _read_touches),
        "plate.csv": _single([{"plate.csv": PLATE.encode()}], read_probed_points),
        "plate.csv>plane": Reader(
            [{"plate.csv": PLATE.encode()}, {"plate.csv": b"A,B,C,D\n0.1,0.2,2,-400\n"}], _plane
        ),
        "markers.csv": _single(
            [{"m.csv": MARKERS.encode()}], lambda path: read_marker_list(path, frame="Base")
        ),
        "robot-poses": _single(
            [{"p.txt": POSES.encode()}, {"p.json": rob.encode()}],
            lambda path: read_robot_poses(path, "extrinsic-xyz"),
        ),
        "profiles": _single(
            [{"p.csv": profile.encode()}, {"p.yml": yaml.encode()}],
            lambda path: read_profiles([path]),
        ),
        "ply": _single(_plys(), read_cloud),
        "xyz": _single([{"a.xyz": xyz.encode()}, {"a.csv": xyz[24:].encode()}], read_cloud),
        "png": _single([{"a.png": png} for png in pngs], read_exposure, is_text=False),
        "tiff": _single([{"a.tif": tiff} for tiff in tiffs], read_exposure, is_text=False),
        "netpbm": _single(_netpbm(), read_exposure),
        "bmp-jpg": _single(
            [{"a.bmp": _encoded(".bmp", colour)}, {"a.jpg": _encoded(".jpg", colour)}],
            read_exposure,
            is_text=False,
        ),
        "opencv-yaml": _single(_opencv(".yml"), read_camera_calibration),
        "opencv-xml": _single(_opencv(".xml"), read_camera_calibration),
        "opencv-json": _single(_opencv_json(), read_camera_calibration),
        "arm.toml": _single([{"arm.toml": ARM_MODEL.encode()}], read_arm_model),
        "probe.toml": _single([{"probe.toml": PROBE.encode()}], read_probe_tip),
        "observations": _single([{"a.npz": _observations()}], read_observations, is_text=False),
        "info(any)": Reader([*anything, scan], _info),
    }


# running ----------------------------------------------------------------------------------------


class _OverTimeError(BaseException):
    """The case took too long."""


def _over_time(*_: object) -> None:
    raise _OverTimeError


def _status(key: str) -> float:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return float(text.split(f"{key}:")[1].split()[0]) / 1024


def run_case(reader: Reader, folder: Path) -> dict[str, Any]:
    """Outcome of reading a case: what happened, where, seconds and megabytes."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before_mb, start = _status("VmRSS"), time.perf_counter()
    outcome, place = "accepted", ""
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        reader.read(folder)
    except ArmscanError as error:
        outcome = "refused"
        sentence = str(error).replace(str(folder), "")
        place = "long" if len(sentence) > LONG_SENTENCE else ""
    except _OverTimeError:
        outcome, place = "slow", _place(sys.exc_info()[2])
    except MemoryError:
        outcome, place = "large", _place(sys.exc_info()[2])
    except Exception as error:
        outcome, place = (
            "other",
            f"{type(error).__name__} {_place(error.__traceback__)} {error!s:.80}",
        )
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    seconds, megabytes = time.perf_counter() - start, _status("VmHWM") - before_mb
    if outcome in ("accepted", "refused") and megabytes > LIMIT_MB:
        outcome = "large"
    if outcome in ("accepted", "refused") and seconds > LIMIT_S:
        outcome = "slow"
    return {"outcome": outcome, "place": place, "seconds": seconds, "megabytes": megabytes}


def _place(trace: Any) -> str:
    steps = [step for step in traceback.extract_tb(trace) if "armscan" in step.filename]
    return f"{Path(steps[-1].filename).name}:{steps[-1].lineno}" if steps else "?"


def work(names: Sequence[str], first: int, n_cases: int, seed: int) -> None:
    """Run cases in this process and print one line of JSON for each."""
    signal.signal(signal.SIGALRM, _over_time)
    all_readers = readers()
    limit = int((_status("VmSize") + 1.5 * LIMIT_MB) * 2**20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)
    for name in names:
        reader = all_readers[name]
        for number in range(first, first + n_cases):
            with tempfile.TemporaryDirectory(prefix="mutated-") as folder:
                write_case(Path(folder), reader, number, seed)
                print(json.dumps({"begun": [name, number]}), flush=True)
                found = run_case(reader, Path(folder))
                print(json.dumps({"reader": name, "case": number, **found}), flush=True)


def run(name: str, first: int, n_cases: int, seed: int) -> list[dict[str, Any]]:
    """Outcomes of cases of one reader; a process that dies or hangs is started again behind it."""
    outcomes: list[dict[str, Any]] = []
    while len(outcomes) < n_cases:
        begin = first + len(outcomes)
        left = n_cases - len(outcomes)
        command = [sys.executable, __file__, "--work", "--readers", name, "--seed", str(seed)]
        command += ["--first", str(begin), "--cases", str(left)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            found, death = _listen(cast(IO[bytes], process.stdout), left)
            process.kill()
        outcomes += found
        if len(found) < left:
            lost = {"reader": name, "case": first + len(outcomes), "outcome": death}
            outcomes.append({**lost, "place": "?", "seconds": SILENT_S, "megabytes": 0.0})
    return outcomes


def _listen(pipe: IO[bytes], n_cases: int) -> tuple[list[dict[str, Any]], str]:
    """Outcomes that a worker told, and how it ended before the last one."""
    found: list[dict[str, Any]] = []
    pending = b""
    patience = 120.0
    while len(found) < n_cases:
        ready, _, _ = select.select([pipe], [], [], patience)
        chunk = os.read(pipe.fileno(), 65536) if ready else b""
        if not chunk:
            return found, "died" if ready else "slow"
        *lines, pending = (pending + chunk).split(b"\n")
        parsed = [json.loads(line) for line in lines]
        found += [line for line in parsed if "outcome" in line]
        patience = SILENT_S
    return found, ""


KINDS = ("accepted", "refused", "other", "slow", "large", "died")


def main() -> None:
    """Run and tell."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--readers", nargs="*", help="names; all if left out")
    parser.add_argument("--cases", type=int, default=1500)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--keep", help="write the first case's files into this folder and stop")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    names = given.readers or list(readers())
    if given.keep:
        shutil.rmtree(given.keep, ignore_errors=True)
        write_case(Path(given.keep), readers()[names[0]], given.first, given.seed)
        return
    if given.work:
        work(names, given.first, given.cases, given.seed)
        return
    print("| reader | " + " | ".join(KINDS) + " | long sentence | slowest s | most MB |")
    print("|---" * (len(KINDS) + 4) + "|")
    total: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    example: dict[str, int] = {}
    for name in names:
        outcomes = run(name, given.first, given.cases, given.seed)
        counts = Counter(item["outcome"] for item in outcomes)
        total += counts
        n_long = sum(item["place"] == "long" for item in outcomes)
        slowest = max(item["seconds"] for item in outcomes)
        most = max(item["megabytes"] for item in outcomes)
        cells = " | ".join(str(counts[kind]) for kind in KINDS)
        print(f"| {name} | {cells} | {n_long} | {slowest:.2f} | {most:.0f} |", flush=True)
        for item in outcomes:
            if item["outcome"] not in ("accepted", "refused"):
                key = f"{name}: {item['outcome']} {item['place']}"
                faults[key] += 1
                example.setdefault(key, item["case"])
    print("sum: " + ", ".join(f"{total[kind]} {kind}" for kind in KINDS))
    for key, count in faults.most_common():
        print(f"{count} x {key} (case {example[key]})")
    if faults:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
