# SPDX-License-Identifier: Apache-2.0
"""JPEG files that lack a part: what decoders draw grey is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.storage.images import jpeg_defect, read_exposure

WRITERS: dict[str, list[int]] = {
    "plain": [],
    "optimised codes": [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    "restart markers": [cv2.IMWRITE_JPEG_RST_INTERVAL, 7],
    "half colour": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420],
    "full colour": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444],
}


def photograph(shape: tuple[int, ...]) -> np.ndarray:
    """A line on a dark, noisy ground."""
    rng = np.random.default_rng(5)
    rows = np.arange(shape[0]).reshape((-1, *[1] * (len(shape) - 1)))
    line = 200.0 * np.exp(-0.5 * ((rows - 0.4 * shape[0]) / 3.0) ** 2)
    return np.clip(20.0 + line + rng.normal(0.0, 4.0, shape), 0, 255).astype(np.uint8)


def written(shape: tuple[int, ...], options: list[int]) -> bytes:
    return bytes(cv2.imencode(".jpg", photograph(shape), options)[1].tobytes())


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("shape", [(120, 160), (121, 163), (17, 9), (120, 160, 3), (121, 163, 3)])
def test_whole_files_pass(shape: tuple[int, ...], name: str) -> None:
    assert jpeg_defect(written(shape, WRITERS[name])) == ""


@pytest.mark.parametrize("name", WRITERS)
def test_files_that_lack_a_tenth_are_refused(name: str) -> None:
    data = written((480, 640, 3), WRITERS[name])
    start = data.index(b"\xff\xda") + 20
    places = np.linspace(start, len(data) - len(data) // 10 - 20, 25).astype(int)
    for place in places:
        assert jpeg_defect(data[:place] + data[place + len(data) // 10 :])


def test_pictures_of_a_video_stream_have_no_tables_of_their_own() -> None:
    data = written((480, 640, 3), [])
    bare = bytearray(data[:2])
    position = 2
    while data[position + 1] != 0xDA:
        end = position + 2 + int.from_bytes(data[position + 2 : position + 4])
        if data[position + 1] != 0xC4:
            bare += data[position:end]
        position = end
    bare += data[position:]
    assert len(bare) < len(data) - 400
    assert jpeg_defect(bytes(bare)) == ""
    assert jpeg_defect(bytes(bare[: len(bare) // 2] + bare[len(bare) // 2 + 3000 :]))


def test_a_header_that_claims_more_than_the_data_hold_is_refused() -> None:
    data = bytearray(written((120, 160), []))
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = (32_000).to_bytes(2, "big") * 2
    assert "claims" in jpeg_defect(bytes(data))


def test_a_reader_refuses_the_damaged_file(tmp_path: Path) -> None:
    data = written((480, 640), [])
    path = tmp_path / "cut.jpg"
    path.write_bytes(data[: len(data) // 2] + data[len(data) // 2 + 3000 :])
    with pytest.raises(FileFormatError, match="damaged"):
        read_exposure(path)
