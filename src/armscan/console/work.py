# SPDX-License-Identifier: Apache-2.0
"""The jobs of a session's steps, and a process of its own that runs them and can be killed.

Jobs write all or nothing, so that whoever ends the process leaves a whole session behind.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar, cast

from armscan.calibration.cameras.pairs import SIDES
from armscan.console.journey import (
    BY_NAME,
    INSPECTIONS,
    OF_A_SCAN,
    REPORT_FILE,
    RESULTS,
    SETTING,
    SETTINGS_FILE,
    STEPS,
    TIMED_FILE,
    WORDS,
    Journey,
    SessionSettings,
    StepName,
    StepResult,
    Verdict,
    read_settings,
    result_key,
)
from armscan.errors import ArmscanError, EstimationError, FileFormatError, OptionError
from armscan.jobs.camera import calibrate_camera
from armscan.jobs.hand_eye import Artefact, StripeSource, calibrate_hand_eye, calibrate_latency
from armscan.jobs.inspection.cad import inspect_cad
from armscan.jobs.inspection.shapes import inspect_plane, inspect_sphere
from armscan.jobs.job import Job
from armscan.jobs.live.recordings import recover_recording
from armscan.jobs.probe import probe
from armscan.jobs.reconstruct import StillPaths, reconstruct
from armscan.jobs.sheets import SheetImages, calibrate_sheets
from armscan.jobs.stereo import calibrate_stereo
from armscan.jobs.verify import Standard, verify
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.report.page import Block, Facts, Links, Page, Section, footer, render_page
from armscan.report.quantity import Summary, fact, sentence
from armscan.storage.arm import ARM_FILE
from armscan.storage.documents import new_provenance
from armscan.storage.files import is_file, settle_aside, write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.recording import read_recording
from armscan.storage.recording_session import EXPOSURES_FILE
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.targets.target import Target, parse_target

Result = TypeVar("Result")
LEAST_LINE = 50
"""A laser line of fewer points crosses the target or the plate hardly at all."""


class WorkCancelledError(ArmscanError):
    """A person ended the work; nothing was written."""


class Worker:
    """One process that runs one piece of work after the other; started when it is first needed.

    It stays, so that only the first work waits for its imports.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: BaseProcess | None = None
        self._link: Connection | None = None
        self._is_cancelled = False

    @property
    def pid(self) -> int | None:
        """Number of the process; None while there is none."""
        return None if self._process is None else self._process.pid

    @property
    def is_busy(self) -> bool:
        """Whether work is under way."""
        return self._lock.locked()

    def prepare(self) -> None:
        """Start the process ahead of its first work."""
        if self._process is None or not self._process.is_alive():
            context = get_context("spawn")
            self._link, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs,), daemon=True)
            process.start()
            self._process = process
            theirs.close()

    def run(self, work: Callable[..., Result], *given: Any, progress: Progress = silent) -> Result:
        """Run a function of a module with ``progress`` as its keyword, and wait for its result.

        Raises
        ------
        WorkCancelledError
            If `cancel` was called meanwhile.
        EstimationError
            If the process came to an end, or the work failed by a bug.
        ArmscanError
            What the work raised, or that other work is under way.
        """
        if not self._lock.acquire(blocking=False):
            raise EstimationError("other work is under way", remedy="wait for it or cancel it")
        try:
            self._is_cancelled = False
            self.prepare()
            return cast(Result, self._wait(work, given, progress))
        except (EOFError, OSError) as error:
            self.close()
            if self._is_cancelled:
                raise WorkCancelledError("the work was cancelled; nothing was written") from error
            raise EstimationError(
                "the process that calculated came to an end, and nothing was written",
                remedy="start it once more; if it happens again, free some memory",
            ) from error
        finally:
            self._lock.release()

    def cancel(self) -> None:
        """End the work that is under way, at once."""
        if self.is_busy and self._process is not None:
            self._is_cancelled = True
            self._process.kill()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join(5.0)
        if self._link is not None:
            self._link.close()
        self._process = self._link = None

    def _wait(self, work: Callable[..., Any], given: tuple[Any, ...], progress: Progress) -> object:
        if self._link is None:
            raise EOFError
        self._link.send((work, given))
        while True:
            kind, content = self._link.recv()
            if kind == "progress":
                progress(content)
            elif kind == "error":
                raise content
            elif kind == "bug":
                raise EstimationError(
                    f"this is a bug in armscan ({content})", remedy="report it with the session"
                )
            else:
                return content


