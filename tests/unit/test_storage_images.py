# SPDX-License-Identifier: Apache-2.0
"""Image files: exact pixels in every format, and a sentence for each broken file."""

from __future__ import annotations

import io
import resource
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from armscan.errors import FileFormatError, OptionError
from armscan.storage.image_paths import expand_paths, natural_key
from armscan.storage.images import ImageOptions, read_exposure, read_exposures, source_names

RNG_SEED = 20


def noise(shape: tuple[int, ...], bits: int = 8) -> np.ndarray:
    kind = np.uint8 if bits <= 8 else np.uint16
    return np.random.default_rng(RNG_SEED).integers(0, 1 << bits, shape).astype(kind)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".pgm"])
def test_grey_pixels_are_exact(tmp_path: Path, suffix: str) -> None:
    image = noise((31, 47))
    path = tmp_path / f"image{suffix}"
    assert cv2.imwrite(str(path), image)
    exposure = read_exposure(path)
    assert exposure.source == path.name
    assert (exposure.bits_used, exposure.colour) == (8, "mono")
    np.testing.assert_array_equal(exposure.image, image)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".ppm"])
def test_colour_order_is_red_green_blue(tmp_path: Path, suffix: str) -> None:
    rgb = noise((12, 20, 3))
    path = tmp_path / f"image{suffix}"
    Image.fromarray(rgb).save(path)
    exposure = read_exposure(path)
    assert exposure.colour == "rgb"
    np.testing.assert_array_equal(exposure.image, rgb)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pgm"])
def test_sixteen_bits_are_exact(tmp_path: Path, suffix: str) -> None:
    image = noise((20, 30), bits=16)
    path = tmp_path / f"image{suffix}"
    assert cv2.imwrite(str(path), image)
    exposure = read_exposure(path)
    assert (exposure.bits_used, exposure.full_scale) == (16, 65535)
    np.testing.assert_array_equal(exposure.image, image)


SHORT, TWO_BYTES = 3, "<HHIHH"


