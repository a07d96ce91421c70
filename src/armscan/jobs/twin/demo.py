# SPDX-License-Identifier: Apache-2.0
"""The demos: the twin's scenes recorded, the commands run on them, and a page with the truth."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.devices.sources import Preset, ScanSource, Twin, TwinScene
from armscan.errors import OptionError, OutputError
from armscan.geometry.arrays import FloatArray
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import StepInspection
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.step import inspect_step
from armscan.jobs.camera import calibrate_camera
from armscan.jobs.hand_eye import Artefact, StripeSource, calibrate_hand_eye
from armscan.jobs.inspection.shapes import read_plate
from armscan.jobs.job import Job, solved
from armscan.jobs.probe import probe
from armscan.jobs.reconstruct import StillPaths
from armscan.jobs.reconstruct import reconstruct as reconstruct_files
from armscan.jobs.sheets import SheetImages, calibrate_sheets
from armscan.jobs.stereo import calibrate_stereo
from armscan.kernels.arrays import load_kernels
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.pipeline.adaptive_scan import record_adaptively
from armscan.pipeline.measure import MeasureOptions, reconstruct
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.scan import ScanReconstruction, measure_scan
from armscan.pipeline.simulate import TwinName, record_touches, recorded_scenes
from armscan.pipeline.truth import (
    HeadDemo,
    NamingErrors,
    calibration_errors,
    hand_eye_errors,
    naming_errors,
    part_errors,
    true_names,
)
from armscan.reconstruction.sync import exposure_poses
from armscan.reconstruction.triangulate import DepthRange
from armscan.records.cloud import PointCloud
from armscan.report.demo import (
    FRACTION_RULE,
    KINDS,
    comparison_table,
    head_data,
    head_demo_page,
    heads_page,
    naming_table,
    truth_table,
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
    new_provenance,
    read_scanner_calibration,
    read_sensor_calibration,
)
from armscan.storage.files import replaced_folder, told_path, write_files
from armscan.storage.recording import FolderRecording, read_recording

Result = TypeVar("Result")

RECORDINGS, TRUTH, FILES = "recordings", "truth.json", "files.txt"
CALIBRATION_SCENES: tuple[TwinScene, ...] = ("camera", "laser", "hand-eye")
SCANS: tuple[TwinScene, ...] = ("plate", "ball", "steps", "part")
"""Scanned by hand; where sheets must be told apart, a wavy plate too."""
PHOTO_SCENES: tuple[TwinScene, ...] = ("camera", "laser", "still-part")
STILL_HEIGHT_MM, STEREO_STILL_HEIGHT_MM = 20.0, 5.0
"""Block of the scene ``still-step``: figures 5.19 and 5.33."""
UNUSED = ("mesh_search",)
"""Modules of kernels, and kernels, that no command of a demo calls, so that the first one need not
wait for them. What is left out though it is needed is compiled when it is called."""
UNUSED_BY_ONE_LINE = (
    "naming",
    "fusing",
    "chains.best_states",
    "chains.compare_light",
    "chains.cut_at_largest",
    "chains.sum_windows",
    "grids.add_heights",
    "grids.principal_axes",
    "grids.voxel_values",
    "placing.propagate_points",
    "rays.sheet_gradients",
    "target_edges.fit_crossings",
    "target_edges.crossing_sums",
    "target_edges.row_product",
    "target_edges.invert_scaled",
)
STILL_MARGIN = 0.3
"""The block fills the view, and its lower face lies up to 13 mm beyond the 55 mm of depth in which
the crossed lines are calibrated."""


@dataclass(frozen=True, slots=True)
class DemoRequest:
    """Where a demo goes, and what is simulated.

    Parameters
    ----------
    most_views
        Views of a scene that are used, evenly chosen; where lasers are chosen meanwhile, exposures
        of a pass. Scenes that are not named are used whole.
    """

    folder: Path
    head: str = "thesis-single"
    seed: int = 1
    preset: Preset = "thesis"
    most_views: Mapping[TwinScene, int] = field(default_factory=dict)
    processes: int = 2

    @property
    def twin(self) -> TwinName:
        """What is simulated."""
        return TwinName(self.head, self.preset, self.seed)

    def command(self, kind: str) -> tuple[str, ...]:
        """The command line that asks for the same."""
        words = ("armscan", "demo", kind, "-o", self.folder.as_posix())
        return (*words, "--preset", self.preset, "--seed", str(self.seed))


@contextmanager
def demo_folder(folder: Path) -> Iterator[Path]:
    """Give a folder to make a demo in; complete and listed, it replaces the earlier one.

    Raises
    ------
    OutputError
        If the folder holds a file that no earlier demo listed, now or at the end, or cannot be
        written.
    """
    with replaced_folder(folder, partial(_check_replaceable, folder)) as place:
        yield place
        names = [*_files_in(place), FILES]
        (place / FILES).write_text("\n".join(names) + "\n", "utf-8")


def _check_replaceable(folder: Path) -> None:
    listing = folder / FILES
    listed = listing.read_text("utf-8").splitlines() if listing.is_file() else []
    foreign = [name for name in _files_in(folder) if name not in listed]
    if folder.exists() and not folder.is_dir():
        raise OutputError("this is a file", where=str(folder), remedy="name a new or empty folder")
    if foreign:
        raise OutputError(
            f"the folder holds other files than a demo's ({', '.join(foreign[:3])})",
            where=str(folder),
            remedy="name a new or an empty folder",
        )


def _files_in(folder: Path) -> list[str]:
    """Files and links, as paths in the folder."""
    found = sorted(folder.rglob("*")) if folder.is_dir() else []
    return [
        path.relative_to(folder).as_posix()
        for path in found
        if path.is_symlink() or not path.is_dir()
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """One head's demo while it is made: where, of what, and the seconds of each stage so far."""

    request: DemoRequest
    folder: Path
    twin: Twin
    progress: Progress
    command: tuple[str, ...]
    seconds: dict[str, float] = field(default_factory=dict)
    _coming: list[Iterator[tuple[TwinScene, ScanSource]]] = field(default_factory=list)

    def timed(self, stage: str, work: Callable[[], Result]) -> Result:
        """Do the work and note how long it took; parts of one stage are added up."""
        start = perf_counter()
        result = work()
        self.seconds[stage] = round(self.seconds.get(stage, 0.0) + perf_counter() - start, 2)
        return result

    def job(self, output: Path) -> Job:
        """Of a command that writes into the demo's folder."""
        return Job(output, command=self.command, progress=self.progress)

    def place(self, scene: str) -> Path:
        """Folder of a recording."""
        return self.folder / RECORDINGS / scene

    @contextmanager
    def recording(self, *scenes: TwinScene) -> Iterator[None]:
        """Render scenes whose exposures are known before anything is calibrated.

        They come one after the other; see `recorded`.
        """
        self.place("").mkdir()
        record_touches(self.place("probing"), self.twin)
        is_single = len(self.twin.truth.sheet_points_mm) == 1
        unused = (*UNUSED, *UNUSED_BY_ONE_LINE) if is_single else UNUSED
        coming = recorded_scenes(
            {scene: self.place(scene) for scene in scenes},
            self.request.twin,
            self.request.most_views,
            processes=self.request.processes,
            progress=self.progress,
            meanwhile=partial(load_kernels, without=unused),
        )
        with closing(coming):
            self._coming.append(coming)
            yield
            self.timed("render", lambda: deque(coming, 0))

    def recorded(self, scene: TwinScene) -> Path:
        """Wait until a scene is recorded; returns its folder."""
        place = self.place(scene)
        for coming in self._coming:
            while not place.exists() and self.timed("render", partial(next, coming, None)):
                pass
        return place

    def scanned(self, scene: TwinScene, scanner: ScannerCalibration) -> FolderRecording:
        """Read a recording, or make it now, with lasers chosen by the labelling."""
        if not self.place(scene).exists():
            record_adaptively(
                self.place(scene),
                self.request.twin,
                scene,
                scanner,
                longest_pass=self.request.most_views.get(scene),
                processes=self.request.processes,
                progress=self.progress,
            )
        return read_recording(self.place(scene))


