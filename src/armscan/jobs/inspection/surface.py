# SPDX-License-Identifier: Apache-2.0
"""From a cloud to a cleaned one, and to a file of triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import part_of
from armscan.inspection.cleaning import CleaningOptions, clean_cloud
from armscan.jobs.job import Job
from armscan.reconstruction.surface import (
    ScannedSurface,
    SurfaceOptions,
    draw_surface,
    thinned_surface,
)
from armscan.report.cloud import cleaning_page, cleaning_quantities, cleaning_table
from armscan.report.quantity import Quantity, Summary, sentences
from armscan.storage.clouds import (
    CLOUD_SUFFIXES,
    cloud_bytes,
    cloud_losses,
    read_cloud_file,
)
from armscan.storage.files import path_text
from armscan.storage.image_paths import are_simulated
from armscan.storage.parts.meshes import SURFACE_SUFFIXES, encoded_surface

LEAST_TRIANGLES = 4
FINE = 0.6
"""Cells below this part of the lines' distance are said to be too small."""
MANY_WITHOUT = 0.2
"""Part of the points without a normal from which it is said."""
COARSE_STL_MM = 0.001
"""Spacing of an STL file's numbers from which it is said: far from the origin they are coarse."""


def draw_mesh(
    job: Job,
    path: Path,
    *,
    options: SurfaceOptions | None = None,
    n_triangles: int | None = None,
) -> Summary:
    """Draw triangles over a cloud and write them.

    ``n_triangles``: triangles that are kept, the flattest joined first; None for all.
    """
    if n_triangles is not None and n_triangles < LEAST_TRIANGLES:
        raise OptionError(f"--triangles is {n_triangles}", remedy="give 4 or more")
    job.places(*SURFACE_SUFFIXES, reads=(path,))
    source = read_cloud_file(path)
    cloud = source.cloud
    try:
        full = draw_surface(cloud, options)
    except EstimationError as error:
        raise EstimationError(error.what, where=path_text(path), remedy=error.remedy) from error
    surface: ScannedSurface = full
    extra: tuple[Quantity, ...] = ()
    if n_triangles is not None and n_triangles < len(full.triangles):
        surface = thinned_surface(full, n_triangles, cloud.points_mm)
        extra = (_moved(full, surface),)
    quantities = (*_quantities(surface), *extra)
    is_simulated = cloud.is_simulated or are_simulated((path,))
    written: tuple[Path, ...] = ()
    rounded: tuple[str, ...] = ()
    if job.output is not None:
        if job.output.suffix.lower() == ".stl":
            rounded = _rounded(surface.vertices_mm)
        title = f"armscan mesh of {path.name}, mm" + (", simulated data" if is_simulated else "")
        content = encoded_surface(
            job.output.suffix.lower(), surface.vertices_mm, surface.triangles, title
        )
        written = job.write({job.output: content})
    return Summary(
        title="Mesh" + (" (simulated data)." if is_simulated else "."),
        quantities=quantities,
        warnings=sentences((*source.remarks, *source.doubts, *_warnings(full), *rounded)),
        written=written,
        next_step=f"open {job.output} in any program for meshes" if written else "",
        forced=cloud.forced,
        extra={"kind": "mesh", "simulated": is_simulated, "frame": cloud.frame},
    )


def _moved(full: ScannedSurface, thinned: ScannedSurface) -> Quantity:
    """How far the thinned surface's corners lie from the full one."""
    surface = PartSurface(part_of(full.vertices_mm[full.triangles], source="the full surface"))
    off = np.abs(surface.distance(thinned.vertices_mm).signed_mm)
    text = f"by thinning {len(full.triangles):,} triangles, at most"
    return Quantity("moved_mm", "Moved", float(off.max()), unit="mm", meaning=text)


def _quantities(surface: ScannedSurface) -> tuple[Quantity, ...]:
    return (
        Quantity("n_triangles", "Triangles", len(surface.triangles)),
        Quantity("n_vertices", "Vertices", len(surface.vertices_mm)),
        Quantity("area_mm2", "Area", surface.area_mm2, unit="mm²"),
        Quantity(
            "cell_mm", "Cell", surface.cell_mm, unit="mm", meaning="what is smaller is smoothed"
        ),
        Quantity(
            "reach_mm",
            "Reach",
            surface.reach_mm,
            unit="mm",
            meaning="no corner lies farther from a measured point",
        ),
        Quantity(
            "n_border_edges",
            "Border",
            surface.n_border_edges,
            unit="edges",
            meaning="rims of holes and of what was scanned",
        ),
        Quantity("n_points", "Points", surface.n_points, meaning="with a normal"),
    )


def _warnings(surface: ScannedSurface) -> tuple[str, ...]:
    part = surface.n_without_normal / (surface.n_points + surface.n_without_normal)
    texts = []
    if part >= MANY_WITHOUT:
        texts.append(
            f"{part:.0%} of the points have no normal and are left out: they lie on single lines, "
            "or on no plane"
        )
    if surface.cell_mm < FINE * surface.spacing_mm:
        texts.append(
            f"cells of {surface.cell_mm:.3g} mm, but lines up to {surface.spacing_mm:.3g} mm "
            "apart: the surface falls into strips; leave --cell out, or scan more densely"
        )
    return tuple(texts)


def _rounded(vertices_mm: FloatArray) -> tuple[str, ...]:
    """What STL's single precision takes from corners far from the origin."""
    far_mm = float(np.abs(vertices_mm).max(initial=0.0))
    step_mm = float(np.spacing(np.float32(far_mm)))
    if step_mm <= COARSE_STL_MM:
        return ()
    return (
        f"STL holds coordinates of {far_mm:,.0f} mm as multiples of {step_mm:.2g} mm: write .ply, "
        "which holds all digits, or move the cloud nearer to the origin",
    )


def clean(job: Job, path: Path, options: CleaningOptions) -> Summary:
    """Clean a cloud."""
    if job.output is None:
        raise OptionError("no output is named", where="-o", remedy="name the cloud to write")
    places = job.places(*CLOUD_SUFFIXES, beside=(".html",), reads=(path,))
    source = read_cloud_file(path)
    cloud = source.cloud
    found = clean_cloud(cloud, options)
    losses = cloud_losses(found.cloud, job.output, source.dropped)
    lost = (f"the new file does not hold: {', '.join(losses)}",) if losses else ()
    warnings = (*source.remarks, *source.doubts, *found.warnings, *lost)
    provenance = job.provenance((path,), (options,), warnings=warnings, forced=cloud.forced)
    is_simulated = cloud.is_simulated or are_simulated((path,))
    page = cleaning_page(found, cloud.points_mm, provenance, is_simulated=is_simulated)
    written = job.write({places[0]: cloud_bytes(found.cloud, job.output), places[1]: page})
    return Summary(
        title="Cloud cleaned" + (" (simulated data)." if is_simulated else "."),
        quantities=cleaning_quantities(found),
        tables=(cleaning_table(found),),
        warnings=sentences(warnings),
        written=written,
        next_step=f"open {places[1]}",
        forced=cloud.forced,
        extra={"kind": "cleaning", "simulated": is_simulated, "frame": cloud.frame},
    )
