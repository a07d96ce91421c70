# SPDX-License-Identifier: Apache-2.0
"""Recordings of the twin's scenes, rendered in parallel processes."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Lock
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast, get_args

import cv2
import numpy as np

from armscan.devices.sources import (
    Preset,
    ScanSource,
    SimulatedScan,
    TrueStripe,
    Twin,
    TwinScene,
    load_driver,
)
from armscan.errors import EstimationError, InputError, OptionError, OutputError
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.inspection.cad.part import PartModel
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session
from armscan.storage.arm import ProbeTip, write_probing
from armscan.storage.codec import json_bytes
from armscan.storage.documents import fingerprint
from armscan.storage.files import RECORDING_SUFFIX, check_new_folder, check_outputs, path_text
from armscan.storage.parts.meshes import MESH_SUFFIXES, UNITS_MM, read_part
from armscan.storage.recording import encoded_png, write_recording, written_session
from armscan.storage.recordings.read_mcap import check_new_file, record_source

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    processes: int,
    prepare: Callable[..., None],
    given: tuple[Any, ...],
    *,
    meanwhile: Callable[[], object] | None = None,
) -> Generator[Result]:
    """Results of ``work`` on every item, in order.

    When the generator is closed, or an interrupt ends it, the processes end too, without finishing
    their items.

    Parameters
    ----------
    work
        A function of a module, so that other processes find it.
    items
        What it is called with, one after the other.
    processes
        How many share the work.
    prepare, given
        Called in every process first, with these arguments.
    meanwhile
        Called in this process when the others have begun, before their first result is waited for.

    Raises
    ------
    EstimationError
        If one of the processes came to an end.
    """
    spawn = get_context("spawn")
    listener, held = spawn.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        processes, spawn, initializer=_begin, initargs=(listener, prepare, given)
    )
    try:
        with _deaf_children():
            waiting = deque(pool.submit(work, item) for item in items)
        if meanwhile is not None:
            meanwhile()
        while waiting:
            yield waiting.popleft().result()
    except BaseException as error:
        # nothing is cancelled: a pool whose processes end fails what waits, and a cancelled
        # element cannot be failed
        held.close()
        if isinstance(error, BrokenProcessPool):
            raise EstimationError(
                "a process that rendered images came to an end",
                remedy="free some memory, or let one process render",
            ) from error
        raise
    finally:
        pool.shutdown(wait=True)
        held.close()
        listener.close()


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Processes that are started meanwhile never hear an interrupt; this one hears it afterwards.

    It is for the process that waits, which ends the others.
    """
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_NICENESS = 5
"""The process that calibrates from what others render is the one that must not wait for a core."""


