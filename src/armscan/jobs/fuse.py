# SPDX-License-Identifier: Apache-2.0
"""From clouds to one with a point a voxel, and its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armscan.errors import InputError
from armscan.fusion.digest import CloudDigest, percentiles
from armscan.fusion.point_spool import PointSpool
from armscan.fusion.voxel_map import VoxelMap
from armscan.jobs.job import Job, noise_remarks
from armscan.models.calibration import Provenance
from armscan.pipeline.progress import ProgressEvent
from armscan.records.cloud import FUSED, PointCloud
from armscan.report.cloud import FusedCloud, fused_page, fused_quantities
from armscan.report.quantity import Summary, sentences
from armscan.storage.clouds import (
    CLOUD_SUFFIXES,
    CloudPiece,
    cloud_losses,
    cloud_parts,
    read_cloud_pieces,
)
from armscan.storage.documents import fingerprint
from armscan.storage.files import scratch_folder, told_of

STAGE = "fuse"
NOT_KNOWN = (
    "the points' covariances are not known: all count alike, and the fused points have none either"
)

SENSOR_MOVES = (
    "the clouds are in the frame Sensor, which moves with the head: they belong together only if "
    "head and object stood still between them; `armscan register` joins them by markers, "
    "`armscan reconstruct` places a scan in Base"
)


def fuse(job: Job, paths: Sequence[Path], size_mm: float) -> Summary:
    """Put clouds of one frame together, one point a voxel of edge ``size_mm``."""
    places = job.places(*CLOUD_SUFFIXES, beside=(".html",), reads=paths)
    _refuse_twice(paths)
    remarks: list[str] = []
    with scratch_folder(places[0]) as scratch:
        voxels = VoxelMap(size_mm, scratch)
        try:
            for k, path in enumerate(paths):
                job.progress(ProgressEvent(STAGE, k, len(paths), path.name))
                for piece in read_cloud_pieces(path):
                    told = (*piece.remarks, *piece.doubts, *noise_remarks(piece.cloud))
                    remarks += (f"{path.name}: {remark}" for remark in told)
                    with told_of(str(path)):
                        voxels.add(piece.cloud)
            job.progress(ProgressEvent(STAGE, len(paths), len(paths)))
            if voxels.n_points == 0:
                raise InputError("the clouds hold no point", where=", ".join(map(str, paths)))
            is_moved = voxels.frame == "Sensor" and len(paths) > 1
            warnings = (
                *dict.fromkeys(remarks),
                *((SENSOR_MOVES,) if is_moved else ()),
                *(() if voxels.has_covariance else (NOT_KNOWN,)),
            )
            provenance = job.provenance(paths, (), warnings=warnings, forced=voxels.forced)
            return _written(job, places, voxels, scratch, provenance)
        finally:
            voxels.close()


def fused_marks(voxels: VoxelMap) -> PointCloud:
    """Names and marks of a map's fused points, and none of these."""
    empty = PointCloud.empty(
        frame=voxels.frame or "Part", sheet_names=(FUSED,), exposure_sources=(FUSED,)
    )
    return replace(
        empty,
        normals=np.zeros((0, 3)) if voxels.has_normals else None,
        noise_length=np.zeros(0) if voxels.has_noise_length else None,
        is_simulated=voxels.is_simulated,
        forced=voxels.forced,
        calibrations=voxels.calibrations,
    )


def fused_pieces(voxels: VoxelMap) -> Iterator[CloudPiece]:
    """A map's points, as files take them."""
    for piece in voxels.fused():
        yield CloudPiece(piece.cloud, piece.cloud.sigma_mm, piece.n_points)


def _refuse_twice(paths: Sequence[Path]) -> None:
    """Points that count twice would seem more certain than they are."""
    first: dict[str, Path] = {}
    for path in paths:
        same = first.setdefault(fingerprint(path).sha256, path)
        if same is not path:
            raise InputError(
                f"its content is that of {same}: its points would count twice",
                where=str(path),
                remedy="give each cloud once",
            )


def _written(
    job: Job, places: Sequence[Path], voxels: VoxelMap, scratch: Path, provenance: Provenance
) -> Summary:
    with PointSpool(voxels.frame or "Part", (FUSED,), scratch) as points:
        for piece in voxels.fused():
            points.add(piece.cloud)
        marks = fused_marks(voxels)
        digest = CloudDigest.of_spool(points, marks)
        n_points = len(points)
        private = percentiles(lambda: (part[:, 1] for part in points.sigmas()), (50.0,), n_points)
    result = FusedCloud(
        voxels.size_mm,
        voxels.n_points,
        digest,
        float(private[0]),
        has_covariance=voxels.has_covariance,
    )
    warnings = provenance.warnings
    content = cloud_parts(places[0], marks, n_points, fused_pieces(voxels), is_fused=True)
    written = job.write({places[0]: content, places[1]: fused_page(result, provenance, warnings)})
    losses = cloud_losses(marks, places[0])
    kind = places[0].suffix.lstrip(".").upper()
    lost = (f"the {kind} file does not hold {', '.join(losses)}",) if losses else ()
    return Summary(
        title="Clouds fused" + (" (simulated images)." if voxels.is_simulated else "."),
        quantities=fused_quantities(result),
        warnings=sentences((*warnings, *lost)),
        written=written,
        next_step=f"open {written[-1]}",
        forced=voxels.forced,
        extra={"kind": "fused", "simulated": voxels.is_simulated},
    )