def _serve(link: Connection) -> None:
    """Do what is asked for until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asked: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
    ready = threading.Semaphore(0)

    def listen() -> None:
        while True:
            try:
                asked.append(link.recv())
            except (EOFError, OSError):
                # the console is gone: what is under way would write behind the next one's back
                os._exit(1)
            ready.release()

    threading.Thread(target=listen, daemon=True).start()
    while True:
        ready.acquire()
        link.send(_done(*asked.pop(), link))


def _done(work: Callable[..., Any], given: tuple[Any, ...], link: Connection) -> tuple[str, object]:
    def tell(event: ProgressEvent) -> None:
        link.send(("progress", event))

    try:
        return "done", work(*given, progress=tell)
    except ArmscanError as error:
        return "error", error
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return "error", EstimationError(f"{place}{error.strerror or error}")
    except Exception as error:
        return "bug", f"{type(error).__name__}: {error}"


def run_step(
    folder: Path,
    step: StepName,
    scan: str = "",
    compare: str = INSPECTIONS[0],
    progress: Progress = silent,
) -> StepResult:
    """Run a step's job on what was taken, and keep what it says in the session.

    ``compare``: what an inspection compares with, one of `INSPECTIONS`.

    Returns
    -------
    StepResult
        Also where the job refused: a refusal is a result with its sentence.

    Raises
    ------
    ArmscanError
        If the session cannot be read or written.
    """
    journey = Journey(folder, read_settings(folder / SETTINGS_FILE))
    known = BY_NAME[step]
    if known.filling == "placements" and (n := journey.n_taken(step)) < known.least:
        raise OptionError(
            f"{n} of {len(known.placements)} placements are taken",
            where=known.title,
            remedy=f"take at least {known.least}, better all",
        )
    if known.filling == "motion" and not journey.n_taken(step, scan):
        raise OptionError(
            "none of the exposures can be used: passes were taken back, parts of images were lost, "
            "or the clocks of the devices were not known",
            where=scan or known.title,
            remedy="scan once more; without a trigger in common at ten images a second or more",
        )
    inputs = [path for path in _inputs(journey, step, scan, compare) if is_file(path)]
    names = [
        (path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix()
        for path in inputs
    ]
    if journey.settings.needs_latency and step in (StepName.CHECK, StepName.SCAN):
        # a latency that is found later changes the scanner, too
        names = [TIMED_FILE if name == journey.scanner_file.name else name for name in names]
    used = USED.get(step, ()) if step is not StepName.INSPECT else USED_TO_COMPARE[compare]
    rests_on = {name: journey.digest(name) for name in (*names, *(SETTING + key for key in used))}
    try:
        result = _judged(step, _work(journey, step, scan, compare, progress))
    except ArmscanError as error:
        result = StepResult("not good", (_reason(error),))
        if isinstance(error, OptionError):
            result = replace(result, next_step="Correct that above, and calculate again.")
        result = replace(result, written=_refusal(journey, step, scan))
    written = tuple(
        Path(name).relative_to(folder).as_posix() if Path(name).is_absolute() else name
        for name in result.written
    )
    advice = result.next_step or _advice(journey, step, result)
    result = replace(result, written=written, rests_on=rests_on, next_step=advice)
    place = folder / RESULTS / f"{result_key(step, scan)}.json"
    place.parent.mkdir(exist_ok=True)
    write_files({place: json.dumps(asdict(result), indent=1).encode()}, is_overwriting=True)
    write_report(journey)
    return result


def recover_scans(folder: Path, progress: Progress = silent) -> tuple[str, ...]:
    """Make recordings that were cut short whole again, with all exposures that are.

    Nobody may record into the session meanwhile; what takes a file's place all the same stays.

    Returns
    -------
    told
        A sentence for each; one of which nothing can be used is laid aside as ``NAME.aside``, and
        the one that it was to replace is there again.

    Raises
    ------
    OutputError
        If the disk is full or refuses; nothing is lost then.
    """
    said = []
    for path in Journey(folder, SessionSettings()).cut_short:
        whole, before = path.with_name(f".{path.name}"), _which(path)
        try:
            found = recover_recording(path, whole, is_overwriting=True)
        except FileFormatError as error:
            if _which(path) == before:
                aside = path.with_suffix(".aside")
                path.replace(aside)
                lies = f"it lies in {aside.name}"
                said.append(f"{path.stem} was cut short, and {error.what}: {lies}.")
                settle_aside(path)
            continue
        if _which(path) != before:
            whole.unlink()
            continue
        whole.replace(path)
        settle_aside(path)
        n = next(one.value for one in found.quantities if one.key == "exposures")
        saved = "its one exposure was" if n == 1 else f"its {n} exposures were"
        said.append(f"{path.stem} was cut short: {saved} saved.")
    return tuple(said)


def _which(path: Path) -> tuple[int, ...]:
    """Which file it is and how far it was written; nothing where there is none."""
    with suppress(OSError):
        found = path.stat()
        return found.st_ino, found.st_size, found.st_mtime_ns
    return ()


def seen_in_take(folder: Path, step: StepName, progress: Progress = silent) -> tuple[bool, str]:
    """Whether what was taken last is of use, and what is seen in it, in words.

    ``step``: camera, light sheets or hand-eye.
    """
    journey = Journey(folder, read_settings(folder / SETTINGS_FILE))
    source = read_recording(journey.recording(step))
    rows = source.rows
    latest = [k for k, row in enumerate(rows) if row.arrangement == rows[-1].arrangement]
    by_camera: dict[int, list[Exposure]] = {}
    for k in latest:
        by_camera.setdefault(source.rows[k].camera, []).append(source.exposure(k))
    target = parse_target(journey.settings.target) if step in OF_TARGET else None
    found = [_seen_by_one(by_camera[camera], step, target) for camera in sorted(by_camera)]
    words = [one.words for one in found]
    if len(words) > 1:
        words = [f"in the {side} image: {text}" for side, text in zip(SIDES, words, strict=True)]
    is_whole = not any(one.lacks for one in found)
    # a sheet is calibrated by what either camera sees of it
    lines = {source.rows[k].lasers for k in latest if source.rows[k].lasers}
    shown = {lasers for one in found if one.has_target for lasers in one.lines}
    if not is_whole and not (step is StepName.LASER and lines and lines <= shown):
        return False, f"{sentence('; '.join(words))} Take it back and once more."
    rest = "" if is_whole else " One of the two images is enough for each line."
    return True, f"Seen{' ' if len(words) > 1 else ': '}{'; '.join(words)}.{rest}"


OF_TARGET = (StepName.CAMERA, StepName.LASER)


@dataclass(slots=True)
class _SeenByOne:
    """What one camera's images of a take show and lack, and of which lasers lines are seen."""

    has_target: bool = False
    lines: set[tuple[str, ...]] = field(default_factory=set)
    seen: list[str] = field(default_factory=list)
    lacks: list[str] = field(default_factory=list)

    @property
    def words(self) -> str:
        """What is lacking; if nothing is, what is seen."""
        return "; ".join(self.lacks) if self.lacks else " and ".join(self.seen)


