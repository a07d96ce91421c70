# SPDX-License-Identifier: Apache-2.0
"""The page's buttons on a drawn rig: what is told when something fails, and what is left."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from armscan.console.journey import StepName
from armscan.console.pages import ConsolePage
from armscan.console.server import close_server, open_server
from armscan.console.work import Worker, recover_scans
from armscan.errors import DeviceError
from armscan.pipeline.live.rig import Rig
from armscan.storage.arm import PROBE_FILE, ProbeTip, probe_tip_toml, read_probe_tip
from armscan.storage.recording import read_recording
from rigs.console_rig import FailingArm, FailingBench, put_scanner, waited


@contextmanager
def opened(folder: Path, bench: FailingBench | None) -> Iterator[ConsolePage]:
    server, _ = open_server(lambda: folder, port=0)
    page = ConsolePage(server, folder, bench)
    try:
        yield page
    finally:
        page.close()
        close_server(server)


def text_of(page: ConsolePage) -> str:
    """What the column says."""
    parts = (page._head, page._guide, page._note, page.scanning._facts)
    return unescape(re.sub(r"<[^>]*>", " ", " ".join(part.content for part in parts)))


def begin_scan(page: ConsolePage) -> None:
    page.choose(StepName.SCAN)
    page.controls.tried(page.start_or_pause)
    waited(lambda: page.live is not None and page.live.snapshot.n_points > 0)


def test_a_camera_is_unplugged_and_the_arm_stalls_while_scanning(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    with opened(tmp_path / "s", bench) as page:
        begin_scan(page)
        bench.cameras[0].is_gone = True
        waited(lambda: "it was unplugged. The scan goes on by itself" in text_of(page))
        n_before = page.live.n_recorded
        bench.cameras[0].is_gone = False
        waited(lambda: page.live.n_recorded > n_before + 5)
        waited(lambda: "unplugged" not in text_of(page))
        bench.arm.is_stalled = True
        waited(lambda: "arm has delivered nothing for 2" in text_of(page))
        bench.arm.is_stalled = False
        waited(lambda: "delivered nothing" not in text_of(page))
        page.scanning.end()
    recorded = read_recording(page.journey.recording(StepName.SCAN, "scan-01"))
    ids = [row.trigger_id or 0 for row in recorded.rows]
    assert ids == sorted(set(ids)) and len(ids) > n_before + 5


def test_what_does_not_answer_is_told_as_long_as_it_does_not(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    with opened(tmp_path / "s", bench) as page:
        begin_scan(page)
        bench.arm.is_stalled = True
        waited(lambda: "arm has delivered nothing for 2" in text_of(page))
        bench.cameras[0].is_gone = True
        waited(lambda: "it was unplugged. The scan goes on by itself" in text_of(page))
        bench.cameras[0].is_gone = False
        waited(lambda: "unplugged" not in text_of(page))
        page.controls.tried(page.scanning.see_arm)
        assert "arm has delivered nothing for 2" in text_of(page)
        # and what fails while nothing is recorded is told when the scan goes on
        page.controls.tried(page.start_or_pause)
        bench.cameras[0].is_gone = True
        waited(lambda: len(page.live.snapshot.faults) == 2)
        waited(lambda: "unplugged" not in text_of(page))
        page.controls.tried(page.start_or_pause)
        waited(lambda: "it was unplugged. The scan goes on by itself" in text_of(page))


def test_a_press_while_a_scan_begins_does_not_pause_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    begun, may_go_on, scan_rig = threading.Event(), threading.Event(), bench.scan_rig

    def slow_rig(step: StepName) -> Rig:
        begun.set()
        assert may_go_on.wait(30.0)
        return scan_rig(step)

    monkeypatch.setattr(bench, "scan_rig", slow_rig)
    with opened(tmp_path / "s", bench) as page:
        page.choose(StepName.SCAN)
        first = threading.Thread(target=pressed, args=(page.scanning.start_button,))
        first.start()
        assert begun.wait(30.0)
        assert "Starting the devices" in page._working.content and page._working.visible
        again = threading.Thread(target=pressed, args=(page.scanning.start_button,))
        again.start()
        again.join(10.0)
        assert not again.is_alive()
        page.choose(StepName.CHECK)
        assert page.step is StepName.SCAN and "wait for its end" in text_of(page)
        may_go_on.set()
        first.join()
        assert page.live is not None and page.live.snapshot.state == "scanning"


def test_nothing_begins_while_a_scan_ends_and_its_step_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        page.choose(StepName.CHECK)
        page.controls.tried(page.start_or_pause)
        waited(lambda: page.live is not None and page.live.n_recorded > 2)
        live, ran = page.live, list[tuple[Any, ...]]()
        ending, may_end, stop = threading.Event(), threading.Event(), live.stop

        def stop_slowly() -> None:
            ending.set()
            assert may_end.wait(30.0)
            stop()

        monkeypatch.setattr(live, "stop", stop_slowly)
        monkeypatch.setattr(page, "_run", lambda *of: ran.append(of))
        first = threading.Thread(target=pressed, args=(page.scanning._finish,))
        first.start()
        assert ending.wait(30.0)
        assert "Ending the scan" in page._working.content and page._working.visible
        assert page.scanning.start_button.disabled and page.scanning._finish.disabled
        again = threading.Thread(target=pressed, args=(page.scanning.start_button,))
        again.start()
        again.join(10.0)
        assert not again.is_alive()
        page.choose(StepName.SCAN)
        assert page.step is StepName.CHECK and "wait for its end" in text_of(page)
        may_end.set()
        first.join()
        # and the arm's button, heard late
        page.scanning._turn(live)
        assert page.live is None and not page.scanning.start_button.disabled
        assert ran == [(page.journey.folder, StepName.CHECK, "")]
        assert len(read_recording(page.journey.recording(StepName.CHECK)).rows) == live.n_recorded


def test_nothing_begins_while_a_recording_that_was_cut_short_is_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    place = tmp_path / "s" / "recordings" / "check.mcap"
    place.parent.mkdir()
    place.write_bytes(b"cut")
    saving, may_end = threading.Event(), threading.Event()

    def save(*_: object, **__: object) -> tuple[str, ...]:
        saving.set()
        assert may_end.wait(30.0)
        place.unlink()
        return ("It is saved.",)

    monkeypatch.setattr(Worker, "run", save)
    with opened(tmp_path / "s", FailingBench()) as page:
        assert saving.wait(30.0)
        page.choose(StepName.CHECK)
        pressed(page.scanning.start_button)
        assert page.live is None and place.read_bytes() == b"cut"
        may_end.set()
        waited(lambda: not page.scanning.start_button.disabled)
        pressed(page.scanning.start_button)
        assert page.live is not None


def test_a_closed_console_ends_its_scan_and_the_next_one_goes_on_there(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        begin_scan(page)
    n = len(read_recording(tmp_path / "s" / "recordings" / "scan-01.mcap").rows)
    assert n > 0
    whole = (tmp_path / "s" / "recordings" / "scan-01.mcap").read_bytes()
    # and one that was killed: its file has no end
    (tmp_path / "s" / "recordings" / "scan-02.mcap").write_bytes(whole[: len(whole) - 60])
    with opened(tmp_path / "s", None) as page:
        waited(lambda: "scan-02 was cut short" in text_of(page))
        saved = "its one exposure was saved" if n == 1 else f"its {n} exposures were saved"
        assert saved in text_of(page)
        assert page.journey.scans == ("scan-01", "scan-02")


SCANNING = """
import sys, time
from pathlib import Path
from armscan.console.journey import StepName
from unit.console.test_page import begin_scan, opened
from rigs.console_rig import FailingBench

