# SPDX-License-Identifier: Apache-2.0
"""Points shown in the console: time, memory and how the page answers, in headless Chromium.

    python benchmarks/console_points.py --points 2000000

Times of the console's process are processor time. The browser draws without a graphics processor
here: its rate is what the slowest computer gives.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

from armscan.console.quality import Incidence
from armscan.console.scene import COLOURED_BY, SceneView, ShownPoints
from armscan.console.server import close_server, open_server
from armscan.pipeline.live.session import ShownCloud

FRAMES = """
const done = arguments[0], times = [], start = performance.now();
function step(now) {
  times.push(now);
  if (now - start < 10000) requestAnimationFrame(step); else done(times);
}
requestAnimationFrame(step);
"""


FLAGS = (
    *("--headless=new", "--no-sandbox", "--window-size=1400,900"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
LINES, SETTLED_S = 1000, 15.0


def waves(n: int) -> ShownPoints:
    """A wavy surface of 300 x 200 mm, a thousand lines."""
    rng = np.random.default_rng(1)
    along = np.tile(np.linspace(0.0, 200.0, n // LINES), LINES)
    across = np.repeat(np.linspace(0.0, 300.0, LINES), n // LINES)
    height = 10.0 * np.sin(along / 20.0) * np.cos(across / 30.0)
    points = np.column_stack([across, along, height + rng.normal(0.0, 0.02, len(along))])
    sheet = np.zeros(len(points), dtype=np.int64)
    return ShownPoints(points, sheet, rng.uniform(0.02, 0.05, len(points)))


def resident_mib(pid: int | str = "self") -> float:
    """Memory of a process that lies in RAM."""
    for line in Path(f"/proc/{pid}/status").read_text("utf-8").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024.0
    return 0.0


def renderers() -> list[int]:
    """Processes of Chromium that draw pages."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_bytes()
        except OSError:
            continue
        if b"--type=renderer" in words or b"--type=gpu-process" in words:
            found.append(int(place.name))
    return found


def timed(name: str, work: Callable[[], object]) -> None:
    """Do something and tell its processor time."""
    before, wall = time.process_time(), time.monotonic()
    work()
    cpu, took = time.process_time() - before, time.monotonic() - wall
    print(f"{name:<44} {cpu:8.2f} s processor {took:8.2f} s wall")


@contextmanager
def browser(address: str) -> Iterator[tuple[webdriver.Chrome, list[int]]]:
    """A browser with a page open, and the processes that draw it."""
    before = set(renderers())
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:
        options = Options()
        options.binary_location = str(shutil.which("chromium"))
        for flag in (*FLAGS, f"--user-data-dir={place}"):
            options.add_argument(flag)
        one = webdriver.Chrome(options=options, service=Service(str(shutil.which("chromedriver"))))
        one.set_script_timeout(120)
        one.get(address)
        time.sleep(3.0)
        yield one, [pid for pid in renderers() if pid not in before]
        one.quit()


def show(view: SceneView, shown: ShownPoints) -> None:
    """Tell what the console's process does for points."""
    for by in COLOURED_BY[:2]:
        timed(f"show by {by}", partial(view.show, shown, by))
    timed("show by coverage", partial(view.show, shown, "coverage"))
    n = len(shown.points_mm) // LINES
    exposure = np.repeat(np.arange(LINES), n)
    cloud = ShownCloud(shown.points_mm, shown.sheet, shown.sigma_mm, exposure)
    seen_from = {k: np.array([150.0, 100.0, 150.0]) for k in range(LINES)}
    known = Incidence()
    timed("incidence of 100,000 of them", partial(known.angles_deg, cloud, seen_from))


def answers_ms(one: webdriver.Chrome, pressed: list[float]) -> float:
    """Median time from a press in the browser to the console."""
    late = []
    for _ in range(5):
        n, start = len(pressed), time.monotonic()
        for found in one.find_elements("tag name", "button"):
            if found.text == "Press":
                one.execute_script("arguments[0].click()", found)
        while len(pressed) == n and time.monotonic() - start < 30.0:
            time.sleep(0.005)
        late.append(time.monotonic() - start)
    return 1e3 * float(np.median(late))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=2_000_000)
    given = parser.parse_args()
    shown = waves(given.points)
    pressed: list[float] = []
    server, address = open_server(Path, port=0)
    server.gui.add_button("Press").on_click(lambda _: pressed.append(time.monotonic()))
    with browser(address) as (one, own):
        before = resident_mib(), sum(map(resident_mib, own))
        print(f"{len(shown.points_mm):,} points")
        show(SceneView(server), shown)
        time.sleep(SETTLED_S)
        after = resident_mib(), sum(map(resident_mib, own))
        steps = np.diff(one.execute_async_script(FRAMES))
        late = answers_ms(one, pressed)
    close_server(server)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"console: {before[0]:.0f} MiB before, {after[0]:.0f} after, peak {most:.0f}")
    print(f"the browser's page and drawing: {before[1]:.0f} MiB before, {after[1]:.0f} after")
    print(f"frames: {1e3 / steps.mean():.1f} a second, longest {steps.max():.0f} ms")
    print(f"a press reaches the console after {late:.0f} ms (median of 5)")


if __name__ == "__main__":
    main()