def run_head_demo(request: DemoRequest, progress: Progress = silent) -> Summary:
    """Record, calibrate, measure, inspect, compare with the truth, and write it all."""
    if request.head not in KINDS:
        raise OptionError(
            f"there is no demo of the head {request.head!r}",
            remedy=f"give one of {', '.join(KINDS)}",
        )
    request.twin.build()
    with demo_folder(request.folder) as place:
        return make_head_demo(request, place, progress)[0]


def run_all_heads(request: DemoRequest, progress: Progress = silent) -> Summary:
    """Run the demo of each head, each in its own folder, and compare them; raises the same."""
    with demo_folder(request.folder) as folder:
        heads: dict[str, Any] = {}
        demos: dict[str, HeadDemo] = {}
        warnings: list[str] = []
        data: dict[str, Any] = {}
        for name, kind in KINDS.items():
            own = folder / name.removeprefix("thesis-")
            own.mkdir()
            summary, demos[name] = make_head_demo(replace(request, head=name), own, progress)
            data = summary.data
            heads |= data["heads"]
            warnings += [f"{kind}: {text}" for text in summary.warnings]
        folders = tuple(folder / name.removeprefix("thesis-") for name in KINDS)
        truths = [own / TRUTH for own in folders]
        provenance = new_provenance(truths, command=request.command("all"))
        page, result = folder / "report.html", folder / "summary.json"
        summary = Summary(
            title="Demo of three simulated heads on the same scenes",
            tables=(comparison_table(heads),),
            warnings=tuple(warnings),
            written=tuple(map(told_path, (*folders, page, result))),
            next_step=f"open {told_path(page)} in a browser; each head has its own page in its "
            "folder",
            extra={**data, "heads": heads},
        )
        document = render_page(heads_page(heads, demos, footer(provenance)))
        write_files({page: document, result: summary_json(summary).encode()})
        return summary