def tiff_bytes(pixels: np.ndarray, *entries: tuple[int, int]) -> bytes:
    """A TIFF of one strip with these tags of one short value beside those that it must have;
    colour (3, H, W) lies in planes, one strip each.
    """
    height, width = pixels.shape[-2:]
    n, bits = pixels.size // (height * width), 8 * pixels.itemsize
    start = 8 + 2 + 12 * (9 + len(entries) + (n > 1)) + 4
    strips = [start + 100 + k * height * width * pixels.itemsize for k in range(n)]
    tail = struct.pack("<3H3I3I", bits, bits, bits, *(strips * 3)[:3], *([pixels.nbytes // n] * 3))
    one = {256: width, 257: height, 259: 1, 262: 1 if n == 1 else 2, 277: n, 278: height}
    values = one | dict(entries) | ({284: 2} if n > 1 else {})
    packed = {tag: struct.pack(TWO_BYTES, tag, SHORT, 1, value, 0) for tag, value in values.items()}
    far = {258: (SHORT, bits, start), 273: (4, strips[0], start + 6)}
    far[279] = (4, pixels.nbytes // n, start + 18)
    for tag, (kind, value, place) in far.items():
        packed[tag] = struct.pack("<HHII", tag, kind, n, value if n == 1 else place)
    body = b"".join(packed[tag] for tag in sorted(packed))
    head = struct.pack("<2sHIH", b"II", 42, 8, len(packed)) + body + bytes(4)
    return (head + tail).ljust(start + 100, b"\0") + pixels.tobytes()


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
@pytest.mark.parametrize("bits", [8, 16])
def test_no_orientation_turns_a_tiff(tmp_path: Path, orientation: int, bits: int) -> None:
    image, path = noise((20, 31), bits=bits), tmp_path / "turned.tif"
    path.write_bytes(tiff_bytes(image, (274, orientation)))
    np.testing.assert_array_equal(read_exposure(path).image, image)


def test_an_orientation_of_another_type_turns_no_tiff_either(tmp_path: Path) -> None:
    """The decoder takes one of four bytes, or of one, as it takes the standard's two."""
    image, path = noise((20, 31)), tmp_path / "long.tif"
    short = tiff_bytes(image, (274, 6))
    entry = struct.pack("<HHIHH", 274, SHORT, 1, 6, 0)
    assert entry in short
    for kind in (1, 4):
        path.write_bytes(short.replace(entry, struct.pack("<HHIHH", 274, kind, 1, 6, 0)))
        np.testing.assert_array_equal(read_exposure(path).image, image)


def test_a_transparent_tiff_is_refused_for_its_colours_are_lost(tmp_path: Path) -> None:
    """The decoder multiplies them by an alpha of 0."""
    path, rgba = tmp_path / "clear.tif", noise((20, 31, 4))
    rgba[:, :, 3] = 0
    Image.fromarray(rgba, "RGBA").save(path)
    with pytest.raises(FileFormatError, match="transparent pixels"):
        read_exposure(path)


def test_colours_in_planes_are_read_or_refused(tmp_path: Path) -> None:
    """The decoder takes planes of 16 bits for one after the other pixel."""
    path, planes = tmp_path / "planes.tif", noise((3, 20, 32))
    path.write_bytes(tiff_bytes(planes))
    np.testing.assert_array_equal(read_exposure(path).image, planes.transpose(1, 2, 0))
    path.write_bytes(tiff_bytes(noise((3, 20, 32), bits=16)))
    with pytest.raises(FileFormatError, match="keeps its colours in planes of 16 bits"):
        read_exposure(path)


def test_grey_that_counts_from_white_is_read_or_refused(tmp_path: Path) -> None:
    path, image = tmp_path / "white.tif", noise((20, 31))
    path.write_bytes(tiff_bytes(image, (262, 0)))
    np.testing.assert_array_equal(read_exposure(path).image, 255 - image)
    path.write_bytes(tiff_bytes(noise((20, 31), bits=16), (262, 0)))
    with pytest.raises(FileFormatError, match="counts from white, in 16 bits"):
        read_exposure(path)


def test_a_tiff_of_several_images_is_refused_but_not_for_its_preview(tmp_path: Path) -> None:
    path, image = tmp_path / "stack.tif", noise((20, 30))
    pages = [Image.fromarray(image), Image.fromarray(255 - image)]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    with pytest.raises(FileFormatError, match="holds several images; save each of them"):
        read_exposure(path)
    pages[0].save(path, save_all=True, append_images=[Image.fromarray(image[::2, ::2])])
    np.testing.assert_array_equal(read_exposure(path).image, image)


def test_a_fourth_byte_that_nobody_filled_is_no_alpha(tmp_path: Path) -> None:
    """A bitmap of 32 bits whose masks name red, green and blue only."""
    rgb, path = noise((20, 31, 3)), tmp_path / "padded.bmp"
    rows = np.dstack([rgb[::-1, :, ::-1], np.zeros((20, 31), np.uint8)]).tobytes()
    masks = struct.pack("<III", 0xFF0000, 0xFF00, 0xFF)
    info = struct.pack("<IiiHHIIiiII", 40, 31, 20, 1, 32, 3, len(rows), 0, 0, 0, 0) + masks
    head = b"BM" + struct.pack("<IHHI", 14 + len(info) + len(rows), 0, 0, 14 + len(info))
    path.write_bytes(head + info + rows)
    np.testing.assert_array_equal(read_exposure(path).image, rgb)


def test_a_pgm_header_of_windows_shifts_no_pixel(tmp_path: Path) -> None:
    path, image = tmp_path / "crlf.pgm", noise((4, 6))
    path.write_bytes(b"P5\r\n6 4\r\n255\r\n" + image.tobytes())
    np.testing.assert_array_equal(read_exposure(path).image, image)
    image[0, 0] = 10
    path.write_bytes(b"P5\r\n6 4\r\n255\r" + image.tobytes())
    np.testing.assert_array_equal(read_exposure(path).image, image)


def test_bits_used_and_high_alignment(tmp_path: Path) -> None:
    image = noise((20, 30), bits=12)
    low, high = tmp_path / "low.png", tmp_path / "high.png"
    cv2.imwrite(str(low), image)
    cv2.imwrite(str(high), image << 4)
    assert read_exposure(low, ImageOptions(bits_used=12)).full_scale == 4095
    aligned = read_exposure(high, ImageOptions(bits_used=12, align="high"))
    np.testing.assert_array_equal(aligned.image, image)
    with pytest.raises(OptionError, match="more than 10 bits hold"):
        read_exposure(low, ImageOptions(bits_used=10))


def test_pgm_header_says_the_bits(tmp_path: Path) -> None:
    image = noise((3, 4), bits=10)
    path = tmp_path / "ten.pgm"
    path.write_bytes(b"P5\n# a comment\n4 3\n1023\n" + image.astype(">u2").tobytes())
    exposure = read_exposure(path)
    assert exposure.bits_used == 10
    np.testing.assert_array_equal(exposure.image, image)
    text = tmp_path / "text.pgm"
    text.write_text("P2 2 1 # width, height\n255\n7 9\n")
    np.testing.assert_array_equal(read_exposure(text).image, [[7, 9]])


def test_orientation_tag_is_ignored(tmp_path: Path) -> None:
    """A camera that was held upright must not swap the axes of the sensor."""
    image = Image.fromarray(noise((16, 40, 3)))
    orientation = Image.Exif()
    orientation[0x0112] = 6
    path = tmp_path / "turned.jpg"
    image.save(path, exif=orientation)
    exposure = read_exposure(path)
    assert (exposure.width_px, exposure.height_px) == (40, 16)


def test_alpha_is_dropped_where_opaque_and_refused_otherwise(tmp_path: Path) -> None:
    grey = noise((9, 9))
    opaque = Image.merge("LA", (Image.fromarray(grey), Image.new("L", (9, 9), 255)))
    opaque.save(tmp_path / "opaque.png")
    np.testing.assert_array_equal(read_exposure(tmp_path / "opaque.png").image, grey)
    clear = Image.fromarray(noise((9, 9, 3)))
    clear.putalpha(128)
    clear.save(tmp_path / "clear.png")
    with pytest.raises(FileFormatError, match="transparent"):
        read_exposure(tmp_path / "clear.png")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "TIFF", "PPM"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.97])
def test_a_cut_file_is_never_half_a_picture(tmp_path: Path, kind: str, share: float) -> None:
    buffer = io.BytesIO()
    Image.fromarray(noise((64, 80, 3))).save(buffer, kind)
    data = buffer.getvalue()
    path = tmp_path / f"cut.{kind.lower()}"
    path.write_bytes(data)
    read_exposure(path)
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileFormatError, match=r"cut\.\w+: .*(cut short|holds \d+ of|cannot be)"):
        read_exposure(path)


def test_a_cut_jpeg_with_a_preview_inside_is_noticed(tmp_path: Path) -> None:
    """The preview in the metadata has its own end marker, which must not count."""
    preview = io.BytesIO()
    Image.fromarray(noise((8, 8, 3))).save(preview, "JPEG")
    buffer = io.BytesIO()
    Image.fromarray(noise((64, 64, 3))).save(buffer, "JPEG", comment=preview.getvalue())
    path = tmp_path / "photo.jpg"
    path.write_bytes(buffer.getvalue()[:-300])
    with pytest.raises(FileFormatError, match="cut short"):
        read_exposure(path)


def test_progressive_jpeg_is_read(tmp_path: Path) -> None:
    path = tmp_path / "progressive.jpg"
    Image.fromarray(noise((64, 64, 3))).save(path, progressive=True)
    assert read_exposure(path).width_px == 64


def test_damaged_png_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), noise((30, 30)))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="damaged near byte"):
        read_exposure(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"hello, this is text", "not a PNG"),
        (b"P5\n-3 4\n255\n", "header"),
        (b"P5\n3 4\n0\n0000", "greatest value of 0"),
        (b"\x89PNG\r\n\x1a\n", "cut short"),
        (b"BM", "cut short"),
        (b"II*\0\xff\xff\xff\x7f", "cut short"),
    ],
)
def test_broken_content_has_a_reason(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_exposure(path)


def test_missing_file_and_folder_have_a_reason(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_exposure(tmp_path / "absent.png")
    with pytest.raises(FileFormatError, match="folder, not a file"):
        read_exposure(tmp_path)


def test_natural_order() -> None:
    names = ["frame10.png", "frame2.png", "Frame1.png", "frame02.png", "a"]
    ordered = sorted(names, key=natural_key)
    assert ordered == ["Frame1.png", "a", "frame02.png", "frame2.png", "frame10.png"]


def test_paths_from_folders_patterns_and_files(tmp_path: Path) -> None:
    for name in ("f10.png", "f2.png", "f1.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    assert [p.name for p in expand_paths([tmp_path])] == ["f1.jpg", "f2.png", "f10.png"]
    found = expand_paths([f"{tmp_path}/*.png", tmp_path / "f2.png", tmp_path / "notes.txt"])
    assert [path.name for path in found] == ["f2.png", "f10.png", "notes.txt"]


def test_paths_relative_to_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "deep" / "er" / "f.png").write_bytes(b"x")
    monkeypatch.chdir(tmp_path / "deep")
    assert expand_paths(["**/*.png"]) == (Path("er/f.png"),)
    assert expand_paths(["../deep/er/*"]) == (Path("../deep/er/f.png"),)


def test_hidden_files_are_no_images_unless_they_are_named(tmp_path: Path) -> None:
    """As macOS leaves them beside each file on a disk of another system."""
    for name in ("a.jpg", "._a.jpg", ".DS_Store"):
        (tmp_path / name).write_bytes(b"x")
    assert [path.name for path in expand_paths([tmp_path])] == ["a.jpg"]
    assert [path.name for path in expand_paths([f"{tmp_path}/*.jpg"])] == ["a.jpg"]
    assert [path.name for path in expand_paths([f"{tmp_path}/.*.jpg"])] == ["._a.jpg"]


def test_a_folder_may_be_called_like_a_pattern(tmp_path: Path) -> None:
    folder = tmp_path / "photos [new]"
    folder.mkdir()
    (folder / "a.png").write_bytes(b"x")
    assert expand_paths([f"{folder}/*.png"]) == (folder / "a.png",)


def test_paths_that_match_nothing_have_a_reason(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="folder holds no image"):
        expand_paths([tmp_path])
    with pytest.raises(FileFormatError, match="no file matches the pattern"):
        expand_paths([f"{tmp_path}/*.png"])
    with pytest.raises(FileFormatError, match="no such file"):
        expand_paths([f"{tmp_path}/x.png"])
    with pytest.raises(FileFormatError, match="no image was given"):
        expand_paths([])


def test_repeated_names_are_told_apart(tmp_path: Path) -> None:
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "1.png"), noise((4, 4)))
    cv2.imwrite(str(tmp_path / "2.png"), noise((4, 4)))
    paths = [tmp_path / "left/1.png", tmp_path / "right/1.png", tmp_path / "2.png"]
    names = source_names(paths)
    assert names == ("left/1.png", "right/1.png", "2.png")
    deep = [Path("a/x/1.png"), Path("b/x/1.png"), Path("y/1.png"), Path("1.png")]
    assert source_names(deep) == ("a/x/1.png", "b/x/1.png", "y/1.png", "1.png")
    assert tuple(exposure.source for exposure in read_exposures(paths)) == names


