# SPDX-License-Identifier: Apache-2.0
"""Point clouds on disk: PLY, which loses nothing, and XYZ, which says what it loses."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError, InputError
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.storage.images import read_bytes
from armscan.storage.ply_format import PlyVertices, parse_ply, ply_header

POINT = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COVARIANCE = {
    "cov_xx_mm2": (0, 0),
    "cov_xy_mm2": (0, 1),
    "cov_xz_mm2": (0, 2),
    "cov_yy_mm2": (1, 1),
    "cov_yz_mm2": (1, 2),
    "cov_zz_mm2": (2, 2),
}
INDICES = ("sheet", "exposure", "segment")
SIMULATED = "simulated"
"""Comment in the header of a cloud that was measured on rendered images."""
FORCED = "forced"
"""Comment with a reason for which the cloud's calibration was refused, and used all the same."""

XYZ_LOSES = (
    "normals",
    "sigma_mm and covariance",
    "sheet, exposure and segment",
    "intensity",
    "digits beyond 0.1 nm",
)
"""What an XYZ file does not hold."""


def ply_bytes(cloud: PointCloud) -> bytes:
    """Content of a binary little-endian PLY file that holds all of a cloud, in float64 and int32.

    ``sigma_mm`` is written for other programs; it follows from the covariance. Names stand in the
    header: ``comment frame Sensor``, ``comment sheet 0 "A"``, ``comment exposure 0 "laser.png"``;
    of points measured on rendered images also ``comment simulated``, of those of a calibration
    that was refused and forced ``comment forced 0 "why"``.
    """
    columns: dict[str, NDArray[Any]] = {}
    columns |= {name: cloud.points_mm[:, k] for k, name in enumerate(POINT)}
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, k] for k, name in enumerate(NORMAL)}
    columns["sigma_mm"] = cloud.sigma_mm
    columns["sigma_noise_mm"] = cloud.sigma_noise_mm
    columns |= {name: cloud.covariance_mm2[:, i, j] for name, (i, j) in COVARIANCE.items()}
    columns["intensity"] = cloud.intensity
    columns |= {name: getattr(cloud, name) for name in INDICES}
    kinds = [(name, "<i4" if name in INDICES else "<f8") for name in columns]
    table = np.zeros(len(cloud), dtype=kinds)
    for name, values in columns.items():
        table[name] = values
    comments = ["written by armscan", "unit mm", f"frame {cloud.frame}"]
    if cloud.is_simulated:
        comments.append(SIMULATED)
    for word, names in (
        ("sheet", cloud.sheet_names),
        ("exposure", cloud.exposure_sources),
        (FORCED, cloud.forced),
    ):
        comments += [f"{word} {k} {json.dumps(name)}" for k, name in enumerate(names)]
    return ply_header(table.dtype, len(cloud), comments) + table.tobytes()


def xyz_bytes(cloud: PointCloud) -> bytes:
    """Content of an XYZ text file; it lacks `XYZ_LOSES`."""
    buffer = io.StringIO()
    frame = f"{cloud.frame}; {SIMULATED}" if cloud.is_simulated else cloud.frame
    header = f"x_mm y_mm z_mm in frame {frame}; not in this file: {'; '.join(XYZ_LOSES)}"
    header = "\n".join((header, *(f"{FORCED}: {reason}" for reason in cloud.forced)))
    np.savetxt(buffer, cloud.points_mm, fmt="%.7f", header=header)
    return buffer.getvalue().encode()


def read_ply(path: Path) -> PointCloud:
    """Read a cloud that armscan wrote.

    Raises
    ------
    FileFormatError
        If the file is cut short, is no PLY, or lacks what armscan writes.
    """
    vertices = parse_ply(read_bytes(path), str(path))
    table = vertices.table
    names = set(table.dtype.names or ())
    needed = {*POINT, *COVARIANCE, *INDICES, "sigma_noise_mm", "intensity"}
    if missing := sorted(needed - names):
        raise FileFormatError(
            f"the PLY file has no {missing[0]}, so it was not written by armscan",
            where=str(path),
            remedy="use the cloud that `armscan reconstruct` wrote",
        )
    covariance = np.zeros((len(table), 3, 3))
    for name, (i, j) in COVARIANCE.items():
        covariance[:, i, j] = covariance[:, j, i] = table[name]
    has_normals = names.issuperset(NORMAL)
    try:
        return PointCloud(
            frame=_frame(vertices),
            points_mm=np.stack([table[name] for name in POINT], axis=1),
            covariance_mm2=covariance,
            sigma_noise_mm=table["sigma_noise_mm"],
            sheet=table["sheet"],
            sheet_names=_names(vertices, "sheet"),
            exposure=table["exposure"],
            exposure_sources=_names(vertices, "exposure"),
            segment=table["segment"],
            intensity=table["intensity"],
            normals=np.stack([table[n] for n in NORMAL], axis=1) if has_normals else None,
            is_simulated=SIMULATED in vertices.comments,
            forced=_names(vertices, FORCED),
        )
    except InputError as error:
        raise FileFormatError(error.what, where=str(path)) from error


def _frame(vertices: PlyVertices) -> CloudFrame:
    found = [text[6:] for text in vertices.comments if text.startswith("frame ")]
    if len(found) != 1 or found[0] not in get_args(CloudFrame):
        raise InputError("the PLY header does not name the frame of the points")
    return cast(CloudFrame, found[0])


def _names(vertices: PlyVertices, word: str) -> tuple[str, ...]:
    names = []
    for text in vertices.comments:
        if text.startswith(f"{word} "):
            try:
                names.append(str(json.loads(text.split(" ", 2)[2])))
            except (IndexError, ValueError) as error:
                raise InputError(f"the PLY header's comment {text!r} is damaged") from error
    return tuple(names)
