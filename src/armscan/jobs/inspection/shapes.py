# SPDX-License-Identifier: Apache-2.0
"""From a cloud to its deviations from a plane, a sphere or a step, to a feature, or to how two
features stand, and the page about them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import (
    ProbeSide,
    ProbingOptions,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.errors import OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.features import SHAPE_KINDS
from armscan.geometry.shapes import plane_from_coefficients
from armscan.inspection.features import inspect_feature as feature_of
from armscan.inspection.features import relate
from armscan.inspection.plane import inspect_plane as plane_of
from armscan.inspection.search import WantedFeature, normals_are_of_points
from armscan.inspection.selection import InspectionOptions, StepOptions
from armscan.inspection.sphere import inspect_sphere as sphere_of
from armscan.inspection.step import inspect_step as step_of
from armscan.jobs.job import Job, noise_remarks, solved
from armscan.records.cloud import PointCloud
from armscan.records.points import ProbedPoints
from armscan.report.inspection.features import feature_report, relation_report
from armscan.report.inspection.shapes import (
    InspectionReport,
    inspection_page,
    plane_report,
    sphere_report,
    step_report,
)
from armscan.report.quantity import Summary, sentences
from armscan.storage.clouds import CloudFile, read_cloud_file
from armscan.storage.files import path_text
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import parse_plane, read_points_or_plane


def inspect_plane(
    job: Job,
    path: Path,
    *,
    plane: str = "",
    plate: Path | None = None,
    side: ProbeSide | None = None,
    region: Sequence[float] = (),
    options: InspectionOptions | None = None,
) -> Summary:
    """Inspect a flat face.

    ``plane``: ``A,B,C,D`` of the nominal plane, D in mm; empty for none. ``plate``: probed points
    of the nominal plane, or a file with ``A,B,C,D``; None for none. ``side``: side of the plate
    that was touched; None for where nobody said it. ``region``: ``xmin, xmax, ymin, ymax, zmin,
    zmax`` in mm; empty for the whole cloud.
    """
    options = options or InspectionOptions()
    job.places(".html")
    box, source = region_of(region), read_inspected(path)
    cloud = source.cloud
    reference, text, weak = _reference(cloud, plane, plate, side)
    found = plane_of(
        cloud,
        None if reference is None else reference.plane,
        reference_covariance=None if reference is None else reference.covariance_with_tip,
        reference_text=text,
        region=box,
        options=options,
    )
    report = plane_report(solved(found, path), cloud)
    weak = (*source.remarks, *weak, *_flat_by_itself(cloud))
    report = replace(report, warnings=(*weak, *report.warnings))
    inputs = (path, *(() if plate is None else (plate,)))
    return finished_inspection(job, cloud, report, inputs, (options,))


def inspect_sphere(
    job: Job,
    path: Path,
    diameter_mm: float,
    *,
    region: Sequence[float] = (),
    options: InspectionOptions | None = None,
) -> Summary:
    """Inspect a ball of known diameter; the rest as `inspect_plane`."""
    options = options or InspectionOptions()
    job.places(".html")
    box, source = region_of(region), read_inspected(path)
    cloud = source.cloud
    found = sphere_of(cloud, diameter_mm, region=box, options=options)
    report = _as_read(sphere_report(solved(found, path), cloud), source)
    return finished_inspection(job, cloud, report, (path,), (options,))


def inspect_step(
    job: Job,
    path: Path,
    height_mm: float,
    *,
    normal: Sequence[float] = (),
    region: Sequence[float] = (),
    options: InspectionOptions | None = None,
    step_options: StepOptions | None = None,
) -> Summary:
    """Inspect a step of a nominal height.

    ``normal`` is that of the faces in the cloud's frame, for points of one light sheet; empty
    for none. The rest as `inspect_plane`.
    """
    options, step_options = options or InspectionOptions(), step_options or StepOptions()
    job.places(".html")
    box, source = region_of(region), read_inspected(path)
    cloud = source.cloud
    given = _normal(normal) if normal else None
    found = step_of(
        cloud, height_mm, normal=given, region=box, options=options, step_options=step_options
    )
    report = _as_read(step_report(solved(found, path), cloud), source)
    return finished_inspection(job, cloud, report, (path,), (options, step_options))


def _as_read(report: InspectionReport, source: CloudFile) -> InspectionReport:
    """The report with what is to be known of the reading of its cloud."""
    return replace(report, warnings=(*source.remarks, *report.warnings))


def read_inspected(path: Path) -> CloudFile:
    """Read a cloud, without normals that are not of its points, which is a remark then.

    Of a cloud that tells where the sensor stood they are armscan's own.
    """
    source = read_cloud_file(path)
    cloud = source.cloud
    if cloud.normals is None or cloud.seen_from_mm is not None:
        return source
    if normals_are_of_points(cloud.points_mm, cloud.normals):
        return source
    remark = (
        "the cloud's normals do not stand on the faces that its points make, and were not used; "
        "export it again with normals of its points, or without any"
    )
    own = replace(cloud, normals=None)
    return replace(source, cloud=own, remarks=(*source.remarks, remark))


def region_of(numbers: Sequence[float]) -> Box | None:
    """The box of ``--region``; None if none is given."""
    return Box.from_limits(numbers, "--region") if numbers else None


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
        fit = solved(fit_probed_plate(found, towards_mm, ProbingOptions(side=side)), path)
        return fit.reference, fit.warnings
    if side is None:
        return PlateReference(plane=plane_from_coefficients(found, near_mm)), ()
    return solved(plate_from_coefficients(found, near_mm, side, path_text(path)), path), ()


def _flat_by_itself(cloud: PointCloud) -> tuple[str, ...]:
    """Warn of points of one light sheet in the Sensor frame: they are flat whatever they met."""
    if cloud.frame != "Sensor" or len(np.unique(cloud.sheet)) > 1:
        return ()
    return (
        "all points lie on one light sheet, which is flat itself: this says nothing of the form of "
        "the object; scan it with the arm, or with lines of several sheets",
    )


def _normal(values: Sequence[float]) -> FloatArray:
    remedy = "give the three numbers x,y,z of the faces' normal, not all 0"
    if len(values) != 3:
        what = f"{len(values)} numbers where 3 are needed"
        raise OptionError(what, where="--normal", remedy=remedy)
    if not (np.isfinite(values).all() and any(values)):
        what = f"the normal is {', '.join(f'{value:g}' for value in values)}"
        raise OptionError(what, where="--normal", remedy=remedy)
    return np.array(values, dtype=np.float64)


def _reference(
    cloud: PointCloud, plane: str, plate: Path | None, side: ProbeSide | None
) -> tuple[PlateReference | None, str, tuple[str, ...]]:
    """The nominal plane, where it came from, and what is weak about it.

    A plane that is given in words is exact by definition.
    """
    if plane and plate is not None:
        raise OptionError("both --plane and --plate are given", remedy="give one of them")
    if side is not None and plate is None:
        raise OptionError("a side needs a plate", where="--side", remedy="give --plate")
    middle = cloud.points_mm.mean(axis=0) if len(cloud) else np.zeros(3)
    if plane:
        given = plane_from_coefficients(parse_plane(plane, "--plane"), middle)
        return PlateReference(plane=given, covariance=np.zeros((3, 3))), "the given plane", ()
    if plate is None:
        return None, "", ()
    probed, weak = read_plate(plate, middle, side=side)
    return probed, f"the plane of {plate.name}", weak


def finished_inspection(
    job: Job,
    cloud: PointCloud,
    report: InspectionReport,
    inputs: Sequence[Path],
    options: Sequence[Any],
) -> Summary:
    """Write the page, if one is wanted, and sum up."""
    is_simulated = cloud.is_simulated or are_simulated(inputs)
    report = replace(report, warnings=(*report.warnings, *noise_remarks(cloud)))
    written: tuple[Path, ...] = ()
    delivery = job.delivery(cloud, inputs[0])
    if job.output is not None:
        warnings = (*delivery.warnings, *report.warnings)
        provenance = job.provenance(inputs, options, warnings=warnings, forced=cloud.forced)
        page = inspection_page(report, provenance, is_simulated=is_simulated)
        written = job.write({job.output: delivery.on_page(page)})
    summary = Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        quantities=report.quantities,
        tables=(report.brief_table,),
        warnings=sentences(report.warnings),
        written=written,
        next_step=f"open {job.output}" if job.output else "",
        forced=cloud.forced,
        extra={"kind": "inspection", "simulated": is_simulated, "frame": cloud.frame},
    )
    return delivery.in_summary(summary)


WORDS = {
    "diameter": "diameter_mm",
    "range": "diameter_range_mm",
    "half-angle": "half_angle_deg",
    "axis": "axis",
    "seed": "seed_mm",
    "region": "region",
}
"""What a description of a feature may say, and which field of `WantedFeature` it sets."""


def inspect_feature(
    job: Job, path: Path, wanted: WantedFeature, *, options: InspectionOptions | None = None
) -> Summary:
    """Inspect one feature of a cloud."""
    options = options or InspectionOptions()
    job.places(".html")
    source = read_inspected(path)
    cloud = source.cloud
    found = solved(feature_of(cloud, wanted, options), path)
    report = _as_read(feature_report(found, cloud), source)
    return finished_inspection(job, cloud, report, (path,), (options, wanted))


def inspect_relation(
    job: Job,
    path: Path,
    first: WantedFeature,
    second: WantedFeature,
    *,
    options: InspectionOptions | None = None,
) -> Summary:
    """Inspect how two features of a cloud stand to each other; the rest as `inspect_feature`."""
    options = options or InspectionOptions()
    job.places(".html")
    source = read_inspected(path)
    cloud = source.cloud
    both = [solved(feature_of(cloud, wanted, options), path) for wanted in (first, second)]
    report = _as_read(relation_report(relate(cloud, both[0], both[1]), cloud), source)
    return finished_inspection(job, cloud, report, (path,), (options, first, second))


def parse_feature(text: str, where: str) -> WantedFeature:
    """The feature of a description such as ``cylinder:diameter=20:seed=1,2,3``."""
    kind, *parts = text.split(":")
    words = ", ".join(WORDS)
    remedy = f"write KIND:WORD=VALUE:..., as cylinder:diameter=20:seed=1,2,3; words are {words}"
    if kind not in SHAPE_KINDS:
        what = f"there is no feature '{kind}'"
        raise OptionError(what, where=where, remedy=f"give one of {', '.join(SHAPE_KINDS)}")
    given: dict[str, object] = {}
    for part in parts:
        word, is_there, value = part.partition("=")
        if word not in WORDS or not is_there:
            raise OptionError(f"'{part}' is not understood", where=where, remedy=remedy)
        try:
            numbers = tuple(float(item) for item in value.split(","))
        except ValueError as error:
            raise OptionError(f"'{part}' holds no numbers", where=where, remedy=remedy) from error
        given[WORDS[word]] = numbers
    return wanted_feature(kind, where, given)


def wanted_feature(kind: str, where: str, given: dict[str, object]) -> WantedFeature:
    """A feature of values that are numbers, or tuples of them, by field; None for not given."""
    values = {name: value for name, value in given.items() if value not in (None, ())}
    for name, value in values.items():
        single = name in ("diameter_mm", "half_angle_deg")
        if isinstance(value, tuple) and single:
            if len(value) != 1:
                raise OptionError(f"{len(value)} numbers for one", where=where, remedy="give one")
            values[name] = value[0]
        elif name == "region" and isinstance(value, tuple):
            values[name] = Box.from_limits(value, where)
        elif name == "diameter_range_mm" and isinstance(value, tuple) and len(value) != 2:
            raise OptionError(
                f"{len(value)} numbers where 2 are needed", where=where, remedy="give least,largest"
            )
    known = {item.name for item in fields(WantedFeature)}
    try:
        return WantedFeature(kind=kind, **{k: v for k, v in values.items() if k in known})  # type: ignore[arg-type]
    except OptionError as error:
        raise OptionError(error.what, where=where, remedy=error.remedy) from error
