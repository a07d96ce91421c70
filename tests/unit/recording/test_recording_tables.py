# SPDX-License-Identifier: Apache-2.0
"""Rules of ``exposures.csv`` and of the clock that joins it with ``arm.csv``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError, InputError
from armscan.reconstruction.sync import exposure_poses
from armscan.storage.recording import read_recording
from rigs.recording_folders import (
    ARM,
    EXPOSURES,
    HEADER,
    SESSION,
    lab_folder,
    pixels,
    refusal,
    table,
)


def exposures(*lines: str, header: str = HEADER) -> str:
    return table(header, *lines)


def test_a_plain_recording(tmp_path: Path) -> None:
    scan = read_recording(lab_folder(tmp_path))
    assert [row.index for row in scan.rows] == [0, 1, 2]
    assert [row.t_ns for row in scan.rows] == [1000, 2000, 3000]
    assert [row.lasers for row in scan.rows] == [("A",), (), ("A", "B")]
    assert all(row.view is None and row.trigger_id is None for row in scan.rows)
    assert (scan.name, scan.is_simulated, scan.warnings) == ("scan", False, ())
    assert scan.session.assumed == ()
    for k in range(3):
        exposure = scan.exposure(k)
        np.testing.assert_array_equal(exposure.image, pixels(k))
        assert (exposure.source, exposure.t_ns) == (f"images/{k}.png", 1000 * (k + 1))
        assert exposure.lasers == scan.rows[k].lasers
    assert scan.arm is not None
    np.testing.assert_array_equal(scan.arm.translations_mm[1], [901, 1, 400])
    assert scan.arm.joints_rad is None


def test_images_are_read_when_asked_for_only(tmp_path: Path) -> None:
    folder = lab_folder(tmp_path)
    (folder / "images/2.png").write_bytes(b"damaged")
    scan = read_recording(folder)
    scan.exposure(0)
    with pytest.raises(FileFormatError, match=r"2\.png.*not a PNG"):
        scan.exposure(2)


def test_marks_of_other_systems_do_no_harm(tmp_path: Path) -> None:
    def foreign(text: str) -> bytes:
        return ("\ufeff# from the lab's computer\n" + text).replace("\n", "\r\n").encode()

    files = {"session": SESSION, "exposures": EXPOSURES, "arm": ARM}
    scan = read_recording(lab_folder(tmp_path, **{k: foreign(v) for k, v in files.items()}))
    assert (len(scan.rows), scan.warnings) == (3, ())


def test_columns_are_found_by_name(tmp_path: Path) -> None:
    swapped = table(
        "qz,qy,qx,qw,z_mm,y_mm,x_mm,t_ns", "0,0,0.6,0.8,3,2,901,1", "0,0,0,1,3,2,1,9000"
    )
    listed = exposures("A,images/0.png,0,50,7", header="lasers,file,camera,t_ns,index")
    scan = read_recording(lab_folder(tmp_path, arm=swapped, exposures=listed))
    assert scan.rows[0].index == 7 and scan.rows[0].lasers == ("A",)
    assert scan.arm is not None
    np.testing.assert_array_equal(scan.arm.translations_mm[0], [901, 2, 3])
    np.testing.assert_allclose(scan.arm.rotations[0] @ [0, 1, 0], [0, 0.28, 0.96], atol=1e-15)


def test_rows_are_given_in_order_of_time_with_their_unknown_columns(tmp_path: Path) -> None:
    listed = exposures(
        "0,1000,0,images/0.png,A,warm",
        "1,2500,0,images/1.png,A,cold",
        "2,2000,1,images/2.png,A,dry",
        header=HEADER + ",weather",
    )
    scan = read_recording(lab_folder(tmp_path, exposures=listed, session=None))
    assert [row.index for row in scan.rows] == [0, 2, 1]
    assert scan.exposure_columns == {"weather": ("warm", "dry", "cold")}
    assert any("columns not known, kept: weather" in text for text in scan.warnings)


BAD_EXPOSURES = {
    "empty file": ("", "empty"),
    "no rows": (HEADER + "\n", "lists no exposure"),
    "column missing": (EXPOSURES.replace(",lasers", ",laser"), "'laser' may be 'lasers'"),
    "cut line": (EXPOSURES[:-12], "line 4: 4 cells, but the header has 5; the file may be cut"),
    "duplicate index": (EXPOSURES.replace("2,3000", "1,3000"), "line 4: index 1 appears again"),
    "index of two cameras": (EXPOSURES.replace("2,3000,0", "1,3000,1"), "index 1 appears again"),
    "times go back": (EXPOSURES.replace("2,3000", "2,1500"), "camera 0 goes back from 2000"),
    "time repeated": (EXPOSURES.replace("2,3000", "2,2000"), "camera 0 repeats 2000"),
    "time in seconds": (EXPOSURES.replace("3000", "3.5"), "'3.5' in column t_ns is no whole"),
    "time too large": (EXPOSURES.replace("3000", "9" * 19), "more than 64 bits"),
    "negative camera": (EXPOSURES.replace("3000,0", "3000,-1"), "count cameras from 0"),
    "unknown camera": (EXPOSURES.replace("3000,0", "3000,1"), "not among the 1 cameras"),
    "missing image": (EXPOSURES.replace("2.png", "9.png"), "the first is images/9.png"),
    "path up": (EXPOSURES.replace("images/2", "../2"), "no path inside the recording"),
    "absolute path": (EXPOSURES.replace("images/2", "/images/2"), "no path inside"),
    "other separator": (EXPOSURES.replace("images/2", "images\\2"), "no path inside"),
    "drive": (EXPOSURES.replace("images/2", "C:/images/2"), "no path inside"),
    "no name": (EXPOSURES.replace("images/2.png", ""), "no path inside"),
    "laser twice": (EXPOSURES.replace("A+B", "A+A"), "name a source twice"),
    "laser lacking": (EXPOSURES.replace("A+B", "A+"), "name a source twice or not at all"),
    "semicolons": (EXPOSURES.replace(",", ";"), "not separated by commas"),
    "other text": (EXPOSURES.encode("utf-16"), "not UTF-8"),
    "negative index": (EXPOSURES.replace("2,3000", "-2,3000"), "not negative"),
}


@pytest.mark.parametrize("case", BAD_EXPOSURES)
def test_bad_lists_of_exposures_are_refused(tmp_path: Path, case: str) -> None:
    text, said = BAD_EXPOSURES[case]
    message = refusal(tmp_path, exposures=text)
    assert said in message and "exposures.csv" in message


def test_a_file_that_may_be_cut_or_is_listed_twice_is_warned_of(tmp_path: Path) -> None:
    text = EXPOSURES.replace("images/2", "images/1").rstrip("\n")
    scan = read_recording(lab_folder(tmp_path, exposures=text))
    assert any("so the file may be cut" in warning for warning in scan.warnings)
    assert any("images/1.png is listed again" in warning for warning in scan.warnings)


def test_trigger_ids_join_the_tables_and_two_cameras_may_share_one(tmp_path: Path) -> None:
    listed = exposures(
        "0,10,0,images/0.png,A,4",
        "1,10,1,images/1.png,A,4",
        "2,20,1,images/2.png,A,",
        header=HEADER + ",trigger_id",
    )
    poses = table(ARM.splitlines()[0] + ",trigger_id", "7,1,2,3,1,0,0,0,4", "8,1,2,900,1,0,0,0,")
    session = SESSION.replace("shared", "separate").split("[[camera]]")[0]
    scan = read_recording(lab_folder(tmp_path, exposures=listed, arm=poses, session=session))
    assert [row.trigger_id for row in scan.rows] == [4, 4, None]
    assert scan.arm is not None and scan.arm.trigger_ids is not None
    assert scan.arm.trigger_ids.tolist() == [4, -1]
    assert scan.exposure(1).trigger_id == 4


@pytest.mark.parametrize(
    ("of_exposures", "of_arm", "said"),
    [
        (("1", "1", "2"), ("1", "2", "3"), "trigger_id 1 appears again"),
        (("1", "2", "3"), ("1", "1", "3"), "trigger_id 1 is in line 2 too"),
        (("1", "2", "3"), ("4", "5", "6"), "no trigger_id is in both"),
        (("-1", "2", "3"), ("1", "2", "3"), "not negative"),
        (("1", "2", "3"), ("-1", "2", "3"), "is negative"),
        (("1.5", "2", "3"), ("1", "2", "3"), "no whole number"),
    ],
)
def test_bad_trigger_ids_are_refused(
    tmp_path: Path, of_exposures: tuple[str, ...], of_arm: tuple[str, ...], said: str
) -> None:
    def with_ids(text: str, ids: tuple[str, ...]) -> str:
        head, *lines = text.splitlines()
        return exposures(
            *(f"{line},{number}" for line, number in zip(lines, ids, strict=True)),
            header=f"{head},trigger_id",
        )

    message = refusal(
        tmp_path, exposures=with_ids(EXPOSURES, of_exposures), arm=with_ids(ARM, of_arm)
    )
    assert said in message


def test_ids_in_one_table_only_leave_it_to_the_clock(tmp_path: Path) -> None:
    listed = exposures(
        "0,1000,0,images/0.png,A,4",
        "1,2000,0,images/1.png,A,5",
        header=HEADER + ",trigger_id",
    )
    head, *lines = ARM.splitlines()
    empty = table(f"{head},trigger_id", *(f"{line}," for line in lines))
    for k, poses in enumerate((ARM, empty)):
        scan = read_recording(lab_folder(tmp_path / str(k), exposures=listed, arm=poses))
        assert scan.rows[1].trigger_id == 5
    session = SESSION.replace("shared", "separate")
    folder = lab_folder(tmp_path / "separate", exposures=listed, arm=empty, session=session)
    assert "neither a shared clock nor trigger ids" in read_recording(folder).warnings[-1]


def test_neither_a_shared_clock_nor_ids_gives_no_pose(tmp_path: Path) -> None:
    """A latency calibration reads it all the same: it finds offset and drift."""
    folder = lab_folder(tmp_path / "lab", session=SESSION.replace("shared", "separate"))
    scan = read_recording(folder)
    assert "neither a shared clock nor trigger ids" in scan.warnings[-1]
    with pytest.raises(InputError, match="separate clocks"):
        exposure_poses(scan.rows, scan.arm, scan.session.clock)


def test_times_of_another_unit_are_noticed_by_their_range(tmp_path: Path) -> None:
    text = ARM.replace("500,", "500000000,").replace("1500000000", "1500000001")
    assert "within the arm's times" in refusal(tmp_path, arm=text)


def track_text(period_ns: int, last_ns: int) -> str:
    times = range(0, last_ns + 1, period_ns)
    return table(
        ARM.splitlines()[0], *(f"{t},{900 + k},0,400,1,0,0,0" for k, t in enumerate(times))
    )


def listed_at(*times: int, view: str = "") -> str:
    lines = (f"{k},{t},0,images/{k}.png,A,{view}" for k, t in enumerate(times))
    return exposures(*lines, header=HEADER + ",view")


MS, S = 10**6, 10**9


@pytest.mark.parametrize(
    ("times", "factor"),
    [
        ((1_000_000, 5_000_000, 9_000_000), "1,000 times"),
        ((1_000, 5_000, 9_000), "1,000,000 times"),
        ((1, 5, 9), "1,000,000,000 times"),
    ],
)
def test_times_of_another_unit_that_hit_the_first_samples_are_refused(
    tmp_path: Path, times: tuple[int, ...], factor: str
) -> None:
    """Exposures at 1, 5, 9 s in us, ms and s beside an arm's samples every 10 ms for 10 s."""
    message = refusal(tmp_path, exposures=listed_at(*times), arm=track_text(10 * MS, 10 * S))
    assert "exposures.csv were " + factor in message


