# SPDX-License-Identifier: Apache-2.0
"""Recordings of the band around stripes: the same points, zero elsewhere, and said so."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli import main
from armscan.jobs.info import describe_recording
from armscan.records.exposure import Exposure
from armscan.records.recording import CameraSetup, ExposureRow, Session
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import extract_recording
from armscan.storage.recordings.write_mcap import RecordingWriter, WriterOptions
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.ridge import near_lines

SIZE = (400, 640)


def lit_image(seed: int, bits: int = 8, ambient: float = 25.0) -> np.ndarray:
    """A bent line, a faint one that crosses it, a spot, on ground that brightens to one side."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    first = y - (150 + 0.1 * x + 20 * np.sin(x / 150))
    second = (x - 330) + 0.3 * (y - 200)
    light = 170 * np.exp(-0.5 * (first / 3) ** 2) + 40 * np.exp(-0.5 * (second / 2.5) ** 2)
    light += 90 * np.exp(-0.5 * ((x - 560) ** 2 + (y - 340) ** 2) / 6**2)
    light *= 1.0 + 0.2 * cv2.GaussianBlur(rng.normal(size=SIZE), (0, 0), 1.0)
    image = light + ambient * (0.5 + x / SIZE[1]) + rng.normal(0, 2.0, SIZE)
    full = (1 << bits) - 1
    return np.clip(image * full / 255, 0, full).astype(np.uint8 if bits == 8 else np.uint16)


def test_wide_lines_have_a_wide_band() -> None:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:800, : SIZE[1]].astype(float)
    # so wide that its sides, where the background is told, lie beyond 40 px
    light = 120 * np.exp(-0.5 * ((y - 200 - 0.7 * x + 60 * np.sin(x / 200)) / 22.0) ** 2)
    image = np.clip(light + 30 + 0.03 * y + rng.normal(0, 2, y.shape), 0, 255)
    whole = Exposure(image.astype(np.uint8), "wide")
    keep = near_lines(whole.image.astype(np.float32))
    part = replace(whole, image=np.where(keep, whole.image, np.uint8(0)))
    found = extract_stripes(whole)
    assert len(found) > 200
    assert keep.mean() < 0.9
    np.testing.assert_array_equal(extract_stripes(part).points_px, found.points_px)
    np.testing.assert_array_equal(extract_stripes(part).flags, found.flags)


