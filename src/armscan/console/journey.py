# SPDX-License-Identifier: Apache-2.0
"""The way from an empty folder to a report: its steps as data, their state as it lies on disk.

A session can be closed and opened again at any step. Every step fills a recording, runs one job on
it, and keeps what came out with what it rests on, so that an older result is known as old.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from armscan.console.placements import CAMERA, HAND_EYE, LASER, TOUCHES, Placement
from armscan.errors import ArmscanError, FileFormatError, OptionError, OutputError
from armscan.pipeline.live.exposure import ExposureSettings
from armscan.pipeline.live.rig import RigDescription
from armscan.pipeline.live.session import LiveOptions
from armscan.pipeline.measure import MeasureOptions
from armscan.report.quantity import plural
from armscan.storage.arm import ARM_FILE
from armscan.storage.codec import MismatchError, RecordCodec, parse_toml, toml_bytes
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.files import files_in, is_file, make_folder, path_text, read_bytes, write_files
from armscan.storage.recording_session import EXPOSURES_FILE, exposure_rows
from armscan.storage.tables import read_csv
from armscan.vision.stripe.image import StripeOptions

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows has none
    fcntl = None  # type: ignore[assignment]

SETTINGS_FILE, LOCK_FILE, REPORT_FILE = "console.toml", ".console.lock", "report.html"
RECORDINGS, RESULTS = "recordings", "results"
SETTING = f"{SETTINGS_FILE}: "
"""Before the key of a setting that a result rests on."""
TIMED_FILE = "scanner-timed.json"
MOVED = ".mcap"
"""Of a recording that was taken while the hand moved."""


class StepName(StrEnum):
    """The steps in their order."""

    CAMERA = "camera"
    LASER = "laser"
    PROBING = "probing"
    HAND_EYE = "hand-eye"
    LATENCY = "latency"
    CHECK = "check"
    SCAN = "scan"
    INSPECT = "inspect"


Filling = Literal["placements", "touches", "motion", "nothing"]
"""How a step's recording comes about: one by one, touch by touch, or while the hand moves."""
Verdict = Literal["good", "doubtful", "not good"]
Status = Literal["waiting", "open", "ready", "good", "doubtful", "not good", "old"]
WORDS: Mapping[str, str] = {
    "waiting": "waits",
    "open": "to do",
    "ready": "can be calculated",
    "good": "good",
    "doubtful": "with remarks",
    "not good": "not good",
    "old": "out of date",
}
"""What people read of a status."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the journey.

    Parameters
    ----------
    placements
        What is to be taken, one after the other; empty where the hand moves freely.
    least
        With fewer of them the job is not worth a try.
    needs
        Steps whose documents it rests on.
    """

    name: StepName
    title: str
    to_do: str
    filling: Filling
    placements: tuple[Placement, ...] = ()
    least: int = 1
    needs: tuple[StepName, ...] = ()
    is_optional: bool = False


STEPS: tuple[Step, ...] = (
    Step(
        StepName.CAMERA,
        "Camera",
        "Lock focus and aperture. Hold the target before the camera as drawn, keep it still, and "
        "take a photograph. It should be sharp, without reflections, and wholly in the image.",
        "placements",
        CAMERA,
        least=8,
    ),
    Step(
        StepName.LASER,
        "Light sheets",
        "Put the target where you will scan, as drawn, so that the laser line crosses it. Each "
        "take makes one image with the laser and one without: nothing may move between them.",
        "placements",
        LASER,
        least=6,
        needs=(StepName.CAMERA,),
    ),
    Step(
        StepName.PROBING,
        "Touch the plate",
        "Fix a flat, matt plate to the table. Touch it with the arm's probe where drawn, always "
        "from above, hold still, and take. Leave the scanner mounted, and do not reference the arm "
        "anew until the hand-eye is done.",
        "touches",
        TOUCHES,
        least=8,
    ),
    Step(
        StepName.HAND_EYE,
        "Hand-eye",
        "Point the head at the plate that you touched, roughly as drawn: what counts is that the "
        "postures differ as much. All of the laser line that the camera sees must lie on the "
        "plate. Hold the arm still and take. The plate and the arm's base must not move from the "
        "first touch to the last take.",
        "placements",
        HAND_EYE,
        least=6,
        needs=(StepName.LASER, StepName.PROBING),
    ),
    Step(
        StepName.LATENCY,
        "Latency",
        "Only where camera and arm have no trigger in common. Start, and over the plate move the "
        "head nearer and away by 10 mm or more, about once a second and unevenly, for ten seconds, "
        "and slowly sideways meanwhile. Keep the line on the plate and the range bar in the green; "
        "then finish.",
        "motion",
        needs=(StepName.HAND_EYE,),
        is_optional=True,
    ),
    Step(
        StepName.CHECK,
        "Daily check",
        "Put the reference ball on the table and write its certified diameter into 'Ball, mm'. "
        "Start, scan it from above and from four sides, and finish. This says whether the scanner "
        "is still what its calibration says: do it every day, and after a knock.",
        "motion",
        needs=(StepName.HAND_EYE,),
    ),
    Step(
        StepName.SCAN,
        "Scan",
        "Scan the part: start, move the line over it in even passes, and keep the range bar in the "
        "green. Pause to put the arm elsewhere. A pass that went wrong can be taken back. Finish "
        "makes the points.",
        "motion",
        needs=(StepName.HAND_EYE,),
    ),
    Step(
        StepName.INSPECT,
        "Inspect",
        "Choose a scan and what it is compared with.",
        "nothing",
        needs=(StepName.SCAN,),
    ),
)
BY_NAME: Mapping[StepName, Step] = {step.name: step for step in STEPS}
OF_TWO_CAMERAS = {
    StepName.CAMERA: "Both cameras must see all of it: look at both images.",
    StepName.LASER: "Of many lines each one has to cross the target near and far, left and right. "
    "It is enough that one of the two cameras sees line and target.",
    StepName.HAND_EYE: "Both cameras must see the lines: look at both images.",
}
"""What a head with two cameras asks for besides."""


