# SPDX-License-Identifier: Apache-2.0
"""Centre spot and reflected lines against rays followed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Plate, Pose, Sensor
from armscan.simulation.head import build_head
from armscan.simulation.objects.shapes import FlatPlate, Placed
from armscan.simulation.optics.lasers import LaserSource, in_sources
from armscan.simulation.optics.render import IMAGING
from armscan.simulation.optics.scene import CERAMIC, GROUND_STEEL, Material, SceneObject
from armscan.simulation.optics.stray_light import CentreSpot, stray_lights

HERE: Pose[Base, Sensor] = Pose.from_vectors([0.3, 0.2, -0.1], [400.0, 20.0, 150.0])
THESIS = IMAGING["thesis"]


def projector() -> LaserSource:
    (source,) = in_sources(build_head("thesis-multi", seed=2).lasers)
    return source


def plate(finish: Material) -> SceneObject:
    """Turned towards the projector, but not quite; placed in Base by the head's pose."""
    up = np.array([0.5, 0.05, -0.8])
    up /= np.linalg.norm(up)
    x = np.cross(up, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up], axis=1)
    sensor_from_plate: Pose[Sensor, Plate] = Pose(rotation, np.array([0.0, 0.0, 140.0]))
    shape = FlatPlate(np.array([200.0, 200.0]))
    return SceneObject("plate", Placed(shape, HERE @ sensor_from_plate), finish)


def onto(origins: FloatArray, rays: FloatArray, normal: FloatArray, at: FloatArray) -> FloatArray:
    """Where rays meet a plane."""
    return np.asarray(origins + (((at - origins) @ normal) / (rays @ normal))[:, None] * rays)


def test_reflected_lines_are_where_two_mirrors_throw_the_rays() -> None:
    source, steel = projector(), plate(GROUND_STEEL)
    stray = stray_lights(source, (steel,), HERE, THESIS)[1]
    assert isinstance(stray, LaserSource)
    assert isinstance(steel.surface, Placed)
    face = HERE.inverse() @ steel.surface.scene_from_shape
    normal, at = face.rotation[:, 2], face.translation_mm
    middle = source.sheets[5]
    front = middle.rays(np.zeros(1))[0]
    for before, after in zip(source.sheets, stray.sheets, strict=True):
        rays = before.rays(np.linspace(-0.2, 0.2, 9))
        first = onto(before.source_mm[None], rays, normal, at)
        up = rays - 2.0 * (rays @ normal)[:, None] * normal
        second = onto(first, up, front, middle.source_mm)
        down = up - 2.0 * (up @ front)[:, None] * front
        landed = onto(second, down, normal, at)
        assert np.abs(after.offset_mm(landed)).max() < 1e-6
        facing = np.broadcast_to(normal, landed.shape)
        _, faint = after.reach_and_peak(landed, facing)
        _, bright = before.reach_and_peak(first, facing)
        # 0.12 for gloss 1, half of it for ground steel; the cosines differ
        assert 0.03 < np.median(faint / bright) < 0.08


def test_the_spot_is_round_saturating_and_on_the_middle_line() -> None:
    source = projector()
    (spot,) = stray_lights(source, (plate(CERAMIC),), HERE, THESIS)
    assert isinstance(spot, CentreSpot)
    middle = source.sheets[5]
    ray = middle.rays(np.zeros(1))[0]
    centre = middle.source_mm + 140.0 * ray
    aside = np.linalg.svd(ray[None])[2][1:]
    ring = centre + THESIS.spot_mm * np.array(
        [np.cos(a) * aside[0] + np.sin(a) * aside[1] for a in np.linspace(0, 6, 7)]
    )
    facing = np.broadcast_to(-ray, (7, 3))
    reach, peak = spot.reach_and_peak(ring, facing)
    np.testing.assert_allclose(reach, 1.0, atol=1e-9)
    _, line = middle.reach_and_peak(centre[None], -ray[None])
    assert peak[0] / line[0] == pytest.approx(THESIS.spot_level, rel=0.1)
    # brighter than full scale on white, over a few millimetres
    assert peak[0] * np.exp(-0.5 * (1.0 / THESIS.spot_mm) ** 2) > 1.0
    behind = spot.reach_and_peak(middle.source_mm - 50.0 * ray[None], -ray[None])[1]
    assert behind[0] == 0.0


@pytest.mark.parametrize("kind", ["clean", "single", "cross"])
def test_clean_heads_and_single_lines_cast_nothing_stray(kind: str) -> None:
    steel = plate(GROUND_STEEL)
    if kind == "clean":
        assert stray_lights(projector(), (steel,), HERE, IMAGING["clean"]) == ()
        return
    for source in in_sources(build_head(f"thesis-{kind}").lasers):
        assert stray_lights(source, (steel,), HERE, THESIS) == ()


def test_paint_and_ceramics_throw_no_lines_back_and_harsh_steel_more() -> None:
    source = projector()
    assert len(stray_lights(source, (plate(CERAMIC),), HERE, THESIS)) == 1
    shares = []
    for imaging in (THESIS, IMAGING["harsh"]):
        steel = plate(GROUND_STEEL.scaled(imaging.gloss, 1.0))
        stray = stray_lights(source, (steel,), HERE, replace(imaging, spot_level=0.0))[0]
        assert isinstance(stray, LaserSource)
        shares.append(stray.sheets[5].irradiance / source.sheets[5].irradiance)
    np.testing.assert_allclose(shares, [0.06, 0.15])
