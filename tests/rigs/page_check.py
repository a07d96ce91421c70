# SPDX-License-Identifier: Apache-2.0
"""A page opened in headless Chromium at two widths and as it is printed: what a reader would trip
over.

Looked for: anything beyond the page's edge, text on text, text that its box cuts, and requests to
any other place than the file itself.
"""

from __future__ import annotations

import base64
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    None,
)
DRIVER = shutil.which("chromedriver")
WIDTHS_PX = (1400, 500)
PAPER_PX = 688
"""Width of the text on A4 with the margins of `page.css`: 182 mm at 96 px an inch."""
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--hide-scrollbars"),
)
FAULTS = r"""
const wide = document.documentElement.clientWidth, found = [];
const name = (node) => node.tagName + ": " + (node.textContent || "").trim().slice(0, 60);
if (document.documentElement.scrollWidth > wide + 1)
  found.push("the page is " + document.documentElement.scrollWidth + " px wide in " + wide);
const scrolls = (node) => {
  for (let up = node.parentElement; up; up = up.parentElement)
    if (["auto", "scroll"].includes(getComputedStyle(up).overflowX)) return true;
  return false;
};
const texts = [];
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode, holder = node.parentElement;
  const isShown = !["SCRIPT", "STYLE", "NOSCRIPT"].includes(holder.tagName);
  if (!isShown || !node.textContent.trim()) continue;
  const range = document.createRange();
  range.selectNodeContents(node);
  for (const box of range.getClientRects()) {
    if (box.width < 1 || box.height < 1) continue;
    // a space at the end of a line may hang over the edge
    const room = getComputedStyle(holder).whiteSpace === "pre-wrap" ? 6 : 1;
    if ((box.right > wide + room || box.left < -1) && !(arguments[0] && scrolls(holder)))
      found.push("beyond the edge: " + name(holder));
    texts.push([box, holder]);
  }
}
for (const node of document.querySelectorAll("body *")) {
  const style = getComputedStyle(node);
  const cuts = style.overflowX === "hidden" || style.textOverflow === "ellipsis";
  const isCut = cuts && node.scrollWidth > node.clientWidth + 1 && node.tagName !== "svg";
  if (isCut) found.push("cut: " + name(node));
}
for (let a = 0; a < texts.length; a++) for (const [other, second] of texts.slice(a + 1, a + 200)) {
  const [one, first] = texts[a];
  if (first === second || first.contains(second) || second.contains(first)) continue;
  const right = Math.min(one.right, other.right) - Math.max(one.left, other.left);
  const down = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top);
  if (right > 2 && down > 4) found.push("text on text: " + name(first) + " | " + name(second));
}
for (const image of document.images) {
  const isThere = !image.closest("noscript") && image.getClientRects().length;
  if (isThere && !image.naturalWidth) found.push("a picture is not shown: " + image.alt);
}
return [...new Set(found)];
"""


@contextmanager
def browser(folder: Path) -> Iterator[Any]:
    """A browser that keeps its files in a folder and notes what it asks for."""
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = str(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    try:
        yield driver
    finally:
        driver.quit()


SETTLED = """
const done = arguments[0];
const frames = () => requestAnimationFrame(() => requestAnimationFrame(done));
Promise.all([...document.images].map(one => one.decode().catch(() => 0))).then(frames);
"""
"""Pictures are decoded and laid out: on a busy machine text was read where it did not stay."""


def page_faults(driver: Any, page: Path, pictures: Path | None = None) -> list[str]:
    """What is wrong with a page, in words; empty for a sound one.

    Parameters
    ----------
    driver
        Of `browser`.
    page
        The HTML file.
    pictures
        Folder for its pictures at each width, and for its PDF; None for none.
    """
    found: list[str] = []
    # the browser's own first tab
    driver.get_log("performance")
    driver.get_log("browser")
    for width in WIDTHS_PX:
        _set_width(driver, width)
        driver.get(page.as_uri())
        # folded parts are read too
        driver.execute_script("document.querySelectorAll('details').forEach(d => d.open = true)")
        found += [f"{width} px: {text}" for text in _that_stay(driver, may_scroll=True)]
        if pictures is not None:
            _save(driver, pictures / f"{page.stem}-{width}.png", width)
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    _set_width(driver, PAPER_PX)
    found += [f"paper: {text}" for text in _that_stay(driver, may_scroll=False)]
    if pictures is not None:
        printed = driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
        (pictures / f"{page.stem}.pdf").write_bytes(base64.b64decode(printed["data"]))
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    for entry in driver.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            url = message["params"]["request"]["url"]
            if not url.startswith(("data:", "chrome")) and url != page.as_uri():
                found.append(f"asks for {url}")
    found += [entry["message"] for entry in driver.get_log("browser")]
    return found


def _that_stay(driver: Any, may_scroll: bool) -> list[str]:
    """Faults that are there at each of three looks: a busy browser may still be laying out."""
    for pause_s in (0.0, 1.0, 3.0):
        time.sleep(pause_s)
        driver.execute_async_script(SETTLED)
        found: list[str] = driver.execute_script(FAULTS, may_scroll)
        if not found:
            break
    return found


def _set_width(driver: Any, width: int) -> None:
    driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": False},
    )


def _save(driver: Any, path: Path, width: int) -> None:
    height = driver.execute_script("return document.documentElement.scrollHeight")
    size = {"x": 0, "y": 0, "width": width, "height": min(height, 12_000), "scale": 1}
    taken = driver.execute_cdp_cmd(
        "Page.captureScreenshot", {"captureBeyondViewport": True, "clip": size}
    )
    path.write_bytes(base64.b64decode(taken["data"]))