def test_an_arm_in_another_unit_is_refused_though_its_start_hits_an_exposure(
    tmp_path: Path,
) -> None:
    message = refusal(
        tmp_path, exposures=listed_at(0, 5 * S, 9 * S), arm=track_text(10_000, 10 * MS)
    )
    assert "arm.csv were 1,000 times" in message


@pytest.mark.parametrize(
    ("times", "view"),
    [
        ((5 * S,), ""),
        ((5 * MS,), ""),
        ((5 * S, 5 * S + 5 * MS, 5 * S + 20 * MS), ""),
        ((S, 5 * S, 9 * S), ""),
        ((5 * S, 5 * S + MS, 5 * S + 2 * MS), "p1"),
    ],
)
def test_a_still_exposure_or_a_burst_beside_a_long_track_is_no_other_unit(
    tmp_path: Path, times: tuple[int, ...], view: str
) -> None:
    scan = read_recording(
        lab_folder(
            tmp_path, exposures=listed_at(*times, view=view), arm=track_text(10 * MS, 10 * S)
        )
    )
    assert scan.warnings == ()


def test_a_burst_at_the_start_of_a_long_track_is_asked_about(tmp_path: Path) -> None:
    scan = read_recording(
        lab_folder(
            tmp_path,
            exposures=listed_at(MS, 5 * MS, 9 * MS, view="still"),
            arm=track_text(10 * MS, 10 * S),
        )
    )
    assert "are both in nanoseconds?" in scan.warnings[0] and len(scan.warnings) == 1


