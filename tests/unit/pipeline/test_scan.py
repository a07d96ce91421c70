# SPDX-License-Identifier: Apache-2.0
"""A scan of a known plane, with all that can be missing from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.errors import EstimationError, InputError
from armscan.fusion import point_spool
from armscan.geometry.arrays import Box
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline import measure, progress
from armscan.pipeline import scan as scan_module
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.progress import ProgressEvent, StageClock
from armscan.pipeline.scan import (
    ExposureStatus,
    ScanOptions,
    measure_long_scan,
    measure_scan,
    scan_spool,
)
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.records.recording import LASER_UNKNOWN, Clock
from armscan.storage.clouds import ply_bytes
from armscan.storage.detection_cache import DetectionCache
from armscan.vision.stripe.extract import extract_stripes
from rigs.scan_fake import (
    PERIOD_NS,
    FakeScan,
    as_source,
    fake_scan,
    looking_down,
    scanner,
    with_rows,
)


@pytest.fixture(scope="module")
def device() -> ScannerCalibration:
    return scanner()


def test_the_plane_comes_back_in_base(device: ScannerCalibration) -> None:
    """Noise 2 of 180 grey levels, line sigma 2.5 px: a few hundredths of a pixel, 0.22 mm/px."""
    events: list[ProgressEvent] = []
    result = measure_scan(as_source(fake_scan()), device, progress=events.append)
    cloud = result.cloud
    assert cloud.frame == "Base"
    assert len(cloud) > 6 * 280
    height = cloud.points_mm[:, 2]
    noise = np.median(cloud.sigma_noise_mm)
    assert abs(np.median(height)) < noise
    assert np.sqrt(np.mean(height**2)) < 2.0 * noise
    assert (cloud.sigma_mm >= 0.005).all(), "the arm's own 0.005 mm is part of every sigma"
    np.testing.assert_array_equal(np.unique(cloud.exposure), np.arange(6))
    assert cloud.exposure_sources[2] == "images/2.png"
    middles = [np.median(cloud.points_mm[cloud.exposure == k, 1]) for k in range(6)]
    np.testing.assert_allclose(np.diff(middles), 1.0, atol=0.05)
    assert cloud.normals is not None
    defined = cloud.normals.any(axis=1)
    assert defined.mean() > 0.9
    assert (cloud.normals[defined, 2] > 0.95).all()
    assert result.poses.source == "time"
    assert result.without_pose == ()
    assert [event.done for event in events if event.stage == "scan"] == [0, 1, 2, 3, 4, 5, 6]
    assert (events[-1].stage, events[-1].done) == ("normals", len(cloud))


def test_reading_ahead_and_volume_change_nothing_but_speed_and_extent(
    device: ScannerCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure, "MOST_THREADS", 1)
    one = measure_scan(as_source(fake_scan()), device, ScanOptions(has_normals=False))
    monkeypatch.setattr(measure, "MOST_THREADS", 3)
    monkeypatch.setattr(progress, "count_cores", lambda: 3)
    two = measure_scan(as_source(fake_scan()), device, ScanOptions(has_normals=False))
    np.testing.assert_array_equal(one.cloud.points_mm, two.cloud.points_mm)
    assert one.cloud.normals is None
    box = Box(np.array([-100.0, -100.0, -1.0]), np.array([100.0, 2.6, 1.0]))
    cut = measure_scan(as_source(fake_scan()), device, ScanOptions(has_normals=False, volume=box))
    inside = box.holds(one.cloud.points_mm)
    np.testing.assert_array_equal(cut.cloud.points_mm, one.cloud.points_mm[inside])
    assert sum(e.n_outside_volume for e in cut.exposures) == int((~inside).sum()) > 0
    assert any("outside the volume" in warning for warning in cut.warnings)
    assert cut.cloud.exposure.max() < len(cut.images) == 6


def test_what_is_missing_is_counted_and_named(device: ScannerCalibration) -> None:
    """A gap of the arm, an image that cannot be read, an exposure after the track."""
    scan = fake_scan(8)
    assert scan.arm is not None
    known = np.ones(9, dtype=bool)
    known[6] = False
    late = with_rows(scan, [{}] * 7 + [{"t_ns": int(scan.arm.t_ns[-1]) + 1}])
    result = measure_scan(
        as_source(replace(late, arm=replace(scan.arm, is_known=known), broken=(2,))), device
    )
    statuses = [exposure.status for exposure in result.exposures]
    placed, unreadable, no_pose = (
        ExposureStatus.PLACED,
        ExposureStatus.UNREADABLE,
        ExposureStatus.NO_POSE,
    )
    assert statuses == [placed] * 2 + [unreadable] + [placed] * 2 + [no_pose] * 3
    assert result.image_rows == (0, 1, 3, 4)
    assert result.cloud.exposure_sources == tuple(f"images/{k}.png" for k in (0, 1, 3, 4))
    assert [source for source, _ in result.without_pose] == [f"images/{k}.png" for k in (5, 6, 7)]
    text = " ".join(result.warnings)
    assert "3 of 8 exposures have no pose: 2 in a gap of the arm's samples, 1 after" in text
    assert "1 of 8 images cannot be read: images/2.png: the image is cut short" in text
    assert result.count(placed) == 4
    height = result.cloud.points_mm[:, 2]
    assert np.sqrt(np.mean(height**2)) < 2.0 * np.median(result.cloud.sigma_noise_mm)


def test_exposures_are_not_read_for_nothing(device: ScannerCalibration) -> None:
    """Laser-off rows are the background of their view, read once; others are left alone."""
    scan = fake_scan(5)
    changes = [
        {"view": "a", "lasers": ()},
        {"view": "a"},
        {"view": "a"},
        {"lasers": ()},
        {},
    ]
    shown = with_rows(scan, changes)
    result = measure_scan(as_source(shown), device, ScanOptions(has_normals=False))
    assert sorted(shown.reads) == [0, 1, 2, 4]
    assert [e.status for e in result.exposures].count(ExposureStatus.LASER_OFF) == 2
    assert result.image_rows == (1, 2, 4)


def test_without_names_of_lasers_all_are_taken_as_lit(device: ScannerCalibration) -> None:
    scan = with_rows(fake_scan(3), [{"lasers": ()}] * 3)
    result = measure_scan(as_source(scan), device, ScanOptions(has_normals=False))
    assert len(result.images) == 3
    assert any("no exposure names its lasers" in warning for warning in result.warnings)


def test_an_image_whose_lasers_are_not_known_is_counted_and_not_measured(
    device: ScannerCalibration,
) -> None:
    unknown: dict[str, object] = {"lasers": (), "flags": (LASER_UNKNOWN,)}
    scan = with_rows(fake_scan(), [{}, unknown, {}, {"lasers": ()}, unknown, {}])
    result = measure_scan(as_source(scan), device)
    states = [one.status for one in result.exposures]
    assert [k for k, one in enumerate(states) if one is ExposureStatus.PLACED] == [0, 2, 5]
    assert [k for k, one in enumerate(states) if one is ExposureStatus.LASER_UNKNOWN] == [1, 4]
    assert not set(scan.reads) & {1, 4}
    (told,) = (text for text in result.warnings if "what laser was on is not known" in text)
    assert told.startswith("2 of 6 images were not measured")


def test_an_image_of_a_calibrated_laser_beside_another_one_is_counted_and_left_out(
    device: ScannerCalibration,
) -> None:
    scan = with_rows(fake_scan(3), [{}, {"lasers": ("A", "C")}, {"lasers": ("C",)}])
    result = measure_scan(as_source(scan), device)
    assert np.unique(result.cloud.exposure).tolist() == [0, 2]
    told = "1 exposures were left out: of C, which was on, too, the calibration has no sheet"
    assert told in result.warnings
    assert any(one.startswith("exposures name the laser C, of which") for one in result.warnings)


def test_where_no_row_names_a_laser_a_row_of_unknown_lasers_makes_none_lit(
    device: ScannerCalibration,
) -> None:
    dark: dict[str, object] = {"lasers": ()}
    unknown: dict[str, object] = {**dark, "flags": (LASER_UNKNOWN,)}
    scan = with_rows(fake_scan(), [unknown, dark, unknown, dark, unknown, dark])
    with pytest.raises(EstimationError, match="no exposure with a pose could be measured"):
        measure_scan(as_source(scan), device)
    with pytest.raises(InputError, match="of none of 6 exposures is it known"):
        measure_scan(as_source(with_rows(scan, [unknown] * 6)), device)


def test_latency_shifts_the_points_along_the_sweep() -> None:
    """1 mm a period: a quarter of a period late is 0.25 mm."""
    on_time = measure_scan(as_source(fake_scan(4)), scanner(), ScanOptions(has_normals=False)).cloud
    late = measure_scan(
        as_source(fake_scan(4)), scanner(PERIOD_NS // 4), ScanOptions(has_normals=False)
    ).cloud
    np.testing.assert_allclose(
        late.points_mm - on_time.points_mm, np.tile([0, 0.25, 0], (len(late), 1)), atol=1e-9
    )


def test_a_wrong_hand_eye_does_not_lie_flat(device: ScannerCalibration) -> None:
    """The test of the test: 1 degree about the sheet's normal moves points by 0.1 mm or more."""
    wrong = replace(
        device,
        hand_eye=replace(
            device.hand_eye,
            tool_from_sensor=looking_down(0.0).inverse()
            @ looking_down(0.0, 0.15 + np.radians(1.0))
            @ device.hand_eye.tool_from_sensor,
        ),
    )
    cloud = measure_scan(as_source(fake_scan(3)), wrong, ScanOptions(has_normals=False)).cloud
    assert np.abs(cloud.points_mm[:, 2]).max() > 0.1


