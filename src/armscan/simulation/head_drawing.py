# SPDX-License-Identifier: Apache-2.0
"""One instrument of a kind: camera, lasers and mounting as far off the print as real ones are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Frame, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera
from armscan.simulation.printed_heads import BLUE_MM, PrintedSheet

_THICKNESS_MM = 0.075
_BLUE_DIVERGENCE_RAD = 4.3e-4
"""Far field of a 405 nm beam of that waist."""
_ORDER_SHARE = 0.25
"""Lines of one projector sit firmly on each other: this part of the tolerance is each one's own."""

A = TypeVar("A", bound=Frame)


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Standard deviations of what differs from one instrument of a kind to the next.

    Parameters
    ----------
    focal_share, centre_px, distortion_share
        Camera: part of the focal length, principal point, part of each distortion coefficient.
    sheet_tilt_rad, sheet_offset_mm, skew_share
        Laser: mounting of the sheet and part of its bow.
    mount_rad, mount_mm
        Head on the tool, and a second camera on the head, about and along each axis.
    """

    focal_share: float = 0.004
    centre_px: float = 8.0
    distortion_share: float = 0.08
    sheet_tilt_rad: float = 0.004
    sheet_offset_mm: float = 0.3
    skew_share: float = 0.25
    mount_rad: float = 0.006
    mount_mm: float = 0.5


def draw_camera(
    printed: RenderCamera, spread: Tolerances, rng: np.random.Generator
) -> RenderCamera:
    """One camera of a kind."""
    focal = 1.0 + spread.focal_share * rng.standard_normal()
    shift = spread.centre_px * rng.standard_normal(2)
    k1, k2, p1, p2, k3 = 1.0 + spread.distortion_share * rng.standard_normal(5)
    c = printed
    return replace(
        c,
        fx=c.fx * focal,
        fy=c.fy * focal,
        cx=c.cx + float(shift[0]),
        cy=c.cy + float(shift[1]),
        k1=c.k1 * k1,
        k2=c.k2 * k2,
        p1=c.p1 * p1,
        p2=c.p2 * p2,
        k3=c.k3 * k3,
    )


def draw_mounting(
    printed: Pose[A, Sensor], spread: Tolerances, rng: np.random.Generator
) -> Pose[A, Sensor]:
    """Where the head sits on something, or something on the head."""
    turn: FloatArray = rotation_from_vector(spread.mount_rad * rng.standard_normal(3))
    shift = spread.mount_mm * rng.standard_normal(3)
    return Pose(turn @ printed.rotation, printed.translation_mm + shift)


def draw_lasers(
    printed: Sequence[PrintedSheet], level: float, spread: Tolerances, rng: np.random.Generator
) -> tuple[LineLaser, ...]:
    """All sheets; those of one source are mounted as one, and each is a little off besides."""
    n_sheets = {sheet.source: 0 for sheet in printed}
    for sheet in printed:
        n_sheets[sheet.source] += 1
    lasers: list[LineLaser] = []
    for source, count in n_sheets.items():
        own = [sheet for sheet in printed if sheet.source == source]
        if count == 1:
            lasers.append(_draw_laser(own[0], level, spread, rng))
            continue
        middle = own[count // 2]
        tilt = rotation_from_vector(spread.sheet_tilt_rad * rng.standard_normal(3))
        shift = spread.sheet_offset_mm * rng.standard_normal(3)
        each = replace(
            spread,
            sheet_tilt_rad=_ORDER_SHARE * spread.sheet_tilt_rad,
            sheet_offset_mm=_ORDER_SHARE * spread.sheet_offset_mm,
        )
        mount: Pose[Sensor, Sensor] = Pose(tilt, middle.aim_mm + shift - tilt @ middle.aim_mm)
        lasers += [_draw_laser(sheet, level, each, rng).moved(mount) for sheet in own]
    return tuple(lasers)


def _draw_laser(
    printed: PrintedSheet, level: float, spread: Tolerances, rng: np.random.Generator
) -> LineLaser:
    """Sheet whose middle ray lies in the printed plane; its ends bow out of it."""
    normal = printed.plane[:3] / np.linalg.norm(printed.plane[:3])
    source, aim = printed.source_mm, printed.aim_mm
    tilt = rotation_from_vector(spread.sheet_tilt_rad * rng.standard_normal(3))
    shift = spread.sheet_offset_mm * rng.standard_normal() * normal
    skew = printed.skew_rad * (1.0 + spread.skew_share * rng.standard_normal())
    forward = (aim - source) / np.linalg.norm(aim - source)
    across = np.cross(normal, forward)
    # The cone's middle ray leaves the fan plane by the skew: turn the fan back by as much.
    back = rotation_from_vector(skew * across)
    cubic = 0.0
    if printed.cubic_rad > 0.0 and spread.skew_share > 0.0:
        cubic = printed.cubic_rad * rng.standard_normal()
    return LineLaser(
        printed.name,
        aim + shift + tilt @ (source - aim),
        tilt @ back @ forward,
        tilt @ across,
        half_angle_rad=printed.half_angle_rad,
        skew_rad=skew,
        waist_mm=_THICKNESS_MM,
        waist_distance_mm=float(np.linalg.norm(aim - source)),
        divergence_rad=_BLUE_DIVERGENCE_RAD * (printed.wavelength_mm / BLUE_MM),
        irradiance=printed.brightness * level,
        colour=(1.0, 1.0, 1.0),
        source=printed.source,
        cubic_rad=cubic,
    )
