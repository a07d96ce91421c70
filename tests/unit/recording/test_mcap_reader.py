# SPDX-License-Identifier: Apache-2.0
"""A recording from folder to file and back, and what is left of broken files."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.errors import ArmscanError, FileFormatError, OutputError
from armscan.jobs.live.recordings import recover_recording
from armscan.records.recording import ArmTrack, CameraSetup, PixelColour, Session
from armscan.report.quantity import summary_json
from armscan.storage.recording import read_recording
from armscan.storage.recordings import write_mcap
from armscan.storage.recordings.mcap_folder import read_summary
from armscan.storage.recordings.read_mcap import extract_recording, record_folder
from armscan.storage.recordings.write_mcap import RecordingWriter, WriterOptions
from armscan.storage.tables import read_csv
from unit.recording.test_mcap_writer import SESSION, image, row

N = 12


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "scan"
    (made / "images").mkdir(parents=True)
    exposures = ["index,t_ns,camera,file,lasers,gain"]
    arm = ["t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz,button"]
    for k in range(N):
        suffix = ".png" if k % 2 else ".bmp"
        content = cv2.imencode(suffix, image(k))[1].tobytes()
        (made / f"images/{k}{suffix}").write_bytes(content)
        exposures.append(f"{k},{1000 * k},0,images/{k}{suffix},A,{k}.50")
        arm.append(f"{1000 * k},{300 + k}.000,0.10,5e1,2.0,0,0,0.0,{k % 2}")
    (made / "exposures.csv").write_text("\n".join(exposures) + "\n")
    (made / "arm.csv").write_text("\n".join(arm).replace("2.0,0,0", "1.00,0,0") + "\n")
    (made / "session.toml").write_text("[[camera]]\nwidth_px = 40\nheight_px = 30\n")
    return made


def content_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_folder_comes_back_byte_by_byte(folder: Path, tmp_path: Path) -> None:
    record_folder(folder, tmp_path / "scan.mcap")
    found = extract_recording(tmp_path / "scan.mcap", tmp_path / "back")
    assert (found.n_exposures, found.n_samples, found.n_aside) == (N, N, 0)
    assert not found.lost and not found.warnings
    assert content_of(tmp_path / "back") == content_of(folder)


@pytest.mark.parametrize("is_cut", [True, False])
def test_a_broken_file_gives_a_good_part_or_a_typed_error(
    folder: Path, tmp_path: Path, is_cut: bool
) -> None:
    whole = content_of(folder)
    record_folder(folder, tmp_path / "scan.mcap")
    data = (tmp_path / "scan.mcap").read_bytes()
    rng = np.random.default_rng(5)
    broken = tmp_path / "broken.mcap"
    n_saved = 0
    for k in range(60):
        place = int(rng.integers(0, len(data)))
        flipped = data[:place] + bytes([data[place] ^ (1 << int(rng.integers(8)))])
        broken.write_bytes(data[:place] if is_cut else flipped + data[place + 1 :])
        strict, saved = tmp_path / f"strict{k}", tmp_path / f"saved{k}"
        try:
            extract_recording(broken, strict)
            assert not is_cut
            assert content_of(strict) == whole
        except ArmscanError:
            assert not strict.exists()
        try:
            found = extract_recording(broken, saved, is_recovering=True)
        except ArmscanError:
            assert not saved.exists()
            continue
        n_saved += 1
        rest = content_of(saved)
        assert found.lost or set(rest) == set(whole)
        images = {name for name in rest if name.startswith("images/")}
        assert len(images) == found.n_exposures > 0
        assert all(rest[name] == whole[name] for name in images)
    assert n_saved > 0
    assert not list(tmp_path.glob(".*"))


def test_an_unfinished_file_is_told_to_be_recovered(tmp_path: Path) -> None:
    path = tmp_path / "scan.mcap"
    with RecordingWriter(path) as writer:
        writer.begin(SESSION)
        for k in (0, 1, 2, 2):
            writer.add_exposure(row(k), image(k))
    data = path.read_bytes()
    path.write_bytes(data[:-40])
    with pytest.raises(FileFormatError, match=r"unfinished.*armscan recover"):
        extract_recording(path, tmp_path / "strict")
    found = extract_recording(path, tmp_path / "saved", is_recovering=True)
    assert (found.n_exposures, found.n_aside) == (3, 1)
    assert read_csv(tmp_path / "saved" / "exposures.csv").columns["index"] == ("0", "1", "2")
    for k in range(3):
        pixels = cv2.imread(str(tmp_path / "saved" / row(k).source), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(pixels, image(k))


def recorded(path: Path, monkeypatch: pytest.MonkeyPatch, n: int = 12) -> list[tuple[int, int]]:
    """A recording of ``n`` exposures, three a chunk; where the chunks of images begin and end."""
    monkeypatch.setattr(write_mcap, "CHUNK_BYTES", 4000)
    with RecordingWriter(path, WriterOptions("raw")) as writer:
        writer.begin(SESSION, {"arm.toml": b"name = 'x'\n"})
        for k in range(n):
            writer.add_exposure(row(k), image(k))
    chunks = read_summary(path).chunks
    spans = [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in chunks]
    return [span for span in spans if span[1] - span[0] > 3000]


@pytest.mark.parametrize("place", [0, 2, 5, 30, 900])
def test_recovery_goes_on_after_a_damaged_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    path, saved = tmp_path / "scan.mcap", tmp_path / "saved"
    start, _ = recorded(path, monkeypatch)[1]
    data = bytearray(path.read_bytes())
    data[start + place] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="damaged"):
        extract_recording(path, tmp_path / "strict")
    found = extract_recording(path, saved, is_recovering=True)
    assert (found.n_exposures, found.n_lost) == (9, 3)
    assert found.lost[0] == "3 of 12 exposures"
    assert read_csv(saved / "exposures.csv").columns["index"] == tuple(
        map(str, (0, 1, 2, *range(6, 12)))
    )
    for k in (0, 1, 2, *range(6, 12)):
        pixels = cv2.imread(str(saved / row(k).source), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(pixels, image(k))


def test_what_makes_no_file_is_told_to_be_saved_as_a_folder(tmp_path: Path) -> None:
    """The poses of the ids that came back are lost: a folder of it can be mended."""
    path = tmp_path / "scan.mcap"
    with RecordingWriter(path) as writer:
        writer.begin(replace(SESSION, clock="separate"))
        for k in range(3):
            writer.add_exposure(replace(row(k), trigger_id=k), image(k))
        track = ArmTrack(
            t_ns=np.arange(3) + 1,
            rotations=np.tile(np.eye(3), (3, 1, 1)),
            translations_mm=np.zeros((3, 3)),
            is_known=np.ones(3, dtype=bool),
            trigger_ids=np.arange(3) + 50,
        )
        writer.add_arm_samples(track)
    with pytest.raises(OutputError, match=r"no trigger_id is in both.*as a folder.*-o \S*saved\.$"):
        recover_recording(path, tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()
    assert recover_recording(path, tmp_path / "saved").data["exposures"] == 3


@pytest.mark.parametrize(("is_gap", "shown"), [(False, "not known"), (True, "at least 3")])
def test_without_the_end_lost_exposures_are_counted_as_far_as_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_gap: bool, shown: str
) -> None:
    """Three of twelve are behind the cut, and nothing says so; a gap before it tells of others."""
    path = tmp_path / "scan.mcap"
    spans = recorded(path, monkeypatch)
    data = bytearray(path.read_bytes()[: spans[3][0]])
    if is_gap:
        data[spans[1][0] + 30] ^= 0xFF
    path.write_bytes(data)
    summary = recover_recording(path, tmp_path / "saved")
    told = next(one for one in summary.quantities if one.key == "lost_exposures")
    assert told.text == shown
    assert json.loads(summary_json(summary))["lost_exposures"] is None
    assert summary.data["least_lost_exposures"] == 3 * is_gap
    assert ("lost: at least 3 exposures" in summary.warnings) is is_gap
    assert not any("lost: 0 bytes" in text for text in summary.warnings)


def test_what_is_left_without_its_beginning_has_its_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, saved = tmp_path / "scan.mcap", tmp_path / "saved"
    spans = recorded(path, monkeypatch)
    data = bytearray(path.read_bytes())
    data[8 : spans[0][0]] = bytes(spans[0][0] - 8)
    path.write_bytes(data)
    found = extract_recording(path, saved, is_recovering=True)
    assert (found.n_exposures, found.n_lost, found.warnings) == (12, 0, ())
    assert read_recording(saved).session.cameras == SESSION.cameras
    assert (saved / "arm.toml").read_bytes() == b"name = 'x'\n"


def test_any_prefix_that_holds_a_chunk_is_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scan.mcap"
    spans = recorded(path, monkeypatch)
    data = path.read_bytes()
    for k, (_, end) in enumerate(spans[1:]):
        path.write_bytes(data[: end + 10])
        found = extract_recording(path, tmp_path / f"saved{k}", is_recovering=True)
        assert found.n_exposures == 3 * (k + 1)
        assert found.lost and not found.warnings


@pytest.mark.parametrize(
    ("shape", "dtype", "colour"),
    [
        ((30, 40), np.uint8, "bayer_rggb"),
        ((30, 40), np.uint16, "mono"),
        ((30, 40, 3), np.uint8, "rgb"),
    ],
)
def test_recovered_raw_pixels_are_those_recorded(
    tmp_path: Path, shape: tuple[int, ...], dtype: type, colour: PixelColour
) -> None:
    path, again = tmp_path / "scan.mcap", tmp_path / "again.mcap"
    bits = 8 * np.dtype(dtype).itemsize
    session = Session(cameras=(CameraSetup(40, 30, bits_used=bits, colour=colour),))
    pixels = np.random.default_rng(1).integers(0, 2**bits, shape).astype(dtype)
    writer = RecordingWriter(path)
    writer.begin(session)
    writer.add_exposure(row(0), pixels)
    writer.add_event(77, "button")
    writer.close()
    path.write_bytes(path.read_bytes()[:-40])
    recover_recording(path, again)
    recover_recording(path, tmp_path / "saved")
    events = [
        json.loads(line)
        for line in (tmp_path / "saved/events.jsonl").read_bytes().split(b"\n")[:-1]
    ]
    assert events == [{"t_ns": 77, "kind": "button", "facts": {}}]
    kept = read_recording(tmp_path / "saved")
    shown = kept.exposure(0).image
    wanted = cv2.cvtColor(pixels, cv2.COLOR_BayerRGGB2RGB) if colour == "bayer_rggb" else pixels
    np.testing.assert_array_equal(shown, wanted)
    assert kept.session.cameras == session.cameras
    extract_recording(again, tmp_path / "third")
    np.testing.assert_array_equal(read_recording(tmp_path / "third").exposure(0).image, wanted)


def test_a_full_disk_leaves_nothing_of_a_conversion(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr(os, "writev", full)
    with pytest.raises(OutputError, match=r"scan.mcap: nothing was written \(No space"):
        record_folder(folder, tmp_path / "scan.mcap")
    assert sorted(tmp_path.iterdir()) == before
