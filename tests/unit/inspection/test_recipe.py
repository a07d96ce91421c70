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
from armscan.geometry.arrays import Box
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.comparison import FaceComparison, deviation_statistics
from armscan.inspection.cad.part import part_of
from armscan.inspection.doubts import sigma_warnings
from armscan.inspection.features import relate
from armscan.inspection.recipe import (
    FollowedRecipe,
    PartDecision,
    PartQuantity,
    PartRow,
    QuantityKind,
    Recipe,
    RecipeFeature,
    RecipeRelation,
    RecipeStep,
    face_values,
    follow_recipe,
    placed_cloud,
)
from armscan.inspection.search import WantedFeature
from armscan.records.cloud import FUSED, PointCloud
from armscan.report.inspection.features import feature_report
from armscan.report.inspection.recipe import _nearness, wrong_text
from armscan.storage.parts.recipes import (
    PartResult,
    found_features,
    part_result_bytes,
    part_table_bytes,
    read_part_result,
    read_recipe,
)
from rigs.inspection_clouds import block_stripes, cloud_of, random_motion
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


def test_a_table_holds_quantities_whose_names_are_alike_apart() -> None:
    names = ("bore 12,5", "bore 125", "bore 125_u", "face 1, mean")
    told = [replace(quantity("pass"), name=one, value=float(k)) for k, one in enumerate(names)]
    told.append(replace(quantity("fail", "mean"), name="face 1", value=4.0))
    table = part_table_bytes([PartRow("a", "a.ply", tuple(told))]).decode()
    *_, heads, cells = table.splitlines()
    found = dict(zip(heads.split(","), cells.split(","), strict=True))
    # part, cloud, verdict and reason, and three of each quantity
    assert len(found) == 4 + 3 * 5
    assert [found[f"{name}_mm"] for name in ("bore 125", "bore 125 (2)", "bore 125_u (2)")] == [
        "0.0", "1.0", "2.0",
    ]  # fmt: skip
    assert [found[f"face 1 mean{k}_decision"] for k in ("", " (2)")] == ["pass", "fail"]
    # the comments of tolerances call them by their own names
    assert re.findall("# column (.*)", table) == [
        "bore 125: bore 12,5, feature",
        "bore 125 (2): bore 125, feature",
        "bore 125_u (2): bore 125_u, feature",
        "face 1 mean: face 1, mean, feature",
        "face 1 mean (2): face 1, mean",
    ]


def test_a_feature_with_the_name_of_its_face_stands_beside_it() -> None:
    """Of a face the worse of mean and spot is named; a feature is another thing."""
    one = replace(quantity("fail"), name="cylinder 19", value=20.2)
    mean = replace(quantity("fail", "mean"), name="cylinder 19", value=0.9, nominal=0.0)
    spot = replace(quantity("fail", "spot"), name="cylinder 19", value=1.0, nominal=0.0)
    told = wrong_text(PartRow("a", "a.ply", (one, mean, spot)))
    assert told == "cylinder 19, spot fail (+1.0000 mm); cylinder 19 fail (+0.2000 mm)"


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
        ("nominal_deg = 90", "nominal_deg = 120", "told as 0 to 90 degrees; write 60"),
        ("nominal_deg = 90", "nominal_deg = 180", "told as 0 to 90 degrees; write 0"),
        ("nominal_deg = 90", "nominal_deg = -30", "told as 0 to 90 degrees; write 30"),
        ("nominal_mm = 6\n", "", "no nominal value"),
        ("height_mm = 6", "height_mm = 6\nnormal = [0, 0, 0]", "the normal is no direction"),
        ("height_mm = 6", "height_mm = 6\nnormal = [0, 1]", "the normal is no direction"),
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


LEANING = """
[[step]]
name = "step"
height_mm = 20
tolerance_mm = {tolerance}
"""


