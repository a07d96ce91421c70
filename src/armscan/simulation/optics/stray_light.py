# SPDX-License-Identifier: Apache-2.0
"""Laser light that reaches a surface by way of another one: reflections that make false
stripes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose
from armscan.simulation.objects.shapes import FlatPlate, Placed
from armscan.simulation.optics.lasers import GAUSSIAN, LaserSource, LineLaser, Section, TracedLight
from armscan.simulation.optics.render import Imaging
from armscan.simulation.optics.scene import SceneObject

_MIRRORS_FROM_GLOSS = 0.3
"""Ground steel mirrors, ceramics and paint do not."""
_PASSES = 3.0
"""Down to the plate, back to the head and down again."""
_STRAY_WIDENING = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class CentreSpot:
    """The beam that a grating leaves undiffracted, round and Gaussian; see `TracedLight`.

    Parameters
    ----------
    source_mm
        (3,) where it starts.
    direction
        (3,) unit.
    sigma_mm
        Gaussian sigma of its cross-section.
    irradiance
        In its middle, on a surface that faces it; as for
        `armscan.simulation.optics.lasers.LineLaser`.
    """

    source_mm: FloatArray
    direction: FloatArray
    sigma_mm: float
    irradiance: float

    @property
    def section(self) -> Section:
        """As for `TracedLight`."""
        return GAUSSIAN

    def reach_and_rank(self, points_mm: FloatArray) -> tuple[FloatArray, IntArray]:
        """As for `TracedLight`."""
        away = np.linalg.norm(np.cross(points_mm - self.source_mm, self.direction), axis=1)
        return np.asarray(away / self.sigma_mm), np.zeros(len(points_mm), np.int64)

    def reach_and_peak(
        self, points_mm: FloatArray, normals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As for `TracedLight`."""
        reach, _ = self.reach_and_rank(points_mm)
        is_ahead = (points_mm - self.source_mm) @ self.direction > 0.0
        cosine = np.maximum(-(normals @ self.direction), 0.0)
        return reach, np.asarray(self.irradiance * cosine * is_ahead)

    def source_of_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `TracedLight`."""
        return self.source_mm


def stray_lights(
    source: LaserSource,
    things: Sequence[SceneObject],
    base_from_eye: Pose[Base, Any],
    imaging: Imaging,
) -> tuple[TracedLight, ...]:
    """All that one light source casts besides its lines; nothing if it has a single line.

    ``source`` is in the camera's frame, ``things`` in Base, with the gloss that they are to have.
    """
    if len(source.sheets) == 1:
        return ()
    middle = source.sheets[len(source.sheets) // 2]
    lights: list[TracedLight] = []
    if imaging.spot_level > 0.0:
        beam = middle.rays(np.zeros(1))[0]
        brightness = imaging.spot_level * middle.irradiance
        lights.append(CentreSpot(middle.source_mm, beam, imaging.spot_mm, brightness))
    mirror = _mirror(things)
    if imaging.stray_share > 0.0 and mirror is not None:
        face, gloss = mirror
        share = imaging.stray_share * gloss
        lights.append(_reflected(source, base_from_eye.inverse() @ face, share))
    return tuple(lights)


def _mirror(things: Sequence[SceneObject]) -> tuple[Pose[Base, Any], float] | None:
    """Frame of the first glossy plate, its face at z = 0, and its gloss."""
    for thing in things:
        surface = thing.surface
        if not isinstance(surface, Placed) or not isinstance(surface.shape, FlatPlate):
            continue
        if thing.finish.gloss >= _MIRRORS_FROM_GLOSS:
            return surface.scene_from_shape, thing.finish.gloss
    return None


def _reflected(source: LaserSource, eye_from_face: Pose[Any, Any], share: float) -> LaserSource:
    """The lines thrown back by a face to the head's front, and by that again to the scene.

    Two mirrors move the fan as a rigid body: to a virtual source about two stand-offs behind the
    head. Its lines are as bright as ``share`` of the first ones, and wider.
    """
    middle = source.sheets[len(source.sheets) // 2]
    front = middle.rays(np.zeros(1))[0]
    turn_face, shift_face = _mirroring(eye_from_face.rotation[:, 2], eye_from_face.translation_mm)
    turn_front, shift_front = _mirroring(front, middle.source_mm)
    moved: Pose[Any, Any] = Pose(turn_front @ turn_face, turn_front @ shift_face + shift_front)
    return LaserSource(tuple(_faint(sheet, share).moved(moved) for sheet in source.sheets))


def _faint(sheet: LineLaser, share: float) -> LineLaser:
    return replace(
        sheet,
        irradiance=share * sheet.irradiance,
        waist_mm=_STRAY_WIDENING * sheet.waist_mm,
        waist_distance_mm=_PASSES * sheet.waist_distance_mm,
    )


def _mirroring(normal: FloatArray, point_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrix (3, 3) and shift (3,) that mirror at a plane."""
    return np.eye(3) - 2.0 * np.outer(normal, normal), 2.0 * (normal @ point_mm) * normal
