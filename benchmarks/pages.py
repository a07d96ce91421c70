# SPDX-License-Identifier: Apache-2.0
"""Pages in headless Chromium at two widths and printed: overflow, overlap, cut text, requests.

    python benchmarks/pages.py FOLDER... [--pictures OUT]

Every .html file below the folders is opened (of a demo, or of any work); a line a page tells what
is wrong. With --pictures, screenshots and PDF files lie in OUT to be looked at.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from rigs.page_check import CHROMIUM, DRIVER, browser, page_faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    if CHROMIUM is None or DRIVER is None:
        print("no Chromium with its driver is found")
        return 2
    if given.pictures is not None:
        given.pictures.mkdir(parents=True, exist_ok=True)
    pages = sorted(page for folder in given.folders for page in folder.rglob("*.html"))
    n_wrong = 0
    with tempfile.TemporaryDirectory() as folder, browser(Path(folder)) as driver:
        for page in pages:
            faults = page_faults(driver, page.resolve(), given.pictures)
            n_wrong += bool(faults)
            print(f"{page}: {'; '.join(faults) or 'sound'}")
    print(f"{len(pages)} pages, {n_wrong} with faults")
    return 1 if n_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
