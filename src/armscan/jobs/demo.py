# SPDX-License-Identifier: Apache-2.0
"""The demos: heads of the twin and rendered photographs through the whole chain, with one page
each.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar
from uuid import uuid4

from armscan.devices.sources import Preset, ScanSource, Twin, TwinScene
from armscan.errors import OptionError, OutputError
from armscan.jobs.camera import calibrate_camera
from armscan.jobs.job import Job
from armscan.jobs.reconstruct import StillPaths, reconstruct
from armscan.jobs.sheets import SheetImages, calibrate_sheets
from armscan.models.calibration import CameraCalibration, Provenance, ScannerCalibration
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.head_demo import (
    ONE_SHEET_SCENES,
    STILL_MARGIN,
    HeadDemo,
    HeadOptions,
    RecordedScans,
    run_head,
)
from armscan.pipeline.photo_demo import PhotoErrors, compare_with_truth, render_photos
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.simulate import TwinName
from armscan.records.exposure import Exposure
from armscan.report.demo import (
    comparison_table,
    demo_data,
    head_demo_page,
    naming_table,
    truth_table,
)
from armscan.report.demo_comparison import (
    HeadPicture,
    head_picture,
    kind,
    three_heads_page,
    three_heads_table,
)
from armscan.report.page import footer, render_page
from armscan.report.quantity import (
    Quantity,
    Summary,
    Table,
    fact,
    sentence,
    significant,
    summary_json,
    with_sigma,
)
from armscan.storage.clouds import ply_bytes, read_ply
from armscan.storage.documents import (
    camera_document,
    new_provenance,
    read_sensor_calibration,
    scanner_document,
    sensor_document,
    stereo_document,
)
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.recording import FolderRecording
from armscan.storage.recording_session import EXPOSURES_FILE, SESSION_FILE

TEMPORARY = re.compile(r"(?<![^/])\.([^/]+)\.[0-9a-f]{32}\.part(?![^/])")
"""Name of a file or folder that was not complete when its writer was killed."""


def check_demo_folder(folder: Path, own_names: Collection[str], mark: Path) -> None:
    """Refuse to write between files that are not an earlier demo's.

    Parameters
    ----------
    folder
        Where the demo goes; need not exist.
    own_names
        What the demo writes.
    mark
        A file of an earlier demo that lies beside the simulator's mark, or below it.

    Raises
    ------
    OutputError
        If the folder holds something else.
    """
    found = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    is_demo = are_simulated((mark,))
    _refuse(folder, [name for name in found if not is_demo or name not in own_names])


@contextmanager
def replaced_demo(folder: Path, own_files: re.Pattern[str]) -> Iterator[Path]:
    """Give a folder of another name to write a demo into; it gets its name when all is written.

    Until then an earlier demo stays as it is, also if the block raises or is interrupted. What a
    killed run left beside the folder is removed first; so no two demos may be written to one
    folder at a time.

    Parameters
    ----------
    folder
        Where the demo goes; made if need be.
    own_files
        Paths, with ``/``, of all files that a demo may hold; ``truth.json`` is its mark.

    Raises
    ------
    OutputError
        If the folder holds anything else, now or at the end, or cannot be written.
    """
    target = folder.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _clean_up(target, own_files)
        _check_files(folder, own_files)
        partial = _beside(target, "part")
        partial.mkdir()
        try:
            yield partial
            _check_files(folder, own_files)
            _swap(partial, target)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise OutputError(
            f"the demo cannot be written ({error.strerror or error})",
            where=str(folder),
            remedy="free some space or choose another folder",
        ) from error


def _beside(target: Path, ending: str) -> Path:
    return target.with_name(f".{target.name}.{uuid4().hex}.{ending}")


def _swap(partial: Path, target: Path) -> None:
    """Two renames; the earlier demo is removed after them."""
    if not target.exists():
        partial.rename(target)
        return
    old = _beside(target, "old")
    target.rename(old)
    try:
        partial.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _clean_up(target: Path, own_files: re.Pattern[str]) -> None:
    """Bring back the demo of a run that was killed between its renames; remove all that is left."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{32}}\.(part|old)")
    left = [path for path in sorted(target.parent.iterdir()) if pattern.fullmatch(path.name)]
    for path in left:
        if path.suffix == ".old" and not target.exists():
            path.rename(target)
        elif not _foreign(path, own_files):
            shutil.rmtree(path)


def _check_files(folder: Path, own_files: re.Pattern[str]) -> None:
    found = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    if found and not are_simulated((folder / "truth.json",)):
        _refuse(folder, found)
    _refuse(folder, _foreign(folder, own_files))


