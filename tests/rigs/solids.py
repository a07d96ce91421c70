# SPDX-License-Identifier: Apache-2.0
"""Solids of the CAD kernel that the extra ``cad`` brings: workpieces, and STEP files of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt
from OCP.Interface import Interface_Static
from OCP.Message import Message
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer

from armscan.inspection.cad.part import PartModel, part_of
from rigs.parts import sphere_part


def box(low: tuple[float, float, float], size: tuple[float, float, float]) -> Any:
    return BRepPrimAPI_MakeBox(gp_Pnt(*low), *size).Shape()


def cylinder(
    low: tuple[float, float, float],
    way: tuple[float, float, float],
    radius: float,
    length: float,
) -> Any:
    axis = gp_Ax2(gp_Pnt(*low), gp_Dir(*way))
    return BRepPrimAPI_MakeCylinder(axis, radius, length).Shape()


def cut(shape: Any, *others: Any) -> Any:
    for other in others:
        shape = BRepAlgoAPI_Cut(shape, other).Shape()
    return shape


def fused(shape: Any, *others: Any) -> Any:
    for other in others:
        shape = BRepAlgoAPI_Fuse(shape, other).Shape()
    return shape


def block() -> Any:
    """80 x 50 x 20 mm with a bore of 16, a smaller one and a slot: no symmetry."""
    return cut(
        box((0, 0, 0), (80, 50, 20)),
        cylinder((25, 20, -1), (0, 0, 1), 8.0, 30.0),
        cylinder((62, 37, -1), (0, 0, 1), 4.0, 30.0),
        box((45, -1, 14), (12, 30, 10)),
    )


def bracket() -> Any:
    """Two plates at a right angle with a rib and holes."""
    return cut(
        fused(box((0, 0, 0), (70, 40, 6)), box((0, 0, 0), (6, 40, 45)),
              box((6, 12, 6), (25, 5, 18))),
        cylinder((50, 12, -1), (0, 0, 1), 4.0, 10.0),
        cylinder((55, 30, -1), (0, 0, 1), 2.5, 10.0),
        cylinder((-1, 26, 32), (1, 0, 0), 5.0, 10.0),
    )  # fmt: skip


def shaft() -> Any:
    """A turned part with a flat and a cross hole off its middle."""
    return cut(
        fused(
            cylinder((0, 0, 0), (0, 0, 1), 15.0, 30.0),
            cylinder((0, 0, 30), (0, 0, 1), 10.0, 40.0),
        ),
        box((-20, 11, 4), (40, 10, 18)),
        cylinder((-20, 0, 48), (1, 0, 0), 3.0, 20.0),
    )


def housing() -> Any:
    """A hollow box, open above, with a boss and a window."""
    return cut(
        fused(
            cut(box((0, 0, 0), (60, 45, 30)), box((3, 3, 4), (54, 39, 30))),
            cylinder((18, 15, 3), (0, 0, 1), 6.0, 20.0),
        ),
        cylinder((18, 15, 10), (0, 0, 1), 3.0, 20.0),
        box((40, -1, 12), (12, 6, 9)),
    )


def bent_body() -> PartModel:
    """A closed free-form face without an edge."""
    corners = sphere_part(25.0, 100).corners_mm * [1.0, 0.75, 1.4]
    bent = corners + 3.0 * np.sin(corners[:, :, ::-1] / [7.0, 9.0, 11.0] + [0.3, 1.0, 2.0])
    return part_of(bent, source="bent body")


def write_step(shape: Any, path: Path, unit: str = "MM") -> Path:
    """Write a STEP file; ``unit`` is that of its numbers, MM, M or INCH."""
    messenger = Message.DefaultMessenger_s()
    for printer in list(messenger.Printers()):
        messenger.RemovePrinter(printer)
    writer = STEPControl_Writer()
    Interface_Static.SetCVal_s("write.step.unit", unit)
    writer.Transfer(shape, STEPControl_AsIs)
    writer.Write(str(path))
    Interface_Static.SetCVal_s("write.step.unit", "MM")
    return path