def _begin(listener: Connection, prepare: Callable[..., None], given: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        os.nice(_NICENESS)
    threading.Thread(target=_end_with, args=(listener,), daemon=True).start()
    # the processes share the cores already
    cv2.setNumThreads(1)
    prepare(*given)


def _end_with(listener: Connection) -> None:
    """End this process, in the middle of an item, as soon as the other end is closed or gone."""
    try:
        listener.recv_bytes()
    except EOFError:
        os._exit(1)


IMAGES_A_PROCESS = 15
"""Fewer do not pay: a process takes some seconds before its first image."""

MostViews: TypeAlias = Mapping[TwinScene, int | None]
"""Scenes in order, with the most views of each that are wanted; None for all."""

_here: list[Scenes] = []
"""The scenes of a rendering process; empty in any other process."""
_first: list[Lock] = []
"""Of a rendering process until its first image, during which it holds this: what is compiled for
that, the next process takes from the cache."""


@dataclass(frozen=True, slots=True)
class TwinName:
    """What a twin is built from, in any process."""

    head: str
    preset: Preset
    seed: int
    part: Path | None = None
    unit: str = "mm"

    def build(self) -> Twin:
        """Build it; the simulator is found by its name.

        Raises
        ------
        OptionError
            If there is no such head or preset.
        ArmscanError
            If there is a part, and it cannot be read or is not of a size to be scanned.
        """
        driver = load_driver("twin")
        given: dict[str, Any] = {"head": self.head, "preset": self.preset, "seed": self.seed}
        if self.part is not None:
            given["part_mm"] = scannable_part(self.part, self.unit).corners_mm
        return cast(Twin, driver(**given))


SMALLEST_PART_MM, LARGEST_PART_MM = 5.0, 500.0
"""Of the diagonal of a part that the twin scans: a smaller one shows less than a stripe of it, and
the simulated arm does not reach round a larger one."""


def scannable_part(path: Path, unit: str) -> PartModel:
    """A mesh for the twin to scan, in its own frame.

    Raises
    ------
    ArmscanError
        If it is no mesh, or so small or large that it seems to be in another unit.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(
            "the twin scans parts made of triangles",
            where="--part",
            remedy=f"give one of {', '.join(MESH_SUFFIXES)}",
        )
    part = read_part(path, unit=unit)
    if SMALLEST_PART_MM <= part.diagonal_mm <= LARGEST_PART_MM:
        return part
    others = [
        other
        for other, size in UNITS_MM.items()
        if SMALLEST_PART_MM <= part.diagonal_mm * size / UNITS_MM[unit] <= LARGEST_PART_MM
    ]
    raise InputError(
        f"the part measures {part.diagonal_mm:.4g} mm across in {unit}; the twin scans parts of "
        f"{SMALLEST_PART_MM:g} to {LARGEST_PART_MM:g} mm",
        where=str(path),
        remedy=f"give its unit, --unit {' or '.join(others)}" if others else "scale the part",
    )


@dataclass(frozen=True, slots=True, eq=False)
class Scenes:
    """Scans of one twin's scenes, each planned when it is first asked for.

    Parameters
    ----------
    twin
        What is looked through.
    most_views
        The scenes.
    """

    twin: Twin
    most_views: MostViews
    _planned: dict[TwinScene, ScanSource] = field(default_factory=dict, init=False)

    def scan(self, scene: TwinScene) -> ScanSource:
        """The views of a scene that are wanted."""
        if scene not in self._planned:
            whole, most = self.twin.scan(scene), self.most_views[scene]
            self._planned[scene] = whole if most is None else fewer_views(whole, most)
        return self._planned[scene]

    def png(self, scene: TwinScene, row: int) -> bytes:
        """Render one exposure."""
        source = self.scan(scene)
        setup = written_session(source).cameras[source.rows[row].camera]
        return encoded_png(source.exposure(row), setup)


def rendered(
    name: TwinName,
    scenes: Scenes,
    processes: int,
    meanwhile: Callable[[], object] | None = None,
) -> Generator[bytes]:
    """PNG files of all rows of all scenes, in order.

    Processes take image after image, whatever scene it is of, so that none waits for another's
    scene. When the generator is closed, or an interrupt ends it, so do they, without finishing
    their images.

    Parameters
    ----------
    name, scenes
        The twin, and what is wanted of it.
    processes
        Processes that render, if there are images enough; 1 renders in this one.
    meanwhile
        As for `in_processes`; not called where this process renders.

    Raises
    ------
    EstimationError
        If one of the processes came to an end.
    """
    rows = [(scene, k) for scene in scenes.most_views for k in range(len(scenes.scan(scene).rows))]
    n_processes = min(processes, max(1, len(rows) // IMAGES_A_PROCESS))
    if n_processes == 1:
        for scene, row in rows:
            yield scenes.png(scene, row)
        return
    given = (name, dict(scenes.most_views), get_context("spawn").Lock())
    start = (_start_rendering, given)
    yield from in_processes(_render, rows, n_processes, *start, meanwhile=meanwhile)


def _start_rendering(name: TwinName, most_views: MostViews, first: Lock) -> None:
    _here.append(Scenes(name.build(), most_views))
    _first.append(first)


def _render(row: tuple[TwinScene, int]) -> bytes:
    if _first:
        with _first.pop():
            return _here[0].png(*row)
    return _here[0].png(*row)


STAGE = "render images"


def recorded_scenes(
    folders: Mapping[TwinScene, Path],
    name: TwinName,
    most_views: MostViews | None = None,
    *,
    processes: int = 2,
    beside: Mapping[Path, bytes] | None = None,
    progress: Progress = silent,
    meanwhile: Callable[[], object] | None = None,
) -> Generator[tuple[TwinScene, ScanSource]]:
    """Render scenes of a twin and write each as a recording: a folder, or one file ``NAME.mcap``.

    Each recording is there complete or not at all. Those that come later are rendered while what is
    there is worked with.

    Parameters
    ----------
    folders
        The scenes, with the place of each, which must not exist or be an empty folder.
    name
        The twin.
    most_views
        The most views that are wanted of some of them.
    processes
        Processes that render. A script that asks for more than 1 needs the usual
        ``if __name__ == "__main__"``.
    beside
        Files that belong to the recordings; they appear with the first one.
    progress
        Told of every image.
    meanwhile
        Called in this process when the others have begun; not where this one renders.

    Yields
    ------
    tuple
        Each scene when it is recorded, and what was recorded as the twin has it.

    Raises
    ------
    OutputError
        If a folder holds something or cannot be written.
    EstimationError
        If a process that renders came to an end.
    """
    wanted = {scene: (most_views or {}).get(scene) for scene in folders}
    scenes = Scenes(name.build(), wanted)
    scans = {scene: scenes.scan(scene) for scene in folders}
    total, before = sum(len(scan.rows) for scan in scans.values()), 0

    def report(done: int, _total: int, item: str) -> None:
        progress(ProgressEvent(STAGE, before + done, total, item))

    with closing(rendered(name, scenes, processes, meanwhile)) as images:
        for scene, scan in scans.items():
            own = islice(images, len(scan.rows))
            files = beside if before == 0 else None
            write = record_source if _is_one_file(folders[scene]) else write_recording
            write(folders[scene], scan, report, encoded=own, beside=files)
            before += len(scan.rows)
            yield scene, scan


def record_scenes(
    folders: Mapping[TwinScene, Path],
    name: TwinName,
    most_views: MostViews | None = None,
    *,
    processes: int = 2,
    beside: Mapping[Path, bytes] | None = None,
    progress: Progress = silent,
) -> dict[TwinScene, ScanSource]:
    """Record all scenes before going on, and tell what was recorded; see `recorded_scenes`."""
    given = (folders, name, most_views)
    return dict(recorded_scenes(*given, processes=processes, beside=beside, progress=progress))


def record_touches(folder: Path, twin: Twin, beside: Mapping[Path, bytes] | None = None) -> int:
    """Write the twin's touches of the plate, and files that belong to them; returns their count.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    """
    probing = twin.probe_plate()
    tip = ProbeTip(probing.tool_from_probe_mm, probing.tip_diameter_mm)
    write_probing(folder, probing.arm, tip, is_simulated=True, beside=beside)
    return len(probing.arm)


@dataclass(frozen=True, slots=True)
class SimulateOptions:
    """What is simulated, and by how many processes.

    Parameters
    ----------
    preset
        How good the instrument and how kind the surroundings are.
    seed
        Everything random follows from it.
    processes
        Processes that render; 1 renders in this one. A script that asks for more needs the usual
        ``if __name__ == "__main__"``.
    part, unit
        A mesh in place of the workpiece, and the unit of its numbers; empty for the workpiece.
    """

    preset: Preset = "thesis"
    seed: int = 1
    processes: int = 2
    part: str = ""
    unit: str = "mm"

    def __post_init__(self) -> None:
        if self.preset not in get_args(Preset):
            raise OptionError(
                f"no preset is called '{self.preset}'",
                remedy=f"choose one of: {', '.join(get_args(Preset))}",
            )
        if self.seed < 0:
            raise OptionError(f"seed {self.seed} is negative", remedy="give 0 or more")
        if not 1 <= self.processes <= 64:
            raise OptionError(f"{self.processes} processes", remedy="give 1 to 64")


@dataclass(frozen=True, slots=True)
class SimulatedScene:
    """What was written.

    Parameters
    ----------
    folder
        The recording.
    truth
        What it was made from.
    n_images, n_arm_samples
        What it holds.
    target
        The calibration target, as the command line names it.
    n_cameras
        Cameras that took the images.
    sources
        Laser sources that were on in any of them.
    notes
        What is odd about the part, in words.
    """

    folder: Path
    truth: Path
    n_images: int
    n_arm_samples: int
    target: str
    n_cameras: int = 0
    sources: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def truth_path(folder: Path) -> Path:
    """``NAME.truth.json`` beside ``NAME`` or ``NAME.mcap``: truth never travels in a recording.

    Raises
    ------
    OutputError
        If the folder is a root.
    """
    # "." and "a/.." have no name of their own
    named = folder if folder.name not in ("", "..") else folder.resolve()
    if not named.name:
        raise OutputError("a root has no name", where=str(folder), remedy="name a new folder")
    name = named.stem if _is_one_file(named) else named.name
    return named.with_name(f"{name}.truth.json")


def _is_one_file(place: Path) -> bool:
    return place.suffix.lower() == RECORDING_SUFFIX


def simulate_scene(
    folder: Path,
    head: str,
    scene: TwinScene,
    options: SimulateOptions | None = None,
    progress: Progress = silent,
) -> SimulatedScene:
    """Write a scene of the twin as a recording, and its truth beside it.

    Parameters
    ----------
    folder
        Must not exist, or be an empty folder; one file if its name ends in ``.mcap``.
    head
        Name of the head.
    scene
        What it looks at; ``probing`` gives no images, but touches of the plate.
    options
        Preset, seed, processes.
    progress
        Called after each image.

    Raises
    ------
    OutputError
        If a result exists or cannot be written.
    OptionError
        If there is no such head, or a part for another scene.
    InputError
        If the part is empty, or seems to be in another unit.
    EstimationError
        If a process that renders came to an end.
    """
    settings = SimulateOptions() if options is None else options
    if settings.unit != "mm" and not settings.part:
        raise OptionError("a unit is that of a part", where="--unit", remedy="give --part with it")
    if settings.part and scene != "workpiece":
        raise OptionError(
            f"a part goes with the scene workpiece, not {scene}",
            where="--part",
            remedy="leave it out, or simulate the scene workpiece",
        )
    truth = truth_path(folder)
    if _is_one_file(folder) and scene == "probing":
        raise OptionError(
            "touches have no images, which a recording in one file is of",
            where=path_text(folder),
            remedy="name a folder",
        )
    (check_new_file if _is_one_file(folder) else check_new_folder)(folder)
    if truth.is_file():
        raise OutputError(
            "the truth of an earlier recording is there",
            where=str(truth),
            remedy="remove it, or name another folder",
        )
    check_outputs((truth,))
    part = Path(settings.part) if settings.part else None
    name = TwinName(head, settings.preset, settings.seed, part, settings.unit)
    twin = name.build()
    beside = {truth: _truth_of(twin, scene, part, settings.unit)}
    if scene == "probing":
        n_touches = record_touches(folder, twin, beside)
        return SimulatedScene(folder, truth, 0, n_touches, twin.target)
    source = record_scenes(
        {scene: folder}, name, processes=settings.processes, beside=beside, progress=progress
    )[scene]
    return SimulatedScene(
        folder,
        truth,
        n_images=len(source.rows),
        n_arm_samples=0 if source.arm is None else len(source.arm),
        target=twin.target,
        n_cameras=len({row.camera for row in source.rows}),
        sources=tuple(dict.fromkeys(name for row in source.rows for name in row.lasers)),
        notes=() if part is None else scannable_part(part, settings.unit).notes,
    )


def _truth_of(twin: Twin, scene: TwinScene, part: Path | None, unit: str) -> bytes:
    """The truth's document for a scene; of a part that was given also which file it is, its unit.

    Its place is ``base_from_workpiece``.
    """
    if part is None:
        return twin.truth.document(scene)
    content = json.loads(twin.truth.document(scene))
    content["part"] = {**asdict(fingerprint(part)), "unit": unit}
    return json_bytes(content)


@dataclass(frozen=True, slots=True, eq=False)
class ScanPart:
    """See `armscan.devices.sources.ScanSource`; its rows keep the numbers that they have.

    Parameters
    ----------
    whole
        The scan.
    kept
        Rows that are kept, increasing.
    """

    whole: ScanSource
    kept: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the whole scan."""
        return self.whole.name

    @property
    def session(self) -> Session:
        """Session of the whole scan."""
        return self.whole.session

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """The rows that are kept."""
        return tuple(self.whole.rows[row] for row in self.kept)

    @property
    def arm(self) -> ArmTrack | None:
        """All samples of the arm."""
        return self.whole.arm

    @property
    def is_simulated(self) -> bool:
        """As the whole scan."""
        return self.whole.is_simulated

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]``."""
        return self.whole.exposure(self.kept[row])


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPart(ScanPart):
    """Some rows of a simulated scan; see `armscan.devices.sources.SimulatedScan`."""

    whole: SimulatedScan

    def expose(self, row: int, lasers: tuple[str, ...]) -> Exposure:
        """Take the exposure of ``rows[row]`` with other lasers on."""
        return self.whole.expose(self.kept[row], lasers)

    def true_pose(self, row: int) -> Pose[Base, Sensor]:
        """True pose of ``rows[row]``."""
        return self.whole.true_pose(self.kept[row])

    def true_stripes(self, row: int) -> Sequence[TrueStripe]:
        """The true stripes of ``rows[row]``."""
        return self.whole.true_stripes(self.kept[row])


def fewer_views(source: ScanSource, n_views: int) -> ScanPart:
    """Evenly chosen views of a scan, all if it has no more; those of one instant stay together.

    Raises
    ------
    OptionError
        If ``n_views`` is not positive.
    """
    if n_views < 1:
        raise OptionError(f"{n_views} views", remedy="keep at least one")
    names = [f"at {row.t_ns}" if row.view is None else row.view for row in source.rows]
    views = list(dict.fromkeys(names))
    places = np.linspace(0, len(views) - 1, min(n_views, len(views))).round().astype(int)
    kept = {views[k] for k in places}
    return ScanPart(source, tuple(k for k, name in enumerate(names) if name in kept))