def _foreign(folder: Path, own_files: re.Pattern[str]) -> list[str]:
    """Files and links, as paths in the folder, that no demo writes."""
    if not folder.is_dir():
        return []
    files = [p for p in sorted(folder.rglob("*")) if p.is_symlink() or not p.is_dir()]
    names = [path.relative_to(folder).as_posix() for path in files]
    return [name for name in names if not own_files.fullmatch(TEMPORARY.sub(r"\1", name))]


def _refuse(folder: Path, foreign: list[str]) -> None:
    if foreign:
        raise OutputError(
            f"the folder holds other files than a demo's ({', '.join(foreign[:3])})",
            where=str(folder),
            remedy="name a new or an empty folder",
        )


def head_demo_commands(recordings: Path, twin: Twin, demo: HeadDemo) -> Table:
    """Each step on the demo's recordings; results go to the current folder."""
    normal = ",".join(f"{value:.6f}" for value in demo.still_normal)
    truth, still = twin.truth, demo.still_step.nominal_height_mm
    lines = [
        *_calibrated(recordings, twin, demo),
        f"armscan probe {recordings / 'probing'} -o plate.csv",
        f"armscan calibrate hand-eye {recordings / 'hand-eye'} --sensor sensor.json "
        "--plate plate.csv -o scanner.json",
        *_measured(recordings, "plate", "plane plate.ply --plate plate.csv"),
        *_measured(recordings, "ball", f"sphere ball.ply --diameter {truth.ball_diameter_mm:g}"),
        f"armscan verify {recordings / 'ball'} --scanner scanner.json "
        f"--ball {truth.ball_diameter_mm:g}",
    ]
    for k, height in enumerate(truth.step_heights_mm):
        found = _measured(recordings, "steps", f"step steps.ply --height {height:g}")
        lines += found if k == 0 else found[1:]
    lines += [
        f"armscan reconstruct {recordings / 'still-step'} --sensor sensor.json "
        f"--depth-margin {STILL_MARGIN:g} -o still.ply",
        f"armscan inspect step still.ply --height {still:g} --normal={normal}",
        f"armscan reconstruct {recordings / 'part'} --scanner scanner.json -o part.ply",
    ]
    columns = ("The same, command by command",)
    return Table(columns, tuple((line,) for line in lines), "", (0,))


def _calibrated(recordings: Path, twin: Twin, demo: HeadDemo) -> list[str]:
    """Cameras and sheets."""
    target, laser = twin.target, recordings / "laser"
    kind = "camera" if demo.instrument.sensor.second is None else "stereo"
    return [
        f"armscan calibrate {kind} --scan {recordings / 'camera'} --target {target} -o {kind}.json",
        f"armscan calibrate laser --camera {kind}.json --scan {laser} --target {target} "
        "-o sensor.json",
    ]


def _measured(recordings: Path, scene: str, inspection: str) -> list[str]:
    return [
        f"armscan reconstruct {recordings / scene} --scanner scanner.json -o {scene}.ply",
        f"armscan inspect {inspection}",
    ]


@dataclass(frozen=True, slots=True)
class DemoOrigin:
    """Where a demo's files come from.

    Parameters
    ----------
    command
        The command line.
    folder, place
        Where they will lie, and where they lie yet.
    """

    command: tuple[str, ...]
    folder: Path
    place: Path

    def provenance(self, files: Iterable[Path], *parents: Provenance) -> Provenance:
        """Provenance that names files in ``place`` as they will be in ``folder``."""
        found = new_provenance(files, command=self.command, parents=parents)
        inputs = tuple(
            replace(item, path=(self.folder / Path(item.path).relative_to(self.place)).as_posix())
            for item in found.inputs
        )
        return replace(found, inputs=inputs)

    def of_recording(self, recording: FolderRecording, *parents: Provenance) -> Provenance:
        """Provenance of what rests on a recording."""
        folder = recording.folder
        return self.provenance((folder / EXPOSURES_FILE, folder / SESSION_FILE), *parents)


def demo_documents(
    demo: HeadDemo, scans: Mapping[TwinScene, FolderRecording], origin: DemoOrigin
) -> dict[Path, bytes]:
    """Files to write: camera or cameras, sensor, scanner, and the part's cloud."""
    found, place = demo.instrument, origin.place
    base = origin.of_recording(scans["camera"])
    sensor = replace(
        found.sensor,
        camera=replace(found.sensor.camera, provenance=base),
        provenance=origin.of_recording(scans["laser"], base),
    )
    if sensor.second is not None:
        right = replace(sensor.second.camera, provenance=base)
        sensor = replace(sensor, second=replace(sensor.second, camera=right))
    scanner = ScannerCalibration(
        sensor=sensor,
        hand_eye=found.hand_eye.fit.calibration,
        provenance=origin.of_recording(scans["hand-eye"], sensor.provenance),
    )
    return {
        **_cameras(found.camera, place, base),
        place / "sensor.json": sensor_document(sensor),
        place / "scanner.json": scanner_document(scanner),
        place / "cloud.ply": ply_bytes(demo.part.scan.cloud),
    }


