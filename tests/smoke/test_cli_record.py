# SPDX-License-Identifier: Apache-2.0
"""``armscan record`` on the twin with a small window, and what it refuses."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armscan.cli import main
from armscan.devices.matching import MatchedInstant
from armscan.devices.protocols import ArmFlag, ArmSample, LaserEvent
from armscan.errors import ArmscanError, DeviceError, DeviceStoppedError, OutputError
from armscan.jobs.live.record import RecordRequest, _Recording, record_scan
from armscan.pipeline.live.acquire import BEHIND, JUMPED, MATCHING, LiveEvent
from armscan.pipeline.live.recorder import LiveRecorder
from armscan.reconstruction.sync import PoseStatus
from armscan.simulation.live import TwinArm, TwinLasers
from armscan.storage.files import set_aside
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import extract_recording
from armscan.storage.recordings.write_mcap import RecordingWriter

TWIN = "twin:thesis-single?scene=plate&preset=clean&pause=0&loop=1&ahead=1"
RIG = f"""cameras = ["{TWIN}"]
arm = "{TWIN}"
lasers = "{TWIN}"
rate_hz = 25.0
is_common_trigger = true
windows = [[1500, 900, 64, 32]]
"""
EARLIER = b"an hour of scanning"


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG)
    return tmp_path / "rig.toml"


def test_a_rig_is_recorded_whole(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = rig.parent / "scan.mcap"
    assert main(["record", str(rig), "--exposures", "12", "--json", "-o", str(output)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["exposures"] >= 12 and told["lost"] == told["late"] == told["aside"] == 0
    assert not told["interrupted"] and told["megabytes"] == output.stat().st_size / 1e6
    extract_recording(output, rig.parent / "scan")
    recorded = read_recording(rig.parent / "scan")
    assert len(recorded.rows) == told["exposures"]
    assert {row.lasers for row in recorded.rows} == {("A",)} and recorded.is_simulated
    window = recorded.session.cameras[0].window
    assert (window.x_px, window.y_px) == (1500, 900)
    assert recorded.exposure(0).image.shape == (32, 64)
    ids = [row.trigger_id for row in recorded.rows]
    assert set(ids) <= set(recorded.arm.trigger_ids.tolist())
    assert main(["record", str(rig), "-o", str(output)]) == 2
    assert "exists" in capsys.readouterr().err
    # what is simulated stays so, however it is played
    again = rig.parent / "again.mcap"
    words = ["--camera", f"replay:{output}?loop=1", "--exposures", "3", "-o", str(again)]
    assert main(["record", *words]) == 0
    assert main(["info", str(again), "--json"]) == 0
    told = capsys.readouterr().out
    assert json.loads(told[told.index("{") :])["items"][0]["simulated"] is True


@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
def test_ctrl_c_ends_a_recording_that_is_whole(rig: Path) -> None:
    output = rig.parent / "scan.mcap"
    # a shell's background job would ignore the signal
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "from armscan.cli import main; sys.exit(main())"
    run = subprocess.Popen(
        [sys.executable, "-c", code, "record", str(rig), "--json", "-o", str(output)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stderr is not None and run.stdout is not None
    while not re.search("[1-9] exposures", line := run.stderr.readline()):
        assert line, "it ended by itself"
    run.send_signal(signal.SIGINT)
    out = run.communicate(timeout=60)[0]
    assert run.returncode == 0
    told = json.loads(out)
    assert told["interrupted"] and told["exposures"] > 0
    found = extract_recording(output, rig.parent / "scan")
    assert found.n_exposures == told["exposures"] and not found.lost


def test_a_full_disk_ends_it_and_says_what_is_safe(
    rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real, n_left = RecordingWriter.add_exposure, iter([True] * 5)

    def full(self: RecordingWriter, *given: object, **named: object) -> float:
        if not next(n_left, False):
            raise OutputError("the recording stopped (no space): 5 exposures of 6 are safe")
        return real(self, *given, **named)  # type: ignore[arg-type]

    heard = _Recording._hear

    def with_other_trouble(self: _Recording, event: LiveEvent) -> None:
        """A busy machine is slow, and a clock seems to jump: that is not why it ended."""
        for other in (LiveEvent("warning", BEHIND), LiveEvent("warning", JUMPED, "arm")):
            heard(self, other)
        heard(self, event)
        heard(self, other)

    monkeypatch.setattr(RecordingWriter, "add_exposure", full)
    monkeypatch.setattr(_Recording, "_hear", with_other_trouble)
    output = rig.parent / "scan.mcap"
    told: list[str] = []
    with pytest.raises(DeviceError, match="no space"):
        record_scan(RecordRequest(str(rig), seconds=60.0), output, told.append)
    assert any("no space" in line for line in told)
    assert extract_recording(output, rig.parent / "scan").n_exposures == 5


def test_without_an_image_there_is_no_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.toml").write_text(RIG.replace(f'lasers = "{TWIN}"\n', ""))
    output = tmp_path / "scan.mcap"
    start, n_before = time.monotonic(), threading.active_count()
    # nothing triggers the camera: the laser controller is missing
    assert main(["record", str(tmp_path / "rig.toml"), "--seconds", "4", "-o", str(output)]) == 2
    # how long the space lasts is not told of nothing
    assert re.search(r"[0-9,]+ GB left$", capsys.readouterr().err, re.MULTILINE)
    assert not output.exists() and time.monotonic() - start < 60.0
    assert threading.active_count() <= n_before


def test_what_is_to_be_replaced_stays_where_no_image_comes(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG.replace(f'lasers = "{TWIN}"\n', ""))
    output = tmp_path / "scan.mcap"
    output.write_bytes(EARLIER)
    words = ["record", str(tmp_path / "rig.toml"), "--seconds", "0.3", "--force", "-o", str(output)]
    assert main(words) == 2
    assert output.read_bytes() == EARLIER
    assert sorted(one.name for one in tmp_path.iterdir()) == ["rig.toml", "scan.mcap"]


@pytest.mark.parametrize("ending", [KeyboardInterrupt(), DeviceError("the arm is gone")])
def test_what_is_to_be_replaced_stays_where_it_ends_before_it_begins(
    ending: BaseException, rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(_: _Recording) -> None:
        raise ending

    monkeypatch.setattr(_Recording, "_wait_for_clocks", ended)
    output = rig.parent / "scan.mcap"
    output.write_bytes(EARLIER)
    with pytest.raises(type(ending)):
        record_scan(RecordRequest(str(rig)), output, print, is_overwriting=True)
    assert output.read_bytes() == EARLIER
    assert sorted(one.name for one in rig.parent.iterdir()) == ["rig.toml", "scan.mcap"]


@pytest.mark.parametrize("step", ["_wait_for_clocks", "_put_aside"])
def test_what_another_run_makes_meanwhile_is_not_touched(
    step: str, rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, real = rig.parent / "scan.mcap", getattr(_Recording, step)

    def meanwhile(run: _Recording) -> None:
        real(run)
        output.write_bytes(EARLIER)

    monkeypatch.setattr(_Recording, step, meanwhile)
    with pytest.raises(OutputError, match="exists"):
        record_scan(RecordRequest(str(rig), n_exposures=2), output, print)
    assert output.read_bytes() == EARLIER
    assert sorted(one.name for one in rig.parent.iterdir()) == ["rig.toml", "scan.mcap"]


def test_what_cannot_be_brought_back_is_kept_and_said(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, real = rig.parent / "scan.mcap", _Recording._put_aside
    output.write_bytes(EARLIER)

    def meanwhile(run: _Recording) -> None:
        real(run)
        output.write_bytes(b"of another run")

    monkeypatch.setattr(_Recording, "_put_aside", meanwhile)
    told: list[str] = []
    with pytest.raises(OutputError, match="exists"):
        record_scan(RecordRequest(str(rig)), output, told.append, is_overwriting=True)
    assert output.read_bytes() == b"of another run"
    assert output.with_name(".scan.mcap.before").read_bytes() == EARLIER
    assert "what was there lies in .scan.mcap.before until the recording ends" in told
    assert any("what was there before lies in .scan.mcap.before" in line for line in told)


def test_what_a_killed_run_left_is_named_and_not_replaced(
    rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, left = rig.parent / "scan.mcap", rig.parent / ".scan.mcap.before"
    output.write_bytes(b"a second of scanning")
    left.write_bytes(EARLIER)
    words = ["record", str(rig), "--exposures", "2", "--force", "-o", str(output)]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "an earlier file of this name lies in .scan.mcap.before" in told
    assert "opening the devices" not in told
    assert left.read_bytes() == EARLIER and output.read_bytes() == b"a second of scanning"
    left.unlink()
    assert main(words) == 0
    assert len(read_recording(output).rows) >= 2 and not left.exists()


@pytest.mark.skipif(os.name != "posix", reason="locks files")
def test_a_recording_that_still_grows_is_not_replaced(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = rig.parent / "scan.mcap"
    refused: list[str] = []
    real = _Recording._watch

    def watched(run: _Recording, request: RecordRequest, start: float) -> None:
        try:
            set_aside(output, is_overwriting=True)
        except OutputError as error:
            refused.append(error.what)
        real(run, request, start)

    monkeypatch.setattr(_Recording, "_watch", watched)
    record_scan(RecordRequest(str(rig), n_exposures=2), output, print)
    assert refused == ["another run writes this file"]
    aside = set_aside(output, is_overwriting=True)
    assert aside is not None and aside.path == rig.parent / ".scan.mcap.before"
    with pytest.raises(OutputError, match=r"lies in \.scan\.mcap\.before"):
        set_aside(output, is_overwriting=True)


def test_what_another_run_still_writes_is_kept_where_nothing_locks(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, aside = rig.parent / "scan.mcap", rig.parent / ".scan.mcap.before"
    output.write_bytes(EARLIER)
    real = _Recording._watch

    def watched(run: _Recording, request: RecordRequest, start: float) -> None:
        with aside.open("ab") as growing:
            growing.write(b" and a minute")
        real(run, request, start)

    monkeypatch.setattr(_Recording, "_watch", watched)
    monkeypatch.setattr("armscan.storage.files.fcntl", None)
    told: list[str] = []
    record_scan(RecordRequest(str(rig), n_exposures=2), output, told.append, is_overwriting=True)
    assert len(read_recording(output).rows) >= 2
    assert aside.read_bytes() == EARLIER + b" and a minute"
    assert any("lies in .scan.mcap.before and is not removed" in line for line in told)


def test_a_run_without_an_image_removes_no_other_run_s_file(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.write_text(RIG.replace(f'lasers = "{TWIN}"\n', ""))
    output = rig.parent / "scan.mcap"
    real = _Recording._watch

    def watched(run: _Recording, request: RecordRequest, start: float) -> None:
        output.rename(rig.parent / "moved")
        output.write_bytes(EARLIER)
        real(run, request, start)

    monkeypatch.setattr(_Recording, "_watch", watched)
    with pytest.raises(DeviceError, match="no image came"):
        record_scan(RecordRequest(str(rig), seconds=0.3), output, print)
    assert output.read_bytes() == EARLIER


@pytest.mark.parametrize(
    ("lacking", "words"),
    [
        ("lasers", "it is not known what lasers were on; see that the laser controller answers"),
        ("trigger_id", "they bear no trigger's id, and ids alone give poses; let the cameras tell"),
    ],
)
def test_a_recording_of_which_nothing_can_be_used_is_no_success(
    lacking: str, words: str, rig: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    real, output = LiveRecorder.add_instant, rig.parent / "scan.mcap"

    def without(recorder: LiveRecorder, instant: MatchedInstant) -> None:
        frames = tuple(one and replace(one, **{lacking: None}) for one in instant.frames)
        real(recorder, replace(instant, frames=frames, **{lacking: None}))

    monkeypatch.setattr(LiveRecorder, "add_instant", without)
    assert main(["record", str(rig), "--exposures", "3", "-o", str(output)]) == 2
    told = capsys.readouterr().err
    assert re.search("none of [0-9]+ exposures can be used: " + re.escape(words), told)
    assert "the file keeps them" in told and len(read_recording(output).rows) >= 3


def test_a_camera_that_counts_otherwise_than_the_arm_is_no_success(
    rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real, output = LiveRecorder.add_instant, rig.parent / "scan.mcap"

    def later(recorder: LiveRecorder, instant: MatchedInstant) -> None:
        """Its ids are those of triggers of 10 s before."""
        frames = tuple(one and replace(one, t_host_ns=one.t_host_ns + 10**10)
                       for one in instant.frames)  # fmt: skip
        status = PoseStatus.UNKNOWN_TRIGGER
        real(recorder, replace(instant, frames=frames, t_ns=None, pose=None, status=status))

    monkeypatch.setattr(LiveRecorder, "add_instant", later)
    assert main(["record", str(rig), "--exposures", "3", "-o", str(output)]) == 2
    told = capsys.readouterr().err
    words = "they bear ids of samples of the arm that came long before or after; let camera and arm"
    assert re.search("none of [0-9]+ exposures can be used: " + words, told)


def test_what_arrives_and_cannot_be_matched_is_no_success(
    rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real, n_left = RecordingWriter.add_exposure, iter([True] * 5)

    def broken(self: RecordingWriter, *given: object, **named: object) -> float:
        if not next(n_left, False):
            raise ValueError("a bug")
        return real(self, *given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(RecordingWriter, "add_exposure", broken)
    output = rig.parent / "scan.mcap"
    assert main(["record", str(rig), "--seconds", "60", "-o", str(output)]) == 2
    assert "the recording ended: ValueError" in capsys.readouterr().err
    assert extract_recording(output, rig.parent / "scan").n_exposures == 5


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["-o", "x.ply"], "no camera is named"),
        (["--camera", "webcam:0", "-o", "x.ply"], "end it in .mcap"),
        (["nothing.toml"], "no such file"),
        (["--camera", "twin:none", "-o", "x.mcap"], "no simulated head"),
        (["--camera", "webcam:0", "--seconds", "-1"], "--seconds"),
        (["--camera", "webcam:0", "--seconds", "nan"], "--seconds: nan"),
        (["--camera", "webcam:0", "--seconds", "inf"], "--seconds: inf"),
        (["--camera", "webcam:0", "--exposures", "0"], "--exposures: 0"),
        (["--camera", "webcam:0", "--rate", "nan"], "--rate: nan"),
        (["twin:none", "-o", "x.mcap"], "no simulated head"),
        (["webcam:0", "-o", "x.mcap"], "give it as --camera"),
    ],
)
def test_what_cannot_be_recorded_is_refused(
    given: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", *given]) == 2
    assert words in capsys.readouterr().err


def test_options_beside_a_description_count(rig: Path) -> None:
    rig.write_text(RIG.replace("is_common_trigger = true\n", ""))
    asked = RecordRequest(str(rig), rate_hz=12.5, is_common_trigger=True).description()
    assert (asked.rate_hz, asked.is_common_trigger) == (12.5, True)
    as_it_is = RecordRequest(str(rig)).description()
    assert (as_it_is.rate_hz, as_it_is.is_common_trigger) == (25.0, False)


@pytest.mark.parametrize(
    ("address", "cameras", "is_common"),
    [
        ("twin:thesis-single?seed=1", ("twin:thesis-single?seed=1",), True),
        ("twin:thesis-multi", ("twin:thesis-multi", "twin:thesis-multi?camera=1"), True),
        ("twin:thesis-single?wired=0", ("twin:thesis-single?wired=0",), False),
    ],
)
def test_an_address_of_the_simulator_is_a_rig(
    address: str, cameras: tuple[str, ...], is_common: bool
) -> None:
    found = RecordRequest(address).description()
    assert found.cameras == cameras and found.is_common_trigger == is_common
    assert found.arm == found.lasers == address


@pytest.mark.parametrize(("mode", "is_told"), [("automatic", True), ("fixed", False)])
def test_a_common_trigger_with_a_changing_exposure_is_warned_of(
    mode: str, is_told: bool, rig: Path
) -> None:
    text = RIG.replace("twin:", "no-driver:") + f'[exposure]\nmode = "{mode}"\n'
    rig.write_text(text)
    told: list[str] = []
    with pytest.raises(ArmscanError):
        record_scan(RecordRequest(str(rig)), rig.parent / "x.mcap", told.append)
    assert any("a pose is that of the trigger" in one for one in told) is is_told


def test_a_stripe_band_is_recorded_and_said(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = rig.parent / "scan.mcap"
    words = ["record", str(rig), "--exposures", "4", "--stripe-band", "-o", str(output)]
    assert main(words) == 0
    assert read_recording(output).session.is_stripe_band


def test_an_arm_without_a_pose_is_no_success(
    rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = TwinArm.read

    def unreferenced(arm: TwinArm, timeout_s: float) -> tuple[ArmSample, ...]:
        found = real(arm, timeout_s)
        return tuple(replace(one, pose=None, flags=ArmFlag.NONE) for one in found)

    monkeypatch.setattr(TwinArm, "read", unreferenced)
    monkeypatch.setattr("armscan.jobs.live.record.TOLD_EVERY_S", 0.0)
    output = rig.parent / "x.mcap"
    assert main(["record", str(rig), "--exposures", "20", "-o", str(output)]) == 2
    told = capsys.readouterr().err
    said = "none of [0-9]+ exposures can be used: none of [0-9]+ samples of the arm has a pose"
    assert re.search(said, told) and "the file keeps them" in told
    assert "the arm gives no pose" in told and len(read_recording(output).rows) >= 20


def test_lasers_that_went_off_by_themselves_end_the_recording(
    rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing lights them but a person; what came before is kept."""
    real, output = TwinLasers.read, rig.parent / "scan.mcap"
    recorders: list[RecordingWriter] = []
    begun = RecordingWriter.begin

    def begin(self: RecordingWriter, *given: Any) -> None:
        begun(self, *given)
        recorders.append(self)

    def read(lasers: TwinLasers, timeout_s: float) -> tuple[LaserEvent, ...]:
        if recorders and recorders[0].status().n_accepted > 3:
            raise DeviceStoppedError("it switched the lasers off")
        return real(lasers, timeout_s)

    monkeypatch.setattr(RecordingWriter, "begin", begin)
    monkeypatch.setattr(TwinLasers, "read", read)
    words = ["record", str(rig), "--exposures", "300", "-o", str(output)]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert re.search(r"after [0-9.]+ s twin .*lasers: it switched the lasers off", told)
    assert "what came before is whole" in told
    assert 3 < len(read_recording(output).rows) < 300