@dataclass(frozen=True, slots=True)
class SeeingSettings:
    """How the cameras look at the laser's line, and how it is found; most keys are ``rig.toml``'s.

    ``photo_us`` is the exposure time of photographs of the target; 0 for the camera's own. The rest
    as of `armscan.pipeline.live.rig.RigDescription` and
    `armscan.pipeline.live.session.LiveOptions`.
    """

    windows: tuple[tuple[int, int, int, int], ...] = ()
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    stripes: StripeOptions = field(default_factory=StripeOptions)
    photo_us: float = 0.0
    voxel_mm: float = 0.5
    measured_every: int = 1

    @staticmethod
    def of(rig: RigDescription) -> SeeingSettings:
        """What the description of a rig says."""
        return SeeingSettings(rig.windows, rig.exposure, rig.stripes)

    def set_in(self, rig: RigDescription) -> RigDescription:
        """The description of a rig with these in place of its own."""
        return replace(rig, windows=self.windows, exposure=self.exposure, stripes=self.stripes)

    @property
    def options(self) -> LiveOptions:
        """Those of a live scan."""
        return LiveOptions(
            MeasureOptions(stripes=self.stripes),
            voxel_mm=self.voxel_mm,
            measured_every=self.measured_every,
            exposure=self.exposure,
        )


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """What is known of a session besides its recordings; the keys of ``console.toml``.

    Parameters
    ----------
    rig
        The rig that fills it: path of ``rig.toml``, or ``twin:HEAD?seed=1``; empty for none.
    target
        Specification of the calibration target.
    n_cameras
        Cameras of the head.
    ball_mm
        Certified diameter of the reference ball.
    part
        Model of the part that scans are compared with; empty for none.
    tolerance
        As of ``armscan inspect cad``; empty for none.
    needs_latency
        Camera and arm have no trigger in common.
    seeing
        In place of what the rig's description says; None for that.
    """

    rig: str = ""
    target: str = ""
    n_cameras: int = 1
    ball_mm: float = 0.0
    part: str = ""
    tolerance: str = ""
    needs_latency: bool = False
    seeing: SeeingSettings | None = None


@dataclass(frozen=True, slots=True)
class StepResult:
    """What a step's job said.

    Parameters
    ----------
    reasons
        Why it is not good, or what to look at, as sentences.
    values
        (label, value and meaning) as the report shows them.
    written
        Files, relative to the session.
    rests_on
        SHA-256 of every input, by its path relative to the session, and of each setting that was
        used, by its key behind `SETTING`; older results have no settings.
    """

    verdict: Verdict
    reasons: tuple[str, ...] = ()
    values: tuple[tuple[str, str], ...] = ()
    written: tuple[str, ...] = ()
    rests_on: Mapping[str, str] | None = None
    next_step: str = ""

    @property
    def page(self) -> str:
        """Its page, relative to the session; empty for none."""
        return next((name for name in self.written if name.endswith(".html")), "")