@pytest.mark.parametrize(("error_mm", "tolerance"), [(0.0, 0.05), (-0.31, 0.05), (0.0, 0.5)])
def test_a_step_in_a_leaning_sheet_is_decided_only_with_the_normal(
    tmp_path: Path, error_mm: float, tolerance: float
) -> None:
    """Twenty exposures at rest, the sheet at 10 degrees: 20 mm read 20.31, and 19.69 mm read 20."""
    lean = np.deg2rad(10.0)
    normal = np.array([0.0, np.sin(lean), -np.cos(lean)])
    x = np.tile(np.linspace(-30.0, 30.0, 600), 20)
    apart = (20.0 + error_mm) / np.cos(lean)
    z = 130.0 + np.where(x > 5.0, 0.0, apart)
    z += np.random.default_rng(1).normal(0.0, 0.01, len(x))
    points = np.column_stack([x, np.zeros_like(x), z])
    cloud = cloud_of(points, np.repeat(np.arange(20), 600), frame="Sensor")
    path = tmp_path / "recipe.toml"
    text = LEANING.format(tolerance=tolerance)
    path.write_text(text)
    found = follow_recipe(read_recipe(path).recipe, cloud)
    assert isinstance(found, FollowedRecipe)
    (height,) = found.quantities
    assert height.value == pytest.approx(apart, abs=0.005)
    assert math.isnan(height.u_value)
    assert height.decision == "undecided"
    assert [note.startswith("step: one stripe: the light sheet is taken to stand square")
            for note in found.notes] == [True]  # fmt: skip
    path.write_text(f"{text}normal = {normal.tolist()}\n")
    known = follow_recipe(read_recipe(path).recipe, cloud)
    assert isinstance(known, FollowedRecipe)
    assert known.quantities[0].value == pytest.approx(20.0 + error_mm, abs=0.005)
    assert known.quantities[0].decision == ("fail" if error_mm else "pass")
    assert known.notes == ()


def rounds(kind: str) -> PointCloud:
    """A ball of 20 mm in diameter, or the rim of a disc of it 2 mm thick, over a plane z = -30."""
    rng = np.random.default_rng(2)
    turn = rng.uniform(0.0, 2.0 * np.pi, 4000)
    if kind == "ball":
        z = rng.uniform(-2.0, 10.0, 4000)
        radius = np.sqrt(100.0 - z**2)
    else:
        z, radius = rng.uniform(-1.0, 1.0, 4000), np.full(4000, 10.0)
    points = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])
    flat = np.column_stack([rng.uniform(-40.0, 40.0, (6000, 2)), np.full(6000, -30.0)])
    both = np.concatenate([points, flat])
    exposure = rng.integers(0, 30, len(both))
    return cloud_of(both + rng.normal(0.0, 0.005, both.shape), exposure, sigma_mm=0.005)


@pytest.mark.parametrize(("kind", "decision"), [("ball", "pass"), ("disc", "undecided")])
def test_what_may_be_no_ball_passes_nothing(kind: str, decision: str) -> None:
    """Nor its form, nor its distance from a plane; its diameter is 20 mm either way."""
    ball = WantedFeature("sphere", diameter_mm=20.0, region=Box([-15, -15, -15], [15, 15, 15]))
    recipe = Recipe(
        features=(
            RecipeFeature("ball", ball, 20.0, 0.3, form_tolerance=2.0),
            RecipeFeature("table", WantedFeature("plane"), form_tolerance=0.2),
        ),
        relations=(RecipeRelation("height", ("ball", "table"), "distance", 30.0, 0.3),),
    )
    found = follow_recipe(recipe, rounds(kind))
    assert isinstance(found, FollowedRecipe)
    decisions = {one.name: one.decision for one in found.quantities if one.decision}
    assert decisions == {
        "ball": decision, "ball form": decision, "table form": "pass", "height": decision,
    }  # fmt: skip
    doubts = [note for note in found.notes if "may be of no sphere, but of a disc" in note]
    assert len(doubts) == (kind == "disc")
    assert all(note.startswith("ball: ") for note in found.notes)
    report = feature_report(found.features["ball"], found.placed).warnings
    assert found.notes == tuple(f"ball: {text}" for text in report)