def test_faults_of_this_program_are_no_device_s() -> None:
    run: Any = _Recording.__new__(_Recording)
    run._n_faults, run._why_ended, run._tell = 0, "", lambda _: None
    run._is_over = False
    run._hear(LiveEvent("fault", "the images are no longer matched", MATCHING))
    assert run._n_faults == 0 and "no longer matched" in run._why_ended
    run._hear(LiveEvent("fault", "unplugged", "camera 0"))
    assert run._n_faults == 1


@pytest.mark.parametrize(
    "line",
    [
        "windows = [[1, 2, 3]]", "windows = [[1, 2, 3, 0]]", "windows = []\nrate_hz = nan",
        'schedule = ["A"]\nchooses_lasers = true', '[exposure]\nmode = "auto"',
        "[exposure]\ntarget = 3.0", "[stripes]\nthreshold = -1.0", 'arm_model = "none.toml"',
        "rate_hz = 0.0", "colour = 3", 'lasers = "x:"\nschedule = ["A+"]',
    ],
)  # fmt: skip
def test_a_wrong_description_is_refused(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(f'cameras = ["webcam:0"]\n{line}\n')
    assert main(["record", str(path), "-o", str(tmp_path / "x.mcap")]) == 2
    err = capsys.readouterr().err
    assert str(tmp_path) in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('schedule = ["A", "B"]', "schedule says which lasers are on, and there is no laser contr"),
        ("chooses_lasers = true", "chooses_lasers says which lasers are on, and there is no laser"),
        ('lasers = "x:"\nschedule = ["A+A"]', "the step 'A+A' of schedule names a laser twice"),
        ('lasers = "x:"\nchooses_lasers = true', "no scanner is given; give --scanner"),
    ],
)
def test_lasers_that_nothing_would_choose_are_refused_before_a_device_is_opened(
    line: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(f'cameras = ["webcam:0"]\n{line}\n')
    assert main(["record", str(path), "-o", str(tmp_path / "x.mcap")]) == 2
    err = capsys.readouterr().err
    assert words in err and "opening the devices" not in err