def _seen_by_one(
    exposures: Sequence[Exposure], step: StepName, target: Target | None
) -> _SeenByOne:
    one = _SeenByOne()
    if target is not None:
        found = find_targets([image for image in exposures if not image.lasers], target)
        one.has_target = bool(found.views)
        one.seen += [f"{len(view.points_px)} points of the target" for view in found.views]
        one.lacks += [reason for _, reason in found.not_found]
    if step in (StepName.LASER, StepName.HAND_EYE):
        lit = [image for image in exposures if image.lasers]
        n = [len(extract_stripes(image).points_px) for image in lit]
        counts = [count for count in n if count >= LEAST_LINE]
        each = " in each image" if len(counts) > 1 else ""
        one.lines = {image.lasers for image, k in zip(lit, n, strict=True) if k >= LEAST_LINE}
        one.seen += [f"a laser line of {min(counts)} points{each}"] if counts else []
        dark = [" and ".join(image.lasers) for image in lit if image.lasers not in one.lines]
        if dark or not lit:
            of = f" of {', '.join(dark)}" if dark and one.lines else ""
            one.lacks.append(f"no laser line{of} is seen: look at laser, exposure and distance")
    return one


USED: Mapping[StepName, tuple[str, ...]] = {
    StepName.CAMERA: ("target",),
    StepName.LASER: ("target",),
    StepName.CHECK: ("ball_mm",),
}
USED_TO_COMPARE = dict(zip(INSPECTIONS, (("part", "tolerance"), (), ("ball_mm",)), strict=True))
"""Settings that steps, and the inspection by what it compares with, make use of."""


