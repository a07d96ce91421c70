# SPDX-License-Identifier: Apache-2.0
"""The page of the console: one column that leads through the steps, beside the space with points.

Everything that it does is a call that a script can make: `Journey`, `Bench`, `LiveScan` and
`run_step`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import viser

from armscan.console.cards import GOOD, WRONG, overview, padded, result_card
from armscan.console.journey import (
    BY_NAME,
    INSPECTIONS,
    OF_A_SCAN,
    OF_TWO_CAMERAS,
    REPORT_FILE,
    Journey,
    SeeingSettings,
    StepName,
    StepState,
    held_session,
    open_journey,
    sessions_in,
)
from armscan.console.panels import (
    Controls,
    PointsPanel,
    ScanPanel,
    SeeingPanel,
    TipPanel,
    put,
)
from armscan.console.placements import Placement, drawing
from armscan.console.quality import ModelWatch
from armscan.console.rig import open_bench, take_back
from armscan.console.scan import Bench, LiveScan
from armscan.console.scene import SceneView, ShownPoints, depths_mm, paragraph, shown_points
from armscan.console.server import LOOPBACK, PAGES, close_server, open_server
from armscan.console.work import Worker, recover_scans, run_step, seen_in_take
from armscan.errors import ArmscanError, OutputError
from armscan.pipeline.progress import ProgressEvent
from armscan.records.exposure import Exposure
from armscan.report.drawing import ACCENT, ALERT, INK, MUTED
from armscan.report.quantity import sentence
from armscan.storage.arm import PROBE_FILE
from armscan.storage.clouds import read_cloud
from armscan.storage.documents import read_scanner_calibration, read_sensor_calibration
from armscan.storage.files import read_bytes
from armscan.storage.formats.ply import parse_ply


class ConsolePage:
    """The page of one session.

    Parameters
    ----------
    folder
        The session, made if need be.
    bench
        What fills it; None to look at what is there.
    """

    def __init__(self, server: viser.ViserServer, folder: Path, bench: Bench | None) -> None:
        self.server, self.bench = server, bench
        self.worker = Worker()
        self.controls = Controls(server, self.refresh)
        self.points = PointsPanel(SceneView(server))
        self.scanning = ScanPanel(self.controls, self.points, self.finish, self._look)
        self.seeing = SeeingPanel(self.controls, self._see)
        self.tip = TipPanel(self.controls, lambda: self.journey.folder / PROBE_FILE)
        self._seen: tuple[bool, str] | None = None
        self._said: tuple[str, ...] = ()
        self._is_listing = False
        # real lasers are on only when somebody asked for it
        self._is_viewing = bench is not None and bench.has_operator
        self._held = ExitStack()
        self._lock, self._showing = threading.RLock(), threading.RLock()
        self._is_cancelled = self._is_turning = False
        self._under_way: list[tuple[str, bool]] = []
        self.journey = self._opened(folder)
        self.step = self.journey.next_step()
        self.scan = self.journey.scans[-1] if self.journey.scans else ""
        self._build()
        self.refresh()
        self._show_stored()
        threading.Thread(target=self._prepare, daemon=True).start()

    def _prepare(self) -> None:
        """Start the worker's process, and save what a killed console left behind."""
        self.worker.prepare()
        if self.journey.cut_short:
            self.controls.tried(lambda: self.controls.alone(self._recover, waits=True))

    def _recover(self) -> None:
        """Save what was cut short; a scan that runs meanwhile looks like that, too."""
        if self.live is not None or not self.journey.cut_short:
            return
        with self._busy("Saving a recording that was cut short ..."):
            self._said = self.worker.run(recover_scans, self.journey.folder)
        if not self.scan and self.journey.scans:
            self.scan = self.journey.scans[-1]

    def close(self) -> None:
        """End a scan and the work under way, and let others open the session."""
        self.cancel()
        self.scanning.close()
        self.worker.close()
        self._held.close()

    @property
    def live(self) -> LiveScan | None:
        """The scan that runs."""
        return self.scanning.live

    def _opened(self, folder: Path) -> Journey:
        held = ExitStack()
        held.enter_context(held_session(folder))
        try:
            settings = None if self.bench is None else self.bench.settings
            journey = open_journey(folder, settings)
            if self.bench is not None:
                self.bench.see(journey.settings.seeing)
        except BaseException:
            held.close()
            raise
        self._held.close()
        self._held = held
        return journey

    # the column, from top to bottom

    def _build(self) -> None:
        gui = self.server.gui
        gui.configure_theme(
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(11, 110, 135),
        )
        gui.main_panel.dock_right()
        gui.set_panel_label("armscan")
        self._head = gui.add_html("")
        titles = [step.title for step in self.journey.steps]
        self._choice = gui.add_dropdown("Step", titles, initial_value=BY_NAME[self.step].title)
        self._choice.on_update(lambda _: self._choose_title(self._choice.value))
        self._guide = gui.add_html("")
        self._settings()
        self.tip.build()
        self._view = self.controls.button(
            "Camera view", self.view, "V", "Show what the camera sees, lasers on where needed"
        )
        button = self.controls.button
        self._take = button(
            "Take", self.take_one, "T", "Record this placement", "teal", is_alone=True
        )
        self._take_all = button(
            "Take all that is left (simulated)", self.take_all, "", "The twin shows them all",
            is_alone=True,
        )  # fmt: skip
        self._take_back = button(
            "Take back", self.take_back, "B", "Remove what was taken last", is_alone=True
        )
        self._start_over = self.controls.removing_button(
            "Start over", self.start_over, "Remove what was taken", self._what_goes
        )
        self.scanning.build(self.start_or_pause)
        self._inspecting()
        self.scanning.build_pictures()
        self._calculate = button("Calculate", self.calculate, "K", "Run this step's job", "teal")
        self._working = gui.add_html("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._cancel = button("Cancel", self.cancel, "", "End what runs", "red")
        self._cancel.visible = False
        self._next = button("Go on", self.go_on, "N", "To the next step", "teal")
        self._note = gui.add_html("")
        self.seeing.build(has_exposure=self.bench is not None and not self.bench.has_operator)
        self.points.build(gui)
        with gui.add_folder("Sessions", expand_by_default=False):
            self._session_list = gui.add_dropdown("Session", (self._name(),))
            button("Open", self._open_chosen, "", "Close this one, open that", is_alone=True)

    def _settings(self) -> None:
        gui = self.server.gui
        self._target = gui.add_text("Target", self.journey.settings.target)
        self._target.on_update(lambda _: self._set(target=self._target.value.strip()))
        self._ball = gui.add_number("Ball, mm", self.journey.settings.ball_mm, step=0.0001)
        self._ball.on_update(lambda _: self._set(ball_mm=float(self._ball.value)))

    def _inspecting(self) -> None:
        gui = self.server.gui
        self._scan_choice = gui.add_dropdown("Scan", ("none",))
        self._scan_choice.on_update(lambda _: self._choose_scan(self._scan_choice.value))
        first = INSPECTIONS[0 if self.journey.settings.part else 1]
        self._compare = gui.add_dropdown("Compare with", INSPECTIONS, initial_value=first)
        self._compare.on_update(lambda _: self.refresh())
        self._part = gui.add_text("Model (STL, STEP)", self.journey.settings.part)
        self._part.on_update(lambda _: self._set(part=self._part.value.strip()))
        self._tolerance = gui.add_text("Tolerance, mm", self.journey.settings.tolerance)
        self._tolerance.on_update(lambda _: self._set(tolerance=self._tolerance.value.strip()))

    def _set(self, **settings: Any) -> None:
        now = self.journey.settings
        if any(getattr(now, key) != value for key, value in settings.items()):
            self.controls.tried(lambda: self.journey.change(**settings))

    def _see(self, seeing: SeeingSettings | None) -> None:
        """Have cameras and lines looked at so in this session."""
        with self._lock:
            self._bench().see(seeing)
            self.journey.change(seeing=seeing)

    def _name(self) -> str:
        return self.journey.folder.resolve().name

    # what the operator does

    def choose(self, step: StepName) -> None:
        """Show a step; not while a scan of the one that is shown begins, runs or ends."""
        with self._showing:
            if self.live is not None or self._is_turning:
                self.controls.problem = "Finish the scan first, and wait for its end."
                self.refresh()
                return
            self.step, self._seen, self._said = step, None, ()
        self.controls.forget_question()
        self._rest()
        self.refresh()
        self._show_stored()

    def _choose_title(self, title: str) -> None:
        chosen = next((one.name for one in self.journey.steps if one.title == title), self.step)
        if chosen is not self.step:
            self.controls.problem = ""
            self.choose(chosen)

    def _choose_scan(self, scan: str) -> None:
        if not self._is_listing and scan in self.journey.scans and scan != self.scan:
            self.scan = scan
            self.refresh()
            self._show_stored()

    def go_on(self) -> None:
        """Show the step that comes next."""
        order = [one.name for one in self.journey.steps]
        place = order.index(self.step)
        self.choose(order[min(place + 1, len(order) - 1)])

    def view(self) -> None:
        """Show what the camera sees, or no more."""
        self._is_viewing = not self._is_viewing
        if not self._is_viewing:
            self._rest()

    def _rest(self) -> None:
        self._is_viewing = self.bench is not None and self.bench.has_operator
        self.scanning.show_images(())
        if self.bench is not None:
            self.bench.rest()

    def cancel(self) -> None:
        """End the calculation, or taking all that is left."""
        self._is_cancelled = True
        self.worker.cancel()

    def _what_goes(self) -> str:
        n, step = self.journey.n_taken(self.step), BY_NAME[self.step]
        kind = "touch" if step.filling == "touches" else "placement"
        return f"Remove {n} {kind}{'' if n == 1 else 'es' if kind == 'touch' else 's'}? Press again"

    def take(self, step: StepName | None = None) -> None:
        """Record the placement or touch that is drawn, of the step that is shown or another."""
        step = step or self.step
        if self.worker.is_busy and BY_NAME[step].filling == "placements":
            raise ArmscanError("other work is under way", remedy="wait for it or cancel it")
        with self._lock:
            bench = self._bench()
            k, place = self.journey.n_taken(step), self.journey.recording(step)
            if BY_NAME[step].filling == "touches":
                bench.touch(place, k)
                return
            self.scanning.show_images(bench.take(step, place, k))

    def take_one(self) -> None:
        """Record the placement or touch that is drawn, and say what is seen in it."""
        step = self.step
        with self._busy("Taking ...", can_end=False):
            self.take(step)
            if BY_NAME[step].filling == "placements":
                n_taken = self.journey.n_taken(step)
                seen = self.worker.run(seen_in_take, self.journey.folder, step)
                # of something else, if the person has gone on meanwhile
                if self.step is step and self.journey.n_taken(step) == n_taken:
                    self._seen = seen

    def take_all(self) -> None:
        """Record all that is left, as the twin shows it."""
        self._seen, self._is_cancelled, step, n_wanted = None, False, self.step, self._n_wanted()
        with self._busy("Taking all that is left ..."):
            while self.journey.n_taken(step) < n_wanted and not self._is_cancelled:
                put(self._bar, 100.0 * self.journey.n_taken(step) / n_wanted)
                self.take(step)
                self.refresh()

    def take_back(self) -> None:
        """Remove the placement or touch that was taken last."""
        self._seen, step = None, self.step
        with self._lock:
            take_back(step, self.journey.recording(step))

    def start_over(self) -> None:
        """Remove what this step has taken."""
        self._seen, step = None, self.step
        with self._lock:
            self.scanning.show_images(())
            self.journey.start_over(step, self._scan_of(step))

    def start_or_pause(self) -> None:
        """Begin a scan, pause it, or go on."""
        live = self.live  # what waited for the end of this one does not begin another
        with self._lock:
            if live is None:
                self._begin()
            elif live.snapshot.state == "scanning":
                live.pause()
            else:
                live.start()

    @contextmanager
    def _turning(self, words: str, *, can_end: bool = False) -> Iterator[None]:
        """A scan begins or ends: step and session stay meanwhile."""
        with self._showing:
            self._is_turning = True
        try:
            with self._busy(words, can_end=can_end):
                yield
        finally:
            self._is_turning = False

    def _begin(self) -> None:
        with self._turning("Starting the devices ..."):
            step, journey, model = self.step, self.journey, None
            part, seeing = journey.settings.part, journey.settings.seeing
            scanner = read_scanner_calibration(journey.scanner_file)
            scan = journey.new_scan() if step is StepName.SCAN else ""
            if step is StepName.SCAN and part:
                model = ModelWatch(self.worker, journey.folder / part)
            place = journey.new_file(step, scan)
            if place in journey.cut_short:
                raise ArmscanError(
                    f"{place.stem} was cut short and is not saved yet",
                    remedy="open the session again to save it, or start over",
                )
            live = LiveScan(self._bench(), step, place, scanner, seeing)
            live.open()
            self.scanning.begin(live, scanner, model)
            self.scan = scan or self.scan

    def finish(self) -> None:
        """End the scan, and run its job; then save what was cut short before, which had to wait."""
        n, of = list[int](), (self.journey.folder, self.step, self._scan_of(self.step))
        self.controls.alone(lambda: n.append(self._end()))
        self.refresh()
        if any(n):
            self._run(*of)
        self.controls.alone(self._recover)

    def _end(self) -> int:
        """End the scan; how many exposures it recorded."""
        with self._turning("Ending the scan ...", can_end=True), self._lock:
            try:
                return self.scanning.end()
            except OutputError as error:
                self._recover()
                raise OutputError(
                    error.what, remedy="free some space, and scan the rest anew"
                ) from error

    def calculate(self) -> None:
        """Run this step's job in its process, and show what it says."""
        self._run(self.journey.folder, self.step, self._scan_of(self.step))

    def _run(self, folder: Path, step: StepName, scan: str) -> None:
        with self._busy(f"{BY_NAME[step].title}: calculating ..."):
            self.worker.run(run_step, folder, step, scan, self._compare.value, progress=self._tell)
        self.refresh()
        self._show_stored()

    def _tell(self, event: ProgressEvent) -> None:
        put(self._bar, 100.0 * event.done / max(event.total, 1))
        words = f"{event.stage.capitalize()}: {event.done} of {event.total}"
        self._working.content = padded(paragraph(words, MUTED))

    @contextmanager
    def _busy(self, words: str, *, can_end: bool = True) -> Iterator[None]:
        """Say what is under way; what was before it, and still is, is said again afterwards."""
        work = words, can_end
        with self._showing:
            if not self._under_way:
                put(self._bar, 0.0)
            self._under_way.append(work)
            self._show_work()
        try:
            yield
        finally:
            with self._showing:
                self._under_way.remove(work)
                self._show_work()

    def _show_work(self) -> None:
        works = tuple(self._under_way)
        self._working.content = padded(paragraph(works[-1][0] if works else "", MUTED))
        self._working.visible = self._calculate.disabled = bool(works)
        is_worked_for = BY_NAME[self.step].filling == "placements"
        self._take.disabled = self.controls.is_busy or bool(works and is_worked_for)
        self._bar.visible = self._cancel.visible = any(can_end for _, can_end in works)

    def _open_chosen(self) -> None:
        chosen = self._session_list.value
        if self.live is not None or self.worker.is_busy:
            self.controls.problem = "Finish the scan or the calculation first."
            return
        if chosen != self._name():
            self.journey = self._opened(self.journey.folder.resolve().parent / chosen)
            self.scan = self.journey.scans[-1] if self.journey.scans else ""
            titles = tuple(step.title for step in self.journey.steps)
            if self._choice.options != titles:
                self._choice.options = titles
            self.seeing.renew()
            self.choose(self.journey.next_step())
            self._recover()

    # what is shown

    def _bench(self) -> Bench:
        if self.bench is None:
            raise ArmscanError(
                "no rig is connected", remedy="open the console with --rig to take and scan"
            )
        return self.bench

    def _look(self) -> tuple[Exposure, ...]:
        """What the cameras see while something is put before them to be taken."""
        step = BY_NAME[self.step]
        if self.bench is None or not self._is_viewing or step.filling != "placements":
            return ()
        if self.worker.is_busy or not self._take.visible or not self._lock.acquire(blocking=False):
            return ()
        try:
            seen = self.bench.look(step.name, self.journey.n_taken(step.name))
            return seen if self._is_viewing else ()
        finally:
            if not self._is_viewing:
                # it was ended meanwhile: what looked has lit the lasers anew
                self.bench.rest()
            self._lock.release()

    def _scan_of(self, step: StepName) -> str:
        return self.scan if step in OF_A_SCAN else ""

    def _n_wanted(self) -> int:
        wanted = {} if self.bench is None else self.bench.n_placements
        return wanted.get(self.step, len(BY_NAME[self.step].placements))

    def refresh(self) -> None:
        """Show what lies on disk now."""
        # one after the other: a state that was read earlier must not be shown later
        with self._showing, self.server.atomic():
            step = BY_NAME[self.step]
            state = self.journey.state(self.step, self._scan_of(self.step))
            self._head.content = padded(self._overview())
            if self._choice.value != step.title:
                put(self._choice, step.title)
            self._guide.content = padded(self._instruction(state))
            self._arrange(state)
            self._show_work()
            self._note.content = padded(self._told(state))
            known = tuple(one.name for one in sessions_in(self.journey.folder.resolve().parent))
            self._session_list.options = known or (self._name(),)

    def _arrange(self, state: StepState) -> None:
        """Which controls this step has."""
        step, is_live = BY_NAME[self.step], self.live is not None
        is_taken = step.filling in ("placements", "touches")
        has_rig, is_motion = self.bench is not None, step.filling == "motion"
        is_blocked = state.status == "waiting"
        is_twin = self.bench is not None and self.bench.has_operator
        # a person may take more than the list asks for
        is_full = is_taken and state.n_taken >= self._n_wanted()
        self._take.visible = is_taken and has_rig and not is_blocked and not (is_full and is_twin)
        self._take.color = "gray" if is_full else "teal"
        is_view = self._take.visible and step.filling == "placements" and not is_twin
        self._view.visible = is_view
        self._view.label = "End the camera view (V)" if self._is_viewing else "Camera view (V)"
        self._take_all.visible = self._take.visible and is_twin
        self._take_back.visible = is_taken and state.n_taken > 0 and has_rig
        self._start_over.visible = is_taken and state.n_taken > 0
        self.scanning.arrange(
            is_motion=is_motion,
            can_start=is_motion and has_rig and not is_blocked,
            is_again=self.step is StepName.SCAN and bool(self.journey.scans),
        )
        is_inspection = self.step is StepName.INSPECT
        self._compare.visible = is_inspection
        is_cad = is_inspection and self._compare.value == INSPECTIONS[0]
        self._part.visible = self._tolerance.visible = is_cad
        self._scan_choice.visible = self.step in OF_A_SCAN and bool(self.journey.scans)
        self._scan_choice.visible = self._scan_choice.visible and not is_live
        self._list_scans()
        now = self.journey.settings
        self.seeing.show(self._seeing(), is_visible=has_rig and not is_live and not is_inspection)
        known: tuple[tuple[Any, object], ...] = (
            (self._target, now.target),
            (self._ball, now.ball_mm),
            (self._part, now.part),
            (self._tolerance, now.tolerance),
        )
        for field, value in known:
            typed = field.value.strip() if isinstance(field.value, str) else field.value
            if typed != value:
                put(field, value)
        self._target.visible = self.step in (StepName.CAMERA, StepName.LASER)
        self.tip.show(is_visible=self._needs_tip())
        uses_ball = is_inspection and self._compare.value == "ball"
        self._ball.visible = (self.step is StepName.CHECK or uses_ball) and not is_live
        can_run = not is_blocked and (is_inspection or state.n_taken >= step.least)
        self._calculate.visible = can_run and not is_live
        verb = "Inspect" if is_inspection else "Calculate"
        self._calculate.label = f"{verb} again (K)" if state.result else f"{verb} (K)"
        is_settled = state.status in ("good", "doubtful")
        self._calculate.color = "gray" if is_settled else "teal"
        self._next.visible = is_settled and not is_live and self.step is not StepName.INSPECT

    def _seeing(self) -> SeeingSettings:
        """How lines are looked at now."""
        kept = self.journey.settings.seeing
        if kept is None:
            return SeeingSettings() if self.bench is None else self.bench.seeing
        return kept

    def _list_scans(self) -> None:
        """Show the scans; the library chooses the first of new options by itself."""
        scans, chosen = self.journey.scans, self.scan
        if scans and self._scan_choice.options != scans:
            self._is_listing = True
            self._scan_choice.options = scans
            self._is_listing = False
        if chosen in scans and self._scan_choice.value != chosen:
            put(self._scan_choice, chosen)

    def _overview(self) -> str:
        states = {
            step.title: (self.journey.state(step.name, self._scan_of(step.name)).status,
                         step.name is self.step)
            for step in self.journey.steps
        }  # fmt: skip
        rig = "no rig: looking only"
        if self.bench is not None:
            what = "Simulated rig: " if self.bench.is_simulated else "Rig: "
            rig = what + self.journey.settings.rig
        return overview(self._name(), rig, states, self._link(REPORT_FILE, "Report of the session"))

    def _link(self, page: str, words: str) -> str:
        if not page or not (self.journey.folder / page).is_file():
            return ""
        return (
            f'<a href="{PAGES}{quote(page)}" target="_blank" rel="noopener" '
            f'style="color:{ACCENT}">{escape(words)}</a>'
        )

    def _instruction(self, state: StepState) -> str:
        step = BY_NAME[self.step]
        body = paragraph(step.to_do)
        if self.journey.settings.n_cameras > 1:
            body += paragraph(OF_TWO_CAMERAS.get(self.step, ""))
        if self.step is StepName.HAND_EYE:
            with suppress(ArmscanError):
                sensor = read_sensor_calibration(self.journey.folder / "sensor.json")
                low, high = depths_mm(sensor)
                body += paragraph(f"Near and far stay within {low:.0f} to {high:.0f} mm.")
        if state.why and state.result is None:
            body += paragraph(sentence(state.why), ALERT)
        if state.status == "waiting":
            return body
        if step.filling not in ("placements", "touches"):
            return body
        body += paragraph(self._lacking(), ALERT)
        if self._seen is not None:
            body += paragraph(self._seen[1], GOOD if self._seen[0] else WRONG)
        wanted = self._n_wanted()
        n, kind = state.n_taken, "Touch" if step.filling == "touches" else "Placement"
        is_twin = self.bench is not None and self.bench.has_operator
        if n >= wanted:
            more = "" if is_twin else " More may be taken, each unlike those before."
            now = "" if state.status in ("good", "doubtful") else ": calculate"
            return body + paragraph(f"All {wanted} are taken{now}.{more}", GOOD)
        shown = self._placement(n)
        enough = f" At least {step.least} are needed." if n < step.least else ""
        own = "The simulated operator follows a list of its own." if is_twin else ""
        return (
            body + f'<p style="margin:6px 0 2px;font-size:14px;color:{INK}"><b>{kind} {n + 1} of '
            f"{wanted}:</b> {escape(shown.words)}.{enough}</p>"
            + drawing(shown)
            + paragraph(own, MUTED, 12)
        )

    def _lacking(self) -> str:
        """What the operator has to tell before this step makes sense; empty for nothing."""
        needs_target = self.step in (StepName.CAMERA, StepName.LASER)
        if needs_target and not self.journey.settings.target:
            return (
                "Write into 'Target' which one you hold, for example chessboard:9x6:10 for 9 by 6 "
                "inner corners 10 mm apart."
            )
        return self.tip.lacking if self._needs_tip() else ""

    def _needs_tip(self) -> bool:
        is_person = self.bench is not None and not self.bench.has_operator
        return self.step is StepName.PROBING and is_person

    def _placement(self, k: int) -> Placement:
        known = BY_NAME[self.step].placements
        return known[k % len(known)]

    def _told(self, state: StepState) -> str:
        problem = "".join(paragraph(text, INK) for text in self._said)
        problem += paragraph(self.controls.problem, WRONG) if self.controls.problem else ""
        if state.result is None or self.live is not None:
            return problem
        return problem + result_card(state, self._link(state.result.page, "All about it"))

    def _show_stored(self) -> None:
        """The points that belong to this step."""
        shown = None
        if self.step in OF_A_SCAN and self.scan:
            try:
                shown = self._stored_points()
            except ArmscanError as error:
                self.controls.problem = str(error)
        self.points.show(shown)

    def _stored_points(self) -> ShownPoints | None:
        compared = self.journey.folder / f"{self.scan}-cad.ply"
        if self.step is StepName.INSPECT and compared.is_file():
            table = parse_ply(read_bytes(compared), str(compared)).table
            points = np.column_stack([table[name] for name in "xyz"]).astype(np.float64)
            deviation = np.asarray(table["deviation_mm"], dtype=np.float64)
            limit = float(np.quantile(np.abs(deviation), 0.95)) if len(deviation) else 0.1
            sheet = np.asarray(table["sheet"], dtype=np.int64)
            return ShownPoints(
                points, sheet, np.zeros(len(points)), None, deviation, float(f"{limit:.1g}")
            )
        path = self.journey.cloud_file(self.scan)
        return shown_points(read_cloud(path)) if path.is_file() else None


def run_console(
    folder: Path,
    rig: str = "",
    *,
    host: str = LOOPBACK,
    port: int | None = None,
    tell: Callable[[str], object] = print,
) -> None:
    """Open a session's page and serve it until an interrupt; ``tell`` is told its address."""
    with open_console(folder, rig, host=host, port=port) as (page, address):
        tell(f"{page.journey.folder}: open {address} in a browser; Ctrl-C ends the console")
        with suppress(KeyboardInterrupt):
            threading.Event().wait()


@contextmanager
def open_console(
    folder: Path, rig: str = "", *, host: str = LOOPBACK, port: int | None = None
) -> Iterator[tuple[ConsolePage, str]]:
    """A session's page and its address, closed at the end; parameters as of `run_console`."""
    with ExitStack() as opened:
        # before devices are opened and a port is taken: two consoles do not fight for them
        with held_session(folder):
            bench = open_bench(rig) if rig else None
        if bench is not None:
            opened.callback(bench.close)
        pages: list[ConsolePage] = []
        server, address = open_server(
            lambda: pages[0].journey.folder if pages else folder, host, port
        )
        opened.callback(close_server, server)
        pages.append(ConsolePage(server, folder, bench))
        opened.callback(pages[0].close)
        yield pages[0], address
