# SPDX-License-Identifier: Apache-2.0
"""The demo of a single-line arm scanner: recordings, documents, page, figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.models.calibration import Provenance
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.single_demo import SCENES, SingleDemo, SingleOptions, run_single
from armscan.pipeline.single_recordings import TwinName, record_scenes
from armscan.records.exposure import Exposure
from armscan.report.demo_folder import clear_demo_folder
from armscan.report.numbers import sentence
from armscan.report.origin import footer
from armscan.report.page import render_page
from armscan.report.single_demo_commands import single_demo_commands
from armscan.report.single_demo_data import demo_data
from armscan.report.single_demo_page import comparison_table, single_demo_page, truth_table
from armscan.report.summary import Summary, Table, summary_json
from armscan.storage.atomic import write_files
from armscan.storage.calibration_files import camera_document, sensor_document
from armscan.storage.clouds import ply_bytes
from armscan.storage.provenance import new_provenance
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_reader import FolderRecording
from armscan.storage.recording_session import SESSION_FILE
from armscan.storage.scanner_files import scanner_document

HEAD = "thesis-single"
RECORDINGS = "recordings"
TRUTH = "truth.json"
DOCUMENTS = ("camera.json", "sensor.json", "scanner.json")
OWN_NAMES = frozenset({RECORDINGS, TRUTH, *DOCUMENTS, "cloud.ply", "report.html", "summary.json"})
"""What this demo writes: a folder that holds nothing else may be used again."""


@dataclass(frozen=True, slots=True)
class SingleDemoRequest:
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
    options: SingleOptions = field(default_factory=SingleOptions)
    processes: int = 2


def run_single_demo(request: SingleDemoRequest, progress: Progress = silent) -> Summary:
    """Render and record, calibrate, measure, inspect, compare with the truth, and write it all.

    Raises
    ------
    ArmscanError
        If the folder holds something else than an earlier demo or cannot be written.
    """
    folder = request.folder
    name = TwinName(HEAD, request.preset, request.seed)
    twin = name.build()
    clear_demo_folder(folder, OWN_NAMES)
    start = perf_counter()
    (folder / RECORDINGS).mkdir(parents=True)
    write_files({folder / TRUTH: twin.truth.document()})
    views = {scene: request.options.most_views.get(scene) for scene in SCENES}
    scans = record_scenes(
        folder / RECORDINGS, name, views, processes=request.processes, progress=progress
    )
    rendered = round(perf_counter() - start, 2)
    demo = run_single(twin, request.options, progress, scans=scans)
    return _written(request, twin, demo, scans, {"render": rendered, **demo.seconds})


def _written(
    request: SingleDemoRequest,
    twin: Twin,
    demo: SingleDemo,
    scans: Mapping[TwinScene, FolderRecording],
    seconds: dict[str, float],
) -> Summary:
    start = perf_counter()
    folder = request.folder
    commands = single_demo_commands(folder / RECORDINGS, twin, demo)
    photographs: dict[str, Exposure] = {s: _photograph(scan) for s, scan in scans.items()}
    data = demo_data(demo, head=HEAD, seed=request.seed, preset=request.preset, seconds=seconds)
    head = data["heads"][HEAD]
    documents = _documents(request, demo, scans)
    provenance = _provenance(request, (folder / TRUTH,))
    page = single_demo_page(demo, head, photographs, commands, footer(provenance))
    write_files({**documents, folder / "report.html": render_page(page)})
    seconds["write"] = round(perf_counter() - start, 2)
    head["seconds"] = seconds
    summary = _summary(folder, demo, data, commands)
    write_files({folder / "summary.json": summary_json(summary).encode()})
    return summary


def _photograph(scan: ScanSource) -> Exposure:
    """An exposure of the middle of a scan, with the laser on if it ever is."""
    lit = [k for k, row in enumerate(scan.rows) if row.lasers] or list(range(len(scan.rows)))
    return scan.exposure(lit[len(lit) // 2])


def _documents(
    request: SingleDemoRequest, demo: SingleDemo, scans: Mapping[TwinScene, FolderRecording]
) -> dict[Path, bytes]:
    """Calibrations and the part's cloud, each with what it came from."""
    found, folder = demo.instrument, request.folder
    camera = replace(found.camera, provenance=_provenance(request, _tables(scans["camera"])))
    sensor = replace(
        found.sensor,
        camera=camera,
        provenance=_provenance(request, _tables(scans["laser"]), camera.provenance.document_id),
    )
    scanner = ScannerCalibration(
        sensor,
        found.hand_eye.fit.calibration,
        _provenance(request, _tables(scans["hand-eye"]), sensor.provenance.document_id),
    )
    return {
        folder / "camera.json": camera_document(camera),
        folder / "sensor.json": sensor_document(sensor),
        folder / "scanner.json": scanner_document(scanner),
        folder / "cloud.ply": ply_bytes(demo.part.scan.cloud),
    }


def _tables(scan: FolderRecording) -> tuple[Path, ...]:
    return (scan.folder / EXPOSURES_FILE, scan.folder / SESSION_FILE)


def _provenance(request: SingleDemoRequest, files: Iterable[Path], *parents: str) -> Provenance:
    words = ("armscan", "demo", "single", "-o", request.folder.as_posix())
    options = ("--preset", request.preset, "--seed", str(request.seed))
    return new_provenance(files, command=(*words, *options), parent_ids=parents)


def _summary(folder: Path, demo: SingleDemo, data: Mapping[str, Any], commands: Table) -> Summary:
    names = (*DOCUMENTS, "cloud.ply", "report.html", "summary.json")
    seconds: Mapping[str, float] = data["heads"][HEAD]["seconds"]
    fit = demo.instrument.hand_eye.fit
    return Summary(
        title="Demo on a simulated single-line arm scanner: calibrated, used, compared with its "
        "truth",
        facts=(("time", f"{sum(seconds.values()):.0f} s"),),
        tables=(comparison_table(data["heads"][HEAD]), truth_table(demo), commands),
        warnings=tuple(sentence(f"hand-eye: {text}") for text in fit.warnings),
        written=(folder / RECORDINGS, *(folder / name for name in names)),
        next_step=f"open {folder / 'report.html'} in a browser",
        data=data,
    )
