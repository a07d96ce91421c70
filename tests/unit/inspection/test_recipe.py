# SPDX-License-Identifier: Apache-2.0
"""Recipes: decisions of a part's quantities, its cloud in the model's frame, the page's example."""

from __future__ import annotations

import math
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.comparison import FaceComparison, deviation_statistics
from armscan.inspection.recipe import (
    PartDecision,
    PartQuantity,
    PartRow,
    QuantityKind,
    face_values,
    placed_cloud,
)
from armscan.storage.parts.recipes import (
    PartResult,
    part_result_bytes,
    part_table_bytes,
    read_part_result,
    read_recipe,
)
from rigs.inspection_clouds import cloud_of, random_motion

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
