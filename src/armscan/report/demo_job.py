# SPDX-License-Identifier: Apache-2.0
"""The demo: render a photo set, run the three commands on it, compare with the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

from armscan.pipeline.photo_demo import PhotoErrors, compare_with_truth, render_photos
from armscan.pipeline.progress import Progress, silent
from armscan.report.camera_job import CameraRequest, run_camera_calibration
from armscan.report.cloud_job import CloudRequest, run_reconstruction
from armscan.report.demo_folder import check_demo_folder
from armscan.report.laser_job import LaserRequest, run_laser_calibration
from armscan.report.numbers import significant, with_sigma
from armscan.report.summary import Summary, Table, summary_json
from armscan.storage.atomic import write_files
from armscan.storage.calibration_files import read_sensor_calibration
from armscan.storage.clouds import read_ply

T = TypeVar("T")

OWN_NAMES = frozenset(
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
    check_demo_folder(folder, OWN_NAMES, photos / "camera")
    seconds: dict[str, float] = {}
    truth = _timed(seconds, "render", lambda: render_photos(photos, request.seed, progress))
    camera = CameraRequest(
        images=(str(photos / "camera"),),
        target=truth.target,
        output=folder / "camera.json",
        is_overwriting=True,
        command=("armscan", "demo", "photos", "-o", folder.as_posix()),
    )
    laser = LaserRequest(
        camera=camera.output,
        on=(str(photos / "laser" / "on"),),
        off=(str(photos / "laser" / "off"),),
        target=truth.target,
        output=folder / "sensor.json",
        is_overwriting=True,
        command=camera.command,
    )
    cloud = CloudRequest(
        sensor=laser.output,
        images=(str(photos / "object" / "laser.png"),),
        background=(str(photos / "object" / "background.png"),),
        output=folder / "cloud.ply",
        is_overwriting=True,
        command=camera.command,
    )
    stages = (
        _timed(seconds, "calibrate_camera", lambda: run_camera_calibration(camera, progress)),
        _timed(seconds, "calibrate_laser", lambda: run_laser_calibration(laser, progress)),
        _timed(seconds, "reconstruct", lambda: run_reconstruction(cloud, progress)),
    )
    errors = compare_with_truth(
        read_sensor_calibration(laser.output), read_ply(cloud.output), truth
    )
    names = ("camera", "laser", "points")
    data = _data(request.seed, dict(zip(names, stages, strict=True)), errors, seconds)
    result = folder / "summary.json"
    summary = Summary(
        title="Demo on simulated photographs: camera, light sheet and points against their truth",
        facts=_facts(errors),
        tables=(_commands(photos, folder, truth.target),),
        warnings=tuple(warning for stage in stages for warning in stage.warnings),
        written=(photos, *(path for stage in stages for path in stage.written), result),
        next_step=f"open {folder / 'camera.html'}, {folder / 'sensor.html'} and "
        f"{folder / 'cloud.html'} in a browser",
        data=data,
    )
    write_files({result: summary_json(summary).encode()}, is_overwriting=True)
    return summary


def _timed(seconds: dict[str, float], stage: str, work: Callable[[], T]) -> T:
    start = perf_counter()
    result = work()
    seconds[stage] = round(perf_counter() - start, 2)
    return result


def _facts(errors: PhotoErrors) -> tuple[tuple[str, str], ...]:
    sheet = errors.sheet
    return (
        (
            "camera",
            f"error of the focal length {with_sigma(errors.focal_px, errors.focal_sigma_px, 'px')}",
        ),
        (
            "light sheet",
            f"{significant(sheet.angle_deg)} deg and {significant(abs(sheet.offset_mm))} mm off, "
            f"{significant(sheet.rms_mm)} mm rms over the boards",
        ),
        (
            "object",
            f"{errors.n_on_object} points, {significant(errors.points_median_mm)} mm median and "
            f"{significant(errors.points_rms_mm)} mm rms from its true surface",
        ),
        (
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
        **{name: dict(stage.data) for name, stage in stages.items()},
        "errors": asdict(errors),
        "seconds": dict(seconds),
    }
