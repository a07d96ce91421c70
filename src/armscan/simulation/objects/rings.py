# SPDX-License-Identifier: Apache-2.0
"""Coded and plain ring markers on surfaces, and their images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, floats
from armscan.geometry.poses import Base, Pose
from armscan.simulation.optics.camera import RenderCamera, blur_image
from armscan.simulation.optics.render import camera_rays
from armscan.simulation.optics.scene import Scene, Surface

DISC_DIAMETER_MM = 3.0
"""Section 4.3."""
RING_DIAMETER_MM = 5.6
_LIGHT, _DARK = 0.85, 0.06
_EDGE_MM = 0.05
"""Width over which a sample of laser light averages the two tones: about two pixels."""
_LEAST_SIDE_MM = 1e-9
_FLAT_SHARE = 1e-3
_OFF_FACE_MM = 0.5
"""A point farther from the marker's plane is on another face."""


class RingMarker(ArrayRecord, kw_only=False):
    """One marker: (3,) middle of its disc, on a face, and the face's normal.

    ``disc_mm`` and ``ring_mm`` are diameters of the bright disc and of the dark ring around it.
    """

    centre_mm: FloatArray = floats(3)
    normal: FloatArray = floats(3)
    disc_mm: float = DISC_DIAMETER_MM
    ring_mm: float = RING_DIAMETER_MM
    light: float = _LIGHT
    dark: float = _DARK

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.disc_mm < self.ring_mm:
            raise InputError(f"a disc of {self.disc_mm} mm in a ring of {self.ring_mm} mm")

    def seen_from(self, base_from_camera: Pose[Base, Any]) -> RingMarker:
        """The marker, given in Base, in the frame of a camera."""
        turn, place = base_from_camera.rotation, base_from_camera.translation_mm
        return replace(self, centre_mm=(self.centre_mm - place) @ turn, normal=self.normal @ turn)

    def covers(self, radius_mm: FloatArray, sides_mm: FloatArray) -> FloatArray:
        """(..., 2) parts of square samples that disc and ring cover.

        Parameters
        ----------
        radius_mm
            (...) distances of the samples' middles from the centre.
        sides_mm
            (..., 2) by how much the distance changes along each side of a sample.
        """
        disc = _covered(0.5 * self.disc_mm - radius_mm, sides_mm)
        whole = _covered(0.5 * self.ring_mm - radius_mm, sides_mm)
        return np.stack([disc, whole - disc], axis=-1)


