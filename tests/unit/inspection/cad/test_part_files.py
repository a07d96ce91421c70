# SPDX-License-Identifier: Apache-2.0
"""Models of parts from files, against trimesh's own writers, and files that are not whole."""

from __future__ import annotations

import builtins
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from armscan.errors import ArmscanError, FileFormatError, InputError, OptionError
from armscan.inspection.cad.part import part_of
from armscan.storage.parts.meshes import read_part
from armscan.storage.parts.step import ChordError, face_kind
from armscan.storage.parts.tables import datum_faces, read_tolerances
from rigs.parts import box_corners, extruded, wedge_part

PART = part_of(box_corners([1, 2, 3.0], [11, 7, 5]), source="box")
MESH = trimesh.Trimesh(PART.vertices_mm, PART.triangles, process=False)


def written(folder: Path, name: str, mesh: trimesh.Trimesh = MESH, **how: str) -> Path:
    kind = name.partition(".")[2]
    path = folder / f"part.{kind.partition('_')[0]}"
    data = mesh.export(file_type=kind, **how)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


FORMS = [("a.stl", {}), ("a.stl_ascii", {}), ("a.ply", {}), ("a.ply", {"encoding": "ascii"}),
         ("a.obj", {})]  # fmt: skip


@pytest.mark.parametrize(("name", "how"), FORMS)
def test_what_another_library_wrote_is_read(tmp_path: Path, name: str, how: dict[str, str]) -> None:
    found = read_part(written(tmp_path, name, **how))
    assert len(found.triangles) == 12
    assert len(found.vertices_mm) == 8
    assert len(found.face_names) == 6
    assert found.notes == ()
    assert np.allclose([found.low_mm, found.high_mm], [[1, 2, 3], [11, 7, 5]])
    assert found.areas_mm2.sum() == pytest.approx(MESH.area)
    outward = np.einsum("ij,ij->i", found.normals, found.corners_mm.mean(axis=1) - [6, 4.5, 4])
    assert (outward > 0.0).all()


@pytest.mark.parametrize(("name", "how"), FORMS[:4])
def test_a_file_cut_short_is_refused(tmp_path: Path, name: str, how: dict[str, str]) -> None:
    path = written(tmp_path, name, **how)
    whole = path.read_bytes()
    for share in (0.2, 0.6, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(FileFormatError):
            read_part(path)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "step", "iges"])
@pytest.mark.parametrize("content", [b"", b"\n\n", b"nonsense " * 30])
def test_a_file_that_is_no_model_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"part.{suffix}"
    path.write_bytes(content)
    with pytest.raises(ArmscanError):
        read_part(path)


def test_a_binary_file_may_begin_with_solid(tmp_path: Path) -> None:
    path = written(tmp_path, "a.stl")
    data = bytearray(path.read_bytes())
    data[:11] = b"solid facet"
    path.write_bytes(bytes(data))
    assert len(read_part(path).triangles) == 12


def test_polygons_are_cut_into_triangles(tmp_path: Path) -> None:
    path = tmp_path / "quads.obj"
    v = PART.vertices_mm
    quads = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf -7 -3 -1 -5\n"
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in v) + quads)
    found = read_part(path)
    assert len(found.triangles) == 12
    assert found.areas_mm2.sum() == pytest.approx(MESH.area)
    assert found.notes == ()


def test_groups_of_an_obj_are_its_faces(tmp_path: Path) -> None:
    path = tmp_path / "two.obj"
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in PART.vertices_mm)
    path.write_text(text + "g low end\nf 1 2 4 3\ng rest\nf 5 7 8 6\nf 1 5 6 2\n")
    found = read_part(path)
    assert found.face_names == ("low end", "rest")
    assert np.bincount(found.face).tolist() == [2, 4]


def test_a_part_in_metres_is_read_in_metres(tmp_path: Path) -> None:
    path = written(tmp_path, "a.stl", trimesh.Trimesh(PART.vertices_mm / 1000, PART.triangles))
    assert read_part(path, unit="m").diagonal_mm == pytest.approx(PART.diagonal_mm, rel=1e-6)