def calibrate_head(
    request: DemoRequest, kind: str, folder: Path, progress: Progress = silent
) -> Calibrated:
    """Record what the calibrations of a head rest on, and run their commands.

    ``kind``: the demo that asks for it, named in what they write.
    """
    run = _Run(request, folder, request.twin.build(), progress, request.command(kind))
    with run.recording(*CALIBRATION_SCENES):
        return _calibrated(run)


def make_head_demo(
    request: DemoRequest, folder: Path, progress: Progress = silent
) -> tuple[Summary, HeadDemo]:
    """As `run_head_demo`, in a folder that is there and empty, with all that was found."""
    twin = request.twin.build()
    command = request.command(request.head.removeprefix("thesis-"))
    run = _Run(request, folder, twin, progress, command)
    write_files({folder / TRUTH: twin.truth.document()})
    is_many = len(twin.truth.sheet_points_mm) > 1
    scans = (*SCANS, "waves") if is_many else SCANS
    # a head of several sources chooses its lasers while it scans; a still has all of them on
    known = () if len(twin.sources) > 1 else scans
    with run.recording(*CALIBRATION_SCENES, *known, "still-step"):
        instrument = _calibrated(run)
        demo = _measured(run, scans, instrument)
    return _written(run, demo, instrument.warnings), demo


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """What the commands of the calibrations wrote, and what was warned of at the hand-eye."""

    sensor: SensorCalibration
    scanner: ScannerCalibration
    plate: PlateReference
    warnings: tuple[str, ...]


def _calibrated(run: _Run) -> Calibrated:
    target, folder = run.twin.target, run.folder
    is_stereo = run.twin.truth.right_camera_parameters is not None
    camera = folder / ("stereo.json" if is_stereo else "camera.json")
    sensor, table, document = (folder / n for n in ("sensor.json", "plate.csv", "scanner.json"))
    scan = run.recorded("camera")
    calibrate = calibrate_stereo if is_stereo else calibrate_camera
    run.timed("calibrate_camera", partial(calibrate, run.job(camera), target, scan=scan))
    images = SheetImages(scan=run.recorded("laser"))
    laser = partial(calibrate_sheets, run.job(sensor), camera, target, images)
    run.timed("calibrate_laser", laser)
    run.timed("probe_plate", partial(probe, run.job(table), run.place("probing")))
    source = StripeSource(scans=(run.recorded("hand-eye"),), sensor=sensor)
    hand_eye = partial(calibrate_hand_eye, run.job(document), source, Artefact(plate=table))
    found = run.timed("calibrate_hand_eye", hand_eye)
    plate, _ = read_plate(table, np.zeros(3))
    marked = tuple(sentence(f"Hand-eye: {text}") for text in found.warnings)
    return Calibrated(
        read_sensor_calibration(sensor), read_scanner_calibration(document), plate, marked
    )