def test_notes_of_a_recipe_are_the_warnings_of_its_features_alone() -> None:
    """An arc of 60 degrees, a fifth of it lifted, and a seed that is off it."""
    rng = np.random.default_rng(4)
    turn, z = rng.uniform(0.0, np.deg2rad(60.0), 4000), rng.uniform(0.0, 30.0, 4000)
    radius = 20.0 + rng.normal(0.0, 0.005, 4000)
    radius[::20] += 0.3
    points = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])
    wanted = WantedFeature(
        "cylinder", diameter_mm=40.0, axis=(0.0, 0.0, 1.0), seed_mm=(18.5, 10.0, 15.0)
    )
    recipe = Recipe(features=(RecipeFeature("bore", wanted, 40.0, 0.5),))
    whole = cloud_of(points, rng.integers(0, 30, 4000), sigma_mm=0.005)
    fused = replace(
        whole, sheet_names=(FUSED,), exposure_sources=(FUSED,), exposure=0 * whole.exposure
    )
    for cloud in (whole, fused, cloud_of(points, sigma_mm=0.0)):
        found = follow_recipe(recipe, cloud)
        assert isinstance(found, FollowedRecipe)
        report = feature_report(found.features["bore"], cloud).warnings
        of_cloud = sigma_warnings(cloud)
        assert found.notes == (
            *of_cloud, *(f"bore: {text}" for text in report if text not in of_cloud),
        )  # fmt: skip
        for word in ("degrees of the turn", "are outliers", "the seed is not on it"):
            assert any(word in note for note in found.notes), word


def test_a_step_between_bent_faces_is_undecided() -> None:
    """Table and block bent alike by 0.2 mm, which no noise of a micron makes of flat ones."""
    points, exposure = block_stripes(5.0)
    rng = np.random.default_rng(0)
    points += rng.normal(0.0, 0.001, points.shape)
    step = Recipe(steps=(RecipeStep("pad", 5.0, 1.0),))
    for bend, decision in ((0.0, "pass"), (0.0002, "undecided")):
        bent = points + np.outer(bend * points[:, 0] ** 2, [0.0, 0.0, 1.0])
        found = follow_recipe(step, cloud_of(bent, exposure, sigma_mm=0.001))
        assert isinstance(found, FollowedRecipe)
        assert [one.decision for one in found.quantities] == [decision]
        said = [note for note in found.notes if "pad: the two faces are not flat" in note]
        assert len(said) == (decision == "undecided")


def test_the_file_of_a_part_states_the_form_that_was_measured(tmp_path: Path) -> None:
    """Of a line the tube that holds its points: all are 0.1 mm off it, in pairs across."""
    turn = np.linspace(0.0, 40.0 * np.pi, 600)
    around = 0.1 * np.column_stack([np.cos(turn), np.sin(turn)])
    z = np.linspace(0.0, 80.0, 600)[:, None]
    points = np.concatenate([np.hstack([around, z]), np.hstack([-around, z])])
    wanted = WantedFeature("line", region=Box([-5, -5, -5], [5, 5, 85]))
    recipe = Recipe(features=(RecipeFeature("edge", wanted, form_tolerance=0.5),))
    run = follow_recipe(recipe, cloud_of(points, np.tile(np.arange(600) // 20, 2)))
    assert isinstance(run, FollowedRecipe)
    (edge,) = found_features(run)
    assert edge.form_mm == pytest.approx(0.2, abs=1e-6)
    row = PartRow("a", "a.ply", run.quantities)
    path = tmp_path / "features.json"
    path.write_bytes(part_result_bytes(PartResult("0", "1", "", "2", row, (edge,))))
    assert [one.form_mm for one in read_part_result(path).features] == [run.quantities[1].value]


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
