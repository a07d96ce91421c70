# SPDX-License-Identifier: Apache-2.0
"""A recording from folder to file and back, and what is left of broken files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.errors import ArmscanError, FileFormatError
from armscan.storage.recordings.read_mcap import extract_recording, record_folder
from armscan.storage.recordings.write_mcap import RecordingWriter
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
