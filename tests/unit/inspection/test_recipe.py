# SPDX-License-Identifier: Apache-2.0
"""Recipes: decisions of a part's quantities, its cloud in the model's frame, the page's example."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh

from armscan.errors import FileFormatError
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.comparison import FaceComparison, deviation_statistics
from armscan.inspection.cad.part import part_of
from armscan.inspection.features import relate
from armscan.inspection.recipe import (
    FollowedRecipe,
    PartDecision,
    PartQuantity,
    PartRow,
    QuantityKind,
    Recipe,
    face_values,
    follow_recipe,
    placed_cloud,
)
from armscan.report.inspection.recipe import _nearness
from armscan.storage.parts.recipes import (
    PartResult,
    part_result_bytes,
    part_table_bytes,
    read_part_result,
    read_recipe,
)
from rigs.inspection_clouds import cloud_of, random_motion
from rigs.parts import box_corners

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "repeat-an-inspection.md"


def face(
    decision: PartDecision, mean: float, spot: float, *, tolerance: float = 0.05
) -> FaceComparison:
    return FaceComparison(
        name="face 1",
        statistics=deviation_statistics(np.array([mean, mean])),
        u_mean_mm=0.01,
        spot_mm=spot,
        u_spot_mm=0.01,
        spot_place_mm=np.zeros(3),
        tolerance_mm=tolerance,
        decision=decision,
    )


@pytest.mark.parametrize(
    ("one", "wanted"),
    [
        (face("pass", 0.0, 0.03), ["pass", "pass"]),
        (face("fail", 0.0, 0.08), ["pass", "fail"]),
        (face("fail", 0.07, 0.08), ["fail", "fail"]),
        (face("undecided", 0.045, 0.03), ["undecided", "pass"]),
        # another spot than the one that deviates most, with a smaller U, fails the face
        (face("fail", 0.0, 0.055), ["pass", "fail"]),
        # one exposure alone shows it: the face is excused, and so is what is told of it
        (face("undecided", 0.0, 0.08), ["pass", "undecided"]),
        (face("undecided", 0.08, 0.09), ["undecided", "undecided"]),
        (face("not seen", 0.0, math.nan), ["not seen", "not seen"]),
    ],
)
def test_mean_and_spot_together_decide_as_the_face_does(
    one: FaceComparison, wanted: list[str]
) -> None:
    assert [value.decision for value in face_values(one)] == wanted


def test_a_face_without_a_tolerance_is_no_quantity() -> None:
    assert face_values(face("", 0.0, 0.0, tolerance=math.nan)) == ()


def quantity(decision: PartDecision, kind: QuantityKind = "feature") -> PartQuantity:
    return PartQuantity(
        name="bore", kind=kind, unit="mm", value=math.nan, u_value=0.01, nominal=20.0,
        tolerance=0.05, decision=decision,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("quantities", "verdict", "is_passed"),
    [
        ((quantity("pass"), quantity("fail"), quantity("undecided")), "fail", False),
        ((quantity("pass"), quantity("undecided")), "undecided", False),
        ((quantity("pass"), quantity("not seen", "mean")), "pass", True),
        ((quantity("pass"), quantity("not seen")), "undecided", False),
        ((quantity("not seen", "mean"),), "undecided", False),
        ((quantity(""),), "", True),
    ],
)
def test_the_worst_decision_is_the_part_s(
    quantities: tuple[PartQuantity, ...], verdict: str, is_passed: bool
) -> None:
    row = PartRow("a", "a.ply", quantities)
    assert (row.verdict, row.is_passed) == (verdict, is_passed)
    assert not PartRow("a", "a.ply", quantities, reason="no file").is_passed


def test_a_placed_cloud_keeps_what_its_errors_mean() -> None:
    """Variances along a direction of a point are the same along the turned direction."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = cloud_of(rng.normal(size=(20, 3)), noise_mm=0.03, noise_along=normals, normals=normals)
    rotation, shift = random_motion(1)
    placed = placed_cloud(cloud, Pose[Cad, Part](rotation, shift))
    assert placed.frame == "Cad"
    assert np.allclose(placed.points_mm, cloud.points_mm @ rotation.T + shift, atol=1e-12)
    assert placed.normals is not None
    along = np.einsum("ni,nij,nj->n", placed.normals, placed.covariance_mm2, placed.normals)
    assert np.allclose(along, 0.01**2 + 0.03**2, rtol=1e-9)


def test_a_result_comes_back_as_it_was_written(tmp_path: Path) -> None:
    row = PartRow("a", "a.ply", (quantity("not seen"), quantity("pass", "mean")), ("a note.",))
    result = PartResult("0", "1", "", "2", row, ())
    path = tmp_path / "features.json"
    path.write_bytes(part_result_bytes(result))
    again = read_part_result(path)
    assert part_result_bytes(again) == part_result_bytes(result)
    assert math.isnan(again.row.quantities[0].value)