def test_several_exposures_between_two_samples_are_warned_of(tmp_path: Path) -> None:
    scan = read_recording(
        lab_folder(
            tmp_path, exposures=listed_at(12 * S, 13 * S, 14 * S), arm=track_text(5 * S, 20 * S)
        )
    )
    (warning,) = scan.warnings
    assert f"3 exposures fall between the same two samples of the arm (t_ns {10 * S} and" in warning


def test_without_an_arm_no_clock_is_needed(tmp_path: Path) -> None:
    scan = read_recording(
        lab_folder(tmp_path, arm=None, session=SESSION.replace("shared", "separate"))
    )
    assert scan.arm is None


@pytest.mark.parametrize(("unit_ns", "is_asked"), [(S, True), (MS, True), (1, False)])
def test_both_tables_in_another_unit_are_asked_about(
    tmp_path: Path, unit_ns: int, is_asked: bool
) -> None:
    """Ten samples of the arm in each of six seconds, one exposure a second."""
    period = 100 * MS // unit_ns or 1
    lines = [f"{k},{10 * k * period},0,images/{k % 3}.png,A," for k in range(6)]
    listed = exposures(*lines, header=HEADER + ",view")
    folder = lab_folder(tmp_path, exposures=listed, arm=track_text(period, 60 * period))
    asked = [one for one in read_recording(folder).warnings if "both times in nanoseconds" in one]
    assert len(asked) == int(is_asked)
