# SPDX-License-Identifier: Apache-2.0
"""Two cameras of which one loses a frame: the rest is measured, the lone image is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armscan.errors import InputError
from armscan.jobs.reconstruct import StillPaths, read_stills
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.hand_eye import observe_stripes
from armscan.pipeline.instants import PARTNER_MISSING, SAME_TIME_NS, ScanInstants, group_instants
from armscan.pipeline.measure import reconstruct
from armscan.pipeline.progress import silent
from armscan.pipeline.scan import ExposureStatus, ScanOptions, measure_scan
from armscan.records.recording import LASER_UNKNOWN, ExposureRow
from armscan.storage.images import ImageOptions
from armscan.storage.recording import read_recording, write_recording
from rigs.scan_fake import as_source, fake_scan, scanner, with_rows
from rigs.two_camera_scan import (
    PERIOD_NS,
    SeenAs,
    TwoCameraScan,
    plate_profiles,
    small_head,
    stereo_scanner,
    two_camera_scan,
)

LOST = ((1, 1),)


def rows_at(times: list[tuple[int, int]]) -> list[ExposureRow]:
    return [
        ExposureRow(index=k, t_ns=t_ns, camera=camera, source=f"{k}.png")
        for k, (t_ns, camera) in enumerate(times)
    ]


def grouped(times: list[tuple[int, int]]) -> list[tuple[int, ...]]:
    return [one.rows for one in group_instants(rows_at(times), "scan")]


@pytest.fixture(scope="module")
def device() -> ScannerCalibration:
    return stereo_scanner(small_head())


@pytest.fixture(scope="module")
def seen_as() -> SeenAs:
    return SeenAs(plate_profiles(small_head()))


@pytest.mark.parametrize("late_ns", [0, 1, -1, SAME_TIME_NS])
def test_times_that_hardly_differ_are_one_instant(late_ns: int) -> None:
    times = [(10 * SAME_TIME_NS * k + c * late_ns, c) for k in (1, 2) for c in (0, 1)]
    assert grouped(times) == [(0, 1), (2, 3)]


def test_times_that_differ_by_more_are_two() -> None:
    assert grouped([(0, 0), (SAME_TIME_NS + 1, 1)]) == [(0,), (1,)]


def test_frames_close_in_time_are_not_mixed() -> None:
    """Where frames follow each other within the tolerance, a quarter of their period counts."""
    times = [(0, 0), (1_000, 0), (1_100, 1), (2_000, 0), (2_100, 1)]
    assert grouped(times) == [(0,), (1, 2), (3, 4)]
    assert grouped([(0, 0), (1, 0), (1, 1)]) == [(0,), (1, 2)]


def test_two_exposures_of_one_camera_at_one_time_are_refused() -> None:
    with pytest.raises(InputError, match="camera 0 has 2 exposures of one instant"):
        grouped([(5, 0), (5, 0), (5, 1)])


def test_a_trigger_id_counts_more_than_the_time() -> None:
    rows = rows_at([(0, 0), (50 * SAME_TIME_NS, 1), (0, 1)])
    rows = [replace(rows[0], trigger_id=7), replace(rows[1], trigger_id=7), rows[2]]
    assert [one.rows for one in group_instants(rows, "scan")] == [(0, 1), (2,)]


def test_lone_rows_are_told_from_complete_instants() -> None:
    found = ScanInstants(two_camera_scan(3, lost=LOST, late_ns=1), 2)
    assert [one.rows for one in found.lit] == [(0, 1), (3, 4)]
    assert found.without_partner == (2,)


def test_the_lasers_of_an_instant_are_those_that_any_of_its_rows_names() -> None:
    """The table of a trigger box: ids and lasers of camera 0, ids alone of camera 1."""
    scan = two_camera_scan(3)
    first, dark, last = (
        tuple(
            replace(row, trigger_id=k, lasers=("A",) if row.camera == 0 and k != 1 else ())
            for row in scan.rows[2 * k : 2 * k + 2]
        )
        for k in range(3)
    )
    found = ScanInstants(replace(scan, rows=(*first, *dark, *last)), 2)
    assert [(one.rows, one.lasers) for one in found.lit] == [((0, 1), ("A",)), ((4, 5), ("A",))]
    assert found.is_lit.tolist() == [True, True, False, False, True, True]
    assert found.without_partner == ()
    (images,) = found.read(found.lit[:1], "scan", silent)
    assert images.lasers == ("A",)
    other = replace(first[1], lasers=("B",))
    with pytest.raises(InputError, match="cameras of one instant name different lasers, A and B"):
        ScanInstants(replace(scan, rows=(first[0], other, *dark, *last)), 2)


def test_a_scan_goes_on_without_a_lost_frame(
    device: ScannerCalibration, seen_as: SeenAs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armscan.pipeline.measure.extract_profile", seen_as)
    result = measure_scan(
        two_camera_scan(3, lost=LOST, late_ns=1), device, ScanOptions(has_normals=False)
    )
    placed, alone = ExposureStatus.PLACED, ExposureStatus.NO_PARTNER
    assert [e.status for e in result.exposures] == [placed, placed, alone, placed, placed]
    assert result.exposures[2].reason == PARTNER_MISSING
    assert result.image_rows == (0, 1, 3, 4)
    assert set(result.cloud.exposure.tolist()) >= {0, 2}
    assert any(
        f"1 of 5 images were not used, {PARTNER_MISSING}: images/1l.png" in text
        for text in result.warnings
    )


def test_a_pose_that_only_the_partner_lacks_is_said_to_be_its(
    device: ScannerCalibration, seen_as: SeenAs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The right image of the last instant lies just after the arm's last sample."""
    monkeypatch.setattr("armscan.pipeline.measure.extract_profile", seen_as)
    scan = two_camera_scan(3, late_ns=1)
    assert scan.arm is not None
    moved = PERIOD_NS // 2
    late = [replace(row, t_ns=row.t_ns + moved) for row in scan.rows[4:]]
    result = measure_scan(
        replace(scan, rows=(*scan.rows[:4], *late)), device, ScanOptions(has_normals=False)
    )
    assert late[0].t_ns == scan.arm.t_ns[-1] < late[1].t_ns
    assert result.exposures[4].reason == "the other camera's image has none"