def _inputs(journey: Journey, step: StepName, scan: str, compare: str) -> list[Path]:
    place = journey.recording(step, scan)
    own = [place / EXPOSURES_FILE, place / ARM_FILE]
    folder, part = journey.folder, journey.settings.part
    standards = [[folder / part] if part else [], [folder / "plate.csv"], []]
    rest: dict[StepName, list[Path]] = {
        StepName.LASER: [journey.camera_file],
        StepName.HAND_EYE: [folder / "sensor.json", folder / "plate.csv"],
        StepName.LATENCY: [folder / "scanner.json"],
        StepName.CHECK: [journey.scanner_file],
        StepName.SCAN: [journey.scanner_file],
        StepName.INSPECT: [journey.cloud_file(scan), *standards[INSPECTIONS.index(compare)]],
    }
    return [*([] if step is StepName.INSPECT else own), *rest.get(step, [])]


def _work(journey: Journey, step: StepName, scan: str, compare: str, progress: Progress) -> Summary:
    """Run the job of a step."""
    folder, settings, place = journey.folder, journey.settings, journey.recording(step, scan)

    def job(name: str) -> Job:
        command = ("armscan", "console", step.value, *((scan,) if scan else ()))
        return Job(folder / name, is_overwriting=True, command=command, progress=progress)

    def scanned() -> Summary:
        paths, seeing = StillPaths((str(place),)), settings.seeing
        options = None if seeing is None else seeing.options.measure
        return reconstruct(job(f"{scan}.ply"), journey.scanner_file, paths, options=options)

    def camera() -> Summary:
        if settings.n_cameras > 1:
            return calibrate_stereo(job("stereo.json"), settings.target, scan=place)
        return calibrate_camera(job("camera.json"), settings.target, scan=place)

    def laser() -> Summary:
        images = SheetImages(scan=place)
        return calibrate_sheets(job("sensor.json"), journey.camera_file, settings.target, images)

    def hand_eye() -> Summary:
        source = StripeSource(scans=(place,), sensor=folder / "sensor.json")
        return calibrate_hand_eye(job("scanner.json"), source, Artefact(plate=folder / "plate.csv"))

    works: dict[StepName, Callable[[], Summary]] = {
        StepName.CAMERA: camera,
        StepName.LASER: laser,
        StepName.PROBING: lambda: probe(job("plate.csv"), place),
        StepName.HAND_EYE: hand_eye,
        StepName.LATENCY: lambda: calibrate_latency(
            job(TIMED_FILE), place, folder / "scanner.json"
        ),
        StepName.CHECK: lambda: verify(
            job("check.html"), place, journey.scanner_file, Standard(ball_mm=settings.ball_mm)
        ),
        StepName.SCAN: scanned,
        StepName.INSPECT: lambda: _inspected(journey, scan, compare, job),
    }
    return works[step]()


def _inspected(journey: Journey, scan: str, compare: str, job: Callable[[str], Job]) -> Summary:
    cloud, settings = journey.cloud_file(scan), journey.settings
    if compare == "plate":
        return inspect_plane(job(f"{scan}-plate.html"), cloud, plate=journey.folder / "plate.csv")
    if compare == "ball":
        return inspect_sphere(job(f"{scan}-ball.html"), cloud, settings.ball_mm)
    if not settings.part:
        raise OptionError("no model of the part is named", remedy="give its STL or STEP file")
    part = journey.folder / settings.part
    return inspect_cad(job(f"{scan}-cad.html"), cloud, part, tolerance=settings.tolerance)


def _judged(step: StepName, summary: Summary) -> StepResult:
    verdict: Verdict = "doubtful" if summary.warnings or summary.forced else "good"
    said = summary.data.get("verdict")
    if step is StepName.CHECK and isinstance(said, str):
        verdict = {"still valid": verdict, "not valid": "not good"}.get(said, "doubtful")
    reasons = (*summary.forced, *summary.warnings)
    if step is StepName.CHECK and verdict != "good":
        reasons = (sentence(f"the check says: {said}"), *reasons)
    if step is StepName.INSPECT and said in ("fail", "undecided"):
        verdict = "not good" if said == "fail" else "doubtful"
        reasons = (sentence(f"the part's verdict is {said}"), *reasons)
    values = tuple((item.label, item.line) for item in summary.quantities if item.label)
    written = tuple(path.as_posix() for path in summary.written)
    return StepResult(verdict, tuple(reasons), values, written)


