# SPDX-License-Identifier: Apache-2.0
"""Valid files of all of armscan's formats, and the readers that take them: see `mutated_inputs`."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armscan.geometry.poses import CameraRight, Pose, Sensor
from armscan.geometry.shapes import fit_plane
from armscan.jobs.info import describe_files
from armscan.models.two_views import StereoCalibration, StereoDiagnostics
from armscan.pipeline.live.rig import read_rig
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
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
from armscan.storage.files import read_bytes
from armscan.storage.images import read_exposure
from armscan.storage.observations import pack_observations, read_observations
from armscan.storage.points import (
    read_marker_list,
    read_points_or_plane,
    read_probed_points,
    read_profiles,
)
from armscan.storage.recording import read_arm_track, read_recording
from armscan.storage.recordings import write_mcap
from armscan.storage.recordings.mcap_folder import folder_in
from armscan.storage.recordings.read_mcap import extract_recording
from armscan.storage.recordings.robot_poses import read_robot_poses
from armscan.vision.targets.target import TargetView
from rigs.calibration_documents import (
    camera_calibration,
    covariance,
    provenance,
    scanner_calibration,
    sensor_calibration,
)

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


# valid files ------------------------------------------------------------------------------------

WIDTH_PX, HEIGHT_PX = 64, 48
PLATE = "x_mm,y_mm,z_mm\n" + "".join(
    f"{30.0 * i:.1f},{40.0 * j:.1f},{500 + 0.01 * (i + j)}\n" for i in range(4) for j in range(3)
)


def _stereo() -> StereoCalibration:
    pose: Pose[CameraRight, Sensor] = Pose(np.eye(3), np.array([-117.4, 0.3, 63.2]))
    return StereoCalibration(
        left=camera_calibration(),
        right=camera_calibration(),
        right_from_left=pose,
        covariance=covariance(24, 1),
        rms_px=0.2,
        n_pairs=9,
        n_points=800,
        provenance=provenance(),
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
                covariance=covariance(6, 1),
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
        provenance=provenance(),
    )


def _unsigned(document: bytes) -> bytes:
    """As of a release without the SHA-256: else hardly any mutation gets behind it."""
    return re.sub(rb",\n  \"sha256\": \"[0-9a-f]*\"\n}", b"\n}", document)


def _documents() -> dict[str, Reader]:
    kinds: dict[str, tuple[bytes, Callable[[Path], object]]] = {
        "camera.json": (camera_document(camera_calibration()), read_camera_calibration),
        "sensor.json": (sensor_document(sensor_calibration()), read_calibration),
        "scanner.json": (scanner_document(scanner_calibration()), read_scanner_calibration),
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


N_RECORDED = 8
"""Exposures of the recording in one file, of two cameras in turn."""
RIG = """cameras = ["webcam:0", "webcam:1"]
arm = "tcp:127.0.0.1:4000"
lasers = "laser-serial:/dev/ttyUSB0:115200"
trigger = "external"
rate_hz = 40.0
schedule = ["A", "A+B", ""]
is_common_trigger = true
scanner = "scanner.json"
"""


def _mcap() -> bytes:
    """A recording in one file, of several chunks: raw pixels, image files, samples, events."""
    setup = CameraSetup(width_px=WIDTH_PX, height_px=HEIGHT_PX)
    whole, write_mcap.CHUNK_BYTES = write_mcap.CHUNK_BYTES, 2 * WIDTH_PX * HEIGHT_PX
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scan.mcap"
            with write_mcap.RecordingWriter(path) as writer:
                writer.begin(Session(cameras=(setup, setup)), {"arm.toml": ARM_MODEL.encode()})
                for k in range(N_RECORDED):
                    pixels = np.roll(_pixels(HEIGHT_PX, WIDTH_PX), k)
                    row = ExposureRow(
                        k, k // 2 * 10**7, k % 2, f"images/{k}.png", ("A",), trigger_id=k // 2
                    )
                    writer.add_exposure(row, pixels if k % 4 < 2 else _encoded(".png", pixels))
                track = ArmTrack(
                    t_ns=np.arange(4) * 10**7,
                    rotations=np.tile(np.eye(3), (4, 1, 1)),
                    translations_mm=np.full((4, 3), 300.0),
                    is_known=np.ones(4, np.bool_),
                )
                writer.add_arm_samples(track, {"button": ("0", "1", "0", "0")})
                writer.add_event(5, "button", {"number": 1})
            return path.read_bytes()
    finally:
        write_mcap.CHUNK_BYTES = whole


def _contents(path: Path) -> Files:
    """All files of a recording in one file, images as their pixels."""
    names = [one for one in folder_in(path).names if not one.startswith("images/")]
    files = {name: read_bytes(path / name) for name in names}
    source = read_recording(path)
    images = {row.source: source.exposure(k).image for k, row in enumerate(source.rows)}
    return files | {name: image.tobytes() for name, image in images.items()}


def _one_file() -> dict[str, Reader]:
    """A recording in one file: what is read is what was recorded, whatever was mutated."""
    data = _mcap()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.mcap"
        path.write_bytes(data)
        right = _contents(path)

    def whole(path: Path) -> object:
        found = _contents(path)
        if found != right:
            raise AssertionError("another recording was read")
        return found

    def saved(path: Path) -> object:
        place = path.parent / "saved"
        try:
            found = extract_recording(path, place, is_recovering=True)
        finally:
            rest = [one for one in path.parent.iterdir() if one not in (path, place)]
            if rest:
                raise AssertionError("something half-written is left")
        for image in (place / "images").iterdir():
            if read_exposure(image).image.tobytes() != right[f"images/{image.name}"]:
                raise AssertionError("other pixels were recovered")
        listed = (place / "exposures.csv").read_bytes().splitlines()
        if not set(listed) <= set(right["exposures.csv"].splitlines()):
            raise AssertionError("other exposures were recovered")
        if len(listed) - 1 < N_RECORDED and not found.lost:
            raise AssertionError("a loss is not told")
        return found

    return {
        "mcap": _single([{"scan.mcap": data}], whole, is_text=False),
        "mcap>recover": _single([{"scan.mcap": data}], saved, is_text=False),
    }


def readers() -> dict[str, Reader]:
    """The 31 readers by their names."""
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
        **_one_file(),
        "rig.toml": _single([{"rig.toml": RIG.encode()}], read_rig),
        "info(any)": Reader([*anything, scan], _info),
    }