def test_a_hand_eye_scan_names_the_image_without_partner(
    device: ScannerCalibration, seen_as: SeenAs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armscan.pipeline.measure.extract_profile", seen_as)
    assert device.sensor is not None
    found = observe_stripes(two_camera_scan(3, lost=LOST), device.sensor)
    assert found.not_used == (("images/1l.png", PARTNER_MISSING),)
    assert {item.source for item in found.stripes} >= {"images/0l.png", "images/2l.png"}
    instants = {item.source: item.instant for item in found.stripes}
    assert instants["images/0l.png"] == instants["images/0r.png"] != instants["images/2l.png"]
    assert any(PARTNER_MISSING in text for text in found.warnings)


def stills_of(scan: TwoCameraScan, folder: Path) -> StillPaths:
    write_recording(folder, scan)
    return StillPaths((str(folder),))


def test_stills_leave_the_image_without_partner_out(tmp_path: Path) -> None:
    paths = stills_of(two_camera_scan(3, lost=LOST), tmp_path / "scan")
    found = read_stills(paths, ImageOptions(), 2)
    assert len(found.left.lit) == len(found.right.lit) == 2
    warning = found.warnings[-1]
    assert warning.startswith(f"1 images were not used, {PARTNER_MISSING}: ")


def test_stills_of_a_recording_tell_what_a_scan_tells(tmp_path: Path) -> None:
    scan = two_camera_scan(2)
    rows = (
        *scan.rows[:2],
        *(replace(row, lasers=(), flags=(LASER_UNKNOWN,)) for row in scan.rows[2:]),
    )
    paths = stills_of(replace(scan, rows=rows), tmp_path / "scan")
    table = tmp_path / "scan" / "exposures.csv"
    lines = table.read_text().splitlines()
    odd = [f"{line},{'operator' if k == 0 else 'me'}" for k, line in enumerate(lines)]
    table.write_text("\n".join(odd) + "\n")
    (tmp_path / "scan" / "session.toml").unlink()
    found = read_stills(paths, ImageOptions(), 2)
    told = read_recording(tmp_path / "scan")
    assert told.warnings and told.session.assumed
    assert found.warnings == (
        *told.warnings,
        *told.session.assumed,
        "2 of 4 images were not measured: what laser was on is not known",
    )


def test_stills_of_a_recording_keep_the_partners_of_their_views(tmp_path: Path) -> None:
    """By file name they would be other ones, which were refused."""
    lit = [("b", "on/0.png"), ("a", "on/1.png"), ("b", "on/2.png")]
    dark = [("a", "off/0.png"), ("b", "off/1.png")]
    views: list[dict[str, Any]] = [{"view": view, "source": source} for view, source in lit]
    views += [{"view": view, "source": source, "lasers": ()} for view, source in dark]
    write_recording(tmp_path / "scan", as_source(with_rows(fake_scan(5), views)))
    read = read_stills(StillPaths((str(tmp_path / "scan"),)), ImageOptions(), 1)
    sensor = scanner().sensor
    assert sensor is not None
    found = reconstruct(
        read.left.lit, sensor, backgrounds=read.left.dark, are_paired=read.are_paired
    )
    assert [one.profile.source for one in found.images] == [source for _, source in lit]
    assert [one.source for one in read.left.dark] == ["off/1.png", "off/0.png", "off/1.png"]


def test_no_complete_instant_is_refused_in_words(
    device: ScannerCalibration, tmp_path: Path
) -> None:
    scan = two_camera_scan(2, lost=((0, 1), (1, 0)))
    assert device.sensor is not None
    with pytest.raises(InputError, match="no instant has the images of all 2 cameras"):
        measure_scan(scan, device)
    with pytest.raises(InputError, match="no instant has the images of all 2 cameras"):
        observe_stripes(scan, device.sensor)
    with pytest.raises(InputError, match="no instant has the images of all 2 cameras"):
        read_stills(stills_of(scan, tmp_path / "scan"), ImageOptions(), 2)


def test_a_background_that_one_view_lacks_is_not_dropped_in_silence(tmp_path: Path) -> None:
    """Camera 0 has one for both views, camera 1 for the first only."""
    lit = [replace(row, view=row.source[7]) for row in two_camera_scan(2).rows]
    later = 3 * PERIOD_NS
    dark = [
        replace(row, index=4 + k, lasers=(), t_ns=row.t_ns + later, source=f"images/dark{k}.png")
        for k, row in enumerate(lit[:3])
    ]
    scan = replace(two_camera_scan(5), rows=(*lit, *dark))
    found = read_stills(stills_of(scan, tmp_path / "scan"), ImageOptions(), 2)
    assert (len(found.left.dark), len(found.right.dark)) == (2, 0)
    warning = found.warnings[-1]
    assert warning.startswith("1 of 2 images of camera 1 have no image without laser")