def _cameras(
    found: CameraCalibration | StereoCalibration, place: Path, provenance: Provenance
) -> dict[Path, bytes]:
    if isinstance(found, CameraCalibration):
        return {place / "camera.json": camera_document(replace(found, provenance=provenance))}
    return {place / "stereo.json": stereo_document(replace(found, provenance=provenance))}


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
        quantities=(fact("time", f"{sum(head['seconds'].values()):.0f} s"),),
        tables=(
            comparison_table(head, request.head),
            truth_table(demo, head),
            *naming,
            commands,
        ),
        warnings=tuple(sentence(f"hand-eye: {text}") for text in fit.warnings),
        written=(folder / RECORDINGS, *(folder / name for name in names)),
        next_step=f"open {folder / 'report.html'} in a browser",
        extra=data,
    )


def scenes_of(twin: Twin) -> tuple[TwinScene, ...]:
    """Scenes whose exposures are known before anything is calibrated.

    A head of several sources chooses its lasers while it scans; a still has all of them on.
    """
    if len(twin.sources) > 1:
        return (*CALIBRATION_SCENES, "still-step")
    waves: tuple[TwinScene, ...] = ("waves",) if len(twin.truth.sheet_points_mm) > 1 else ()
    return (*CALIBRATION_SCENES, *ONE_SHEET_SCENES, *waves, "still-step")


HEADS = ("thesis-single", "thesis-cross", "thesis-multi")
FOLDERS = {name: name.removeprefix("thesis-") for name in HEADS}
PAGE, DATA = "report.html", "summary.json"


def run_three_heads(request: HeadDemoRequest, progress: Progress = silent) -> Summary:
    """Run the demo of each head, and compare them.

    An earlier comparison is removed first: if a head fails, none stands beside heads that it does
    not compare.

    Parameters
    ----------
    request
        As for one head; each gets a folder of its name in the request's.
    progress
        Told of every exposure.

    Raises
    ------
    ArmscanError
        If the folder holds something else than an earlier demo or cannot be written.
    """
    folder = request.folder
    mark = folder / FOLDERS[HEADS[0]] / TRUTH
    check_demo_folder(folder, {*FOLDERS.values(), PAGE, DATA}, mark)
    _remove_comparison(folder)
    heads: dict[str, Any] = {}
    pictures: dict[str, HeadPicture] = {}
    warnings: list[str] = []
    for name in HEADS:
        own = replace(request, folder=folder / FOLDERS[name], head=name)
        summary, demo = make_head_demo(own, progress)
        heads.update(summary.data["heads"])
        pictures[name] = head_picture(kind(name), demo)
        warnings += [f"{kind(name)}: {text}" for text in summary.warnings]
    command = ("armscan", "demo", "all", "-o", folder.as_posix())
    options = ("--preset", request.preset, "--seed", str(request.seed))
    truths = [folder / FOLDERS[name] / TRUTH for name in HEADS]
    provenance = new_provenance(truths, command=(*command, *options))
    page = three_heads_page(heads, pictures, footer(provenance))
    first = summary.data
    result = Summary(
        title="Demo of three simulated heads on the same scenes",
        tables=(three_heads_table(heads),),
        warnings=tuple(warnings),
        written=_three_heads_job_written(folder),
        next_step=f"open {folder / PAGE} in a browser; each head has its own page in its folder",
        extra={**{key: first[key] for key in first if key != "heads"}, "heads": heads},
    )
    files = {folder / PAGE: render_page(page), folder / DATA: summary_json(result).encode()}
    write_files(files, is_overwriting=True)
    return result


def _remove_comparison(folder: Path) -> None:
    for name in (PAGE, DATA):
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"the earlier comparison cannot be removed ({error.strerror or error})",
                where=str(folder / name),
                remedy="choose another folder",
            ) from error


def _three_heads_job_written(folder: Path) -> tuple[Path, ...]:
    return (*(folder / own for own in FOLDERS.values()), folder / PAGE, folder / DATA)


T = TypeVar("T")

DEMO_JOB_OWN_NAMES = frozenset(
    {
        "photos",
        "summary.json",
        *("cloud.ply", "cloud.html"),
        *(f"{name}{end}" for name in ("camera", "sensor") for end in (".json", ".npz", ".html")),
    }
)
"""What a demo writes: a folder that holds nothing else may be used again."""


@dataclass(frozen=True, slots=True)
class DemoRequest:
    """Where the demo goes.

    Parameters
    ----------
    folder
        Made if need be; an earlier demo in it is replaced.
    seed
        Placement and noise of the rendered photographs.
    """

    folder: Path
    seed: int = 1


