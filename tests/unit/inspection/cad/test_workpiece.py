# SPDX-License-Identifier: Apache-2.0
"""The workpiece that comes with armscan: its model, and the part as it was made."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np

from armscan.geometry.poses import Pose
from armscan.inspection.cad.distance import PartSurface
from armscan.jobs.twin.inspect_demo import MADE_MM, TOLERANCES, _beside_truth
from armscan.simulation.twin import build_twin
from armscan.storage.parts.meshes import read_part

FOLDER = Path(str(files("armscan.simulation"))) / "workpiece"


def test_only_the_two_faults_lie_off_the_model() -> None:
    """By the closest surface; the model's triangles and the part's are within 0.002 mm of it."""
    model, made = read_part(FOLDER / "workpiece.step"), read_part(FOLDER / "as_made.stl")
    points, _ = made.surface_points(20_000)
    found = PartSurface(model).distance(points)
    names = np.array(model.face_names)[model.face[found.triangle]]
    inner = np.abs(np.einsum("nk,nk->n", model.normals[found.triangle], found.normals)) > 0.98
    for face in model.face_names:
        off = found.signed_mm[(names == face) & inner]
        assert len(off) > 10
        # the pad's walls reach 0.08 mm beyond the model's
        assert np.abs(np.median(off) - MADE_MM.get(face, 0.0)) < 0.003, face
    assert set(tomllib.loads(TOLERANCES)["faces"]) <= set(model.face_names)
    assert set(MADE_MM) <= set(model.face_names)


def test_the_model_in_triangles_is_the_model() -> None:
    exact, triangles = read_part(FOLDER / "workpiece.step"), read_part(FOLDER / "workpiece.stl")
    points, _ = triangles.surface_points(5000)
    assert np.abs(PartSurface(exact).distance(points).signed_mm).max() < 0.005


def test_a_wrong_place_is_told_by_the_truth() -> None:
    truth = build_twin("thesis-single", "thesis", 2).truth
    right = truth.base_from_workpiece.inverse()
    off = Pose.from_vectors([0.0, 0.0, np.radians(0.02)], [0.03, 0.0, -0.04]) @ right
    faces = [
        {"face": "plane 3", "n": 500, "mean_mm": 0.081, "decision": "fail"},
        {"face": "cylinder 19", "n": 50, "mean_mm": -0.02, "decision": "pass"},
        {"face": "plane 5", "n": 500, "mean_mm": 0.002, "decision": "pass"},
        {"face": "plane 1", "n": 0, "mean_mm": float("nan"), "decision": "not seen"},
    ]
    points = truth.base_from_workpiece.apply(np.array([[0.0, 27.0, 14.0], [0.0, 27.0, 14.2]]))
    found = {one.key: one.value for one in _beside_truth(faces, off, points, truth)}
    assert np.isclose(found["truth.shift_mm"], 0.05)
    assert np.isclose(found["truth.turn_deg"], 0.02)
    assert np.isclose(found["truth.largest_face_error_mm"], 0.005)
    assert found["truth.within_50_um"] == 50.0
    assert found["truth.wrongly_called"] == ["cylinder 19"]