def test_an_open_surface_and_a_turned_triangle_are_noticed() -> None:
    corners = PART.corners_mm
    opened = part_of(corners[1:], source="a.stl")
    assert "open" in opened.notes[0]
    bent = corners.copy()
    bent[4] = bent[4][::-1]
    assert "opposite sides" in part_of(bent, source="a.stl").notes[0]


def test_a_closed_surface_turned_inside_out_is_turned_back() -> None:
    """Its scans were called those of another part: every distance had the wrong sign."""
    found = part_of(PART.corners_mm[:, ::-1] + 500.0, source="a.stl")
    assert "inside out" in found.notes[0]
    outward = np.einsum("ij,ij->i", found.normals, found.corners_mm.mean(axis=1))
    plain = np.einsum("ij,ij->i", PART.normals, PART.corners_mm.mean(axis=1) + 500.0)
    np.testing.assert_allclose(outward, plain, atol=1e-9)
    assert part_of(PART.corners_mm, source="a.stl").notes == ()
    # what does not close tells no inside
    assert "open" in part_of(PART.corners_mm[1:, ::-1], source="a.stl").notes[0]


def test_degenerate_triangles_are_left_out_and_counted() -> None:
    flat = np.repeat(PART.corners_mm[:2, :1], 3, axis=1)
    line = PART.corners_mm[:1, [0, 1, 1]]
    found = part_of(np.concatenate([PART.corners_mm, flat, line]), source="a.stl")
    assert len(found.triangles) == 12
    assert "3 triangles have no area" in found.notes[-1]


def test_corners_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "a.stl")
    data = bytearray(path.read_bytes())
    data[96:100] = struct.pack("<f", float("nan"))
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="no numbers"):
        read_part(path)


def test_a_cloud_is_no_model(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(trimesh.PointCloud(PART.vertices_mm).export(file_type="ply"))
    with pytest.raises(FileFormatError, match="cloud"):
        read_part(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [(b"element face 12", b"element face 1x"), (b"list uchar int", b"list uchar"),
     (b"list uchar int", b"list uchar word"), (b"element face 12", b"element face 13"),
     (b"element face 12", b"element face -3")],
)  # fmt: skip
def test_a_damaged_header_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = written(tmp_path, "a.ply")
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    with pytest.raises(ArmscanError):
        read_part(path)


def test_options_without_effect_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        read_part(written(tmp_path, "a.stl"), chord=ChordError())
    with pytest.raises(OptionError):
        read_part(step_file(tmp_path), unit="inch")


def test_faces_are_parted_at_creases_only() -> None:
    """A prism of 36 sides has a bottom, a top, and one round side."""
    angle = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    outline = 10.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    found = part_of(extruded(outline, 30.0), source="prism")
    assert len(found.face_names) == 3
    assert np.unique(found.face[np.abs(found.normals[:, 2]) < 0.1]).tolist() == [0]
    assert len(wedge_part().face_names) == 19


def step_file(folder: Path, **how: str) -> Path:
    solids = pytest.importorskip("rigs.solids", reason="needs the extra 'cad'")
    path: Path = solids.write_step(solids.block(), folder / "block.step", **how)
    return path


@pytest.mark.parametrize("unit", ["MM", "M", "INCH"])
def test_a_step_file_keeps_its_faces_and_says_its_unit(tmp_path: Path, unit: str) -> None:
    found = read_part(step_file(tmp_path, unit=unit), chord=ChordError(chord_mm=0.01))
    assert np.allclose([found.low_mm, found.high_mm], [[0, 0, 0], [80, 50, 20]], atol=1e-6)
    assert sorted(name.split()[0] for name in found.face_names).count("cylinder") == 2
    assert found.notes == ()
    # the chord error: corners on the bore, the middles of its triangles' sides inside by it at most
    bore = next(
        k for k, name in enumerate(found.face_names)
        if name.startswith("cylinder") and found.corners_mm[found.face == k][:, 0, 0].max() < 40.0
    )  # fmt: skip
    corners = found.corners_mm[found.face == bore][:, :, :2] - [25.0, 20.0]
    assert np.allclose(np.linalg.norm(corners, axis=2), 8.0, atol=1e-6)
    middle = np.linalg.norm((corners + np.roll(corners, 1, axis=1)) / 2.0, axis=2)
    assert 8.0 - 0.01 <= middle.min() < 8.0 - 0.001


def test_a_step_file_in_a_wrong_unit_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    """A bracket of 80 mm that calls itself 80 m: its triangles took six gigabytes."""
    path = step_file(tmp_path)
    milli = b"SI_UNIT(.MILLI.,.METRE.)"
    assert milli in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(milli, b"SI_UNIT($,.METRE.)"))
    with pytest.raises(InputError, match=r"measures 96,437 mm across.*--chord-mm 0\.042"):
        read_part(path)
    # a coarse chord is the way to read what is so large
    found = read_part(path, chord=ChordError(chord_mm=1.0))
    assert np.allclose(found.high_mm, [80e3, 50e3, 20e3])


