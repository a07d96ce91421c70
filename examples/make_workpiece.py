# SPDX-License-Identifier: Apache-2.0
"""Write the workpiece of the twin: its CAD model, and the part as it was made, with two faults.

    python examples/make_workpiece.py src/armscan/simulation/workpiece

A block with a bore, a hole, a rib, an upright pin, a pad and a free-form face. As made, the bore is
0.05 mm too large in diameter and the pad 0.08 mm too high. Needs the extra ``cad``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
from OCP.BRepMesh import BRepMesh_IncrementalMesh
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakePrism
from OCP.collections import Array2_gp_Pnt
from OCP.GeomAbs import GeomAbs_C2
from OCP.GeomAPI import GeomAPI_PointsToBSplineSurface
from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt, gp_Vec
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
from OCP.StlAPI import StlAPI_Writer

CHORD_MM, ANGLE_RAD = 0.002, 0.15
"""Of the triangles, which stand for the exact surface in the renderer."""
BLOCK_MM = (80.0, 56.0, 14.0)


@dataclass(frozen=True)
class Sizes:
    """What may be made wrongly."""

    bore_mm: float = 20.0
    pad_mm: float = 6.0


def _block(low: tuple[float, float, float], size: tuple[float, float, float]) -> Any:
    return BRepPrimAPI_MakeBox(gp_Pnt(*low), *size).Shape()


def _round(x: float, y: float, z: float, diameter: float, height: float) -> Any:
    axis = gp_Ax2(gp_Pnt(x, y, z), gp_Dir(0.0, 0.0, 1.0))
    return BRepPrimAPI_MakeCylinder(axis, 0.5 * diameter, height).Shape()


def _free_form(x: tuple[float, float], y: tuple[float, float], foot: float) -> Any:
    """A solid under a B-spline face, down to a flat foot."""
    n = 13
    u, v = np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, n)
    points = Array2_gp_Pnt(1, n, 1, n)
    for i, a in enumerate(u):
        for j, b in enumerate(v):
            height = 4.5 + 2.2 * np.sin(np.pi * a) * np.sin(1.4 * np.pi * b) + 1.6 * a * b - 0.8 * b
            place = x[0] + a * (x[1] - x[0]), y[0] + b * (y[1] - y[0]), foot + float(height)
            points.SetValue(i + 1, j + 1, gp_Pnt(*(float(c) for c in place)))
    surface = GeomAPI_PointsToBSplineSurface(points, 3, 5, GeomAbs_C2, 1e-6).Surface()
    face = BRepBuilderAPI_MakeFace(surface, 1e-7).Face()
    column = BRepPrimAPI_MakePrism(face, gp_Vec(0.0, 0.0, -12.0)).Shape()
    below = _block((x[0] - 1.0, y[0] - 1.0, foot - 20.0), (60.0, 60.0, 18.0))
    return BRepAlgoAPI_Cut(column, below).Shape()


def workpiece(sizes: Sizes) -> Any:
    """The solid; z = 0 is its underside, x and y are centred on the block."""
    length, width, height = BLOCK_MM
    part = _block((-0.5 * length, -0.5 * width, 0.0), BLOCK_MM)
    added = (
        _round(4.0, 16.0, height - 1.0, 12.0, 9.0),
        _block((-36.0, -24.0, height - 1.0), (4.0, 28.0, 9.0)),
        _block((-24.0, -24.0, height - 1.0), (22.0, 16.0, sizes.pad_mm + 1.0)),
        _free_form((8.0, 36.0), (-24.0, 6.0), height),
    )
    for solid in added:
        part = BRepAlgoAPI_Fuse(part, solid).Shape()
    for x, y, diameter in ((-18.0, 12.0, sizes.bore_mm), (24.0, 18.0, 8.0)):
        part = BRepAlgoAPI_Cut(part, _round(x, y, -1.0, diameter, height + 2.0)).Shape()
    return part


def write_stl(shape: Any, path: Path) -> None:
    """Triangles at the chord error above, binary."""
    BRepMesh_IncrementalMesh(shape, CHORD_MM, False, ANGLE_RAD, True).Perform()
    writer = StlAPI_Writer()
    writer.ASCIIMode = False
    if not writer.Write(shape, str(path)):
        raise OSError(f"cannot write {path}")


def main(folder: Path) -> None:
    """Write ``workpiece.step``, ``workpiece.stl`` and ``as_made.stl``."""
    folder.mkdir(parents=True, exist_ok=True)
    nominal = workpiece(Sizes())
    writer = STEPControl_Writer()
    writer.Transfer(nominal, STEPControl_AsIs)
    writer.Write(str(folder / "workpiece.step"))
    write_stl(nominal, folder / "workpiece.stl")
    write_stl(workpiece(Sizes(bore_mm=20.05, pad_mm=6.08)), folder / "as_made.stl")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
