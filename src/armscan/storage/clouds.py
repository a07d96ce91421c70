# SPDX-License-Identifier: Apache-2.0
"""Point clouds in every format by the suffix of their file, and conversion between them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError, OptionError, OutputError, listed
from armscan.geometry.arrays import IntArray
from armscan.models.calibration import CameraCalibration, SensorCalibration
from armscan.records.cloud import SMALLEST_EXTENT_MM, PointCloud
from armscan.storage.documents import (
    SCANNER_SCHEMA,
    document_schema,
    read_calibration,
    read_camera_calibration,
    read_scanner_calibration,
)
from armscan.storage.files import check_outputs, is_file, read_bytes, write_files
from armscan.storage.foreign import camera_info_yaml
from armscan.storage.formats import e57, las, meshes, pcd, text
from armscan.storage.formats.columns import (
    FOREIGN_FRAME,
    N_POINTS,
    CloudColumns,
    CloudPiece,
    cloud_of_columns,
    dropped_columns,
)
from armscan.storage.formats.ply import (
    parse_ply,
    ply_bytes,
    ply_columns,
    ply_parts,
    ply_pieces,
    read_ply,
)
from armscan.storage.formats.text import SIGMA_LOSS, XYZ_LOSES, xyz_bytes
from armscan.storage.image_paths import are_simulated
from armscan.storage.parts.meshes import MESH_SUFFIXES, encoded_surface, read_part
from armscan.storage.parts.step import STEP_SUFFIXES, ChordError

__all__ = (
    "CLOUD_SUFFIXES",
    "FOREIGN_FRAME",
    "N_POINTS",
    "XYZ_LOSES",
    "CloudFile",
    "CloudPiece",
    "cloud_bytes",
    "cloud_losses",
    "cloud_parts",
    "convert_file",
    "parse_ply",
    "ply_bytes",
    "ply_parts",
    "read_cloud",
    "read_cloud_file",
    "read_cloud_pieces",
    "read_ply",
    "write_cloud",
    "xyz_bytes",
)


@dataclass(frozen=True, slots=True)
class CloudFormat:
    """How a cloud stands in one kind of file.

    Parameters
    ----------
    read
        Columns of a file's content and path.
    write
        Content of a file that holds a cloud; None for a kind that cannot.
    losses
        What that content does not hold, in words.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[bytes, Path], CloudColumns]
    write: Callable[[CloudPiece], bytes] | None
    losses: Callable[[PointCloud], tuple[str, ...]]


def _lost(*words: str) -> Callable[[PointCloud], tuple[str, ...]]:
    return lambda _: words


