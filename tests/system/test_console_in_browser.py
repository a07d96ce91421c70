# SPDX-License-Identifier: Apache-2.0
"""From an empty folder to a report by the console's buttons alone, in a browser, on the twin."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("viser", reason="the extra console is not installed")
pytest.importorskip("selenium", reason="selenium is not installed")

from selenium import webdriver
from selenium.common.exceptions import WebDriverException
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By

from armscan.console.journey import StepName
from armscan.console.pages import ConsolePage, open_console
from armscan.errors import OutputError

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for name in NAMES if (found := shutil.which(name))), None)
DRIVER = shutil.which("chromedriver")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--window-size=800,600"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
RIG = "twin:thesis-single?seed=1&scene=plate&views=24&rate=50"

LONG_S = 900.0
"""Two cameras' images of many placements on a busy computer."""

pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no Chromium with its driver is found"
)


class Operator:
    """Reads the page and presses its buttons."""

    def __init__(self, folder: Path, address: str) -> None:
        options = Options()
        options.binary_location = str(CHROMIUM)
        for flag in (*FLAGS, f"--user-data-dir={folder}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
        self.browser = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
        self.browser.get(address)

    def waited(self, done, seconds: float = 240.0, what: str = "") -> None:
        end = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < end, f"{what}; the page says: {self.text}"
            time.sleep(0.1)

    @property
    def text(self) -> str:
        return self.browser.find_element(By.TAG_NAME, "body").text

    def sees(self, words: str, seconds: float = 240.0) -> None:
        self.waited(lambda: words in self.text, seconds, f"not seen: {words}")

    def press(self, label: str) -> None:
        """Press the button whose label begins so, once it is there."""

        def pressed() -> bool:
            try:
                for button in self.browser.find_elements(By.TAG_NAME, "button"):
                    if button.text.startswith(label) and button.is_enabled():
                        self.browser.execute_script("arguments[0].click()", button)
                        return True
            except WebDriverException:
                """The page was being drawn anew."""
            return False

        self.waited(pressed, 240.0, f"no button {label}")

    def key(self, letter: str) -> None:
        self.browser.find_element(By.TAG_NAME, "body").send_keys(letter)

    def hosts(self) -> set[str]:
        """Hosts that the page asked for anything."""
        found = set()
        for entry in self.browser.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            params = message["params"]
            if message["method"] == "Network.requestWillBeSent":
                found.add(urlsplit(params["request"]["url"]))
            elif message["method"] == "Network.webSocketCreated":
                found.add(urlsplit(params["url"]))
        return {one.netloc for one in found if one.scheme in ("http", "https", "ws", "wss")}


@contextmanager
def operator(folder: Path, address: str) -> Iterator[Operator]:
    one = Operator(folder, address)
    try:
        yield one
    finally:
        one.browser.quit()


def test_a_step_by_its_buttons_alone_and_a_browser_closed_and_a_job_killed(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "first"
    with open_console(folder, RIG, port=0) as (page, address):
        with operator(tmp_path / "browser1", address) as one:
            one.sees("Placement 1 of 15")
            assert "Light sheets\nwaits" in one.text
            one.key("t")
            one.sees("Placement 2 of 15")
            one.sees("Seen: 99 points of the target.")
            one.press("Take back")
            one.sees("Placement 1 of 15")
            one.key("t")
            one.sees("Placement 2 of 15")
            assert one.hosts() == {urlsplit(address).netloc}, "something came from elsewhere"
        # the browser is closed, and another one opened: the session goes on where it was
        for k in range(1, 8):
            page.bench.take(StepName.CAMERA, page.journey.recording(StepName.CAMERA), k)
        page.refresh()
        with operator(tmp_path / "browser2", address) as one:
            one.sees("Placement 9 of 15")
            one.press("Calculate")
            one.waited(lambda: page.worker.is_busy and one.text.count("Cancel"))
            os.kill(page.worker.pid, signal.SIGKILL)
            one.sees("came to an end, and nothing was written")
            assert not (folder / "camera.json").exists()
            # another console on the same session is told, and this one goes on
            with pytest.raises(OutputError, match="another console"), open_console(folder, port=0):
                pass
            one.press("Calculate")
            # eight placements may leave remarks
            one.sees("o on with 'Light sheets'.")
    assert page.journey.state(StepName.CAMERA).status in ("good", "doubtful")


# the page may be told of a take that ends after its server
@pytest.mark.filterwarnings("ignore:Queued a")
def test_closing_the_console_ends_taking_all_that_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C seemed to do nothing until the last placement was rendered."""
    is_taking = threading.Event()

    def take(page: ConsolePage, step: StepName) -> None:
        is_taking.set()
        time.sleep(0.05)

    monkeypatch.setattr(ConsolePage, "take", take)
    with open_console(tmp_path / "first", RIG, port=0) as (page, _):
        taking = threading.Thread(target=page.take_all, daemon=True)
        taking.start()
        assert is_taking.wait(30.0)
    taking.join(30.0)
    assert not taking.is_alive()


@pytest.mark.skipif(
    "ARMSCAN_JOURNEY" not in os.environ, reason="minutes long, the whole journey: make journey"
)
@pytest.mark.parametrize(
    "rig",
    [RIG, RIG.replace("single", "multi")],
    ids=["one-camera", "two-cameras"],
)
def test_a_new_user_gets_from_an_empty_folder_to_a_report(tmp_path: Path, rig: str) -> None:
    with (
        open_console(tmp_path / "first", rig, port=0) as (page, address),
        operator(tmp_path / "browser", address) as one,
    ):
        assert page.bench is not None
        for step, kind, follows in (
            (StepName.CAMERA, "Placement", "Light sheets"),
            (StepName.LASER, "Placement", "Touch the plate"),
            (StepName.PROBING, "Touch", "Hand-eye"),
            (StepName.HAND_EYE, "Placement", "Daily check"),
        ):
            n = page.bench.n_placements[step]
            one.sees(f"{kind} 1 of {n}")
            one.press("Take all that is left")
            one.sees(f"All {n} are taken", LONG_S)
            one.press("Calculate")
            one.sees(f"o on with '{follows}'.", LONG_S)
            one.press("Go on")
        scanned(one, page)
        one.sees("o on with 'Scan'.")
        one.press("Go on")
        scanned(one, page)
        one.sees("Go on with 'Inspect'.")
        one.press("Go on")
        one.sees("Compare with")
        one.press("Inspect (K)")
        one.sees("The report is ready.")
        report = one.browser.find_element(By.LINK_TEXT, "Report of the session")
        one.browser.get(report.get_attribute("href"))
        one.sees("scan-01")
        assert "SIMULATED" in one.text.upper()
        assert one.hosts() == {urlsplit(address).netloc}
    scans = {StepName.SCAN, StepName.INSPECT}
    states = {
        step.name: page.journey.state(step.name, "scan-01" if step.name in scans else "").status
        for step in page.journey.steps
        if step.name is not StepName.CHECK
    }
    # 24 of the ball's 70 exposures leave the check inconclusive as often as not
    # the target's residuals and turns, and the spacing of lines, may leave remarks
    assert set(states.values()) <= {"good", "doubtful"}
    assert all(states[name] == "good" for name in (StepName.HAND_EYE, StepName.SCAN))


def scanned(one: Operator, page: ConsolePage) -> None:
    """Start, wait for the hand's end, finish."""
    one.press("Start")
    one.waited(lambda: page.live is not None and page.live.n_recorded > 4)
    one.sees("Pause (S)")
    assert "Distance: 1" in one.text, "the range bar says how far the surface is"
    low, high = map(int, re.findall(r"green: (\d+) to (\d+) mm", one.text)[0])
    assert low < high
    assert ("Left camera" in one.text) is (page.journey.settings.n_cameras == 2)
    one.sees("the simulated hand has come to its end", LONG_S)
    one.press("Finish")