def _measured(run: _Run, scenes: tuple[TwinScene, ...], instrument: Calibrated) -> HeadDemo:
    """Measure and inspect every scene, then look at the truth."""
    truth, sensor, scanner = run.twin.truth, instrument.sensor, instrument.scanner
    found: dict[TwinScene, ScanReconstruction] = {}
    for scene in scenes:
        run.recorded(scene)
        source = run.timed(f"take_{scene}", partial(run.scanned, scene, scanner))
        measure = partial(measure_scan, source, scanner, progress=run.progress)
        found[scene] = run.timed(scene, measure)
    steps = tuple(
        solved(inspect_step(found["steps"].cloud, height), "steps")
        for height in truth.step_heights_mm
    )
    run.recorded("still-step")
    still, normal = run.timed("still_step", partial(_still_step, run, instrument, steps[0].normal))
    naming: dict[TwinScene, NamingErrors] = {}
    if len(truth.sheet_points_mm) > 1:
        names = true_names(sensor, truth.sheet_points_mm)
        for scene, scan in found.items():
            compare = partial(naming_errors, scan, run.twin.scan(scene), names)
            naming[scene] = run.timed("compare_names", compare)
    plane = inspect_plane(
        found["plate"].cloud, instrument.plate.plane, reference_text="the probed plane"
    )
    ball = inspect_sphere(found["ball"].cloud, truth.ball_diameter_mm)
    cameras, sheets = calibration_errors(sensor, truth)
    return HeadDemo(
        sensor=sensor,
        scanner=scanner,
        scans=found,
        plate=solved(plane, "plate"),
        ball=solved(ball, "ball"),
        steps=steps,
        still_step=still,
        still_normal=normal,
        part=part_errors(found["part"].cloud, truth),
        naming=naming,
        cameras=cameras,
        sheets=sheets,
        hand_eye=hand_eye_errors(scanner, truth.tool_from_sensor),
    )


def _still_step(
    run: _Run, instrument: Calibrated, normal_base: FloatArray
) -> tuple[StepInspection, FloatArray]:
    """Height of a block from one exposure, in Sensor, and the normal (3,) of its faces there.

    Within the light sheet the faces stand further apart than the height if the sheet leans; how
    far it leans follows from the arm's pose and the faces' direction in Base.
    """
    sensor, scanner = instrument.sensor, instrument.scanner
    source = run.scanned("still-step", scanner)
    poses = exposure_poses(source.rows, source.arm, source.session.clock)
    base_from_sensor = poses.pose(0) @ scanner.hand_eye.tool_from_sensor
    normal = base_from_sensor.rotation.T @ normal_base
    first, *others = (source.exposure(row) for row in range(len(source.rows)))
    options = MeasureOptions(depths=DepthRange(margin=STILL_MARGIN))
    cloud = reconstruct([first], sensor, rights=others, options=options).cloud
    height = STILL_HEIGHT_MM if sensor.second is None else STEREO_STILL_HEIGHT_MM
    return solved(inspect_step(cloud, height, normal=normal), source.name), normal


