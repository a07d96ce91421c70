# SPDX-License-Identifier: Apache-2.0
"""A session is what lies on disk: its state, results that grow old, refusals, two consoles."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.console import work
from armscan.console.journey import (
    LOCK_FILE,
    SETTINGS_FILE,
    Journey,
    SessionSettings,
    StepName,
    digest_of,
    held_session,
    open_journey,
    sessions_in,
)
from armscan.console.rig import open_bench, take_back
from armscan.console.scan import GrowingRecording
from armscan.console.work import run_step, write_report
from armscan.errors import (
    ArmscanError,
    EstimationError,
    FileFormatError,
    OptionError,
    OutputError,
)
from armscan.geometry.poses import Pose
from armscan.jobs.probe import probe
from armscan.models.calibration import InputFile
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from armscan.report.quantity import Summary
from armscan.storage.arm import ProbeTip, write_probing
from armscan.storage.documents import scanner_document
from armscan.storage.recording import read_arm_track, read_recording
from rigs.scan_fake import scanner

SETTINGS = SessionSettings(rig="twin:thesis-single?seed=1", target="chessboard:9x6:10", ball_mm=30)


def touch_plate(journey: Journey, n: int, height_mm: float = 5.0) -> None:
    """Touches of Z = height with a tip of 6 mm, as an arm reports them."""
    rng = np.random.default_rng(3)
    spots = np.column_stack([rng.uniform(-80, 80, (n, 2)), np.full(n, height_mm + 3.0)])
    spots[:, 2] += rng.normal(0.0, 0.01, n)
    tip = np.array([0.0, 0.0, 200.0])
    down = np.diag([1.0, -1.0, -1.0])
    track = ArmTrack(
        t_ns=np.arange(n) * 10**9,
        rotations=np.tile(down, (n, 1, 1)),
        translations_mm=spots - down @ tip,
        is_known=np.ones(n, dtype=bool),
    )
    place = journey.recording(StepName.PROBING)
    place.parent.mkdir(exist_ok=True)
    write_probing(place, track, ProbeTip(tip, 6.0))


def test_an_empty_session_begins_with_the_camera_and_names_what_the_rest_waits_for(
    tmp_path: Path,
) -> None:
    journey = open_journey(tmp_path / "new", SETTINGS)
    assert journey.next_step() is StepName.CAMERA
    states = {step.name: journey.state(step.name) for step in journey.steps}
    assert states[StepName.CAMERA].status == states[StepName.PROBING].status == "open"
    assert states[StepName.LASER].why == "'Camera' comes first"
    assert states[StepName.HAND_EYE].why == "'Camera' comes first"
    assert StepName.LATENCY not in states, "one trigger for camera and arm leaves no latency"
    assert sessions_in(tmp_path) == (tmp_path / "new",)


def test_a_plate_is_probed_and_the_result_grows_old_with_another_touch(tmp_path: Path) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    touch_plate(journey, 12)
    assert journey.state(StepName.PROBING).status == "ready"
    result = run_step(journey.folder, StepName.PROBING)
    assert (result.verdict, result.reasons) == ("good", ())
    assert result.next_step == "Go on with 'Hand-eye'."
    plane = dict(result.values)["A B C D"].split("(")[0].split()
    # 12 touches that scatter by 0.01 mm tell the height to 0.003 mm
    assert -float(plane[3]) == pytest.approx(5.0, abs=0.02)
    again = open_journey(journey.folder)
    assert again.state(StepName.PROBING).status == "good"
    for file in journey.recording(StepName.PROBING).iterdir():
        file.unlink()
    journey.recording(StepName.PROBING).rmdir()
    touch_plate(journey, 13)
    state = again.state(StepName.PROBING)
    assert (state.status, state.why) == (
        "old",
        "what was taken has changed since: calculate again",
    )
    assert "old" in (journey.folder / "report.html").read_text() or run_step(
        journey.folder, StepName.PROBING
    )


def test_the_last_touch_is_taken_back_and_at_last_the_first(tmp_path: Path) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    touch_plate(journey, 3)
    before = read_arm_track(journey.recording(StepName.PROBING))[0].translations_mm
    for n in (2, 1, 0):
        take_back(StepName.PROBING, journey.recording(StepName.PROBING))
        assert journey.n_taken(StepName.PROBING) == n
        if n:
            left = read_arm_track(journey.recording(StepName.PROBING))[0].translations_mm
            np.testing.assert_allclose(left, before[:n], atol=1e-12)


def test_a_step_is_old_where_one_before_it_is_and_told_where_one_is_not_good(
    tmp_path: Path,
) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    touch_plate(journey, 12)
    run_step(journey.folder, StepName.PROBING)
    for name in ("camera.json", "sensor.json", "scanner.json"):
        (journey.folder / name).write_text("{}")
    of_hand_eye = journey.folder / "results" / "hand-eye.json"
    rests_on = {"plate.csv": digest_of(journey.folder / "plate.csv")}
    of_hand_eye.write_text(json.dumps({"verdict": "good", "rests_on": rests_on}))
    states = {name: journey.state(name) for name in (StepName.HAND_EYE, StepName.SCAN)}
    assert [(one.status, one.why) for one in states.values()] == [("good", ""), ("open", "")]
    # another touch: the plate's document is as it was, and out of date
    shutil.rmtree(journey.recording(StepName.PROBING))
    touch_plate(journey, 13)
    state = journey.state(StepName.HAND_EYE)
    why = "'Touch the plate' is out of date: calculate it again, then this"
    assert (state.status, state.why) == ("old", why)
    assert journey.state(StepName.SCAN).why == why
    run_step(journey.folder, StepName.PROBING)
    state = journey.state(StepName.HAND_EYE)
    why = "the result of 'Touch the plate' has changed since: calculate again"
    assert (state.status, state.why) == ("old", why)
    of_hand_eye.write_text(json.dumps({"verdict": "not good"}))
    state = journey.state(StepName.SCAN)
    assert (state.status, state.why) == (
        "open",
        "'Hand-eye' is not good: what it gave before is used",
    )


def test_what_to_do_after_a_refusal_can_be_done_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    touch_plate(journey, 12)

    def refused(*_: object, **__: object) -> None:
        raise EstimationError(
            "the arm would have to scatter by 0.55 mm an axis",
            remedy="check the plate; else say so with --arm-position-mm; "
            "s/scanner.refused.html shows what was found",
        )

    monkeypatch.setattr("armscan.console.work.probe", refused)
    result = run_step(journey.folder, StepName.PROBING)
    assert result.reasons == ("The arm would have to scatter by 0.55 mm an axis; check the plate.",)
    assert "Start over" in result.next_step


def test_advice_after_a_doubtful_check_says_what_it_means_and_the_report_reads_as_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    touch_plate(journey, 12)
    probed = probe

    def with_remark(*given: Any, **how: Any) -> Summary:
        return replace(probed(*given, **how), warnings=("The touches are few.",))

    monkeypatch.setattr("armscan.console.work.probe", with_remark)
    result = run_step(journey.folder, StepName.PROBING)
    assert result.verdict == "doubtful"
    advice = work._advice(journey, StepName.CHECK, result)
    assert "remarks" in advice.split(".")[0]
    assert " they " not in advice
    page = write_report(open_journey(journey.folder)).read_text("utf-8")
    assert "with remarks" in page
    assert "doubtful" not in page


def test_a_refusal_is_a_result_with_its_sentence(tmp_path: Path) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    touch_plate(journey, 2)
    result = run_step(journey.folder, StepName.PROBING)
    assert result.verdict == "not good"
    assert len(result.reasons) == 1 and "2" in result.reasons[0]
    assert open_journey(journey.folder).state(StepName.PROBING).status == "not good"
    assert not (journey.folder / "plate.csv").exists()
    with pytest.raises(OptionError, match="0 of 15 placements"):
        run_step(journey.folder, StepName.CAMERA)


def test_settings_stay_and_a_rig_tells_what_they_lack(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    open_journey(folder, SETTINGS).change(ball_mm=25.0)
    other = SessionSettings(rig="rig.toml", ball_mm=30.0, part="part.stl", needs_latency=True)
    journey = open_journey(folder, other)
    assert journey.settings.ball_mm == 25.0 and journey.settings.target == SETTINGS.target
    assert journey.settings.rig == "rig.toml" and journey.settings.part == "part.stl"
    assert StepName.LATENCY in [step.name for step in journey.steps]


def test_a_rig_tells_how_many_cameras_until_they_are_calibrated(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    open_journey(folder)
    journey = open_journey(folder, replace(SETTINGS, n_cameras=2))
    assert journey.settings.n_cameras == 2 and journey.camera_file.name == "stereo.json"
    journey.camera_file.write_text("{}")
    with pytest.raises(OptionError, match="of 2 cameras, the rig has 1"):
        open_journey(folder, SETTINGS)
    assert open_journey(folder).settings == journey.settings


@pytest.mark.parametrize("content", ["", "ball_mm = [", 'ball_mm = "large"', "ball_mm = nan\n["])
def test_damaged_settings_are_one_sentence(tmp_path: Path, content: str) -> None:
    (tmp_path / SETTINGS_FILE).write_text(content)
    with pytest.raises(FileFormatError):
        open_journey(tmp_path)


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"letter\.txt"):
        open_journey(tmp_path, SETTINGS)
    with pytest.raises(OutputError, match=r"letter\.txt"), held_session(tmp_path):
        pass
    assert [one.name for one in tmp_path.iterdir()] == ["letter.txt"]
    with held_session(tmp_path / "new"):
        pass
    assert not (tmp_path / "new").exists(), "nothing became of it"


@pytest.mark.parametrize(
    ("compare", "changes"),
    [
        ("CAD model", {"tolerance": "0.2", "part": "other.stl"}),
        ("ball", {"ball_mm": 25.0}),
        ("plate", {}),
    ],
)
def test_an_inspection_is_old_where_what_it_compared_with_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compare: str, changes: dict[str, Any]
) -> None:
    monkeypatch.setattr(work, "_work", lambda *_: Summary("An inspection"))
    journey = open_journey(tmp_path / "s", replace(SETTINGS, part="part.stl", tolerance="0.1"))
    touch_plate(journey, 12)
    for name in ("part.stl", "plate.csv", "scan-01.ply"):
        (journey.folder / name).write_text(name)
    for name in ("camera.json", "sensor.json", "scanner.json"):
        (journey.folder / name).write_text("{}")
    run_step(journey.folder, StepName.INSPECT, "scan-01", compare)

    def status() -> str:
        return journey.state(StepName.INSPECT, "scan-01").status

    assert status() == "good"
    for key, value in changes.items():
        before = getattr(journey.settings, key)
        journey.change(**{key: value})
        assert status() == "old"
        assert f"the setting {key}" in journey.state(StepName.INSPECT, "scan-01").why
        journey.change(**{key: before})
        assert status() == "good"
    for name, of in (("part.stl", "CAD model"), ("plate.csv", "plate")):
        (journey.folder / name).write_text("another one")
        assert (status() == "old") is (compare == of)
        (journey.folder / name).write_text(name)


def test_a_latency_counts_for_the_hand_eye_that_it_was_found_with(tmp_path: Path) -> None:
    journey = open_journey(tmp_path / "s", replace(SETTINGS, needs_latency=True))
    plain, timed = journey.folder / "scanner.json", journey.folder / "scanner-timed.json"
    plain.write_bytes(scanner_document(scanner()))
    made = replace(scanner().provenance, inputs=(InputFile("scanner.json", digest_of(plain)),))
    timed.write_bytes(scanner_document(replace(scanner(), provenance=made)))
    assert journey.scanner_file == timed
    of_check = journey.folder / "results" / "check.json"
    of_check.parent.mkdir()
    rests_on = {timed.name: digest_of(timed)}
    of_check.write_text(json.dumps({"verdict": "good", "rests_on": rests_on}))
    assert journey.state(StepName.CHECK).status == "good"
    open_journey(journey.folder, SETTINGS)
    assert open_journey(journey.folder).scanner_file == plain, "one trigger leaves no latency"
    # a new hand-eye
    plain.write_bytes(plain.read_bytes() + b"\n")
    assert journey.scanner_file == plain
    state = journey.state(StepName.CHECK)
    why = "the result of 'Latency' has changed since: calculate again"
    assert (state.status, state.why) == ("old", why)


def test_a_damaged_result_counts_as_none(tmp_path: Path) -> None:
    journey = open_journey(tmp_path / "s", SETTINGS)
    place = journey.folder / "results" / "camera.json"
    place.parent.mkdir()
    for content in ("", "{", json.dumps({"verdict": "good", "more": 1}), "[]"):
        place.write_text(content)
        assert journey.result(StepName.CAMERA) is None


def test_the_second_console_is_told_which_one_is_first(tmp_path: Path) -> None:
    with (
        held_session(tmp_path / "s"),
        pytest.raises(OutputError, match=f"process {os.getpid()}"),
        held_session(tmp_path / "s"),
    ):
        pass
    with held_session(tmp_path / "again"):
        assert (tmp_path / "again" / LOCK_FILE).is_file()


def test_a_growing_recording_is_whole_after_every_take(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    session = Session("calibration", (CameraSetup(6, 4),))
    images = [rng.integers(0, 255, (4, 6)).astype(np.uint8) for _ in range(5)]
    for k, image in enumerate(images):
        # opened anew every time, as after a restart
        grown = GrowingRecording.of(tmp_path / "r", session)
        row = ExposureRow(k, k * 10**9, 0, f"images/{k}.png", ("A",), k, f"{k // 2}")
        grown.add(row, Exposure(image, row.source))
        grown.add_sample(k * 10**9, Pose(np.eye(3), np.array([k, 0.0, 0.0])), k)
        grown.flush()
        found = read_recording(tmp_path / "r")
        assert len(found.rows) == k + 1 == len(found.arm.t_ns)
        np.testing.assert_array_equal(found.exposure(k).image, image)
    assert found.rows[3].lasers == ("A",) and found.arm.trigger_ids.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(found.arm.translations_mm[:, 0], range(5), atol=1e-12)
    grown.take_back()
    grown.flush()
    assert [row.index for row in read_recording(tmp_path / "r").rows] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "address",
    ["twin:thesis-single?colour=red", "twin:thesis-single?seed=x", "twin:other", "no/rig.toml"],
)
def test_a_wrong_rig_is_one_sentence(address: str) -> None:
    with pytest.raises(ArmscanError):
        open_bench(address)


def test_a_rig_of_three_cameras_is_refused_before_a_device_opens(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text('cameras = ["replay:a.mcap", "replay:b.mcap", "replay:c.mcap"]\n')
    with pytest.raises(OptionError, match="3 cameras are more"):
        open_bench(str(rig))