def _refusal(journey: Journey, step: StepName, scan: str) -> tuple[str, ...]:
    """The page of a run that was refused, if it wrote one."""
    names = {
        StepName.CAMERA: journey.camera_file.stem,
        StepName.LASER: "sensor",
        StepName.HAND_EYE: "scanner",
    }
    page = journey.folder / f"{names.get(step, scan)}.refused.html"
    return (page.as_posix(),) if page.is_file() else ()


NOT_GOOD = {
    StepName.CAMERA: "Look at 'Target' first, then at the photographs: take blurred ones again.",
    StepName.LASER: "Is the laser on, and the target the camera's? Take again what is named above.",
    StepName.PROBING: "Has the plate or the arm's base moved? Start over with firm touches.",
    StepName.HAND_EYE: "If the plate or the arm's base may have moved since the first touch, start "
    "over in 'Touch the plate', then here. If not, take again what is named above, or start over.",
    StepName.CHECK: "Clean the ball and the lenses and scan it once more; then calibrate anew.",
    StepName.INSPECT: "Open the report to see where.",
}
"""What most often helps where a step's job refuses or its verdict is bad."""


def _reason(error: ArmscanError) -> str:
    """A failure without what only a command line can do; the page is linked beside it."""
    remedies = [
        part
        for part in error.remedy.split("; ")
        if part and " --" not in f" {part}" and "shows what was found" not in part
    ]
    where = f"{error.where}: " if error.where and not error.where.startswith("--") else ""
    return sentence("; ".join([f"{where}{error.what}", *remedies]))


def _advice(journey: Journey, step: StepName, result: StepResult) -> str:
    if result.verdict == "not good":
        return NOT_GOOD.get(step, "Take again what the sentence above names, or start over.")
    order = [one.name for one in journey.steps]
    place = order.index(step) + 1
    following = f"Go on with '{BY_NAME[order[place]].title}'." if place < len(order) else ""
    if result.verdict == "doubtful":
        rest = f" If they do not matter: {following[0].lower()}{following[1:]}" if following else ""
        left = len(BY_NAME[step].placements) - journey.n_taken(step)
        if step is StepName.CHECK:
            again = "Read the remarks above and scan the ball once more, from more sides."
            return f"{again}{rest.replace('they', 'the remarks', 1)}"
        if left > 0:
            others = "the other one" if left == 1 else f"the other {left}"
            return f"Take {others} and calculate again: few leave most remarks.{rest}"
        return f"Read the remarks above.{rest}"
    return following or "The report is ready."


def write_report(journey: Journey) -> Path:
    """Write the session's page: every step, its verdict and values, and links to its own page."""
    sections = []
    for step in journey.steps:
        for scan in journey.scans if step.name in OF_A_SCAN else ("",):
            state = journey.state(step.name, scan)
            result = state.result
            if result is None:
                continue
            title = f"{step.title} {scan}".strip()
            verdict = "old" if state.status == "old" else result.verdict
            heading = fact("Result", WORDS[verdict], state.why)
            facts = (heading, *(fact(label, text) for label, text in result.values))
            why = tuple(fact("Remark", text) for text in result.reasons)
            blocks: list[Block] = [Facts((*facts, *why))]
            if result.page:
                blocks.append(Links(((result.page, "All about it"),)))
            sections.append(Section(title, tuple(blocks)))
    files = [journey.folder / SETTINGS_FILE]
    places = [journey.recording(step.name) for step in STEPS if step.name not in OF_A_SCAN]
    places += [journey.recording(StepName.SCAN, scan) for scan in journey.scans]
    tables = [place / EXPOSURES_FILE for place in places]
    provenance = new_provenance(files, command=("armscan", "console", journey.folder.name))
    page = Page(
        title=f"Session {journey.folder.resolve().name}",
        subtitle="From calibration to inspection, step by step",
        cards=(),
        warnings=(),
        sections=tuple(sections),
        is_simulated=are_simulated([path for path in tables if is_file(path)]),
        footer=footer(provenance),
    )
    path = journey.folder / REPORT_FILE
    write_files({path: render_page(page)}, is_overwriting=True)
    return path


def told(error: BaseException) -> str:
    """The one sentence about a failure."""
    if isinstance(error, ArmscanError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'the disk'}: {error.strerror or error}."
    return f"this is a bug in armscan ({type(error).__name__}: {error})."