LAZ, LAS = (partial(las.las_bytes, is_packed=is_packed) for is_packed in (True, False))
FORMATS = (
    CloudFormat("PLY", (".ply",), ply_columns, ply_bytes, _lost()),
    CloudFormat("E57", (".e57",), e57.e57_columns, e57.e57_bytes, _lost()),
    CloudFormat("LAZ", (".laz",), las.las_columns, LAZ, las.las_losses),
    CloudFormat("LAS", (".las",), las.las_columns, LAS, las.las_losses),
    CloudFormat("PCD", (".pcd",), pcd.pcd_columns, pcd.pcd_bytes, _lost()),
    CloudFormat("CSV", (".csv",), text.text_columns, text.csv_bytes, _lost(*text.CSV_LOSES)),
    CloudFormat(
        "XYZ", (".xyz", ".asc", ".txt"), text.text_columns, text.xyz_bytes, _lost(*XYZ_LOSES)
    ),
    CloudFormat("OBJ", (".obj",), meshes.obj_columns, meshes.obj_bytes, _lost(*meshes.OBJ_LOSES)),
    CloudFormat("STL", (".stl",), meshes.stl_columns, None, _lost()),
)
BY_SUFFIX = {suffix: item for item in FORMATS for suffix in item.suffixes}
CLOUD_SUFFIXES = tuple(suffix for suffix, item in BY_SUFFIX.items() if item.write is not None)
"""Suffixes of the files that a cloud can be written to."""


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud that armscan wrote, or the points of another program's file, by its suffix.

    Points of other programs come with covariances of zero, which stands for "not known", and as
    one exposure. Of a mesh the vertices are taken for points.

    Raises
    ------
    OptionError
        If its format needs a package that is not installed.
    """
    return read_cloud_file(path).cloud


@dataclass(frozen=True, slots=True, eq=False)
class CloudFile:
    """A cloud as a file held it, and columns that it does not carry.

    ``doubts`` are those of its unit, which who knows the size of things may settle. ``n_points``
    (N,) are the measured points that each of a fused cloud stands for, or None.
    """

    cloud: PointCloud
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    n_points: IntArray | None = None


def read_cloud_file(path: Path) -> CloudFile:
    """As `read_cloud`, with what a person should know of the reading."""
    data = read_bytes(path)
    # a PLY file says so itself, whatever its name
    known = BY_SUFFIX.get(".ply" if data.startswith(b"ply") else path.suffix.lower())
    if known is None:
        is_document = data.lstrip().startswith(b"{")
        raise FileFormatError(
            "this is a JSON document, such as a calibration, where a point cloud is asked for"
            if is_document
            else "this is no point cloud that armscan knows",
            where=str(path),
            remedy=f"give a file {', '.join(BY_SUFFIX)} with x y z in mm",
        )
    found = known.read(data, path)
    return _as_read(found, path)


def _as_read(found: CloudColumns, path: Path) -> CloudFile:
    cloud = cloud_of_columns(found, path)
    counts = found.columns.get(N_POINTS) if found.is_own else None
    doubts = () if found.is_own else _of_units(cloud)
    return CloudFile(cloud, found.remarks, doubts, dropped_columns(found), counts)


def _of_units(cloud: PointCloud) -> tuple[str, ...]:
    """A doubt that points of another program are in mm, where they all lie in one place."""
    if len(cloud) < LEAST_POINTS:
        return ()
    extent = float(np.linalg.norm(np.ptp(cloud.points_mm, axis=0)))
    if extent == 0.0 or extent >= SMALLEST_EXTENT_MM:
        return ()
    return (
        f"all {len(cloud):,} points lie within {extent:.3g} mm: these look like metres; if they "
        "are, multiply the coordinates by 1000",
    )


def cloud_bytes(points: PointCloud | CloudPiece, path: Path) -> bytes:
    """Content of a file that holds a cloud in the format of the path's suffix.

    Raises
    ------
    OptionError
        If there is no such format, or it needs a package that is not installed.
    """
    known = BY_SUFFIX.get(path.suffix.lower())
    if known is None or known.write is None:
        fact, way = f"the output's name ends in '{path.suffix}'", ""
        if known is not None:
            fact = f"{known.name} files hold triangles, and a cloud has none"
            way = "draw them with `armscan mesh`, or "
        remedy = f"{way}end it in {', '.join(CLOUD_SUFFIXES)}"
        raise OptionError(fact, where=str(path), remedy=remedy)
    return known.write(points if isinstance(points, CloudPiece) else CloudPiece(points))


def cloud_parts(
    path: Path,
    marks: PointCloud,
    n_points: int,
    pieces: Iterable[CloudPiece],
    *,
    is_fused: bool = False,
) -> Iterator[bytes]:
    """As `cloud_bytes`, of a cloud that comes in pieces, as `ply_parts` takes them.

    PLY and XYZ files are made piece by piece, others in memory.
    """
    suffix = path.suffix.lower()
    if suffix == ".ply":
        yield from ply_parts(marks, n_points, pieces, is_fused=is_fused)
    elif suffix in (".xyz", ".asc", ".txt"):
        yield from text.xyz_parts(marks, n_points, pieces)
    else:
        whole = CloudPiece.joined(list(pieces))
        marked = replace(
            whole.cloud,
            is_simulated=marks.is_simulated,
            forced=marks.forced,
            calibrations=marks.calibrations,
        )
        yield cloud_bytes(replace(whole, cloud=marked), path)


LEAST_POINTS = 3
"""Points of a cloud of which the extent says something."""
MOST_NAMED = 12
"""Columns that are named, of a file that may have a thousand."""
NO_SIGMA = "the source tells no covariance of its points: it stays zero, which stands for not known"
PIECE_POINTS = 200_000
"""Points of a file that are read at a time: 60 MB with all that is made of them."""


def read_cloud_pieces(path: Path) -> Iterator[CloudFile]:
    """As `read_cloud_file`, a binary PLY file piece by piece; remarks come with the first."""
    pieces = ply_pieces(path, PIECE_POINTS) if is_file(path) else None
    if pieces is None:
        yield read_cloud_file(path)
        return
    for k, found in enumerate(pieces):
        piece = _as_read(found, path)
        # the few points of a last piece may well lie in one place
        yield piece if k == 0 else replace(piece, remarks=(), doubts=())


def cloud_losses(cloud: PointCloud, path: Path, dropped: Sequence[str] = ()) -> tuple[str, ...]:
    """What a file of a cloud in the format of the path's suffix does not hold, in words.

    ``dropped`` are columns of the source that the cloud does not carry; some of many are named.
    """
    losses = BY_SUFFIX[path.suffix.lower()].losses(cloud)
    told = [name for name in dropped if not any(text.startswith(name) for text in losses)]
    if not told:
        return losses
    word = "column" if len(told) == 1 else "columns"
    return (*losses, f"the {word} {listed(told, MOST_NAMED)}")


def write_cloud(path: Path, cloud: PointCloud, *, is_overwriting: bool = False) -> None:
    """Write a cloud in the format of the path's suffix, whole or not at all.

    Raises
    ------
    OptionError
        As `cloud_bytes`.
    """
    write_files({path: cloud_bytes(cloud, path)}, is_overwriting=is_overwriting)


YAML_LOSES = ("covariance", "evidence and provenance")


@dataclass(frozen=True, slots=True)
class Conversion:
    """What was converted, in words, what the new file does not hold, what the old one was, and its
    marks.
    """

    what: str
    losses: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    forced: tuple[str, ...] = ()


def convert_file(source: Path, output: Path, *, is_overwriting: bool = False) -> Conversion:
    """Write a calibration's camera as ROS ``camera_info``, or a cloud or mesh in another format.

    ``source`` is a cloud in any of `FORMATS`, a model of a part, or any calibration that armscan
    reads: its own camera or sensor document, OpenCV's YAML, XML or JSON, ROS. ``output`` is
    ``.yaml`` for a camera, ``.stl`` for the triangles of a model, one of `CLOUD_SUFFIXES` for a
    cloud, or for the corners of a mesh.

    Raises
    ------
    OptionError
        If there is no way from the one kind of file to the other.
    InputError
        If a mesh is wanted and the source holds no triangles.
    """
    suffix = output.suffix.lower()
    if output.exists() and source.exists() and output.samefile(source):
        raise OutputError(
            f"{output.name} is read, and would be replaced",
            where=str(output),
            remedy="give another name",
        )
    if suffix == ".stl" and source.suffix.lower() in (*MESH_SUFFIXES, *STEP_SUFFIXES):
        return _convert_model(source, output, is_overwriting=is_overwriting)
    is_cloud = source.suffix.lower() in BY_SUFFIX
    if is_cloud is not (suffix in BY_SUFFIX) or not (is_cloud or suffix in (".yaml", ".yml")):
        raise OptionError(
            f"there is no conversion from {source.name} to {output.name}",
            remedy="convert a calibration to .yaml, a part's model to .stl, or a cloud to one of "
            + ", ".join(CLOUD_SUFFIXES),
        )
    check_outputs((output,), is_overwriting=is_overwriting)
    if is_cloud:
        found = read_cloud_file(source)
        cloud = found.cloud
        content = cloud_bytes(CloudPiece(cloud, n_points=found.n_points), output)
        kept = tuple(name for name in found.dropped if name != N_POINTS)
        what = f"cloud to {BY_SUFFIX[suffix].name}"
        losses = cloud_losses(cloud, output, kept)
        holds_sigma = SIGMA_LOSS not in losses
        losses = tuple(words for words in losses if words not in _never_had(found))
        without = (NO_SIGMA,) if holds_sigma and not cloud.covariance_mm2.any() else ()
        conversion = Conversion(
            what, losses, (*found.remarks, *found.doubts, *without), cloud.forced
        )
    else:
        calibration, losses = _camera(source)
        forced = calibration.provenance.forced
        content = camera_info_yaml(calibration.camera, forced).encode()
        losses = (*losses, *YAML_LOSES)
        conversion = Conversion("camera to ROS camera_info", losses, (), forced)
    write_files({output: content}, is_overwriting=is_overwriting)
    return conversion


def _never_had(source: CloudFile) -> set[str]:
    """What files may lose, in their words, of which a source has nothing."""
    cloud = source.cloud
    has = {
        "normals": cloud.normals is not None,
        SIGMA_LOSS: cloud.covariance_mm2.any(),
        "sheet, exposure and segment": any(cloud.sheet_names),
        "intensity": cloud.intensity.any(),
        "where the sensor stood": cloud.seen_from_mm is not None,
        "which calibration": bool(cloud.calibrations),
        "n_points of a fused cloud": source.n_points is not None,
    }
    return {words for words, it_has in has.items() if not it_has}


def _convert_model(source: Path, output: Path, *, is_overwriting: bool) -> Conversion:
    """Write the triangles of a part's model as STL."""
    check_outputs((output,), is_overwriting=is_overwriting)
    part = read_part(source)
    is_simulated = are_simulated((source,))
    title = f"{source.name}, mm{', simulated data' if is_simulated else ''}"
    content = encoded_surface(".stl", part.vertices_mm, part.triangles, title)
    write_files({output: content}, is_overwriting=is_overwriting)
    is_step = source.suffix.lower() in STEP_SUFFIXES
    losses = ("names of faces", "digits beyond single precision")
    drawn = (f"faces are triangles within {ChordError().chord_mm:g} mm of the model",)
    return Conversion("model to STL", losses, (*part.notes, *(drawn if is_step else ())))


def _camera(path: Path) -> tuple[CameraCalibration, tuple[str, ...]]:
    """The (left) camera of a calibration, and what else that holds, in words."""
    schema = document_schema(path)
    if schema == SCANNER_SCHEMA:
        sensor = read_scanner_calibration(path).sensor
        if sensor is None:
            raise FileFormatError(
                "the scanner's sensor delivers points, and has no camera",
                where=str(path),
                remedy="give a calibration with a camera",
            )
        return sensor.camera, (*_beside_camera(sensor), "hand-eye")
    is_own = schema is not None
    calibration = read_calibration(path) if is_own else read_camera_calibration(path)
    if isinstance(calibration, SensorCalibration):
        return calibration.camera, _beside_camera(calibration)
    return calibration, ()


def _beside_camera(sensor: SensorCalibration) -> tuple[str, ...]:
    right = () if sensor.second is None else ("the right camera",)
    return (*right, "light sheets")