def main():
    with opened(Path(sys.argv[1]), FailingBench(n=4000)) as page:
        begin_scan(page)
        while True:
            print(page.live.n_recorded, time.monotonic(), flush=True)
            time.sleep(0.02)

if __name__ == "__main__":
    main()
"""


def test_a_console_that_is_killed_while_it_scans_leaves_a_whole_session(tmp_path: Path) -> None:
    folder, script = tmp_path / "s", tmp_path / "scanning.py"
    put_scanner(folder)
    script.write_text(SCANNING)
    command = [sys.executable, str(script), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(2.0)
        process.kill()
        killed = time.monotonic()
        said = [line.split() for line in process.stdout.read().splitlines()]
    due = [int(line[0]) for line in said if len(line) == 2 and float(line[1]) < killed - 1.0]
    # the lock of the dead one keeps nobody out
    with opened(folder, None) as page:
        waited(lambda: "scan-01 was cut short" in text_of(page))
        rows = read_recording(page.journey.recording(StepName.SCAN, "scan-01")).rows
        assert [row.index for row in rows] == list(range(len(rows)))
        assert len(rows) >= due[-1] > 0
        assert page.journey.state(StepName.SCAN, "scan-01").status == "ready"


def test_settings_hold_for_the_session_and_a_wrong_one_is_a_sentence(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        panel = page.seeing
        panel._mode.value, panel._target.value = "automatic", 60.0
        panel._windows.value, panel._height.value = "0, 40, 320, 160", 12.0
        panel._lasers.value = "A 50"
        page.controls.tried(lambda: page._see(panel._read()))
        assert page.controls.problem == ""
        kept = page.journey.settings.seeing
        assert kept.exposure.mode == "automatic" and kept.exposure.target_of(("A",)) == 0.5
        assert kept.exposure.target == 0.6 and kept.stripes.threshold == 12.0
        panel._windows.value = "all of it"
        page.controls.tried(lambda: page._see(panel._read()))
        assert "not understood" in page.controls.problem
        assert page.bench.rig.description.windows == ((0, 40, 320, 160),)
    with opened(tmp_path / "s", FailingBench()) as page:
        assert page.journey.settings.seeing == kept
        assert page.bench.rig.description.stripes.threshold == 12.0
        page.controls.tried(lambda: page._see(None))
        assert page.bench.rig.description.windows == ()


def test_what_is_being_typed_stays(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        page.seeing._windows.value, page.seeing._height.value = "0, 40, 3", 12.0
        page._target.value = "chessboard:9x6:10 "
        page.refresh()
        assert page.seeing._windows.value == "0, 40, 3" and page.seeing._height.value == 12.0
        assert page._target.value == "chessboard:9x6:10 "
        assert page.journey.settings.target == "chessboard:9x6:10"
        page.controls.tried(page.seeing._forget)
        assert page.seeing._windows.value == "" and page.seeing._height.value == 0.0


def test_a_plate_is_touched_by_what_the_page_asks_for(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    with opened(tmp_path / "s", bench) as page:
        page.choose(StepName.PROBING)
        assert "into 'Tip, mm'" in text_of(page)
        page.tip._centre.value = "0, 0"
        page.controls.tried(page.tip._keep)
        assert "write three numbers" in text_of(page)
        page.tip._centre.value, page.tip._diameter.value = "0, 0, 120.5", 6.0
        page.controls.tried(page.tip._keep)
        assert "into 'Tip, mm'" not in text_of(page) and not page.controls.problem
        page.controls.tried(page.take_one)
        assert "Touch 2 of 20" in text_of(page)
        tip = read_probe_tip(page.journey.recording(StepName.PROBING) / "probe.toml")
        assert tip.centre_tool_mm.tolist() == [0.0, 0.0, 120.5] and tip.diameter_mm == 6.0


def pressed(button: Any) -> None:
    for answer in button._impl.update_cb:
        answer(None)


def test_start_over_asks_what_it_would_remove(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        (tmp_path / "s" / PROBE_FILE).write_bytes(probe_tip_toml(ProbeTip(np.zeros(3), 6.0)))
        page.choose(StepName.PROBING)
        for _ in range(3):
            pressed(page._take)
        pressed(page._start_over)
        assert page._start_over.label == "Remove 3 touches? Press again"
        assert page.journey.n_taken(StepName.PROBING) == 3
        pressed(page._take_back)
        assert page._start_over.label == "Start over", "another button is no answer"
        pressed(page._start_over)
        page.choose(StepName.SCAN)
        page.choose(StepName.PROBING)
        pressed(page._start_over)
        assert page.journey.n_taken(StepName.PROBING) == 2
        pressed(page._start_over)
        assert page.journey.n_taken(StepName.PROBING) == 0
        assert page._start_over.label == "Start over"


def test_a_refused_press_hides_nothing_of_what_runs(tmp_path: Path) -> None:
    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        page.choose(StepName.CAMERA)
        with page._busy("Camera: calculating ..."), page.worker._lock:
            assert page._take.disabled
            page.controls.tried(page.take_one)
            page.controls.tried(page.calculate)
            assert "other work is under way" in text_of(page)
            assert page._cancel.visible and "Camera: calculating" in page._working.content
            assert page.journey.n_taken(StepName.CAMERA) == 0
        assert not page._cancel.visible and not page._working.visible and not page._take.disabled


def test_a_press_while_one_is_taken_takes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    begun, may_end, touch = threading.Event(), threading.Event(), bench.touch

    def touch_slowly(folder: Path, k: int) -> None:
        begun.set()
        assert may_end.wait(30.0)
        touch(folder, k)

    monkeypatch.setattr(bench, "touch", touch_slowly)
    with opened(tmp_path / "s", bench) as page:
        (tmp_path / "s" / PROBE_FILE).write_bytes(probe_tip_toml(ProbeTip(np.zeros(3), 6.0)))
        page.choose(StepName.PROBING)
        first = threading.Thread(target=pressed, args=(page._take,))
        first.start()
        assert begun.wait(30.0) and page._take.disabled and page._take_back.disabled
        for button in (page._take, page._take, page._take_back):
            pressed(button)
        may_end.set()
        first.join()
        assert page.journey.n_taken(StepName.PROBING) == 1
        assert not page._take.disabled


def test_a_camera_that_is_gone_is_named_and_not_shown_while_it_is_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    with opened(tmp_path / "s", bench) as page:
        page.choose(StepName.CAMERA)
        page.view()
        waited(lambda: page.scanning._window.visible)
        bench.cameras[0].is_gone = True
        waited(lambda: "it was unplugged" in text_of(page))
        waited(lambda: not page.scanning._window.visible)
        bench.cameras[0].is_gone = False
        waited(lambda: page.scanning._window.visible and "unplugged" not in text_of(page))
        # and what is old is not shown, whatever its device says
        monkeypatch.setattr("armscan.console.rig.SHOWN_NS", 0)
        assert bench.look(StepName.CAMERA, 0) == ()


def test_a_look_that_lasts_until_the_view_was_ended_lights_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    bench, done = FailingBench(), list[str]()
    with opened(tmp_path / "s", bench) as page:
        page.choose(StepName.CAMERA)
        page.scanning._closing.set()
        page.scanning._thread.join()
        monkeypatch.setattr(bench, "rest", lambda: done.append("rest"))

        def look(*_: object) -> tuple[str, ...]:
            page.view()
            done.append("lit")
            return ("image",)

        monkeypatch.setattr(bench, "look", look)
        page.view()
        assert page._look() == () and done == ["rest", "lit", "rest"]


def test_what_was_taken_stays_where_a_new_take_does_not_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(arm: FailingArm) -> None:
        raise DeviceError("it does not answer", where=arm.name)

    put_scanner(tmp_path / "s")
    with opened(tmp_path / "s", FailingBench()) as page:
        page.choose(StepName.CHECK)
        page.controls.tried(page.start_or_pause)
        waited(lambda: page.live is not None and page.live.n_recorded > 2)
        page.scanning.end()
        place = page.journey.recording(StepName.CHECK)
        before = place.read_bytes()
        monkeypatch.setattr(FailingArm, "start", silent)
        page.controls.tried(page.start_or_pause)
        assert "does not answer" in text_of(page) and page.live is None
        assert place.read_bytes() == before


def test_what_was_taken_stays_until_an_image_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_scanner(tmp_path / "s")
    bench = FailingBench()
    with opened(tmp_path / "s", bench) as page:
        page.choose(StepName.CHECK)
        monkeypatch.setattr(page, "_run", lambda *_: None)
        place = page.journey.recording(StepName.CHECK)
        page.controls.tried(page.start_or_pause)
        waited(lambda: page.live is not None and page.live.n_recorded > 0)
        page.controls.tried(page.finish)
        before = place.read_bytes()
        bench.cameras[0].is_gone = True
        page.controls.tried(page.start_or_pause)
        assert place.read_bytes() != before
        page.controls.tried(page.finish)
        assert "no image came" in text_of(page)
        assert place.read_bytes() == before
        bench.cameras[0].is_gone = False
        page.controls.tried(page.start_or_pause)
        waited(lambda: page.live.n_recorded > 0)
        page.controls.tried(page.finish)
        after = place.read_bytes()
        assert read_recording(place).rows and after != before
        assert [one.name for one in place.parent.iterdir()] == ["check.mcap"]
        # of a console that was killed before its first image
        aside = place.rename(place.with_name(".check.mcap.before"))
        place.write_bytes(b"cut")
        recover_scans(page.journey.folder)
        assert not aside.exists() and place.read_bytes() == after
