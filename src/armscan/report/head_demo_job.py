# SPDX-License-Identifier: Apache-2.0
"""The demo of a single-line arm scanner: recordings, documents, page, figures."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.models.calibration import Provenance
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.head_demo import SCENES, HeadDemo, HeadOptions, run_head
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.render_pool import TwinName
from armscan.pipeline.twin_recordings import record_scenes, record_touches
from armscan.records.exposure import Exposure
from armscan.report.demo_folder import replaced_demo
from armscan.report.head_demo_commands import head_demo_commands
from armscan.report.head_demo_data import demo_data
from armscan.report.head_demo_page import comparison_table, head_demo_page, truth_table
from armscan.report.numbers import sentence
from armscan.report.origin import footer
from armscan.report.page import render_page
from armscan.report.summary import Summary, Table, summary_json
from armscan.storage.atomic import write_files
from armscan.storage.calibration_files import camera_document, sensor_document
from armscan.storage.clouds import ply_bytes
from armscan.storage.provenance import new_provenance
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_reader import FolderRecording, read_recording
from armscan.storage.recording_session import SESSION_FILE
from armscan.storage.scanner_files import scanner_document

HEAD = "thesis-single"
RECORDINGS = "recordings"
TRUTH = "truth.json"
DOCUMENTS = ("camera.json", "sensor.json", "scanner.json")
OWN_NAMES = frozenset({RECORDINGS, TRUTH, *DOCUMENTS, "cloud.ply", "report.html", "summary.json"})
"""What this demo writes into its folder."""
OWN_FILES = re.compile(
    "|".join(re.escape(name) for name in OWN_NAMES - {RECORDINGS})
    + rf"|{RECORDINGS}/({'|'.join(('probing', *SCENES))})/"
    r"(session\.toml|exposures\.csv|arm\.csv|probe\.toml|images/(on/|off/)?\d{2,4}\.png)"
)
"""Paths of all that: a folder that holds nothing else may be used again."""


@dataclass(frozen=True, slots=True)
class HeadDemoRequest:
    """Where the demo goes, and what is simulated.

    Parameters
    ----------
    folder
        Made if need be; an earlier demo in it is replaced.
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
    seed: int = 1
    preset: Preset = "thesis"
    options: HeadOptions = field(default_factory=HeadOptions)
    processes: int = 2


def run_head_demo(request: HeadDemoRequest, progress: Progress = silent) -> Summary:
    """Render and record, calibrate, measure, inspect, compare with the truth, and write it all.

    Raises
    ------
    ArmscanError
        If the folder holds something else than an earlier demo or cannot be written.
    """
    name = TwinName(HEAD, request.preset, request.seed)
    twin = name.build()
    with replaced_demo(request.folder, OWN_FILES) as place:
        start = perf_counter()
        write_files({place / TRUTH: twin.truth.document()})
        scans = _recorded(place / RECORDINGS, name, request, progress)
        rendered = round(perf_counter() - start, 2)
        demo = run_head(twin, request.options, progress, scans=scans)
        seconds = {"render": rendered, **demo.seconds}
        return _written(request, place, twin, demo, scans, seconds=seconds)


def _recorded(
    folder: Path, name: TwinName, request: HeadDemoRequest, progress: Progress
) -> dict[TwinScene, FolderRecording]:
    """All scenes and the touches of the plate as recordings, read back."""
    folder.mkdir()
    record_touches(folder / "probing", name.build())
    record_scenes(
        {scene: folder / scene for scene in SCENES},
        name,
        request.options.most_views,
        processes=request.processes,
        progress=progress,
    )
    return {scene: read_recording(folder / scene) for scene in SCENES}


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
    data = demo_data(demo, head=HEAD, seed=request.seed, preset=request.preset, seconds=seconds)
    head = data["heads"][HEAD]
    documents = _documents(request, place, demo, scans)
    provenance = _provenance(request, place, (place / TRUTH,))
    page = head_demo_page(demo, head, photographs, commands, footer(provenance))
    write_files({**documents, place / "report.html": render_page(page)})
    seconds["write"] = round(perf_counter() - start, 2)
    head["seconds"] = seconds
    summary = _summary(request.folder, demo, data, commands)
    write_files({place / "summary.json": summary_json(summary).encode()})
    return summary


def _photograph(scan: ScanSource) -> Exposure:
    """An exposure of the middle of a scan, with the laser on if it ever is."""
    lit = [k for k, row in enumerate(scan.rows) if row.lasers] or list(range(len(scan.rows)))
    return scan.exposure(lit[len(lit) // 2])


def _documents(
    request: HeadDemoRequest,
    place: Path,
    demo: HeadDemo,
    scans: Mapping[TwinScene, FolderRecording],
) -> dict[Path, bytes]:
    """Calibrations and the part's cloud, each with what it came from."""
    found = demo.instrument

    def provenance(scene: TwinScene, *parents: str) -> Provenance:
        folder = scans[scene].folder
        return _provenance(
            request, place, (folder / EXPOSURES_FILE, folder / SESSION_FILE), *parents
        )

    camera = replace(found.camera, provenance=provenance("camera"))
    sensor = replace(
        found.sensor,
        camera=camera,
        provenance=provenance("laser", camera.provenance.document_id),
    )
    scanner = ScannerCalibration(
        sensor,
        found.hand_eye.fit.calibration,
        provenance("hand-eye", sensor.provenance.document_id),
    )
    return {
        place / "camera.json": camera_document(camera),
        place / "sensor.json": sensor_document(sensor),
        place / "scanner.json": scanner_document(scanner),
        place / "cloud.ply": ply_bytes(demo.part.scan.cloud),
    }


def _provenance(
    request: HeadDemoRequest, place: Path, files: Iterable[Path], *parents: str
) -> Provenance:
    """Of files that lie in ``place`` yet and will lie in the demo's folder."""
    words = ("armscan", "demo", "single", "-o", request.folder.as_posix())
    options = ("--preset", request.preset, "--seed", str(request.seed))
    found = new_provenance(files, command=(*words, *options), parent_ids=parents)
    inputs = tuple(
        replace(item, path=(request.folder / Path(item.path).relative_to(place)).as_posix())
        for item in found.inputs
    )
    return replace(found, inputs=inputs)


def _summary(folder: Path, demo: HeadDemo, data: Mapping[str, Any], commands: Table) -> Summary:
    names = (*DOCUMENTS, "cloud.ply", "report.html", "summary.json")
    head, fit = data["heads"][HEAD], demo.instrument.hand_eye.fit
    return Summary(
        title="Demo on a simulated single-line arm scanner: calibrated, used, compared with its "
        "truth",
        facts=(("time", f"{sum(head['seconds'].values()):.0f} s"),),
        tables=(comparison_table(head), truth_table(demo, head), commands),
        warnings=tuple(sentence(f"hand-eye: {text}") for text in fit.warnings),
        written=(folder / RECORDINGS, *(folder / name for name in names)),
        next_step=f"open {folder / 'report.html'} in a browser",
        data=data,
    )
