# SPDX-License-Identifier: Apache-2.0
"""The compiled loops against the surfaces' and lights' own formulas, pixel by pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.geometry.poses import Base, Board, Pose, Sensor
from armscan.simulation.head import build_head, sheet_middle_mm
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.body import free_form_part
from armscan.simulation.objects.fixtures import made_workpiece
from armscan.simulation.objects.mesh import Mesh
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed, Wave, WavyPlate
from armscan.simulation.optics import stripe_light
from armscan.simulation.optics.lasers import TracedLight, in_sources
from armscan.simulation.optics.render import Region
from armscan.simulation.optics.scene import (
    CERAMIC,
    GROUND_STEEL,
    Floor,
    Material,
    SceneObject,
    Sphere,
    Surface,
)
from armscan.simulation.optics.stray_light import CentreSpot
from armscan.simulation.optics.stripe_light import (
    PosedView,
    lit_pixels,
    look,
    shade,
    trace_sheet,
)
from armscan.simulation.station import Station, Target, seen_from

HEAD = build_head("thesis-multi", "thesis", 3)
AIM_MM = sheet_middle_mm(HEAD, 140.0)
TILTED: Pose[Base, Base] = Pose.from_vectors([0.3, -0.2, 0.4], [1.0, -2.0, 0.5])
ABOVE: Pose[Base, Sensor] = Pose(np.diag([1.0, -1.0, -1.0]), AIM_MM * np.array([-1.0, 1.0, 1.0]))
REGION = Region.around(400, 300, 2200, 1400)
WAVES = FlatPlate.draw((60.0, 50.0), 0.3, np.random.default_rng(3))
SHAPES: dict[str, tuple[Surface, ...]] = {
    "plate": (Placed(WAVES, TILTED),),
    "flat plate": (FlatPlate(np.array([60.0, 50.0])),),
    "waves": (
        Placed(WavyPlate((60.0, 60.0), (Wave(1.6, 40.0, 15.0), Wave(0.4, 15.0, 60.0))), TILTED),
    ),
    "blocks": (WAVES, Placed(Box(np.array([22.0, 9.0, 6.0])), TILTED)),
    "ball": (
        Floor(np.array([0.0, 0.0, -9.0]), np.array([0.1, 0.0, 1.0]), (0.4, 0.4, 0.4)),
        Sphere(np.array([1.0, 2.0, -3.0]), 9.0),
    ),
    "body": (Placed(free_form_part(), TILTED),),
    "triangles": (Placed(Mesh(made_workpiece() - [0.0, 0.0, 10.0]), TILTED),),
}
LIGHTS: dict[str, TracedLight] = {
    "one line": in_sources(HEAD.lasers[5:6])[0],
    "eleven lines": in_sources(HEAD.lasers)[0],
    "spot": CentreSpot(HEAD.lasers[5].source_mm, HEAD.lasers[5].rays(np.zeros(1))[0], 0.6, 2.0),
}


def view_of(station: Station) -> PosedView:
    finishes = tuple(thing.finish for thing in station.things)
    return look(seen_from(station, ABOVE), (*finishes, Material()), HEAD.camera, REGION)


def check(view: PosedView) -> None:
    assert view.numbers is not None
    plain = replace(view, numbers=None)
    rays = np.random.default_rng(1).uniform([400.0, 300.0], [2600.0, 1700.0], (4000, 2))
    fast = view.numbers.trace(HEAD.camera, rays, 1e-12)
    from_rays = view.scene.trace(np.zeros(3), _directions(rays))
    assert np.array_equal(fast.surface, from_rays.surface)
    assert (fast.surface >= 0).mean() > 0.05
    np.testing.assert_allclose(fast.points_mm, from_rays.points_mm, atol=2e-5)
    room = view.numbers.room_light(from_rays)
    exact = view.scene.room_light(from_rays)[:, 0]
    # a shadow's rim or a texture's cell may fall to the other side, by rounding
    assert (np.abs(room - exact) > 1e-7).mean() < 2e-3
    for name, light in LIGHTS.items():
        found, wanted = (shade(one, HEAD.camera, light, rays) for one in (view, plain))
        differs = np.abs(found[0] - wanted[0]) > 1e-5
        differs |= np.abs(found[1] - wanted[1]) > 1e-6
        assert differs.mean() < 2e-3, name
        assert (wanted[1] > 0.0).any(), name


def _directions(pixels: np.ndarray) -> np.ndarray:
    rays = np.column_stack([HEAD.camera.rays(pixels, 1e-12), np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@pytest.mark.parametrize("name", SHAPES)
def test_loops_see_what_the_surfaces_show(name: str) -> None:
    finishes = (GROUND_STEEL, CERAMIC)
    things = tuple(
        SceneObject(str(k), surface, finishes[k]) for k, surface in enumerate(SHAPES[name])
    )
    check(view_of(Station(things)))


def test_loops_see_a_print_and_its_discs() -> None:
    shifts = tuple((0.01 * k, -0.02) for k in range(20))
    pattern = CirclePattern(5, 4, 6.0, 3.0, misplaced_mm=shifts)
    turned: Pose[Base, Board] = Pose(np.diag([1.0, -1.0, -1.0]), np.array([-12.0, 9.0, 0.3]))
    floor = Floor(np.array([0.0, 0.0, -9.0]), np.array([0.1, 0.0, 1.0]), (0.4, 0.4, 0.4))
    check(view_of(Station((SceneObject("table", floor),), Target(pattern, turned))))


@pytest.mark.parametrize("name", ["blocks", "ball"])
def test_rows_that_light_cannot_reach_change_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    things = tuple(SceneObject(str(k), surface) for k, surface in enumerate(SHAPES[name]))
    view, light = view_of(Station(things)), LIGHTS["one line"]
    is_lit = lit_pixels(view.nodes, light, REGION)
    is_lit[: REGION.height_px // 2] = 0
    eye = (view, HEAD.camera, light, REGION, is_lit)
    part = trace_sheet(*eye)
    assert part.edges.any()
    assert part.top > 0
    assert len(part.reach) < 0.7 * REGION.height_px
    monkeypatch.setattr(stripe_light, "_rows_around", lambda lit: slice(0, len(lit)))
    whole = trace_sheet(*eye)
    rows = slice(part.top, part.top + len(part.reach))
    for of in ("reach", "peak", "edges"):
        wanted, found = getattr(whole, of), getattr(part, of)
        np.testing.assert_array_equal(found, wanted[rows])
        assert np.count_nonzero(wanted) == np.count_nonzero(found)
    np.testing.assert_array_equal(part.edge_light, whole.edge_light)