@dataclass(frozen=True, slots=True)
class StepState:
    """Where a step stands.

    Parameters
    ----------
    status
        ``waiting`` for an earlier step, ``open`` to be filled, ``ready`` to be calculated, the
        result's verdict, or ``old``: what it rests on has changed.
    n_taken
        Placements or touches that are taken.
    result
        The latest result, also an old one.
    why
        What it waits for, why it is old, or what is wrong with a step before it.
    """

    status: Status
    n_taken: int
    result: StepResult | None = None
    why: str = ""


INSPECTIONS = ("CAD model", "plate", "ball")
"""What a scan can be compared with."""


class Journey:
    """A session folder, with its settings as written there; see `open_journey`."""

    def __init__(self, folder: Path, settings: SessionSettings) -> None:
        self.folder = folder
        self.settings = settings
        self._known: dict[tuple[Path, int, int], bool] = {}

    def change(self, **settings: Any) -> None:
        """Write other settings."""
        self.settings = replace(self.settings, **settings)
        content = toml_bytes(RecordCodec({}).write(self.settings))
        write_files({self.folder / SETTINGS_FILE: content}, is_overwriting=True)

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps that this session has."""
        return tuple(step for step in STEPS if not step.is_optional or self.settings.needs_latency)

    def recording(self, step: StepName, scan: str = "") -> Path:
        """What a step fills, of a scan by its name: a folder, or one file while the hand moves.

        Where there is no file, a folder of an earlier console or put there is read all the same.
        """
        place, file = self.folder / RECORDINGS / (scan or step.value), self.new_file(step, scan)
        is_one_file = BY_NAME[step].filling == "motion" or step in OF_A_SCAN
        return file if is_one_file and (file.is_file() or not place.is_dir()) else place

    def new_file(self, step: StepName, scan: str = "") -> Path:
        """Where a recording is written while the hand moves."""
        return self.folder / RECORDINGS / f"{scan or step.value}{MOVED}"

    @property
    def scans(self) -> tuple[str, ...]:
        """Names of the scans, in their order."""
        place = self.folder / RECORDINGS
        found = place.glob("scan-*") if place.is_dir() else []
        names = {one.name.removesuffix(MOVED) for one in found if self._has_exposures(one)}
        return tuple(sorted(names))

    def _has_exposures(self, place: Path) -> bool:
        """Whether a recording lists any; a file that did not change is not opened again."""
        if place.suffix != MOVED:
            return is_file(place / EXPOSURES_FILE)
        with suppress(OSError):
            facts = place.stat()
            key = place, facts.st_mtime_ns, facts.st_size
            if key not in self._known:
                self._known[key] = is_file(place / EXPOSURES_FILE)
            return self._known[key]
        return False

    @property
    def cut_short(self) -> tuple[Path, ...]:
        """Recordings whose end was not written, as of a console that was killed."""
        found = []
        for path in sorted((self.folder / RECORDINGS).glob(f"[!.]*{MOVED}")):
            try:
                files_in(path)
            except ArmscanError:
                found.append(path)
        return tuple(found)

    def new_scan(self) -> str:
        """A name that no scan has."""
        place = self.folder / RECORDINGS
        found = place.glob("scan-*") if place.is_dir() else []
        used = {one.name.partition(".")[0] for one in found}
        return next(name for k in range(1, 10_000) if (name := f"scan-{k:02d}") not in used)

    @property
    def camera_file(self) -> Path:
        """Calibration of the camera or cameras."""
        return self.folder / ("stereo.json" if self.settings.n_cameras > 1 else "camera.json")

    @property
    def scanner_file(self) -> Path:
        """The calibrated scanner: with latency where that is needed and was found for this one."""
        timed, plain = self.folder / TIMED_FILE, self.folder / "scanner.json"
        if self.settings.needs_latency and timed.is_file():
            with suppress(ArmscanError):
                inputs = read_scanner_calibration(timed).provenance.inputs
                if digest_of(plain) in [one.sha256 for one in inputs]:
                    return timed
        return plain

    def cloud_file(self, scan: str) -> Path:
        """Points of a scan."""
        return self.folder / f"{scan}.ply"

    def n_taken(self, step: StepName, scan: str = "") -> int:
        """Placements, touches or exposures that are on disk."""
        place = self.recording(step, scan)
        try:
            if BY_NAME[step].filling == "touches":
                return len(read_csv(place / ARM_FILE))
            rows, _ = exposure_rows(read_csv(place / EXPOSURES_FILE))
        except ArmscanError:
            return 0
        views = {str(row.t_ns) if row.view is None else f"view {row.view}" for row in rows}
        return len(views)

    def state(self, step: StepName, scan: str = "") -> StepState:
        """Where a step stands; of scan and inspection for one scan."""
        known, n_taken = BY_NAME[step], self.n_taken(step, scan)
        result = self.result(step, scan)
        if missing := self._missing(step, scan):
            what = f"'{BY_NAME[missing].title}' comes first"
            return StepState("waiting", n_taken, result, what)
        doubt, is_old = self._doubt_before(step, scan)
        if result is not None:
            changed = self._changed(result)
            if changed:
                why = f"{changed} has changed since: calculate again"
                return StepState("old", n_taken, result, why)
            return StepState("old" if is_old else result.verdict, n_taken, result, doubt)
        if known.filling == "nothing" or n_taken >= known.least:
            return StepState("ready", n_taken, why=doubt)
        return StepState("open", n_taken, why=doubt)

    def _missing(self, step: StepName, scan: str) -> StepName | None:
        """The first step whose document is missing; None if all that is needed is there."""
        for needed in BY_NAME[step].needs:
            if not self._document(needed, scan).is_file():
                return self._missing(needed, scan) or needed
        return None

    def _doubt_before(self, step: StepName, scan: str) -> tuple[str, bool]:
        """What is wrong with a step before this one, and whether this one is old by it."""
        for needed in BY_NAME[step].needs:
            of_scan = scan if needed in OF_A_SCAN else ""
            doubt, is_old = self._doubt_before(needed, of_scan)
            if doubt:
                return doubt, is_old
            result, title = self.result(needed, of_scan), BY_NAME[needed].title
            if result is not None and self._changed(result):
                return f"'{title}' is out of date: calculate it again, then this", True
            if result is not None and result.verdict == "not good":
                return f"'{title}' is not good: what it gave before is used", False
        return "", False

    def result(self, step: StepName, scan: str = "") -> StepResult | None:
        """What was found last; None where nothing was, or the file is not to be read."""
        path = self.folder / RESULTS / f"{result_key(step, scan)}.json"
        try:
            content = json.loads(path.read_text("utf-8"))
            found = StepResult(**content)
            pairs = tuple((str(label), str(text)) for label, text in found.values)
        except (OSError, ValueError, TypeError):
            return None
        return replace(
            found, reasons=tuple(found.reasons), values=pairs, written=tuple(found.written)
        )

    def next_step(self) -> StepName:
        """The first step that has no good result."""
        for step in self.steps:
            scan = self.scans[-1] if self.scans and step.name in OF_A_SCAN else ""
            if self.state(step.name, scan).status not in ("good", "doubtful"):
                return step.name
        return self.steps[-1].name

    def start_over(self, step: StepName, scan: str = "") -> None:
        """Remove what a step has taken, and its result; documents stay until they are replaced."""
        place = self.recording(step, scan)
        gone = place.with_name(f".{place.name}.old")
        try:
            if place.is_dir():
                place.rename(gone)
                shutil.rmtree(gone)
            self.new_file(step, scan).unlink(missing_ok=True)
            (self.folder / RESULTS / f"{result_key(step, scan)}.json").unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"what was taken cannot be removed ({error.strerror})",
                where=path_text(place),
                remedy="check the rights of the folder",
            ) from error

    def _document(self, step: StepName, scan: str) -> Path:
        if step is StepName.SCAN:
            return self.cloud_file(scan) if scan else self.folder / "no scan"
        names = {
            StepName.CAMERA: self.camera_file,
            StepName.LASER: self.folder / "sensor.json",
            StepName.PROBING: self.folder / "plate.csv",
            StepName.HAND_EYE: self.folder / "scanner.json",
            StepName.LATENCY: self.folder / TIMED_FILE,
        }
        return names[step]

    def _changed(self, result: StepResult) -> str:
        """The first input that is not what the result rests on, in words; empty if none is."""
        for name, digest in (result.rests_on or {}).items():
            if self.digest(name) != digest:
                return self._words(name)
        return ""

    def digest(self, name: str) -> str:
        """SHA-256 of what a result rests on, by its name, as it is now."""
        if name.startswith(SETTING):
            value = getattr(self.settings, name.removeprefix(SETTING), "")
            told = value if isinstance(value, str) else repr(float(value))
            return hashlib.sha256(told.encode()).hexdigest()
        return digest_of(self.scanner_file if name == TIMED_FILE else self.folder / name)

    def _words(self, name: str) -> str:
        """A file of the session as the person knows it."""
        if name.startswith(f"{RECORDINGS}/"):
            return "what was taken"
        if name.startswith(SETTING):
            return f"the setting {name.removeprefix(SETTING)}"
        for step in CALIBRATED:
            if self._document(step, "").name == name:
                return f"the result of '{BY_NAME[step].title}'"
        return name


def result_key(step: StepName, scan: str) -> str:
    """Name under which a step's result is kept."""
    return f"{step.value}-{scan}" if scan else step.value


