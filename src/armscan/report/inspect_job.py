# SPDX-License-Identifier: Apache-2.0
"""From a cloud to an inspected plane, ball or step, and its page."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from armscan.calibration.hand_eye.plate_side import ProbeSide
from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.box import box_corners_mm
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Plane, plane_from_coefficients
from armscan.inspection.cleaning import Region
from armscan.inspection.options import InspectionOptions, StepOptions
from armscan.inspection.plane import inspect_plane
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.step import inspect_step
from armscan.models.calibration import Provenance
from armscan.records.cloud import PointCloud
from armscan.report.inspect_page import InspectionReport, inspection_page
from armscan.report.inspect_texts import plane_report, sphere_report, step_report
from armscan.report.numbers import sentence
from armscan.report.page import render_page
from armscan.report.plate_file import read_plate
from armscan.report.summary import Summary
from armscan.storage.atomic import check_outputs, write_files
from armscan.storage.foreign_clouds import read_cloud
from armscan.storage.probed_points import parse_plane
from armscan.storage.provenance import new_provenance
from armscan.storage.simulated import are_simulated

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class InspectRequest:
    """What to inspect, and where to write.

    Parameters
    ----------
    cloud
        A cloud of ``armscan reconstruct``, or any PLY or text file with x, y, z in mm.
    region
        ``xmin, xmax, ymin, ymax, zmin, zmax`` in mm; empty for the whole cloud.
    output
        Page to write, or None for none.
    options
        What belongs to the feature.
    is_overwriting
        Replace a page that exists.
    command
        The command line, for the record.
    """

    cloud: Path
    region: tuple[float, ...] = ()
    output: Path | None = None
    options: InspectionOptions = field(default_factory=InspectionOptions)
    is_overwriting: bool = False
    command: tuple[str, ...] = ()


def run_plane_inspection(
    request: InspectRequest,
    plane: str = "",
    plate: Path | None = None,
    side: ProbeSide | None = None,
) -> Summary:
    """Inspect a flat face.

    Parameters
    ----------
    request
        What and where.
    plane
        ``A,B,C,D`` of the nominal plane, D in mm; empty for none.
    plate
        Probed points of the nominal plane, or a file with ``A,B,C,D``; None for none.
    side
        Side of the plate that was touched; None for where nobody said it.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or there is no such face; nothing is written
        then.
    """
    cloud, region = _read(request)
    reference, text, weak = _reference(cloud, plane, plate, side)
    found = _found(
        inspect_plane(
            cloud,
            reference,
            reference_text=text,
            region=region,
            options=request.options,
        ),
        request,
    )
    inputs = (request.cloud, *(() if plate is None else (plate,)))
    report = plane_report(found, cloud)
    report = replace(report, warnings=(*weak, *_flat_by_itself(cloud), *report.warnings))
    return _finished(request, cloud, report, inputs)


def _flat_by_itself(cloud: PointCloud) -> tuple[str, ...]:
    """Warn of points of one light sheet in the Sensor frame: they are flat whatever they met."""
    if cloud.frame != "Sensor" or len(np.unique(cloud.sheet)) > 1:
        return ()
    return (
        "all points lie on one light sheet, which is flat itself: this says nothing of the form of "
        "the object; scan it with the arm, or with lines of several sheets",
    )


def run_sphere_inspection(request: InspectRequest, diameter_mm: float) -> Summary:
    """Inspect a ball of known diameter; raises as `run_plane_inspection`."""
    cloud, region = _read(request)
    found = _found(
        inspect_sphere(cloud, diameter_mm, region=region, options=request.options), request
    )
    return _finished(request, cloud, sphere_report(found, cloud), (request.cloud,))


def run_step_inspection(
    request: InspectRequest,
    height_mm: float,
    normal: tuple[float, ...] = (),
    step_options: StepOptions | None = None,
) -> Summary:
    """Inspect a step.

    Parameters
    ----------
    request
        What and where.
    height_mm
        Nominal height.
    normal
        Normal of the faces in the cloud's frame, for a single exposure; empty for none.
    step_options
        How the faces are found.

    Raises
    ------
    ArmscanError
        As `run_plane_inspection`.
    """
    steps = step_options or StepOptions()
    cloud, region = _read(request)
    given = _normal(normal) if normal else None
    found = _found(
        inspect_step(
            cloud,
            height_mm,
            normal=given,
            region=region,
            options=request.options,
            step_options=steps,
        ),
        request,
    )
    return _finished(request, cloud, step_report(found, cloud), (request.cloud,), (steps,))


def _read(request: InspectRequest) -> tuple[PointCloud, Region | None]:
    if request.output is not None:
        if request.output.suffix.lower() != ".html":
            raise OptionError(
                f"the output's name ends in '{request.output.suffix}'",
                where=f"-o {request.output}",
                remedy="end it in .html",
            )
        check_outputs((request.output,), is_overwriting=request.is_overwriting)
    region = None
    if request.region:
        region = Region(*box_corners_mm(request.region, "--region"))
    return read_cloud(request.cloud), region


def _normal(values: tuple[float, ...]) -> FloatArray:
    remedy = "give the three numbers x,y,z of the faces' normal, not all 0"
    if len(values) != 3:
        fact = f"{len(values)} numbers where 3 are needed"
        raise OptionError(fact, where="--normal", remedy=remedy)
    if not (np.isfinite(values).all() and any(values)):
        fact = f"the normal is {', '.join(f'{value:g}' for value in values)}"
        raise OptionError(fact, where="--normal", remedy=remedy)
    return np.array(values, dtype=np.float64)


def _reference(
    cloud: PointCloud, plane: str, plate: Path | None, side: ProbeSide | None
) -> tuple[Plane | None, str, tuple[str, ...]]:
    """The nominal plane, where it came from, and what is weak about it."""
    if plane and plate is not None:
        raise OptionError("both --plane and --plate are given", remedy="give one of them")
    if side is not None and plate is None:
        raise OptionError("a side needs a plate", where="--side", remedy="give --plate")
    middle = cloud.points_mm.mean(axis=0) if len(cloud) else np.zeros(3)
    if plane:
        return plane_from_coefficients(parse_plane(plane, "--plane"), middle), "the given plane", ()
    if plate is None:
        return None, "", ()
    probed, weak = read_plate(plate, middle, side=side)
    return probed.plane, f"the plane of {plate.name}", weak


def _found(result: T | FitFailure, request: InspectRequest) -> T:
    if isinstance(result, FitFailure):
        raise EstimationError(result.reason, where=str(request.cloud), remedy=result.remedy)
    return result


def _finished(
    request: InspectRequest,
    cloud: PointCloud,
    report: InspectionReport,
    inputs: tuple[Path, ...],
    more_options: tuple[StepOptions, ...] = (),
) -> Summary:
    is_simulated = cloud.is_simulated or are_simulated(inputs)
    written: tuple[Path, ...] = ()
    if request.output is not None:
        provenance = _provenance(request, report, inputs, more_options, cloud.forced)
        page = inspection_page(report, provenance, is_simulated=is_simulated)
        write_files({request.output: render_page(page)}, is_overwriting=request.is_overwriting)
        written = (request.output,)
    return Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        facts=report.facts,
        tables=report.brief_tables,
        warnings=tuple(sentence(warning) for warning in report.warnings),
        written=written,
        next_step=f"open {request.output}" if request.output else "",
        forced=cloud.forced,
        data={
            "kind": "inspection",
            "simulated": is_simulated,
            "frame": cloud.frame,
            **report.data,
        },
    )


def _provenance(
    request: InspectRequest,
    report: InspectionReport,
    inputs: tuple[Path, ...],
    more_options: tuple[StepOptions, ...],
    forced: tuple[str, ...],
) -> Provenance:
    return new_provenance(
        inputs,
        command=request.command,
        options=(request.options, *more_options),
        warnings=report.warnings,
        forced=forced,
    )