def _written(run: _Run, demo: HeadDemo, warnings: tuple[str, ...]) -> Summary:
    """Write the cloud of the part, the page and the figures."""
    start = perf_counter()
    request, folder, seconds = run.request, run.folder, run.seconds
    name = request.head
    head = {**head_data(demo), "seconds": seconds}
    commands = _commands(run, demo)
    photographs = {}
    for place in sorted(run.place("").iterdir()):
        if place.name != "probing":
            scan = read_recording(place)
            lit = [k for k, row in enumerate(scan.rows) if row.lasers] or range(len(scan.rows))
            photographs[place.name] = scan.exposure(lit[len(lit) // 2])
    provenance = new_provenance((folder / TRUTH,), command=run.command)
    page = head_demo_page(
        demo,
        name,
        head,
        photographs,
        warnings=warnings,
        commands=commands,
        footer=footer(provenance),
    )
    cloud, report, result = (folder / n for n in ("cloud.ply", "report.html", "summary.json"))
    write_files({cloud: ply_bytes(demo.scans["part"].cloud), report: render_page(page)})
    seconds["write"] = round(perf_counter() - start, 2)
    naming = (naming_table(demo.naming),) if demo.naming else ()
    summary = Summary(
        title=f"Demo on a simulated {KINDS[name]} arm scanner: calibrated, used, compared with its "
        "truth",
        quantities=(fact("time", f"{sum(seconds.values()):.0f} s"),),
        tables=(comparison_table({name: head}), truth_table(demo, head), *naming, commands),
        warnings=warnings,
        written=_told(folder, result),
        next_step=f"open {told_path(report)} in a browser",
        extra={
            "kind": "demo",
            "simulated": True,
            "seed": request.seed,
            "preset": request.preset,
            "rule": FRACTION_RULE,
            "heads": {name: head},
        },
    )
    write_files({result: summary_json(summary).encode()})
    return summary


def _told(folder: Path, result: Path) -> tuple[Path, ...]:
    """What was written into a demo's folder, as it will lie."""
    return tuple(map(told_path, (folder / RECORDINGS, *sorted(folder.glob("*.*")), result)))


def _commands(run: _Run, demo: HeadDemo) -> Table:
    """Each step once more by hand; results go to the current folder."""
    truth, target = run.twin.truth, run.twin.target
    kind = "camera" if demo.sensor.second is None else "stereo"

    def place(scene: str) -> Path:
        return told_path(run.place(scene))

    def scan(scene: str) -> str:
        return f"armscan reconstruct {place(scene)} --scanner scanner.json -o {scene}.ply"

    normal = ",".join(f"{value:.6f}" for value in demo.still_normal)
    heights = (f"armscan inspect step steps.ply --height {h:g}" for h in truth.step_heights_mm)
    lines = (
        f"armscan calibrate {kind} --scan {place('camera')} --target {target} -o {kind}.json",
        f"armscan calibrate laser --camera {kind}.json --scan {place('laser')} "
        f"--target {target} -o sensor.json",
        f"armscan probe {place('probing')} -o plate.csv",
        f"armscan calibrate hand-eye {place('hand-eye')} --sensor sensor.json "
        "--plate plate.csv -o scanner.json",
        scan("plate"),
        "armscan inspect plane plate.ply --plate plate.csv",
        scan("ball"),
        f"armscan inspect sphere ball.ply --diameter {truth.ball_diameter_mm:g}",
        f"armscan verify {place('ball')} --scanner scanner.json --ball {truth.ball_diameter_mm:g}",
        scan("steps"),
        *heights,
        f"armscan reconstruct {place('still-step')} --sensor sensor.json "
        f"--depth-margin {STILL_MARGIN:g} -o still.ply",
        f"armscan inspect step still.ply --height {demo.still_step.nominal_height_mm:g} "
        f"--normal={normal}",
        scan("part"),
    )
    return typed_commands(*lines)


def typed_commands(*lines: str) -> Table:
    """The commands that do what a demo did."""
    return Table(("The same, command by command",), tuple((line,) for line in lines), "", (0,))


def run_photo_demo(request: DemoRequest, progress: Progress = silent) -> Summary:
    """The commands on photographs, as a laboratory with a camera, a laser and no arm has them.

    Writes the recordings of the photographs, ``camera.json``, ``sensor.json``, ``cloud.ply``, a
    page beside each, and ``summary.json``; raises as `run_head_demo`.
    """
    twin = request.twin.build()
    with demo_folder(request.folder) as folder:
        run = _Run(request, folder, twin, progress, request.command("photos"))
        write_files({folder / TRUTH: twin.truth.document()})
        with run.recording(*PHOTO_SCENES):
            pass
        boards, lines, still = (run.place(scene) / "images" for scene in PHOTO_SCENES)
        on, off, lit, dark = (
            *(lines / "on", lines / "off"),
            *(still / "0001.png", still / "0002.png"),
        )
        target = twin.target
        camera, sensor, cloud = (folder / n for n in ("camera.json", "sensor.json", "cloud.ply"))
        of_camera = partial(calibrate_camera, run.job(camera), target, (str(boards),))
        images = SheetImages((str(on),), (str(off),))
        of_laser = partial(calibrate_sheets, run.job(sensor), camera, target, images)
        of_cloud = partial(
            reconstruct_files, run.job(cloud), sensor, StillPaths((str(lit),), (str(dark),))
        )
        works = (
            ("camera", "calibrate_camera", of_camera),
            ("laser", "calibrate_laser", of_laser),
            ("points", "reconstruct", of_cloud),
        )
        stages = {name: run.timed(stage, work) for name, stage, work in works}
        errors = _photo_errors(run, read_sensor_calibration(sensor), read_ply(cloud))
        commands = typed_commands(
            f"armscan calibrate camera {told_path(boards)} --target {target} -o camera.json",
            f"armscan calibrate laser --camera camera.json --on {told_path(on)} "
            f"--off {told_path(off)} "
            f"--target {target} -o sensor.json",
            f"armscan reconstruct {told_path(lit)} --background {told_path(dark)} "
            "--sensor sensor.json -o cloud.ply",
        )
        result = folder / "summary.json"
        summary = Summary(
            title="Demo on simulated photographs: camera, light sheet and points against their "
            "truth",
            quantities=_photo_facts(errors),
            tables=(commands,),
            warnings=tuple(text for stage in stages.values() for text in stage.warnings),
            written=_told(folder, result),
            next_step="open {}, {} and {} in a browser".format(
                *(told_path(path.with_suffix(".html")) for path in (camera, sensor, cloud))
            ),
            extra={
                "kind": "demo",
                "simulated": True,
                "seed": request.seed,
                "preset": request.preset,
                **{name: stage.data for name, stage in stages.items()},
                "errors": errors,
                "seconds": run.seconds,
            },
        )
        write_files({result: summary_json(summary).encode()})
        return summary


def _photo_errors(run: _Run, sensor: SensorCalibration, cloud: PointCloud) -> dict[str, Any]:
    """Errors of the whole chain against the truth."""
    truth = run.twin.truth
    part = part_errors(cloud, truth, run.twin.scan("still-part").true_pose(0))
    (camera,), (sheet,) = calibration_errors(sensor, truth)
    return {
        "focal_px": camera.focal_px,
        "focal_sigma_px": camera.focal_sigma_px,
        "camera_normalised": camera.normalised,
        "n_camera_parameters": camera.n_parameters,
        "sheet": asdict(sheet),
        "n_points": len(cloud),
        "n_on_object": len(part.rows),
        "points_rms_mm": part.rms_mm,
        "points_median_mm": float(np.median(np.abs(part.distance_mm))),
        "points_normalised_rms": part.normalised_rms,
        "points_within_2_sigma": float(np.mean(np.abs(part.normalised) < 2.0)),
    }


def _photo_facts(errors: Mapping[str, Any]) -> tuple[Quantity, ...]:
    sheet, n_camera = errors["sheet"], errors["n_camera_parameters"]
    n_sheet = sheet["n_parameters"]
    return (
        fact(
            "camera",
            "error of the focal length "
            f"{with_sigma(errors['focal_px'], errors['focal_sigma_px'], 'px')}",
        ),
        fact(
            "light sheet",
            f"{significant(sheet['angle_deg'])} deg and {significant(abs(sheet['offset_mm']))} mm "
            f"off, {significant(sheet['rms_mm'])} mm rms over the boards",
        ),
        fact(
            "object",
            f"{errors['n_on_object']} points, {significant(errors['points_median_mm'])} mm median "
            f"and {significant(errors['points_rms_mm'])} mm rms from its true surface",
        ),
        fact(
            "in sigmas",
            f"camera {errors['camera_normalised']:.1f} ({n_camera**0.5:.1f} is usual for "
            f"{n_camera} numbers), sheet {sheet['normalised']:.1f} ({n_sheet**0.5:.1f} is usual "
            f"for {n_sheet}), points {errors['points_normalised_rms']:.2f} rms",
        ),
    )