def test_an_image_whose_noise_hides_its_lines_is_kept_whole() -> None:
    """Lines are sought in it blurred: what lies beside them belongs to it."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:300, : SIZE[1]].astype(float)
    light = 40.0 * np.exp(-0.5 * ((y - 150.0 - 0.1 * x) / 2.0) ** 2)
    image = np.clip(light + 60.0 + rng.normal(0.0, 12.0, y.shape), 0, 255).astype(np.uint8)
    assert extract_stripes(Exposure(image, "noisy")).is_accepted.sum() > 0.9 * SIZE[1]
    assert near_lines(image.astype(np.float32)).all()
    faint = np.clip(light + 60.0 + rng.normal(0.0, 1.0, y.shape), 0, 255).astype(np.float32)
    assert near_lines(faint).mean() < 0.6


def row(k: int, lasers: tuple[str, ...] = ("A",), view: str | None = None) -> ExposureRow:
    return ExposureRow(k, k * 10**7, 0, f"images/{k}.png", lasers, view=view)


@pytest.mark.parametrize(("bits", "ambient"), [(8, 25.0), (12, 60.0), (8, 2.0)])
def test_the_same_points_come_out_of_less(tmp_path: Path, bits: int, ambient: float) -> None:
    setup = CameraSetup(SIZE[1], SIZE[0], bits_used=bits)
    images = [lit_image(seed, bits, ambient) for seed in range(4)]
    sizes = []
    for is_band in (False, True):
        path = tmp_path / f"{is_band}.mcap"
        options = WriterOptions(compression="zstd", is_stripe_band=is_band)
        with RecordingWriter(path, options) as writer:
            writer.begin(Session(cameras=(setup,)))
            for k, image in enumerate(images):
                writer.add_exposure(row(k), image)
        sizes.append(path.stat().st_size)
    source = read_recording(tmp_path / "True.mcap")
    for k, image in enumerate(images):
        found = source.exposure(k)
        whole = extract_stripes(Exposure(image, found.source, bits_used=bits, lasers=("A",)))
        assert len(whole) > 600
        part = extract_stripes(found)
        for one in fields(whole):
            np.testing.assert_array_equal(getattr(part, one.name), getattr(whole, one.name))
        is_kept = found.image == image
        assert (is_kept | (found.image == 0)).all()
        assert is_kept.mean() < 0.75
    assert sizes[1] < 0.75 * sizes[0]


def test_it_is_named_so_and_images_without_a_stripe_are_whole(tmp_path: Path) -> None:
    path, dark = tmp_path / "scan.mcap", np.random.default_rng(1).integers(0, 9, SIZE, np.uint8)
    with RecordingWriter(path, WriterOptions(is_stripe_band=True)) as writer:
        writer.begin(Session(cameras=(CameraSetup(SIZE[1], SIZE[0]),)))
        writer.add_exposure(row(0), lit_image(0))
        writer.add_exposure(row(1, lasers=()), dark)
        writer.add_exposure(row(2, view="p0"), lit_image(2))
    for place in (path, tmp_path / "folder"):
        if place != path:
            extract_recording(path, place)
        source = read_recording(place)
        assert source.session.is_stripe_band
        assert "stripe band" in describe_recording(place)["pixels"]
        assert not np.array_equal(source.exposure(0).image, lit_image(0))
        np.testing.assert_array_equal(source.exposure(1).image, dark)
        np.testing.assert_array_equal(source.exposure(2).image, lit_image(2))


def test_a_recording_is_converted_to_its_band(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = tmp_path / "scan"
    (scan / "images").mkdir(parents=True)
    cv2.imwrite(str(scan / "images/0.png"), lit_image(0))
    (scan / "exposures.csv").write_text("index,t_ns,camera,file,lasers\n0,5,0,images/0.png,A\n")
    (scan / "session.toml").write_text(session_text())
    assert main(["convert", str(scan), str(tmp_path / "a.mcap")]) == 0
    for source in (scan, tmp_path / "a.mcap"):
        band = tmp_path / f"{source.name}-band.mcap"
        assert main(["convert", str(source), str(band), "--stripe-band"]) == 0
        found = read_recording(band)
        assert found.session.is_stripe_band
        assert 0.2 < (found.exposure(0).image == lit_image(0)).mean() < 0.75
    assert "of these as a band  1" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "a.mcap"), str(tmp_path / "b"), "--stripe-band"]) == 2
    assert "--stripe-band: a stripe band is for recordings" in capsys.readouterr().err


def test_a_band_is_said_only_where_one_is_kept(tmp_path: Path) -> None:
    scan = tmp_path / "scan"
    (scan / "images").mkdir(parents=True)
    cv2.imwrite(str(scan / "images/0.png"), lit_image(0))
    (scan / "exposures.csv").write_text("index,t_ns,camera,file,lasers\n0,5,0,images/0.png,\n")
    (scan / "session.toml").write_text(session_text())
    assert main(["convert", str(scan), str(tmp_path / "a.mcap"), "--stripe-band"]) == 0
    found = read_recording(tmp_path / "a.mcap")
    assert not found.session.is_stripe_band
    np.testing.assert_array_equal(found.exposure(0).image, lit_image(0))


def test_a_recording_is_not_replaced_by_its_band(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, WriterOptions()) as writer:
        writer.begin(Session(cameras=(CameraSetup(SIZE[1], SIZE[0]),)))
        writer.add_exposure(row(0), lit_image(0))
    before = path.read_bytes()
    assert main(["convert", str(path), str(path), "--stripe-band", "--force"]) == 2
    assert "a.mcap is read, and would be replaced" in capsys.readouterr().err
    assert path.read_bytes() == before


def session_text() -> str:
    return f"[[camera]]\nwidth_px = {SIZE[1]}\nheight_px = {SIZE[0]}\n"
