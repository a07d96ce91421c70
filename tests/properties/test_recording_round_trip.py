# SPDX-License-Identifier: Apache-2.0
"""A recording that is written and read is the same recording."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from armscan.devices.sources import ScanSource
from armscan.geometry.rotations import EulerConvention
from armscan.models.arm import forward, thesis_arm
from armscan.records.exposure import SensorWindow
from armscan.records.recording import (
    NO_TRIGGER,
    ArmTrack,
    CameraSetup,
    ExposureRow,
    PixelColour,
    PoseForm,
    Session,
)
from armscan.storage.recording import FolderRecording, read_recording, write_recording
from rigs.recording_folders import MemoryScan

ARM = thesis_arm((300, 400, 300, 100), (20, 30, 20))
ROTATION_TOLERANCE = 1e-14
"""A few last bits: a quaternion of doubles is turned into a matrix and back."""

words = st.text(st.characters(categories=("L", "N"), include_characters='",; '), min_size=1)
names = words.map(str.strip).filter(bool)
forms = st.sampled_from(get_args(PoseForm))
conventions = st.sampled_from(get_args(EulerConvention))


@st.composite
def tracks(draw: st.DrawFn, has_triggers: bool) -> ArmTrack:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n = draw(st.integers(2, 6))
    joints = rng.uniform(-3.0, 3.0, (n, 7))
    is_known = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    if draw(st.booleans()):
        rotations, positions = forward(ARM, joints)
        joints[~is_known] = np.nan
        measured = joints
    else:
        rotations = Rotation.random(n, rng=rng).as_matrix()
        positions, measured = rng.uniform(-2000.0, 2000.0, (n, 3)), None
    first = draw(st.integers(-(2**62), 2**61))
    times = first + np.cumsum(rng.integers(10, 10**9, n))
    ids = rng.permutation(50)[:n] if has_triggers else None
    return ArmTrack(
        t_ns=times,
        rotations=rotations,
        translations_mm=positions,
        is_known=is_known,
        trigger_ids=ids,
        joints_rad=measured,
    )


@st.composite
def scans(draw: st.DrawFn) -> MemoryScan:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    colours: st.SearchStrategy[PixelColour] = st.sampled_from(["mono", "rgb"])
    cameras, images, rows = [], [], []
    has_triggers = draw(st.booleans())
    track = draw(st.none() | tracks(has_triggers))
    for _ in range(draw(st.integers(1, 2))):
        bits = draw(st.sampled_from([8, 12, 16]))
        width, height = draw(st.integers(2, 9)), draw(st.integers(2, 9))
        window = SensorWindow(draw(st.integers(0, 3000)), draw(st.integers(0, 3000)))
        cameras.append(
            CameraSetup(
                width_px=width,
                height_px=height,
                window=window,
                bits_used=bits,
                align="low",
                colour=draw(colours),
            )
        )
    start = 0 if track is None else int(track.t_ns[0])
    apart = 1 if track is None else int(track.t_ns[-1] - track.t_ns[0]) // 4
    for k in range(draw(st.integers(1, 4))):
        camera = draw(st.integers(0, len(cameras) - 1))
        setup = cameras[camera]
        shape = (setup.height_px, setup.width_px) + ((3,) if setup.colour == "rgb" else ())
        kind: Any = np.uint8 if setup.bits_used == 8 else np.uint16
        images.append(rng.integers(0, 2**setup.bits_used, shape).astype(kind))
        lasers = draw(st.lists(names, max_size=3, unique=True))
        is_first_known = has_triggers and track is not None and track.trigger_ids is not None
        trigger = int(track.trigger_ids[0]) + 50 * k if is_first_known else None
        rows.append(
            ExposureRow(
                index=3 * k,
                t_ns=start + k * apart,
                camera=camera,
                source=f"images/{k}.png",
                lasers=tuple(lasers),
                trigger_id=trigger,
                view=draw(st.none() | names),
            )
        )
    session = Session(
        kind=draw(st.sampled_from(["scan", "calibration"])),
        cameras=tuple(cameras),
        clock="separate" if has_triggers else "shared",
        pose_form=_form(draw, track),
        rotation=draw(conventions),
        is_simulated=draw(st.booleans()),
    )
    return MemoryScan(session, tuple(rows), tuple(images), track, session.is_simulated)


def _form(draw: st.DrawFn, track: ArmTrack | None) -> PoseForm:
    has_joints = track is not None and track.joints_rad is not None
    return draw(forms.filter(lambda form: form != "joints" or has_joints))


def assert_same_scan(found: ScanSource, expected: ScanSource) -> None:
    assert found.session == expected.session
    assert found.rows == expected.rows
    assert found.is_simulated == expected.is_simulated
    for k in range(len(expected.rows)):
        left, right = found.exposure(k), expected.exposure(k)
        assert left.image.dtype == right.image.dtype
        np.testing.assert_array_equal(left.image, right.image)
        for name in ("source", "bits_used", "window", "lasers", "t_ns", "camera", "view"):
            assert getattr(left, name) == getattr(right, name)
        assert left.trigger_id == right.trigger_id
    assert (found.arm is None) == (expected.arm is None)
    if found.arm is not None and expected.arm is not None:
        assert_same_track(found.arm, expected.arm)


def assert_same_track(found: ArmTrack, expected: ArmTrack) -> None:
    np.testing.assert_array_equal(found.t_ns, expected.t_ns)
    np.testing.assert_array_equal(found.is_known, expected.is_known)
    known = expected.is_known
    for name, tolerance in (("rotations", ROTATION_TOLERANCE), ("translations_mm", 1e-11)):
        left, right = getattr(found, name)[known], getattr(expected, name)[known]
        np.testing.assert_allclose(left, right, rtol=0, atol=tolerance)
    none = np.full(len(known), NO_TRIGGER)
    ids = [none if item.trigger_ids is None else item.trigger_ids for item in (found, expected)]
    np.testing.assert_array_equal(*ids)
    assert (found.joints_rad is None) == (expected.joints_rad is None)
    if found.joints_rad is not None and expected.joints_rad is not None:
        np.testing.assert_array_equal(found.joints_rad[known], expected.joints_rad[known])


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def with_unknown_columns(scan: FolderRecording, cell: str) -> FolderRecording:
    samples = 0 if scan.arm is None else len(scan.arm)
    return replace(
        scan,
        exposure_columns={"exposure_ms": tuple(f"{cell}{k}" for k in range(len(scan.rows)))},
        arm_columns={"force n": (cell,) * samples} if samples else {},
    )


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(scan=scans(), cell=names)
def test_write_then_read_gives_the_same(scan: MemoryScan, cell: str) -> None:
    with tempfile.TemporaryDirectory() as name:
        first, second, third = (Path(name) / part for part in ("1", "2", "3"))
        write_recording(first, scan, arm=ARM)
        once = read_recording(first)
        odd = [text for text in once.warnings if "between the same two samples" not in text]
        assert not odd or not scan.arm or not scan.arm.is_known.all()
        assert_same_scan(once, scan)
        kept = with_unknown_columns(once, cell)
        write_recording(second, kept)
        again = read_recording(second)
        assert_same_scan(again, scan)
        assert again.exposure_columns == kept.exposure_columns
        assert again.arm_columns == kept.arm_columns
        write_recording(third, again)
        before, after = contents(second), contents(third)
        assert before.keys() == after.keys()
        for file in before.keys() - {"arm.csv"}:
            assert before[file] == after[file]