OF_A_SCAN = (StepName.SCAN, StepName.INSPECT)
CALIBRATED = tuple(StepName)[:5]
"""Steps with a document that later ones rest on."""


def digest_of(path: Path) -> str:
    """SHA-256 of a file, also of a table in a recording; empty where it cannot be read."""
    try:
        return hashlib.sha256(read_bytes(path)).hexdigest()
    except ArmscanError:
        return ""


def open_journey(folder: Path, settings: SessionSettings | None = None) -> Journey:
    """Open a session folder, made if need be.

    Parameters
    ----------
    folder
        Empty, new, or a session.
    settings
        Of a new session; what an existing one says of its rig is replaced by them, the rest of it
        stays, and what it does not know they tell. None to take those of the folder.

    Raises
    ------
    OutputError
        If it holds other files than a session's, or cannot be written.
    FileFormatError
        If its settings are damaged.
    OptionError
        If the rig has not as many cameras as were calibrated.
    """
    path = folder / SETTINGS_FILE
    if path.is_file():
        journey = Journey(folder, read_settings(path))
        if settings is not None:
            told = {key: getattr(settings, key) for key in settings.__slots__}
            known = {key: value for key in told if (value := getattr(journey.settings, key))}
            of_rig: dict[str, Any] = {
                "rig": settings.rig,
                "needs_latency": settings.needs_latency,
                "n_cameras": settings.n_cameras,
            }
            n_known = journey.settings.n_cameras
            if n_known != settings.n_cameras and journey.camera_file.is_file():
                raise OptionError(
                    f"the session is of {plural(n_known, 'camera')}, the rig has "
                    f"{settings.n_cameras}",
                    where=path_text(folder),
                    remedy="name another folder, or the rig that was calibrated in this one",
                )
            journey.change(**{**told, **known, **of_rig})
        return journey
    _check_own(folder)
    make_folder(folder, with_parents=True)
    journey = Journey(folder, settings or SessionSettings())
    journey.change()
    return journey