def _covered(inside_mm: FloatArray, sides_mm: FloatArray) -> FloatArray:
    """Part of a square on one side of a straight edge, whichever way the edge runs.

    A ramp as wide as the square would leave errors that do not average out along an edge at 45
    degrees, which meets all squares alike.
    """
    sides = np.abs(sides_mm)
    first = np.maximum(sides.max(axis=-1), _LEAST_SIDE_MM)
    second = np.maximum(sides.min(axis=-1), _FLAT_SHARE * first)
    total, rest = 0.5 * (first + second), 0.5 * (first - second)
    area = sum(
        sign * np.maximum(inside_mm + shift, 0.0) ** 2
        for sign, shift in ((1.0, total), (-1.0, rest), (-1.0, -rest), (1.0, -total))
    )
    return np.asarray(np.clip(0.5 * area / (first * second), 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Marked:
    """A surface with markers in its frame; it is a `Surface` itself."""

    surface: Surface
    markers: Sequence[RingMarker]

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.surface.intersect(origins_mm, directions)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.surface.normals(points_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`, markers included."""
        albedo = np.array(self.surface.albedo(points_mm))
        for marker in self.markers:
            offset = points_mm - marker.centre_mm
            height = offset @ marker.normal
            square = np.einsum("ni,ni->n", offset, offset) - height**2
            reach = 0.5 * marker.ring_mm + _EDGE_MM
            near = np.flatnonzero((square < reach**2) & (np.abs(height) < _OFF_FACE_MM))
            radius = np.sqrt(np.maximum(square[near], 0.0))
            sides = np.broadcast_to([_EDGE_MM, 0.0], (len(near), 2))
            disc, ring = marker.covers(radius, sides).T[:, :, None]
            albedo[near] = (
                disc * marker.light + ring * marker.dark + (1.0 - disc - ring) * albedo[near]
            )
        return albedo


SUBPIXELS = 2
"""Cells per pixel along each axis, on which the lens's blur acts."""
_STEP_PX = 4
"""Rays are traced so far apart; between them the lens's distortion changes by nothing."""
_RIM_PX = 8
"""Pixels around a marker that are drawn with it: more than the blur reaches."""
_OUTLINE_STEPS = 32
_ON_FACE_MM = 0.02
_RAY_TOLERANCE = 1e-8


def draw_markers(
    light: FloatArray, markers: Sequence[RingMarker], scene: Scene, camera: RenderCamera
) -> FloatArray:
    """Image (H, W) of the room's light with markers drawn into ``light`` (H, W), that of the faces.

    Markers are in the scene's frame, whose origin is the camera; the scene may hide them.
    """
    drawn = np.array(light, dtype=np.float64)
    for marker in markers:
        patch = _patch(marker, camera)
        if patch is None:
            continue
        left, top, right, bottom = patch
        inside = (
            slice(max(top, 0), min(bottom, camera.height_px)),
            slice(max(left, 0), min(right, camera.width_px)),
        )
        own = (
            slice(inside[0].start - top, inside[0].stop - top),
            slice(inside[1].start - left, inside[1].stop - left),
        )
        disc, ring, visible = _cover(marker, scene, camera, patch)
        # all light that the face sends back, as though it were white
        face = scene.trace(marker.centre_mm + marker.normal, -marker.normal[None, :])
        white = drawn[inside] / float(scene.albedo(face)[0, 0])
        shown = (
            disc[own] * marker.light * white
            + ring[own] * marker.dark * white
            + (1.0 - disc[own] - ring[own]) * drawn[inside]
        )
        drawn[inside] = np.where(visible[own], shown, drawn[inside])
    return drawn


def _patch(marker: RingMarker, camera: RenderCamera) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom pixel around a marker that faces the camera; else None."""
    if marker.normal @ marker.centre_mm >= 0.0:
        return None
    aside = np.linalg.svd(marker.normal[None, :])[2][1:]
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_STEPS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ aside
    pixels = camera.project(marker.centre_mm + 0.5 * marker.ring_mm * circle)
    if not bool(np.isfinite(pixels).all()):
        return None
    low = np.floor(pixels.min(axis=0)).astype(int) - _RIM_PX
    size = np.ceil(pixels.max(axis=0)).astype(int) + _RIM_PX - low
    size = -(-size // _STEP_PX) * _STEP_PX
    high = low + size
    is_in_view = (high > 0).all() and (low < [camera.width_px, camera.height_px]).all()
    return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if is_in_view else None


def _cover(
    marker: RingMarker, scene: Scene, camera: RenderCamera, patch: tuple[int, int, int, int]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """(h, w) parts of a patch's pixels that disc and ring cover, and where the face is seen."""
    left, top, right, bottom = patch
    u, v = (np.arange(a, b + 1, _STEP_PX) for a, b in ((left, right), (top, bottom)))
    nodes = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(np.float64)
    rays = camera_rays(camera, nodes, _RAY_TOLERANCE)
    hits = scene.trace(np.zeros(3), rays)
    height = (hits.points_mm - marker.centre_mm) @ marker.normal
    on_face = (np.abs(height) < _ON_FACE_MM).reshape(len(v), len(u))
    shape = (bottom - top, right - left)
    visible = cv2.resize(on_face[:-1, :-1].astype(np.uint8), shape[::-1], interpolation=0) > 0
    flat = (rays / rays[:, 2:]).reshape(len(v), len(u), 3)
    cells = _between(flat, SUBPIXELS * _STEP_PX)
    reach = (marker.centre_mm @ marker.normal) / (cells @ marker.normal)
    offset = reach[..., None] * cells - marker.centre_mm
    radius = np.sqrt(np.einsum("hwi,hwi->hw", offset, offset))
    covers = marker.covers(radius, np.stack(np.gradient(radius), axis=-1))
    sigma = SUBPIXELS * camera.blur_sigma_px
    disc, ring = (_binned(blur_image(covers[..., k], sigma)) for k in (0, 1))
    return disc, ring, np.asarray(visible)


def _between(nodes: FloatArray, cells: int) -> FloatArray:
    """(h cells, w cells, 3) values at the middles of pixels' cells between nodes (h+1, w+1, 3).

    A node is the middle of a pixel, which holds `SUBPIXELS` cells on both sides of it.
    """
    place = ((np.arange(cells) + 0.5) - 0.5 * SUBPIXELS) / cells
    n_rows, n_columns = nodes.shape[0] - 1, nodes.shape[1] - 1
    along = _weights(place, n_columns)
    down = _weights(place, n_rows)
    return np.asarray(np.einsum("rh,hwi,cw->rci", down, nodes, along, optimize=True))


def _weights(place: FloatArray, n: int) -> FloatArray:
    """(n cells, n + 1) weights of linear interpolation, continued by half a pixel at the start."""
    weights = np.zeros((n * len(place), n + 1))
    for k in range(n):
        rows = slice(k * len(place), (k + 1) * len(place))
        weights[rows, k], weights[rows, k + 1] = 1.0 - place, place
    return weights


def _binned(fine: FloatArray) -> FloatArray:
    height, width = (n // SUBPIXELS for n in fine.shape)
    return np.asarray(fine.reshape(height, SUBPIXELS, width, SUBPIXELS).mean(axis=(1, 3)))
