# SPDX-License-Identifier: Apache-2.0
"""From a cloud and the model of its part to deviations, verdict and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.inspection.cad.alignment import AlignMethod
from armscan.inspection.cad.comparison import CadOptions, compare_with_part
from armscan.inspection.cad.datums import Datums, align
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import PartModel
from armscan.jobs.inspection.shapes import read_inspected, region_of
from armscan.jobs.job import Job, solved
from armscan.pipeline.progress import ProgressEvent
from armscan.records.cloud import PointCloud
from armscan.report.inspection.cad import (
    cad_page,
    cad_quantities,
    cad_warnings,
    datum_table,
    statistics_table,
    verdict_table,
)
from armscan.report.quantity import Summary, sentences
from armscan.storage.image_paths import are_simulated
from armscan.storage.parts.meshes import UNITS_MM, read_part
from armscan.storage.parts.step import ChordError
from armscan.storage.parts.tables import (
    datum_faces,
    datum_features,
    deviation_ply_bytes,
    face_table_bytes,
    read_reference_markers,
    read_reference_points,
    read_tolerances,
)

STAGES = ("model", "cloud", "alignment", "deviations")


@dataclass(frozen=True, slots=True)
class PartOptions:
    """How the model is read and the cloud laid on it.

    Parameters
    ----------
    align
        ``best``: wherever the cloud fits best; ``none``: it is in the part's frame; ``321``: by
        three faces; ``features``: by fitted features one after the other; ``points``,
        ``markers``: by points whose places on the part are known.
    datums
        Of ``321`` and ``features``, as of `armscan.storage.parts.tables`.
    unit
        Unit of a mesh: mm, cm, m or inch.
    points
        Table of the nominal places of reference points or markers.
    measured
        Table of their measured places; empty if ``points`` holds them.
    """

    align: AlignMethod = "best"
    datums: str = ""
    unit: str = "mm"
    points: str = ""
    measured: str = ""


def inspect_cad(
    job: Job,
    cloud_path: Path,
    part_path: Path,
    *,
    tolerance: str = "",
    region: Sequence[float] = (),
    part_options: PartOptions | None = None,
    options: CadOptions | None = None,
    chord: ChordError | None = None,
) -> Summary:
    """Compare a cloud with the model of its part, in STL, PLY, OBJ or STEP.

    Beside the page go ``NAME.csv``, a row a face, and ``NAME.ply``, the points with their
    deviations.

    ``tolerance``: a length in mm, or a table of them as of
    `armscan.storage.parts.tables.read_tolerances`. ``region``: ``xmin, xmax, ymin, ymax, zmin,
    zmax`` in mm of the cloud's frame; empty for all of it. ``part_options``, ``options``,
    ``chord``: how to read, lay and judge; tolerances are those of ``tolerance``.
    """
    how, options = part_options or PartOptions(), options or CadOptions()
    _check_options(how)
    reads = (cloud_path, part_path, *map(Path, filter(None, (tolerance, how.points, how.measured))))
    job.places(".html", beside=(".csv", ".ply"), reads=reads)
    box = region_of(region)
    _tell(job, 0, part_path.name)
    part = read_part(part_path, unit=how.unit, chord=chord)
    limit, by_face = read_tolerances(tolerance, part)
    options = replace(options, tolerance_mm=limit, face_tolerances_mm=by_face)
    _tell(job, 1, cloud_path.name)
    source = read_inspected(cloud_path)
    cloud = source.cloud
    if box is not None:
        cloud = cloud.select(box.holds(cloud.points_mm))
    if len(cloud) == 0:
        what, remedy = "the cloud holds no points", "give a cloud that was measured"
        if box is not None:
            what, remedy = "no point is left of the cloud", "give another --region"
        raise InputError(what, where=str(cloud_path), remedy=remedy)
    errors_known = bool(cloud.covariance_mm2.any()) and not np.isfinite(options.uncertainty_mm)
    surface = PartSurface(part)
    _tell(job, 2, how.align)
    datums = _datums(how, part, cloud)
    alignment = solved(align(surface, cloud, how.align, datums, errors_known), cloud_path)
    _tell(job, 3)
    found = solved(compare_with_part(surface, cloud, alignment, options, errors_known), cloud_path)
    _tell(job, 4)
    is_simulated = cloud.is_simulated or are_simulated((cloud_path, part_path))
    warnings = (*source.remarks, *part.notes, *cad_warnings(found, errors_known))
    told = cad_quantities(found, part)
    delivery = job.delivery(cloud, cloud_path)
    written: tuple[Path, ...] = ()
    if job.output is not None:
        inputs = [cloud_path, part_path, *(Path(one) for one in (how.points, how.measured) if one)]
        shown: Sequence[Any] = (how, options, *(() if chord is None else (chord,)))
        provenance = job.provenance(
            inputs, shown, warnings=(*delivery.warnings, *warnings), forced=cloud.forced
        )
        page = cad_page(found, part, cloud, provenance, warnings, is_simulated=is_simulated)
        written = job.write(
            {
                job.output: delivery.on_page(page),
                job.output.with_suffix(".csv"): face_table_bytes(found),
                job.output.with_suffix(".ply"): deviation_ply_bytes(found, cloud, part),
            }
        )
    summary = Summary(
        title=f"{cloud_path.name} against {part_path.name}"
        + (" (simulated data)." if is_simulated else "."),
        quantities=told,
        tables=(verdict_table(found), statistics_table(found), *datum_table(alignment)),
        warnings=sentences(warnings),
        written=written,
        next_step=f"open {job.output}" if job.output else "",
        forced=cloud.forced,
        extra={"kind": "cad inspection", "simulated": is_simulated},
    )
    return delivery.in_summary(summary)


def _check_options(how: PartOptions) -> None:
    if how.unit not in UNITS_MM:
        raise OptionError(
            f"unknown unit '{how.unit}'",
            where="--unit",
            remedy=f"give one of {', '.join(UNITS_MM)}",
        )
    by_datums, by_points = how.align in ("321", "features"), how.align in ("points", "markers")
    faults = (
        (by_datums != bool(how.datums), "--datums",
         "datums go with --align 321 or features, and only with these"),
        (by_points != bool(how.points), "--points",
         "a table of points goes with --align points or markers, and only with these"),
        (bool(how.measured) and not by_points, "--measured",
         "measured places go with --align points or markers only"),
        (how.align == "markers" and not how.measured, "--measured",
         "--align markers needs the list of measured markers"),
    )  # fmt: skip
    for is_wrong, where, what in faults:
        if is_wrong:
            raise OptionError(what, where=where, remedy="give both or none of them")


def _datums(how: PartOptions, part: PartModel, cloud: PointCloud) -> Datums:
    """What the alignment rests on."""
    if how.align == "321":
        return Datums(faces=datum_faces(how.datums, part))
    if how.align == "features":
        return Datums(features=datum_features(how.datums, part))
    if not how.points:
        return Datums()
    path, measured = Path(how.points), Path(how.measured) if how.measured else None
    if how.align == "points":
        return Datums(points=read_reference_points(path, measured))
    return Datums(
        points=solved(read_reference_markers(path, Path(how.measured), cloud.frame), path)
    )


def _tell(job: Job, done: int, item: str = "") -> None:
    job.progress(ProgressEvent("inspect", done, len(STAGES), item))
