# SPDX-License-Identifier: Apache-2.0
"""STEP files, their faces made into triangles within a stated chord error."""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError, InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.inspection.cad.part import PartModel, part_of
from armscan.storage.files import path_text, read_bytes

STEP_SUFFIXES = (".step", ".stp")
LEAST_CHORD_MM = 1e-5
MOST_CHORDS = 2.5e6
"""Size of a part over the chord error, 5 m at 0.002 mm: a ball has eight million triangles then."""
QUOTED = re.compile(rb"'[^']*'")
KINDS = {
    "surfaceofextrusion": "extruded",
    "surfaceofrevolution": "turned",
    "beziersurface": "free form",
    "bsplinesurface": "free form",
    "offsetsurface": "offset",
    "othersurface": "surface",
}
"""Words for kinds of surface that are no plane, cylinder, cone, sphere or torus."""
REFERRED, DEFINED = re.compile(rb"#(\d{1,18})"), re.compile(rb"#(\d{1,18})\s*=")


@dataclass(frozen=True, slots=True)
class ChordError:
    """How far triangles may lie from their surface, and the normal may turn along an edge.

    By default a fifth of what a scanner of 0.01 mm tells.
    """

    chord_mm: float = 0.002
    angle_deg: float = 10.0

    def __post_init__(self) -> None:
        if not LEAST_CHORD_MM <= self.chord_mm < math.inf or not 0.1 <= self.angle_deg <= 90.0:
            raise OptionError(
                f"a chord error of {self.chord_mm:g} mm and {self.angle_deg:g} degrees",
                where="--chord-mm",
                remedy="give a length in mm, such as 0.002",
            )


def read_step(path: Path, chord: ChordError) -> PartModel:
    """Read a STEP file; lengths are in mm whatever the file's unit, and faces stay as they are.

    Raises
    ------
    OptionError
        If the extra ``cad`` is not installed.
    InputError
        If it holds no faces, or a part so large that its triangles would be too many.
    """
    where = path_text(path)
    data = read_bytes(path)
    if not data.lstrip().startswith(b"ISO-10303-21"):
        raise FileFormatError("this is no STEP file", where=where, remedy="export it again")
    if b"END-ISO-10303-21" not in data[-4096:]:
        raise FileFormatError(
            "the STEP file is cut short: its last line is missing",
            where=where,
            remedy="copy the file again",
        )
    if missing := _missing_entities(data):
        raise FileFormatError(
            f"the STEP file refers to {missing:,} entities that it does not hold",
            where=where,
            remedy="copy the file again",
        )
    shape = _shape(data, path.name, where)
    _check_size(shape, chord, where)
    corners, kinds = _triangles_of_faces(shape, chord)
    if not corners:
        raise InputError("the STEP file holds no faces", where=where, remedy="export a solid")
    number = np.repeat(np.arange(len(corners)), [len(one) for one in corners])
    return part_of(
        np.concatenate(corners),
        source=path.name,
        face=number.astype(np.int64),
        face_names=[f"{kind} {k + 1}" for k, kind in enumerate(kinds)],
    )


def _missing_entities(data: bytes) -> int:
    """Entities that others refer to and that are not there: the reader would leave faces out."""
    plain = QUOTED.sub(b"", data)
    defined = {int(number) for number in DEFINED.findall(plain)}
    return len({int(number) for number in REFERRED.findall(plain)} - defined)


def _shape(data: bytes, name: str, where: str) -> Any:
    """The solids and surfaces of a file."""
    try:
        from OCP.IFSelect import IFSelect_RetDone
        from OCP.Message import Message
        from OCP.STEPControl import STEPControl_Reader
    except ImportError as error:
        _raise_interrupt(error)
        raise OptionError(
            "STEP files need the extra 'cad', which is not installed",
            where=where,
            remedy="pip install 'armscan[cad]', or export the model as STL",
        ) from error
    # its messages would go to the terminal, between ours
    messenger = Message.DefaultMessenger_s()
    for printer in list(messenger.Printers()):
        messenger.RemovePrinter(printer)
    reader = STEPControl_Reader()
    status = reader.ReadStream(name, io.BytesIO(data))
    if status != IFSelect_RetDone or reader.TransferRoots() == 0:
        raise FileFormatError(
            "the STEP file is not understood", where=where, remedy="export it again"
        )
    return reader.OneShape()


def _check_size(shape: Any, chord: ChordError, where: str) -> None:
    """Refuse what has too many triangles for any memory: most likely its unit is a wrong one."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    box = Bnd_Box()
    BRepBndLib.Add_s(shape, box)
    across = 0.0 if box.IsVoid() else math.sqrt(box.SquareExtent())
    if across > MOST_CHORDS * chord.chord_mm:
        raise InputError(
            f"the model measures {across:,.0f} mm across: triangles within {chord.chord_mm:g} mm "
            "of it would be too many",
            where=where,
            remedy="if the part is smaller, export it with its right unit; if it is so large, give "
            f"--chord-mm {1.1 * across / MOST_CHORDS:.2g}",
        )


def _raise_interrupt(error: BaseException) -> None:
    """Raise the Ctrl-C that an import, stopped within a compiled module, reports as its failure."""
    seen: list[BaseException] = []
    waiting: list[BaseException | None] = [error]
    while waiting:
        one = waiting.pop()
        if isinstance(one, KeyboardInterrupt):
            raise one
        if one is not None and one not in seen:
            seen.append(one)
            waiting += [one.__cause__, one.__context__]


def _triangles_of_faces(shape: Any, chord: ChordError) -> tuple[list[FloatArray], list[str]]:
    """(F, 3, 3) corners of the triangles of each face, and the kind of each face."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.TopAbs import TopAbs_FACE, TopAbs_REVERSED
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS

    BRepMesh_IncrementalMesh(shape, chord.chord_mm, False, math.radians(chord.angle_deg), False)
    corners: list[FloatArray] = []
    kinds: list[str] = []
    faces = TopExp_Explorer(shape, TopAbs_FACE)
    # of older versions the method has another name
    as_face = getattr(TopoDS, "Face_s", None) or TopoDS.Face
    while faces.More():
        face, location = as_face(faces.Current()), TopLoc_Location()
        mesh = BRep_Tool.Triangulation_s(face, location)
        if mesh is not None:
            is_turned = face.Orientation() == TopAbs_REVERSED
            corners.append(_corners(mesh, location.Transformation(), is_turned))
            kinds.append(face_kind(BRepAdaptor_Surface(face).GetType().name))
        faces.Next()
    return corners, kinds


def face_kind(name: str) -> str:
    """Word for a kind of surface, from its name in OCP, such as ``GeomAbs_BSplineSurface``."""
    plain = name.removeprefix("GeomAbs_").lower()
    return KINDS.get(plain, plain)


def _corners(mesh: Any, transformation: Any, is_turned: bool) -> FloatArray:
    """(F, 3, 3) corners, anticlockwise seen from outside."""
    nodes = [mesh.Node(k + 1) for k in range(mesh.NbNodes())]
    points = np.array([(node.X(), node.Y(), node.Z()) for node in nodes])
    matrix = np.array([[transformation.Value(i + 1, j + 1) for j in range(4)] for i in range(3)])
    points = points @ matrix[:, :3].T + matrix[:, 3]
    rows = np.array([mesh.Triangle(k + 1).Get() for k in range(mesh.NbTriangles())]) - 1
    return np.asarray(points[rows[:, ::-1] if is_turned else rows])