def test_faces_that_were_not_judged_come_last_in_the_trend() -> None:
    """Two strays lie ten times the tolerance off a face that the scan does not show."""
    stray = replace(quantity("not seen", "mean"), name="a", value=0.5, nominal=0.0)
    judged = replace(quantity("pass", "mean"), name="b", value=0.01, nominal=0.0)
    rows = (PartRow("1", "1.ply", (stray, judged)), PartRow("2", "2.ply", (judged,)))
    found = sorted("abc", key=lambda name: -_nearness(rows, name))
    assert found == ["b", "a", "c"]


def test_a_table_has_a_row_a_part_though_one_has_no_quantities() -> None:
    rows = (PartRow("a", "a.ply", reason="no file"), PartRow("b", "b.ply", (quantity("pass"),)))
    lines = part_table_bytes(rows).decode().splitlines()
    assert lines[-3:] == [
        "part,cloud,verdict,reason,bore_mm,bore_u_mm,bore_decision",
        "a,a.ply,not inspected,no file,,,",
        "b,b.ply,pass,,,0.01,pass",
    ]


def test_the_recipe_of_the_page_is_one(tmp_path: Path) -> None:
    """With the workpiece that comes with armscan for the part."""
    text = re.findall(r"```toml\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)[0]
    model = files("armscan.simulation") / "workpiece" / "workpiece.step"
    (tmp_path / "part.step").write_bytes(model.read_bytes())
    (tmp_path / "recipe.toml").write_text(text)
    recipe = read_recipe(tmp_path / "recipe.toml").recipe
    assert recipe.cleaning is not None
    assert recipe.cleaning.max_incidence_deg == 70.0
    assert recipe.options.tolerance_of("cylinder 19") == 0.02
    assert recipe.options.tolerance_of("plane 3") == 0.05
    assert (recipe.features[0].nominal, recipe.features[0].tolerance) == (20.0, 0.05)


BLOCK = part_of(
    np.concatenate([box_corners([0, 0, 0], [70, 40, 20]), box_corners([5, 6, 20], [30, 34, 26])]),
    source="block",
)
RELATIONS = """
part = "part.stl"
align = "none"
[[feature]]
name = "top"
kind = "plane"
face = "{top}"
form_tolerance_mm = 0.1
[[feature]]
name = "base"
kind = "plane"
face = "{base}"
[[feature]]
name = "side"
kind = "plane"
face = "{side}"
[[relation]]
name = "height"
of = ["base", "top"]
measure = "distance"
nominal_mm = 6
tolerance_mm = 0.02
[[relation]]
name = "square"
of = ["side", "base"]
measure = "angle"
nominal_deg = 90
tolerance_deg = 0.1
[[relation]]
name = "squareness"
of = ["side", "base"]
measure = "perpendicularity"
tolerance_mm = 0.02
[[relation]]
name = "parallel"
of = ["top", "base"]
measure = "parallelism"
tolerance_mm = 0.02
[[step]]
name = "step"
height_mm = 6
tolerance_mm = 0.02
region = [0, 70, 0, 40, 15, 30]
"""


def block_face(point: list[float]) -> str:
    middles = BLOCK.vertices_mm[BLOCK.triangles].mean(axis=1)
    return BLOCK.face_names[int(BLOCK.face[int(np.linalg.norm(middles - point, axis=1).argmin())])]


FACES = {
    "top": block_face([17.0, 20.0, 26.0]),
    "base": block_face([46.0, 13.0, 20.0]),
    "side": block_face([35.0, 0.0, 10.0]),
}


def relations_file(folder: Path, text: str = RELATIONS) -> Path:
    mesh = trimesh.Trimesh(BLOCK.vertices_mm, BLOCK.triangles, process=False)
    (folder / "part.stl").write_bytes(mesh.export(file_type="stl"))
    (folder / "recipe.toml").write_text(text.format(**FACES))
    return folder / "recipe.toml"


def parallel_step_mm(points: np.ndarray, is_top: np.ndarray) -> float:
    """Height between parallel planes of least squares through points (N, 3); zeros are none."""
    chosen = points.any(axis=1)
    design = np.column_stack([points[:, :2], is_top, ~is_top])[chosen].astype(np.float64)
    a, b, upper, lower = np.linalg.lstsq(design, points[chosen, 2], rcond=None)[0]
    return float((upper - lower) / np.sqrt(1.0 + a * a + b * b))


def test_relations_steps_and_form_stand_beside_features(tmp_path: Path) -> None:
    """A pad 0.03 mm too high that rises by 0.001, a side that leans by 0.002: told so, with U."""
    recipe = read_recipe(relations_file(tmp_path)).recipe
    noise, n = 0.004, 40_000
    points, triangle = BLOCK.surface_points(n, 2)
    hidden = (np.abs(points - [17.5, 20.0, 20.0]) < [12.5, 14.0, 1e-6]).all(axis=1)
    points, triangle = points[~hidden], triangle[~hidden]
    normals, face, n = BLOCK.normals[triangle], BLOCK.face[triangle], len(points)
    top, side = (face == BLOCK.face_names.index(FACES[name]) for name in ("top", "side"))
    points[top, 2] += 0.03 + 0.001 * (points[top, 0] - 17.5)
    points[side, 1] += 0.002 * (points[side, 2] - 10.0)
    as_made = np.where(
        (top | (face == BLOCK.face_names.index(FACES["base"])))[:, None], points, 0.0
    )
    random = np.random.default_rng(1)
    points += normals * random.normal(0.0, noise, n)[:, None]
    exposure = random.integers(0, 30, n)
    cloud = cloud_of(points, exposure, sigma_mm=1e-4, noise_mm=noise, noise_along=normals)
    found = follow_recipe(recipe, cloud)
    assert isinstance(found, FollowedRecipe)
    assert found.notes == (), found.notes
    told = {one.name: one for one in found.quantities if one.kind == "feature"}
    truth = {
        "height": 6.03, "square": 90.0 - np.degrees(0.002), "squareness": 0.002 * 20.0,
        "parallel": 0.001 * 25.0, "step": 6.03,
    }  # fmt: skip
    # A step supposes two parallel planes, and this pad leans: of 0.0012 mm no U can know.
    made = dict.fromkeys(truth, 1e-4) | {"step": abs(parallel_step_mm(as_made, top) - 6.03)}
    for name, value in truth.items():
        assert abs(told[name].value - value) <= 1.5 * told[name].u_value + made[name], name
        assert told[name].u_value < 0.3 * told[name].tolerance, name
    decisions = {name: told[name].decision for name in truth}
    assert decisions == {
        "height": "fail", "square": "fail", "squareness": "fail", "parallel": "fail",
        "step": "fail",
    }  # fmt: skip
    # many points of 4 um: a range of some 7 sigma, and U allows for that
    assert told["top form"].value == pytest.approx(7.5 * noise, rel=0.25)
    assert told["top form"].decision == "pass"
    alone = relate(found.placed, found.features["base"], found.features["top"])
    assert alone.distance is not None
    assert alone.distance.value_mm == told["height"].value


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ('of = ["base", "top"]', 'of = ["base", "foot"]', "foot"),
        ('of = ["base", "top"]', 'of = ["top", "top"]', "two features"),
        ('measure = "distance"', 'measure = "distant"', "measure"),
        ("nominal_deg = 90", "nominal_mm = 90", "degrees"),
        ("nominal_mm = 6\n", "", "no nominal value"),
        ('name = "height"', 'name = "top form"', "twice"),
        ("height_mm = 6", "height_mm = -6", "height_mm"),
        (
            'measure = "parallelism"',
            'measure = "parallelism"\nnominal_mm = 1',
            "value but 0",
        ),
    ],
)
def test_relations_and_steps_that_are_none_are_refused(
    tmp_path: Path, old: str, new: str, word: str
) -> None:
    path = relations_file(tmp_path, RELATIONS.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        read_recipe(path)
    assert word in str(caught.value)


def test_what_was_measured_on_a_part_lies_beside_its_cloud(tmp_path: Path) -> None:
    head = 'part = "part.stl"\nalign = "points"\npoints = "nominal.csv"\ntolerance_mm = 0.1\n'
    path = relations_file(tmp_path, head)
    corners = BLOCK.vertices_mm[:6]
    pose: Pose[Part, Cad] = Pose(*random_motion(3))
    rows = [f"P{k},{x},{y},{z}" for k, (x, y, z) in enumerate(corners)]
    (tmp_path / "nominal.csv").write_text("name,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    file = read_recipe(path)
    assert file.measured_beside
    with pytest.raises(FileFormatError, match=r"one\.points\.csv"):
        file.for_part(tmp_path / "one.ply", "Base")
    seen = pose.apply(corners)
    rows = [f"P{k},{x},{y},{z}" for k, (x, y, z) in enumerate(seen)][::-1]
    (tmp_path / "one.points.csv").write_text("name,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    recipe = file.for_part(tmp_path / "one.ply", "Base")
    assert isinstance(recipe, Recipe)
    cloud = cloud_of(pose.apply(BLOCK.surface_points(2_000, 1)[0]))
    found = follow_recipe(recipe, cloud)
    assert isinstance(found, FollowedRecipe)
    assert found.comparison is not None
    assert np.abs(found.comparison.deviation_mm).max() < 1e-9
