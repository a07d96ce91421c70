# SPDX-License-Identifier: Apache-2.0
"""The demo of an arm scanner of any head: recordings, documents, page, figures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.errors import OptionError
from armscan.pipeline.head_demo import ONE_SHEET_SCENES, HeadDemo, HeadOptions, run_head
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.recorded_scans import RecordedScans
from armscan.pipeline.render_pool import TwinName
from armscan.records.exposure import Exposure
from armscan.report.demo_folder import replaced_demo
from armscan.report.head_demo_commands import head_demo_commands
from armscan.report.head_demo_data import demo_data
from armscan.report.head_demo_documents import DemoOrigin, demo_documents
from armscan.report.head_demo_page import head_demo_page
from armscan.report.head_demo_tables import comparison_table, naming_table, truth_table
from armscan.report.numbers import sentence
from armscan.report.origin import footer
from armscan.report.page import render_page
from armscan.report.summary import Summary, Table, summary_json
from armscan.storage.atomic import write_files
from armscan.storage.recording_reader import FolderRecording

RECORDINGS = "recordings"
TRUTH = "truth.json"
DOCUMENTS = ("camera.json", "sensor.json", "scanner.json")
STEREO_DOCUMENTS = ("stereo.json", "sensor.json", "scanner.json")
RESULTS = ("cloud.ply", "report.html", "summary.json")
OWN_NAMES = frozenset({RECORDINGS, TRUTH, *DOCUMENTS, *STEREO_DOCUMENTS, *RESULTS})
"""What this demo may write into its folder."""
CALIBRATION_SCENES: tuple[TwinScene, ...] = ("camera", "laser", "hand-eye")
SCENES = (*CALIBRATION_SCENES, *ONE_SHEET_SCENES, "waves", "still-step")
OWN_FILES = re.compile(
    "|".join(re.escape(name) for name in OWN_NAMES - {RECORDINGS})
    + rf"|{RECORDINGS}/({'|'.join(('probing', *SCENES))})/"
    r"(session\.toml|exposures\.csv|arm\.csv|probe\.toml|images/([a-zA-Z]+/){0,2}\d{2,4}\.png)"
)
"""Paths of all that: a folder that holds nothing else may be used again."""


KINDS = {
    "thesis-single": "single-line",
    "thesis-cross": "cross-line",
    "thesis-multi": "multi-line",
}
"""Words for the heads."""


@dataclass(frozen=True, slots=True)
class HeadDemoRequest:
    """Where the demo goes, and what is simulated.

    Parameters
    ----------
    folder
        Made if need be; an earlier demo in it is replaced.
    head
        Name of the head.
    seed
        Everything random follows from it.
    preset
        How good the instrument and how kind the surroundings are.
    options
        How much of the scans is used.
    processes
        Processes that render.
    """

    folder: Path
    head: str = "thesis-single"
    seed: int = 1
    preset: Preset = "thesis"
    options: HeadOptions = field(default_factory=HeadOptions)
    processes: int = 2

    @property
    def command(self) -> tuple[str, ...]:
        """The command line that asks for the same."""
        kind = self.head.removeprefix("thesis-")
        words = ("armscan", "demo", kind, "-o", self.folder.as_posix())
        return (*words, "--preset", self.preset, "--seed", str(self.seed))


def run_head_demo(request: HeadDemoRequest, progress: Progress = silent) -> Summary:
    """Render and record, calibrate, measure, inspect, compare with the truth, and write it all.

    Raises
    ------
    ArmscanError
        If the folder holds something else than an earlier demo or cannot be written.
    """
    return make_head_demo(request, progress)[0]


def make_head_demo(
    request: HeadDemoRequest, progress: Progress = silent
) -> tuple[Summary, HeadDemo]:
    """As `run_head_demo`, with all that the chain found.

    Raises
    ------
    ArmscanError
        If the head has no demo, the folder holds something else than an earlier demo or cannot be
        written.
    """
    if request.head not in KINDS:
        raise OptionError(
            f"there is no demo of the head {request.head!r}",
            remedy=f"give one of {', '.join(KINDS)}",
        )
    name = TwinName(request.head, request.preset, request.seed)
    twin = name.build()
    with replaced_demo(request.folder, OWN_FILES) as place:
        start = perf_counter()
        write_files({place / TRUTH: twin.truth.document()})
        views = request.options.most_views
        scans = RecordedScans(place / RECORDINGS, name, views, request.processes)
        scans.record(scenes_of(twin), progress)
        rendered = round(perf_counter() - start, 2)
        demo = run_head(twin, request.options, progress, scans=scans)
        seconds = {"render": rendered, **demo.seconds}
        summary = _written(request, place, twin, demo, scans.recordings, seconds=seconds)
    return summary, demo


def _written(
    request: HeadDemoRequest,
    place: Path,
    twin: Twin,
    demo: HeadDemo,
    scans: Mapping[TwinScene, FolderRecording],
    *,
    seconds: dict[str, float],
) -> Summary:
    start = perf_counter()
    commands = head_demo_commands(request.folder / RECORDINGS, twin, demo)
    photographs: dict[str, Exposure] = {s: _photograph(scan) for s, scan in scans.items()}
    data = demo_data(
        demo, head=request.head, seed=request.seed, preset=request.preset, seconds=seconds
    )
    head = data["heads"][request.head]
    origin = DemoOrigin(request.command, request.folder, place)
    documents = demo_documents(demo, scans, origin)
    page = head_demo_page(
        demo,
        request.head,
        head,
        photographs,
        commands=commands,
        footer=footer(origin.provenance((place / TRUTH,))),
    )
    write_files({**documents, place / "report.html": render_page(page)})
    seconds["write"] = round(perf_counter() - start, 2)
    head["seconds"] = seconds
    written = tuple(path.name for path in documents)
    summary = _summary(request, demo, data, commands, written)
    write_files({place / "summary.json": summary_json(summary).encode()})
    return summary


def _photograph(scan: ScanSource) -> Exposure:
    """An exposure of the middle of a scan, with the laser on if it ever is."""
    lit = [k for k, row in enumerate(scan.rows) if row.lasers] or list(range(len(scan.rows)))
    return scan.exposure(lit[len(lit) // 2])


def _summary(
    request: HeadDemoRequest,
    demo: HeadDemo,
    data: Mapping[str, Any],
    commands: Table,
    written: tuple[str, ...],
) -> Summary:
    folder, head = request.folder, data["heads"][request.head]
    fit = demo.instrument.hand_eye.fit
    names = (*written, "report.html", "summary.json")
    naming = (naming_table(demo.naming),) if demo.naming else ()
    return Summary(
        title=f"Demo on a simulated {KINDS[request.head]} arm scanner: calibrated, used, compared "
        "with its truth",
        facts=(("time", f"{sum(head['seconds'].values()):.0f} s"),),
        tables=(
            comparison_table(head, request.head),
            truth_table(demo, head),
            *naming,
            commands,
        ),
        warnings=tuple(sentence(f"hand-eye: {text}") for text in fit.warnings),
        written=(folder / RECORDINGS, *(folder / name for name in names)),
        next_step=f"open {folder / 'report.html'} in a browser",
        data=data,
    )


def scenes_of(twin: Twin) -> tuple[TwinScene, ...]:
    """Scenes whose exposures are known before anything is calibrated.

    A head of several sources chooses its lasers while it scans; a still has all of them on.
    """
    if len(twin.sources) > 1:
        return (*CALIBRATION_SCENES, "still-step")
    waves: tuple[TwinScene, ...] = ("waves",) if len(twin.truth.sheet_points_mm) > 1 else ()
    return (*CALIBRATION_SCENES, *ONE_SHEET_SCENES, *waves, "still-step")