def claiming(kind: str, width: int, height: int) -> bytes:
    """A small picture whose header claims a size; a PNG's checksum fits."""
    ending = {"PNG": ".png", "JPEG": ".jpg", "BMP": ".bmp", "TIFF": ".tif", "PGM": ".pgm"}[kind]
    content = bytearray(cv2.imencode(ending, noise((8, 8)))[1].tobytes())
    if kind == "PNG":
        content[16:24] = struct.pack(">II", width, height)
        content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    elif kind == "JPEG":
        frame = content.index(b"\xff\xc0")
        content[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    elif kind == "BMP":
        content[18:26] = struct.pack("<ii", width, height)
    elif kind == "PGM":
        content[: content.index(b"255")] = f"P5\n{width} {height}\n".encode()
    else:
        directory = struct.unpack_from("<I", content, 4)[0]
        for k in range(struct.unpack_from("<H", content, directory)[0]):
            entry = directory + 2 + 12 * k
            tag = struct.unpack_from("<H", content, entry)[0]
            if tag in (256, 257):
                size = width if tag == 256 else height
                struct.pack_into("<HII", content, entry + 2, 4, 1, size)
    return bytes(content)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "TIFF", "PGM"])
@pytest.mark.parametrize("size", [(32_000, 32_000), (2**16 - 1, 2**16 - 1), (9000, 9000)])
def test_a_size_that_a_file_cannot_hold_is_refused_at_once(
    tmp_path: Path, kind: str, size: tuple[int, int]
) -> None:
    """A few hundred bytes once made six gigabytes of a grey picture."""
    path = tmp_path / "image"
    path.write_bytes(claiming(kind, *size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileFormatError):
        read_exposure(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


def test_names_that_are_no_text_have_one() -> None:
    assert source_names([Path("na\udcefve/1.png")]) == ("1.png",)
    assert source_names([Path("na\udcefve/1.png"), Path("1.png")])[0] == "na\\xefve/1.png"
    assert natural_key("1²2.png") != natural_key("12.png")
