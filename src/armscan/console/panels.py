# SPDX-License-Identifier: Apache-2.0
"""Parts of the console's column that know no session: buttons with their keys, the points that are
shown, how lines are seen, a scan while it runs, and the card of a step's result.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import viser

from armscan.calibration.cameras.pairs import SIDES
from armscan.console.cards import live_facts, padded
from armscan.console.journey import SeeingSettings
from armscan.console.quality import ModelWatch
from armscan.console.scan import LiveScan
from armscan.console.scene import (
    COLOURED_BY,
    MOST_POINTS,
    SceneView,
    ShownPoints,
    depths_mm,
    live_image,
    paragraph,
    range_bar,
    taken_image,
)
from armscan.console.work import told
from armscan.errors import ArmscanError, OptionError
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.live.exposure import ExposureMode, ExposureSettings, LaserTarget
from armscan.records.exposure import Exposure
from armscan.report.drawing import MUTED
from armscan.report.quantity import sentence
from armscan.storage.arm import ProbeTip, probe_tip_toml, read_probe_tip
from armscan.storage.files import write_files

REFRESH_S, CLOUD_EVERY_S = 0.3, 1.0
DETAILS = {"up to 100,000": 100_000, "up to 500,000": 500_000, "up to 2 million": MOST_POINTS}
DETAIL = "up to 500,000"
"""Shown at first: a computer without graphics processor draws two million points once a second."""
WINDOW_PX, WINDOW_Y_PX = 420.0, 150.0
"""Width, and below what the library says of a computer without graphics processor."""
MODES: dict[str, ExposureMode] = {
    "as set": "fixed",
    "automatic": "automatic",
    "automatic, glints": "reflective",
}
START_BUTTON, UNDO_BUTTON = "0", "1"
"""Buttons of the arm: start or pause, and take the last pass back."""


class Controls:
    """Buttons of a page, and what went wrong with the last one.

    ``refresh`` shows what became of a press.
    """

    def __init__(self, server: viser.ViserServer, refresh: Callable[[], None]) -> None:
        self.gui = server.gui
        self.refresh = refresh
        self.problem = ""
        self._hand = threading.Lock()
        self._kept_out: list[viser.GuiButtonHandle] = []
        self._asked: tuple[viser.GuiButtonHandle, str] | None = None

    def button(
        self,
        label: str,
        work: Callable[[], object],
        key: str,
        hint: str,
        colour: Literal["teal", "gray", "red"] = "gray",
        *,
        is_alone: bool = False,
    ) -> viser.GuiButtonHandle:
        """A button, and a key for it, that tell a failure as its sentence.

        Of those that are alone, as all that fill or empty a recording, one works at a time, and a
        press meanwhile is passed over: one that waited would record the same posture twice.
        """
        if is_alone:
            return self.kept_out(self.button(label, lambda: self.alone(work), key, hint, colour))
        named = f"{label} ({key})" if key else label
        button = self.gui.add_button(named, hint=hint, color=colour)
        button.on_click(lambda _: self.tried(work))
        if key:
            command = self.gui.add_command(label, hotkey=cast(Any, key), description=hint)
            command.on_trigger(
                lambda _: self.tried(work) if button.visible and not button.disabled else None
            )
        return button

    def removing_button(
        self, label: str, work: Callable[[], object], hint: str, question: Callable[[], str]
    ) -> viser.GuiButtonHandle:
        """One that is alone, asks what it would remove, and does so when pressed again."""

        def ask_first() -> None:
            if self._asked is None:
                self._asked = button, label
                button.label, button.color = question(), "red"
            else:
                self.forget_question()
                self.alone(work)

        button = self.gui.add_button(label, hint=hint, color="gray")
        button.on_click(lambda _: self.tried(ask_first, is_answer=True))
        return self.kept_out(button)

    def kept_out(self, button: viser.GuiButtonHandle) -> viser.GuiButtonHandle:
        """Disable this one while something that is alone is being done."""
        self._kept_out.append(button)
        return button

    def forget_question(self) -> None:
        """Take a question back that was not answered."""
        if self._asked is not None:
            (button, label), self._asked = self._asked, None
            button.label, button.color = label, "gray"

    def alone(self, work: Callable[[], object], *, waits: bool = False) -> None:
        """Do this unless something else that is alone is being done, or when that has ended."""
        if not self._hand.acquire(blocking=waits):
            return
        try:
            for button in self._kept_out:
                button.disabled = True
            work()
        finally:
            for button in self._kept_out:
                button.disabled = False
            self._hand.release()

    @property
    def is_busy(self) -> bool:
        """Whether something is being done that is alone."""
        return self._hand.locked()

    def tried(self, work: Callable[[], object], *, is_answer: bool = False) -> None:
        """Do what a button asks for; `is_answer` if it may be the answer to a question."""
        try:
            self.problem = ""
            if not is_answer:
                self.forget_question()
            work()
        except Exception as error:  # every failure ends as a sentence on the page
            self.problem = told(error)
        self.refresh()


class PointsPanel:
    """Which points stand in space, how many of them, and what their colours mean."""

    def __init__(self, view: SceneView) -> None:
        self.view = view
        self._shown: ShownPoints | None = None

    def build(self, gui: viser.GuiApi) -> None:
        """Add it to the column."""
        with gui.add_folder("What is shown"):
            self._colour = gui.add_dropdown("Colour by", COLOURED_BY)
            self._colour.on_update(lambda _: self._redraw())
            self._detail = gui.add_dropdown("Points", tuple(DETAILS), initial_value=DETAIL)
            self._detail.on_update(lambda _: self._redraw())
            self._legend = gui.add_html("")

    @property
    def colour(self) -> str:
        """By what the points are coloured."""
        return str(self._colour.value)

    def show(self, shown: ShownPoints | None, *, is_new: bool = True) -> None:
        """Show points in place of those before; new ones turn the view to themselves."""
        if is_new:
            self.view.forget_view()
        self._shown = shown
        if is_new and shown is not None and shown.deviation_mm is not None:
            put(self._colour, "deviation")
        if shown is None:
            self.view.clear()
            self._legend.content = padded(paragraph("no points yet", MUTED, 12))
        self._redraw()

    def _redraw(self) -> None:
        if self._shown is not None:
            text = self.view.show(self._shown, self._colour.value, DETAILS[self._detail.value])
            self._legend.content = padded(paragraph(text, MUTED, 12))


class SeeingPanel:
    """How the cameras see the laser's line, and what counts as one.

    ``keep`` is told of new settings; of None for what the rig's description says.
    """

    def __init__(self, controls: Controls, keep: Callable[[SeeingSettings | None], object]) -> None:
        self._controls, self._keep = controls, keep
        self._shown: SeeingSettings | None = None
        self._before = SeeingSettings()

    def build(self, *, has_exposure: bool) -> None:
        """Add it to the column; a rendered camera has no exposure to set."""
        gui = self._controls.gui
        self._folder = gui.add_folder("Exposure, window, thresholds", expand_by_default=False)
        with self._folder:
            self._mode = gui.add_dropdown(
                "Exposure", tuple(MODES), visible=has_exposure,
                hint="Automatic brings the line to the grey value below, for parts with glints "
                "its brightest twentieth",
            )  # fmt: skip
            self._target = gui.add_number("Line's grey value, %", 70.0, min=5.0, max=95.0)
            self._lasers = gui.add_text("Of single lasers, %", "", hint="For example A 50, B 80")
            self._time = gui.add_number("Exposure, us", 0.0, min=0.0, hint="0: the camera's own")
            self._least = gui.add_number("At least, us", 20.0, min=0.1)
            self._most = gui.add_number("At most, us", 5000.0, min=0.1)
            self._gain = gui.add_text("Gain, dB", "", hint="Empty: the camera's own")
            self._photo = gui.add_number(
                "Photographs, us", 0.0, min=0.0, hint="Of the target; 0: the camera's own"
            )
            self._windows = gui.add_text(
                "Window, px", "", hint="x, y, width, height; of two cameras with ; between"
            )
            of_camera = (
                *(self._target, self._lasers, self._time, self._least, self._most),
                *(self._gain, self._photo, self._windows),
            )
            for field in of_camera:
                field.visible = has_exposure
            self._height = gui.add_number(
                "Line's height", 0.0, min=0.0, hint="Grey levels; 0: from the noise of the image"
            )
            self._width = gui.add_number(
                "Line's width, px", 0.0, min=0.0, hint="Sigma of its cross-section; 0: found"
            )
            self._smoothing = gui.add_number("Smoothing, px", 12.0, min=0.0)
            self._voxel = gui.add_number("A point each, mm", 0.5, min=0.001, hint="Shown, live")
            self._every = gui.add_number("Measure every", 1, min=1, step=1, hint="Exposure, live")
            self._controls.button("Use these", lambda: self._keep(self._read()), "", "From now on")
            self._controls.button(
                "As the rig says", self._forget, "", "What rig.toml says, or the twin"
            )

    def renew(self) -> None:
        """What is typed is of another session: show what holds in this one."""
        self._shown = None

    def _forget(self) -> None:
        self.renew()
        self._keep(None)

    def show(self, seeing: SeeingSettings, *, is_visible: bool) -> None:
        """Show what holds; what is being typed stays until that changes."""
        self._folder.visible = is_visible
        if seeing == self._shown:
            return
        given, lines = seeing.exposure, seeing.stripes
        mode = next(words for words, name in MODES.items() if name == given.mode)
        windows = "; ".join(", ".join(map(str, one)) for one in seeing.windows)
        lasers = ", ".join(f"{one.laser} {100.0 * one.target:g}" for one in given.laser)
        known: tuple[tuple[Any, object], ...] = (
            (self._mode, mode),
            (self._target, round(100.0 * given.target, 6)),
            (self._lasers, lasers),
            (self._time, given.exposure_us),
            (self._least, given.least_us),
            (self._most, given.most_us),
            (self._gain, "" if given.gain_db is None else f"{given.gain_db:g}"),
            (self._photo, seeing.photo_us),
            (self._windows, windows),
            (self._height, lines.threshold or 0.0),
            (self._width, lines.line_sigma_px or 0.0),
            (self._smoothing, lines.smoothing_px),
            (self._voxel, seeing.voxel_mm),
            (self._every, seeing.measured_every),
        )
        for field, value in known:
            put(field, value)
        self._before = self._shown = seeing

    def _read(self) -> SeeingSettings:
        """What stands in the fields; raises `OptionError`."""
        lasers = [one.rpartition(" ") for one in str(self._lasers.value).split(",") if one.strip()]
        windows = [one.split(",") for one in str(self._windows.value).split(";") if one.strip()]
        gain = str(self._gain.value).strip()
        try:
            exposure = ExposureSettings(
                MODES[self._mode.value],
                float(self._time.value),
                float(gain) if gain else None,
                0.01 * float(self._target.value),
                float(self._least.value),
                float(self._most.value),
                tuple(LaserTarget(name.strip(), 0.01 * float(level)) for name, _, level in lasers),
            )
            places = tuple((int(x), int(y), int(w), int(h)) for x, y, w, h in windows)
        except (ValueError, TypeError) as error:
            raise OptionError(
                "a gain, laser or window is not understood",
                remedy="write 6 for a gain, A 50, B 80 for lasers, 0, 100, 1280, 400 for a window",
            ) from error
        stripes = replace(
            self._before.stripes,
            threshold=float(self._height.value) or None,
            line_sigma_px=float(self._width.value) or None,
            smoothing_px=float(self._smoothing.value),
        )
        found = SeeingSettings(
            places, exposure, stripes, float(self._photo.value), float(self._voxel.value),
            int(self._every.value),
        )  # fmt: skip
        # wrong counts are refused before they are kept
        found.options  # noqa: B018
        return found


class TipPanel:
    """Where the tip of the probe is, for a session whose plate a person touches.

    ``place`` gives the file that holds it.
    """

    def __init__(self, controls: Controls, place: Callable[[], Path]) -> None:
        self._controls, self._place = controls, place

    def build(self) -> None:
        """Add it to the column."""
        gui = self._controls.gui
        self._centre = gui.add_text("Tip, mm", "", hint="x, y, z of its centre in the tool's frame")
        self._diameter = gui.add_number("Its diameter, mm", 0.0, min=0.0, step=0.0001)
        self._use = self._controls.button("Use this tip", self._keep, "", "From now on")

    def show(self, *, is_visible: bool) -> None:
        """Show what is in the file, if there is one."""
        for handle in (self._centre, self._diameter, self._use):
            handle.visible = is_visible
        if is_visible and self._place().is_file() and not self._centre.value:
            with suppress(ArmscanError):
                tip = read_probe_tip(self._place())
                put(self._centre, ", ".join(f"{x:g}" for x in tip.centre_tool_mm))
                put(self._diameter, tip.diameter_mm)

    @property
    def lacking(self) -> str:
        """What a person has to tell before touches make sense; empty for nothing."""
        if self._place().is_file():
            return ""
        return (
            "Write first where the centre of the probe's ball is from the arm's tool point, along "
            "the tool's axes, into 'Tip, mm', and how large it is: it stands in the probe's "
            "papers. An arm that reports the ball's centre itself has 0, 0, 0."
        )

    def _keep(self) -> None:
        try:
            x, y, z = (float(one) for one in str(self._centre.value).split(","))
        except ValueError as error:
            raise OptionError(
                f"the tip is '{self._centre.value}'", remedy="write three numbers as 0, 0, 125.3"
            ) from error
        if not float(self._diameter.value) > 0.0:
            raise OptionError("the tip has no diameter", remedy="write that of its ball")
        content = probe_tip_toml(ProbeTip(np.array([x, y, z]), float(self._diameter.value)))
        write_files({self._place(): content}, is_overwriting=True)


class ScanPanel:
    """A scan while it runs: its buttons, images, range bar and figures.

    ``finish`` ends a scan; ``look`` gives what the cameras see now while no scan runs.
    """

    def __init__(
        self,
        controls: Controls,
        points: PointsPanel,
        finish: Callable[[], object],
        look: Callable[[], Sequence[Exposure]],
    ) -> None:
        self.live: LiveScan | None = None
        self._look, self._model = look, cast(ModelWatch | None, None)
        self._controls, self._points, self._finish_scan = controls, points, finish
        self._scanner: ScannerCalibration | None = None
        self._version, self._drawn_at = -1, 0.0
        self._unseen = ""
        """What kept the cameras' images from being shown last."""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_fresh, daemon=True)

    def build(self, start: Callable[[], object]) -> None:
        """Add buttons and range bar to the column, and begin to show what runs."""
        self._range = self._controls.gui.add_html("", visible=False)
        button = self._controls.button
        self.start_button = button(
            "Start", start, "S", "Begin, pause, go on", "teal", is_alone=True
        )
        self._undo = button("Undo last pass", self.undo, "U", "Take the last pass out")
        self._clear = button("Clear", self.clear, "C", "Take all passes out of the scan")
        self._finish = self._controls.kept_out(
            button("Finish", self._finish_scan, "F", "End the scan and calculate", "teal")
        )
        self._arm = button("See the arm", self.see_arm, "A", "Turn the view to base and head")
        self._facts = self._controls.gui.add_html("", visible=False)
        self._start = start

    def build_pictures(self) -> None:
        """Add the cameras' images, in a window of their own that can be moved."""
        grey = np.full((8, 640, 3), 245, dtype=np.uint8)
        gui = self._controls.gui
        self._window = gui.add_panel(visible=False)
        with self._window.add_tab("What the camera sees"):
            self._pictures = [gui.add_image(grey, label=None, visible=False) for _ in range(2)]
        self._window.float(x=12.0, y=WINDOW_Y_PX, width=WINDOW_PX)
        self._thread.start()

    def close(self) -> None:
        """End a scan, and show no more."""
        self._closing.set()
        if self.live is not None:
            # what a full disk did not take is told when the session is opened again
            with suppress(ArmscanError):
                self.live.stop()
        self._thread.join(5.0)

    def begin(
        self, live: LiveScan, scanner: ScannerCalibration, model: ModelWatch | None = None
    ) -> None:
        """Start a scan and show it, beside its model if there is one."""
        live.start()
        self._version = -1
        self._points.show(None)
        self._scanner, self._model, self.live = scanner, model, live

    def end(self) -> int:
        """End the scan; returns how many exposures it recorded, 0 where none runs."""
        live, self.live = self.live, None
        if live is None:
            return 0
        try:
            live.stop()
        finally:
            self.show_images(())
            self._points.view.show_head(None, None)
            if self._model is not None:
                self._model.end()
        return live.n_recorded

    def undo(self) -> None:
        """Take the last pass back."""
        if self.live is not None:
            self.live.undo_pass()

    def clear(self) -> None:
        """Take all passes back."""
        if self.live is not None:
            self.live.clear()

    def see_arm(self) -> None:
        """Turn the view to all of the arm."""
        pose = None if self.live is None else self.live.snapshot.base_from_tool
        if pose is not None:
            reach = pose.translation_mm
            self._points.view.look_at(0.5 * reach, 1.6 * float(np.linalg.norm(reach)))

    def arrange(self, *, is_motion: bool, can_start: bool, is_again: bool) -> None:
        """Show the controls that a step has now."""
        self.start_button.visible = can_start
        self._label(is_again=is_again)
        for handle in (
            *(self._undo, self._clear, self._finish, self._arm, self._range, self._facts),
        ):
            handle.visible = is_motion and self.live is not None

    def show_images(self, exposures: Sequence[Exposure]) -> None:
        """Show what the cameras see, one image each; none to show nothing."""
        self._name_pictures(len(exposures))
        for handle, exposure in zip_longest(self._pictures, exposures[: len(self._pictures)]):
            if exposure is not None:
                handle.image = taken_image(exposure)
            handle.visible = exposure is not None
        self._window.visible = bool(exposures)

    def _name_pictures(self, n: int) -> None:
        for handle, side in zip(self._pictures, SIDES, strict=True):
            label = f"{side.capitalize()} camera" if n > 1 else None
            if handle.label != label:
                handle.label = label

    def _label(self, *, is_again: bool = False) -> None:
        if self.live is None:
            self.start_button.label = "Start a new scan (S)" if is_again else "Start (S)"
        else:
            runs = self.live.snapshot.state == "scanning"
            self.start_button.label = "Pause (S)" if runs else "Go on (S)"

    def _keep_fresh(self) -> None:
        while not self._closing.wait(REFRESH_S):
            try:
                if (live := self.live) is not None:
                    self._show(live)
                elif seen := self._look():
                    self.show_images(seen)
                    if self._unseen and self._unseen == self._controls.problem:
                        self._tell("")
            except Exception as error:  # the page goes on showing what it can
                if self.live is None:
                    self._unseen = told(error)
                    self.show_images(())
                self._tell(told(error))

    def _tell(self, problem: str) -> None:
        if problem != self._controls.problem:
            self._controls.problem = problem
            self._controls.refresh()

    def _show(self, live: LiveScan) -> None:
        shown = live.snapshot
        self._hear(live)
        sensor = None if self._scanner is None else self._scanner.sensor
        if sensor is not None:
            names = tuple(one.name for one in sensor.sheets)
            self._name_pictures(len(shown.cameras))
            views = zip(self._pictures, shown.cameras, live.rig.cameras, strict=False)
            for handle, view, camera in views:
                handle.image = live_image(view, names, camera.setup.window)
                self._window.visible = handle.visible = True
            self._range.content = padded(range_bar(shown.range_mm, *depths_mm(sensor)))
        self._facts.content = padded(live_facts(live, shown, self._model))
        self._label()
        is_due = time.monotonic() - self._drawn_at > CLOUD_EVERY_S
        if shown.cloud_version != self._version and is_due:
            self._version = shown.cloud_version
            self._points.show(self._points_of(live), is_new=False)
            pose = shown.base_from_tool
            arm_mm = None if pose is None else live.arm_mm(pose)
            self._points.view.show_head(pose, self._scanner, arm_mm)
            self._drawn_at = time.monotonic()

    def _points_of(self, live: LiveScan) -> ShownPoints:
        """The live cloud, with what its colours need."""
        cloud, by = live.session.cloud(), self._points.colour
        incidence = live.incidence_deg(cloud) if by == "incidence" else None
        points = ShownPoints(cloud.points_mm, cloud.sheet, cloud.sigma_mm, incidence)
        if by != "deviation" or self._model is None:
            return points
        # what was compared is a little older than the cloud
        found, deviation = self._model.latest(cloud)
        if not len(deviation):
            return points
        limit = float(np.nanquantile(np.abs(deviation), 0.95, method="nearest"))
        return ShownPoints(
            found.points_mm, found.sheet, found.sigma_mm, None, deviation, float(f"{limit:.1g}")
        )

    def _turn(self, live: LiveScan) -> None:
        """Pause a scan or go on; one that has ended meanwhile does not begin anew."""
        if self.live is live:
            self._start()

    def _hear(self, live: LiveScan) -> None:
        while live.events:
            event = live.events.popleft()
            if event.kind == "button" and event.text == START_BUTTON:
                self._controls.tried(lambda: self._controls.alone(lambda: self._turn(live)))
            elif event.kind == "button" and event.text == UNDO_BUTTON:
                self._controls.tried(self.undo)
            elif event.kind in ("fault", "warning"):
                self._controls.problem = sentence(event.words)
                self._controls.refresh()


def put(handle: Any, value: object) -> None:
    """Show a value; typed anew, for the library types values as what a person changes."""
    handle.value = value