def test_what_gives_no_cloud_is_refused_in_words(device: ScannerCalibration) -> None:
    scan = fake_scan(3)
    with pytest.raises(InputError, match="no samples of the arm"):
        measure_scan(as_source(replace(scan, arm=None)), device)
    with pytest.raises(InputError, match="no camera"):
        coupled = replace(device.hand_eye, dhand_eye_dsensor=None)
        measure_scan(as_source(scan), replace(device, sensor=None, hand_eye=coupled))
    with pytest.raises(
        EstimationError, match=r"could be measured; .*: 6 \(images/0\.png: "
    ) as caught:
        measure_scan(as_source(replace(fake_scan(), broken=tuple(range(6)))), device)
    assert str(caught.value).count("cut short") == 4, "the first few reasons"
    assert scan.arm is not None
    late = int(scan.arm.t_ns[-1])
    dark: dict[str, object] = {"lasers": ()}
    unposed = with_rows(scan, [dark, {"t_ns": late + 1}, {"t_ns": late + 2}])
    with pytest.raises(EstimationError, match=r"without pose: 2 \(after"):
        measure_scan(as_source(unposed), device)
    away = Box(np.full(3, 900.0), np.full(3, 901.0))
    with pytest.raises(EstimationError, match="outside the volume"):
        measure_scan(as_source(scan), device, ScanOptions(volume=away))
    with pytest.raises(InputError, match="cameras 0, 1"):
        measure_scan(as_source(with_rows(scan, [{}, {"camera": 1}, {}])), device)