def _check_own(folder: Path) -> None:
    """Raise `OutputError` for a file, and for a folder of something else."""
    if folder.exists() and not folder.is_dir():
        raise OutputError("this is a file", where=path_text(folder), remedy="name a folder")
    held = [one.name for one in folder.iterdir()] if folder.is_dir() else []
    foreign = sorted(name for name in held if name != LOCK_FILE)
    if foreign and SETTINGS_FILE not in held:
        raise OutputError(
            f"the folder holds other files than a session's ({', '.join(foreign[:3])})",
            where=path_text(folder),
            remedy="name a new or an empty folder",
        )


def read_settings(path: Path) -> SessionSettings:
    """Read ``console.toml``."""
    where, unknown = path_text(path), list[str]()
    remedy = "remove the file: the session asks for its settings again"
    try:
        content = parse_toml(read_bytes(path), where, "write lines as ball_mm = 30.0")
        return RecordCodec({}, unknown).read(SessionSettings, content)
    except (MismatchError, OptionError) as error:
        raise FileFormatError(str(error), where=where, remedy=remedy) from error


@contextmanager
def held_session(folder: Path) -> Iterator[None]:
    """Keep other consoles out of a session folder, which is made if need be.

    Raises
    ------
    OutputError
        If another one has it open, it is of something else, or cannot be written.
    """
    _check_own(folder)
    path = folder / LOCK_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise OutputError(
            f"the folder cannot be written ({error.strerror})", where=path_text(folder)
        ) from error
    try:
        if fcntl is None:
            yield
            return
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            whose = os.read(handle, 100).decode("ascii", "replace").strip()
            raise OutputError(
                f"another console has this session open (process {whose or 'not known'})",
                where=path_text(folder),
                remedy="go on in that one, or close it first",
            ) from error
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(handle)
        # a folder that became no session is left as it was
        with suppress(OSError):
            if [one.name for one in folder.iterdir()] == [LOCK_FILE]:
                path.unlink()
                folder.rmdir()


def sessions_in(folder: Path) -> tuple[Path, ...]:
    """Session folders that lie in a folder, sorted by name."""
    found: Sequence[Path] = ()
    with suppress(OSError):
        found = sorted(one for one in folder.iterdir() if (one / SETTINGS_FILE).is_file())
    return tuple(found)
