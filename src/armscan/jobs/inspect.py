# SPDX-License-Identifier: Apache-2.0
"""From a cloud to its deviations from a plane, a sphere or a step, and the page about them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import (
    ProbeSide,
    ProbingOptions,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane, plane_from_coefficients
from armscan.inspection.plane import inspect_plane
from armscan.inspection.selection import InspectionOptions, StepOptions
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.step import inspect_step
from armscan.models.calibration import Provenance
from armscan.records.cloud import PointCloud
from armscan.records.points import ProbedPoints
from armscan.report.inspect import (
    InspectionReport,
    inspection_page,
    plane_report,
    sphere_report,
    step_report,
)
from armscan.report.page import render_page
from armscan.report.quantity import Summary, sentence
from armscan.storage.clouds import read_cloud
from armscan.storage.documents import new_provenance
from armscan.storage.files import check_outputs, write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import parse_plane, read_points_or_plane


def read_plate(
    path: Path,
    near_mm: FloatArray,
    *,
    towards_mm: FloatArray | None = None,
    side: ProbeSide | None = None,
) -> tuple[PlateReference, tuple[str, ...]]:
    """Read a plate, and what is weak about it, in words.

    Parameters
    ----------
    path
        Probed points, on the surface or centres of the tip; or a file with ``A,B,C,D``.
    near_mm
        (3,) a point near which the plane's own point shall lie if only coefficients are known.
    towards_mm
        (M, 3) places of the arm's tool while it scanned, for probed points; None where not known.
    side
        Side of the plate that was touched; None to take it from ``towards_mm``. Coefficients keep
        their own sign then.

    Raises
    ------
    ArmscanError
        If the file is neither, its points determine no plane, or they are of several features.
    """
    found = read_points_or_plane(path)
    if isinstance(found, ProbedPoints):
        fit = fit_probed_plate(found, towards_mm, ProbingOptions(side=side))
        if isinstance(fit, FitFailure):
            raise EstimationError(fit.reason, where=str(path), remedy=fit.remedy)
        return fit.reference, fit.warnings
    if side is None:
        return PlateReference(plane=plane_from_coefficients(found, near_mm), source=str(path)), ()
    plate = plate_from_coefficients(found, near_mm, side, str(path))
    if isinstance(plate, FitFailure):
        raise EstimationError(plate.reason, where=str(path), remedy=plate.remedy)
    return plate, ()


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


def _read(request: InspectRequest) -> tuple[PointCloud, Box | None]:
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
        region = Box.from_limits(request.region, "--region")
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