def test_ctrl_c_stops_the_scan(device: ScannerCalibration) -> None:
    """The interrupt reaches the caller after the exposures at work, and no more are read."""
    scan: FakeScan = fake_scan(6)

    def interrupt(event: ProgressEvent) -> None:
        if event.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure_scan(as_source(scan), device, progress=interrupt)
    assert scan.reads == [0, 1]


def test_an_interrupted_scan_looks_at_each_image_once(
    device: ScannerCalibration, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What was extracted before the interrupt is taken from the cache, to the last bit."""
    options, looked = ScanOptions(has_normals=False), []

    def counted(exposure: Exposure, *others: Any) -> Profile:
        looked.append(exposure.source)
        return extract_stripes(exposure, *others)

    def interrupt(event: ProgressEvent) -> None:
        if event.done == 4:
            raise KeyboardInterrupt

    whole = measure_scan(as_source(fake_scan(6)), device, options)
    monkeypatch.setattr(measure, "extract_stripes", counted)
    cache, trimmed = DetectionCache(tmp_path / "kept"), []
    monkeypatch.setattr(DetectionCache, "trim", lambda *_: trimmed.append(len(looked)))
    with pytest.raises(KeyboardInterrupt):
        measure_scan(as_source(fake_scan(6)), device, options, progress=interrupt, cache=cache)
    assert 0 < len(looked) < 6
    assert trimmed[-1] == len(looked), "the folder is kept small after an interrupt too"
    again = measure_scan(as_source(fake_scan(6)), device, options, cache=cache)
    assert sorted(looked) == sorted(image.profile.source for image in whole.images)
    np.testing.assert_array_equal(again.cloud.points_mm, whole.cloud.points_mm)
    np.testing.assert_array_equal(again.cloud.sigma_mm, whole.cloud.sigma_mm)


def test_a_long_scan_is_the_same_scan_with_its_points_elsewhere(
    device: ScannerCalibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = measure_scan(as_source(fake_scan(8)), device)
    monkeypatch.setattr(point_spool, "PIECE_POINTS", 700)
    clock = StageClock()
    with scan_spool(device, tmp_path) as points:
        found = measure_long_scan(
            as_source(fake_scan(8)), device, points, most_images=3, clock=clock
        )
        spooled = replace(points.cloud(), calibrations=found.cloud.calibrations)
        assert ply_bytes(spooled) == ply_bytes(whole.cloud)
    assert len(found.cloud) == 0 and found.cloud.calibrations
    assert found.image_rows == (0, 3, 7)
    assert [image.profile.source for image in found.images] == [
        whole.images[k].profile.source for k in found.image_rows
    ]
    assert found.counts == tuple(image.counts for image in whole.images)
    assert found.warnings == whole.warnings
    profile = clock.profile()
    names = [name for name, _ in profile.stages]
    assert names == ["decoding", "extraction", "naming", "placing", "normals", "passes"]
    assert 0.0 < sum(seconds for _, seconds in profile.stages) < 1.05 * profile.processor_s
    assert profile.peak_mb is None or profile.peak_mb > 50.0


@pytest.mark.parametrize(
    ("clock", "latency_ns", "latency_sigma_ns", "is_told"),
    [
        ("related", 0, None, True),
        ("related", 0, 200_000.0, False),
        ("related", 3_000_000, None, False),
        ("shared", 0, None, False),
    ],
)
def test_clocks_related_by_arrival_are_told_where_no_latency_is_known(
    device: ScannerCalibration,
    clock: Clock,
    latency_ns: int,
    latency_sigma_ns: float | None,
    is_told: bool,
) -> None:
    scan = fake_scan(3)
    scan = replace(scan, session=replace(scan.session, clock=clock))
    known = replace(device, latency_ns=latency_ns, latency_sigma_ns=latency_sigma_ns)
    warnings = measure_scan(as_source(scan), known).warnings
    assert any("when their elements arrived" in warning for warning in warnings) == is_told


def test_a_few_points_without_normal_are_normal(
    device: ScannerCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan_module, "choose_scan_radius_mm", lambda *_: 0.6)
    result = measure_scan(as_source(fake_scan(3)), device)
    assert any("have no normal: within 0.6 mm" in warning for warning in result.warnings)


def test_a_laser_without_sheet_is_told_of(device: ScannerCalibration) -> None:
    """Unless the sheet was named; sources of a fan are those before the dot of its sheets."""
    scan = with_rows(fake_scan(), [{"lasers": ("B",)}] * 6)

    def told(head: ScannerCalibration, sheet: str = "") -> bool:
        options = ScanOptions(measure=MeasureOptions(sheet=sheet), has_normals=False)
        texts = measure_scan(as_source(scan), head, options).warnings
        return any("laser B" in text and "A" in text for text in texts)

    assert told(device)
    assert not told(device, "A")
    assert device.sensor is not None
    (sheet,) = device.sensor.sheets
    named = replace(device.sensor, sheets=(replace(sheet, name="B.1"),))
    assert not told(replace(device, sensor=named))
