# SPDX-License-Identifier: Apache-2.0
"""Rules of ``session.toml``, and of the images that it describes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.errors import ArmscanError, FileFormatError, InputError, OptionError
from armscan.pipeline.instants import check_sizes
from armscan.records.exposure import SensorWindow
from armscan.records.recording import CameraSetup, ExposureRow, Session
from armscan.storage.image_paths import are_simulated
from armscan.storage.recording import read_recorded, read_recording, write_recording
from armscan.storage.recording_session import read_session_file, session_toml
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.plain_scanner import plain_camera
from rigs.recording_folders import ARM, EXPOSURES, SESSION, lab_folder, pixels, refusal


def test_a_session_comes_back(tmp_path: Path) -> None:
    session = Session(
        kind="calibration",
        cameras=(
            CameraSetup(
                width_px=2658,
                height_px=800,
                window=SensorWindow(203, 617, 2),
                bits_used=12,
                align="high",
                colour="rgb",
            ),
            CameraSetup(colour="bayer_rggb"),
        ),
        clock="separate",
        pose_form="euler",
        rotation="intrinsic-zxz",
        head='head "A" \\ größe.toml',
        is_simulated=True,
        assumed=("left out:\nit is no fact of the recording",),
    )
    path = tmp_path / "session.toml"
    path.write_bytes(session_toml(session))
    found = read_session_file(path)
    assert session_toml(found.session) == session_toml(session).split(b"\n", 1)[1]
    assert found.session.cameras == session.cameras
    assert (found.session.head, found.session.rotation) == (session.head, session.rotation)
    assert found.warnings == ()


def test_missing_keys_take_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_bytes(b"# nothing said\n[[camera]]\n")
    assert read_session_file(path).session == Session()


def test_without_a_session_the_columns_decide_and_all_is_said(tmp_path: Path) -> None:
    arm = ARM.replace("qw,qx,qy,qz", "a_deg,b_deg,c_deg,extra")
    scan = read_recording(lab_folder(tmp_path, session=None, arm=arm))
    setup = scan.session.cameras[0]
    assert (setup.width_px, setup.height_px, setup.bits_used) == (8, 6, 8)
    assert (scan.session.pose_form, scan.session.clock) == ("euler", "shared")
    said = "; ".join(scan.session.assumed)
    for part in (
        "no session.toml",
        "form 'euler'",
        "Euler angles are 'intrinsic-xyz'",
        "share one clock",
        "width_px 8, height_px 6, bits_used 8, colour mono, as images/0.png",
    ):
        assert part in said


@pytest.mark.parametrize(
    ("shape", "kind", "said"),
    [((6, 8), np.uint16, "more than 8 bits hold"), ((6, 8, 3), np.uint8, "its camera is 'mono'")],
)
def test_a_camera_that_is_described_has_the_formats_defaults(
    tmp_path: Path, shape: tuple[int, ...], kind: type[np.generic], said: str
) -> None:
    folder = lab_folder(tmp_path, session="[[camera]]\nwidth_px = 8\nheight_px = 6\n")
    cv2.imwrite(
        str(folder / "images/0.png"), np.full(shape, 256 if kind is np.uint16 else 9).astype(kind)
    )
    with pytest.raises(ArmscanError, match=said):
        read_recording(folder).exposure(0)


@pytest.mark.parametrize("ending", ["png", "bmp", "tif", "pgm", "jpg"])
def test_every_format_of_images_is_read(tmp_path: Path, ending: str) -> None:
    table = EXPOSURES.replace("0.png", f"0.{ending}")
    folder = lab_folder(tmp_path, exposures=table)
    flat = np.full((6, 8), 77, np.uint8)
    cv2.imwrite(str(folder / f"images/0.{ending}"), flat)
    np.testing.assert_array_equal(read_recording(folder).exposure(0).image, flat)


def test_what_the_images_show_is_taken_where_nobody_said_it(tmp_path: Path) -> None:
    session = SESSION.split("[[camera]]")[0]
    folder = lab_folder(tmp_path, session=session)
    for k in range(3):
        deep = np.full((6, 8, 3), 4000 * (k + 1), np.uint16)
        deep[..., 0] = 7
        cv2.imwrite(str(folder / f"images/{k}.png"), deep)
    scan = read_recording(folder)
    assert (scan.session.cameras[0].bits_used, scan.session.cameras[0].colour) == (16, "rgb")
    assert scan.exposure(1).image[0, 0].tolist() == [8000, 8000, 7]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "scan"', 'kind = "sweep"', "'kind' is 'sweep'"),
        ('kind = "scan"', "kind = 3", "'kind' is 3"),
        ('form = "quaternion"', 'form = "quat"', "'pose.form' is 'quat'"),
        ("[pose]", '[pose]\nrotation = "xyz"', "'pose.rotation' is 'xyz'"),
        ('clock = "shared"', 'clock = "gps"', "'time.clock' is 'gps'"),
        ("width_px = 8", "width_px = 8.0", "'camera.0.width_px' is 8.0"),
        ("width_px = 8", 'width_px = "8"', "'camera.0.width_px' is '8'"),
        ("width_px = 8", "width_px = 0", "'camera.0.width_px' is 0"),
        ("width_px = 8", "window_x_px = -1", "'camera.0.window_x_px' is -1"),
        ("bits_used = 8", "bits_used = 24", "'camera.0.bits_used' is 24"),
        ("bits_used = 8", 'align = "left"', "'camera.0.align' is 'left'"),
        ('"mono"', '"grey"', "'camera.0.colour' is 'grey'"),
        ("[[camera]]", "[camera]", "[[camera]] with two brackets"),
        ('kind = "scan"', "kind = scan", "no TOML"),
        ('kind = "scan"', 'simulated = "yes"', "'simulated' is 'yes'"),
    ],
)
def test_wrong_keys_are_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    message = refusal(tmp_path, session=SESSION.replace(old, new))
    assert said in message and "session.toml" in message


def test_unknown_keys_are_warned_of_with_the_nearest_name(tmp_path: Path) -> None:
    session = SESSION.replace("[pose]", 'lab = "x"\n[pose]\nrotations = "x"')
    session = session.replace("bits_used", "bit_used")
    warnings = read_recording(lab_folder(tmp_path, session=session)).warnings
    assert len(warnings) == 3
    assert any("'lab' is not known" in text for text in warnings)
    assert any("'pose.rotations' is not known" in t and "'rotation' is" in t for t in warnings)
    assert any("'camera.0.bit_used' is not known" in t and "'bits_used' is" in t for t in warnings)


def test_unknown_lists_and_tables_of_tables_are_warned_of_too(tmp_path: Path) -> None:
    session = 'operators = ["Anna", "Bob"]\n' + SESSION + '\n[[lens]]\nname = "x"\n'
    warnings = read_recording(lab_folder(tmp_path, session=session)).warnings
    assert [name for name in ("operators", "lens") for text in warnings if f"'{name}'" in text] == [
        "operators",
        "lens",
    ]


def test_a_head_that_is_not_there_is_warned_of(tmp_path: Path) -> None:
    session = 'head = "head.toml"\n' + SESSION
    folder = lab_folder(tmp_path, session=session)
    assert any("no file head.toml" in text for text in read_recording(folder).warnings)
    (folder / "head.toml").write_text("")
    assert read_recording(folder).warnings == ()
    (folder / "session.toml").write_text(session.replace("head.toml", "../head.toml"))
    with pytest.raises(FileFormatError, match="no path inside the recording"):
        read_recording(folder)


@pytest.mark.parametrize(
    ("size_px", "window_px", "is_read"),
    [
        ((8, 6), (0, 0), True),
        ((8, 6), (5, 3), True),
        ((5, 4), (3, 2), True),
        ((5, 4), (4, 2), False),
        ((5, 4), (3, 3), False),
        ((9, 6), (0, 0), False),
        ((8, 7), (0, 0), False),
    ],
)
def test_an_image_has_its_cameras_size_or_lies_inside_it(
    tmp_path: Path, size_px: tuple[int, int], window_px: tuple[int, int], is_read: bool
) -> None:
    """The camera of the session has 8 x 6 px."""
    window = f"window_x_px = {window_px[0]}\nwindow_y_px = {window_px[1]}\n"
    folder = lab_folder(tmp_path, session=SESSION + window)
    cv2.imwrite(str(folder / "images/1.png"), pixels(7, size_px[::-1]))
    scan = read_recording(folder)
    if is_read:
        assert scan.exposure(1).window == SensorWindow(*window_px)
        return
    with pytest.raises(FileFormatError) as caught:
        scan.exposure(1)
    message = str(caught.value)
    assert "images/1.png" in message
    assert f"is {size_px[0]} x {size_px[1]} px, its camera 8 x 6 px" in message


@pytest.mark.parametrize(
    ("size_px", "window", "is_noted"),
    [
        ((5, 4), "", True),
        ((5, 4), "window_x_px = 0\n", True),
        ((5, 4), "window_x_px = 0\nwindow_y_px = 0\n", False),
        ((5, 4), "is_window = true\n", False),
        ((8, 6), "", False),
    ],
)
def test_a_window_whose_place_nobody_said_is_noted(
    tmp_path: Path, size_px: tuple[int, int], window: str, is_noted: bool
) -> None:
    """The camera of the session has 8 x 6 px."""
    folder = lab_folder(tmp_path, session=SESSION + window)
    cv2.imwrite(str(folder / "images/0.png"), pixels(7, size_px[::-1]))
    assumed = read_recording(folder).session.assumed
    said = "camera 0: 0.png with 5 x 4 px is a window at 0, 0 of the camera's 8 x 6 px; window_x_px"
    assert [text.startswith(said) for text in assumed] == [True] * is_noted


@pytest.mark.parametrize(
    ("window", "is_stated"),
    [
        ("", False),
        ("window_x_px = 0\n", False),
        # all files once bore both, also of whole images
        ("window_x_px = 0\nwindow_y_px = 0\n", False),
        ("window_x_px = 0\nwindow_y_px = 0\nbinning = 1\nis_window = false\n", False),
        ("window_x_px = 0\nwindow_y_px = 0\nis_window = true\n", True),
        ("is_window = true\n", True),
        ("window_x_px = 3\nwindow_y_px = 2\n", True),
    ],
)
def test_a_window_in_the_corner_is_one_where_the_session_says_so(
    tmp_path: Path, window: str, is_stated: bool
) -> None:
    folder = lab_folder(tmp_path, session=SESSION + window)
    scan = read_recording(folder)
    assert scan.exposure(1).window.is_stated == is_stated
    write_recording(tmp_path / "again", scan)
    again = read_recording(tmp_path / "again")
    assert again.exposure(1).window.is_stated == is_stated and again.warnings == scan.warnings
    assert ("is_window = true" in (tmp_path / "again" / "session.toml").read_text()) == is_stated
    # a larger sensor's corner, or another camera's whole image
    sensor = plain_camera(10.0, (5.0, 4.0), (16, 12))
    if is_stated:
        check_sizes([again.exposure(1)], sensor)
        return
    with pytest.raises(InputError, match="is_window = true"):
        check_sizes([again.exposure(1)], sensor)


def test_a_word_that_says_no_window_is_refused(tmp_path: Path) -> None:
    folder = lab_folder(tmp_path, session=SESSION + 'is_window = "corner"\n')
    with pytest.raises(FileFormatError, match="is_window"):
        read_recording(folder)


def test_high_aligned_bits_are_shifted_and_too_many_are_refused(tmp_path: Path) -> None:
    session = SESSION.replace("bits_used = 8", 'bits_used = 12\nalign = "high"')
    folder = lab_folder(tmp_path, session=session)
    levels = np.random.default_rng(3).integers(0, 4096, (6, 8)).astype(np.uint16)
    cv2.imwrite(str(folder / "images/0.png"), levels << 4)
    exposure = read_recording(folder).exposure(0)
    np.testing.assert_array_equal(exposure.image, levels)
    assert exposure.bits_used == 12
    (folder / "session.toml").write_text(session.replace("high", "low"))
    with pytest.raises(OptionError, match="more than 12 bits hold") as refused:
        read_recording(folder).exposure(0)
    for key in ("bits_used", "align", "session.toml"):
        assert key in refused.value.remedy


@pytest.mark.parametrize("said", ["mono", "rgb", "bayer_rggb"])
def test_the_layout_that_the_session_says_is_the_images(tmp_path: Path, said: str) -> None:
    folder = lab_folder(tmp_path, session=SESSION.replace("mono", said))
    wrong = pixels(1) if said == "rgb" else pixels(1, (6, 8, 3))
    cv2.imwrite(str(folder / "images/1.png"), wrong)
    with pytest.raises(FileFormatError, match=f"its camera is '{said}'"):
        read_recording(folder).exposure(1)


def test_images_of_a_bayer_pattern(tmp_path: Path) -> None:
    """A field of one colour: red where the pattern has red, at even rows and columns."""
    levels = {"red": 200, "green": 90, "blue": 30}
    mosaic = np.full((6, 8), levels["green"], np.uint8)
    mosaic[::2, ::2], mosaic[1::2, 1::2] = levels["red"], levels["blue"]
    folder = lab_folder(tmp_path, session=SESSION.replace('"mono"', '"bayer_rggb"'))
    cv2.imwrite(str(folder / "images/0.png"), mosaic)
    image = read_recording(folder).exposure(0).image
    assert image.shape == (6, 8, 3)
    assert (image == [*levels.values()]).all()


def test_a_bayer_pattern_of_many_bits_keeps_them(tmp_path: Path) -> None:
    session = SESSION.replace('"mono"', '"bayer_rggb"').replace("used = 8", "used = 12")
    folder = lab_folder(tmp_path, session=session)
    cv2.imwrite(str(folder / "images/0.png"), np.full((6, 8), 3001, np.uint16))
    assert (read_recording(folder).exposure(0).image == 3001).all()


def test_a_recording_says_itself_that_it_is_simulated(tmp_path: Path) -> None:
    """Also to programs that are given its images only, up to three folders down."""
    folder = lab_folder(tmp_path / "a", session="simulated = true\n" + SESSION)
    assert read_recording(folder).is_simulated
    assert are_simulated([folder / "images/0.png"])
    assert are_simulated([folder / "images/on/0.png"])
    assert are_simulated([folder / "images/left/A/0.png"])
    assert not are_simulated([tmp_path / "other.png"])
    silent = lab_folder(tmp_path / "c")
    assert not read_recording(silent).is_simulated
    (tmp_path / "c" / "truth.json").write_text('{"simulated": true}')
    assert read_recording(silent).is_simulated
    real = lab_folder(tmp_path / "b", session="simulated = false\n" + SESSION)
    assert not read_recording(real).is_simulated
    (real / "session.toml").write_text("simulated = tru")
    assert not are_simulated([real / "images/0.png"])


@pytest.mark.parametrize("name", ["", "scan/images", "nowhere"])
def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path, name: str) -> None:
    lab_folder(tmp_path)
    with pytest.raises(FileFormatError, match=r"no exposures\.csv|no such folder"):
        read_recording(tmp_path / name)


def test_an_image_of_another_camera_is_described_by_its_own_table(tmp_path: Path) -> None:
    table = EXPOSURES.replace("2,3000,0", "2,3000,1")
    session = SESSION + '[[camera]]\ncolour = "rgb"\nwindow_x_px = 4\n'
    folder = lab_folder(tmp_path, session=session, exposures=table)
    cv2.imwrite(str(folder / "images/2.png"), pixels(5, (2, 3, 3)))
    scan = read_recording(folder)
    assert scan.exposure(2).camera == 1
    assert scan.exposure(2).window.x_px == 4
    assert (scan.session.cameras[1].width_px, scan.session.cameras[1].height_px) == (3, 2)


@pytest.mark.parametrize(
    ("stated_px", "size_px"),
    [((64, 48), (64, 48)), ((30, 20), (38, 24)), ((None, None), (38, 24))],
)
def test_a_view_in_a_window_is_of_the_sensor_that_the_session_states(
    stated_px: tuple[int | None, int | None], size_px: tuple[int, int], tmp_path: Path
) -> None:
    """Of a sensor of unknown size it reaches to where the window ends."""
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((20, 30), np.uint8))
    setup = CameraSetup(*stated_px, window=SensorWindow(8, 4))
    exposure = read_recorded(tmp_path, ExposureRow(0, 0, 0, "0.png"), setup)
    nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2))
    view = TargetView.of_image(exposure, Chessboard(9, 6, 25.0), *nothing)
    assert (view.width_px, view.height_px) == size_px