def run_photo_demo(request: DemoRequest, progress: Progress = silent) -> Summary:
    """Render photographs, calibrate camera and laser, measure an object, state the errors.

    Writes ``photos/``, ``camera.json``, ``sensor.json``, ``cloud.ply``, a page beside each, and
    ``summary.json``.

    Raises
    ------
    ArmscanError
        If the folder holds something else than an earlier demo or cannot be written.
    """
    folder = request.folder
    photos = folder / "photos"
    check_demo_folder(folder, DEMO_JOB_OWN_NAMES, photos / "camera")
    seconds: dict[str, float] = {}
    truth = _timed(seconds, "render", lambda: render_photos(photos, request.seed, progress))
    command = ("armscan", "demo", "photos", "-o", folder.as_posix())
    camera, sensor, cloud = (folder / name for name in ("camera.json", "sensor.json", "cloud.ply"))

    def writing(output: Path) -> Job:
        return Job(output, is_overwriting=True, command=command, progress=progress)

    board = SheetImages((str(photos / "laser" / "on"),), (str(photos / "laser" / "off"),))
    stills = StillPaths(
        (str(photos / "object" / "laser.png"),), (str(photos / "object" / "background.png"),)
    )
    stages = (
        _timed(
            seconds,
            "calibrate_camera",
            lambda: calibrate_camera(writing(camera), truth.target, (str(photos / "camera"),)),
        ),
        _timed(
            seconds,
            "calibrate_laser",
            lambda: calibrate_sheets(writing(sensor), camera, truth.target, board),
        ),
        _timed(seconds, "reconstruct", lambda: reconstruct(writing(cloud), sensor, stills)),
    )
    errors = compare_with_truth(read_sensor_calibration(sensor), read_ply(cloud), truth)
    names = ("camera", "laser", "points")
    data = _data(request.seed, dict(zip(names, stages, strict=True)), errors, seconds)
    result = folder / "summary.json"
    summary = Summary(
        title="Demo on simulated photographs: camera, light sheet and points against their truth",
        quantities=_facts(errors),
        tables=(_commands(photos, folder, truth.target),),
        warnings=tuple(warning for stage in stages for warning in stage.warnings),
        written=(photos, *(path for stage in stages for path in stage.written), result),
        next_step=f"open {folder / 'camera.html'}, {folder / 'sensor.html'} and "
        f"{folder / 'cloud.html'} in a browser",
        extra=data,
    )
    write_files({result: summary_json(summary).encode()}, is_overwriting=True)
    return summary


def _timed(seconds: dict[str, float], stage: str, work: Callable[[], T]) -> T:
    start = perf_counter()
    result = work()
    seconds[stage] = round(perf_counter() - start, 2)
    return result


def _facts(errors: PhotoErrors) -> tuple[Quantity, ...]:
    sheet = errors.sheet
    return (
        fact(
            "camera",
            f"error of the focal length {with_sigma(errors.focal_px, errors.focal_sigma_px, 'px')}",
        ),
        fact(
            "light sheet",
            f"{significant(sheet.angle_deg)} deg and {significant(abs(sheet.offset_mm))} mm off, "
            f"{significant(sheet.rms_mm)} mm rms over the boards",
        ),
        fact(
            "object",
            f"{errors.n_on_object} points, {significant(errors.points_median_mm)} mm median and "
            f"{significant(errors.points_rms_mm)} mm rms from its true surface",
        ),
        fact(
            "in sigmas",
            f"camera {errors.camera_normalised:.1f} ({errors.n_camera_parameters**0.5:.1f} is "
            f"usual for {errors.n_camera_parameters} numbers), sheet {sheet.normalised:.1f} "
            f"({sheet.n_parameters**0.5:.1f} is usual for {sheet.n_parameters}), "
            f"points {errors.points_normalised_rms:.2f} rms",
        ),
    )


def _commands(photos: Path, folder: Path, target: str) -> Table:
    """The same by hand."""
    camera, sensor, cloud = (folder / name for name in ("camera.json", "sensor.json", "cloud.ply"))
    lines = (
        f"armscan calibrate camera {photos / 'camera'} --target {target} -o {camera}",
        f"armscan calibrate laser --camera {camera} --on {photos / 'laser' / 'on'} "
        f"--off {photos / 'laser' / 'off'} --target {target} -o {sensor}",
        f"armscan reconstruct {photos / 'object' / 'laser.png'} "
        f"--background {photos / 'object' / 'background.png'} --sensor {sensor} -o {cloud}",
    )
    return Table(("The same, command by command",), tuple((line,) for line in lines))


def _data(
    seed: int, stages: Mapping[str, Summary], errors: PhotoErrors, seconds: Mapping[str, float]
) -> dict[str, Any]:
    return {
        "kind": "demo",
        "simulated": True,
        "seed": seed,
        "preset": "photos",
        **{name: stage.data for name, stage in stages.items()},
        "errors": asdict(errors),
        "seconds": dict(seconds),
    }