def test_a_step_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = step_file(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match="cut short"):
        read_part(path)
    head = whole[: whole.rindex(b"\n", 0, len(whole) // 2)]
    path.write_bytes(head + b"\nENDSEC;\nEND-ISO-10303-21;\n")
    with pytest.raises(FileFormatError, match="does not hold"):
        read_part(path)
    path.write_bytes(b"ISO-10303-21;\nDATA;\nnonsense\nENDSEC;\nEND-ISO-10303-21;\n")
    with pytest.raises(FileFormatError, match="not understood"):
        read_part(path)


@pytest.mark.parametrize("chord_mm", [0.0, -1.0, float("nan"), float("inf")])
def test_a_chord_error_that_makes_no_sense_is_refused(chord_mm: float) -> None:
    with pytest.raises(OptionError):
        ChordError(chord_mm=chord_mm)


def test_tolerances_by_face(tmp_path: Path) -> None:
    table = tmp_path / "limits.csv"
    table.write_text("face,tolerance_mm\n*,0.05\nface 2,0.01\n")
    assert read_tolerances(str(table), PART) == (0.05, {"face 2": 0.01})
    toml = tmp_path / "limits.toml"
    toml.write_text('default_mm = 0.1\n[faces]\n"face 3" = 0.02\n')
    assert read_tolerances(str(toml), PART) == (0.1, {"face 3": 0.02})
    assert read_tolerances("0.07", PART) == (0.07, {})
    assert np.isnan(read_tolerances("", PART)[0])
    with pytest.raises(OptionError):
        read_tolerances("nan", PART)


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.csv", "face,tolerance_mm\nface 22,0.1\n"), ("a.csv", "face,limit\nface 2,0.1\n"),
     ("a.csv", "face,tolerance_mm\nface 2,x\n"),
     ("a.csv", "face,tolerance_mm\nface 2,1\nface 2,1\n"),
     ("a.toml", "faces = 3\n"), ("a.toml", "limit = 3\n"), ("a.toml", "[faces]\n'face 2' = 'x'\n"),
     ("a.toml", "default_mm = true\n"), ("a.txt", "0.1"), ("a.toml", "=")],
)  # fmt: skip
def test_tolerances_that_are_not_understood(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ArmscanError):
        read_tolerances(str(path), PART)


def test_datums_are_three_faces() -> None:
    assert datum_faces("face 3, face 1,face 2", PART) == (2, 0, 1)
    for names in ("face 1,face 2", "face 1,face 1,face 2", "face 1,face 2,face 99"):
        with pytest.raises(ArmscanError):
            datum_faces(names, PART)


@pytest.mark.parametrize(
    ("name", "word"),
    [("Plane", "plane"), ("Cylinder", "cylinder"), ("Torus", "torus"),
     ("SurfaceOfExtrusion", "extruded"), ("SurfaceOfRevolution", "turned"),
     ("BSplineSurface", "free form"), ("BezierSurface", "free form")],
)  # fmt: skip
def test_kinds_of_faces_are_words(name: str, word: str) -> None:
    assert face_kind(f"GeomAbs_{name}") == word


def test_ctrl_c_while_the_step_reader_loads_stays_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiled module reports it as an import that failed."""
    path = step_file(tmp_path)
    real = builtins.__import__

    def stopped(name: str, *how: Any, **more: Any) -> Any:
        if name.startswith("OCP"):
            raise ImportError("initialization failed") from KeyboardInterrupt()
        return real(name, *how, **more)

    monkeypatch.setattr(builtins, "__import__", stopped)
    with pytest.raises(KeyboardInterrupt):
        read_part(path)
