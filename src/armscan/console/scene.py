# SPDX-License-Identifier: Apache-2.0
"""What the console shows in space and on images: points by colour, the head on its arm with its
light sheets, stripes with the names of their sheets, the range bar.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any, Literal, cast

import cv2
import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armscan.console.quality import coverage
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.pipeline.live.session import CameraView
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure, SensorWindow
from armscan.report.drawing import ACCENT, ALERT, INK, LINE, MUTED, PALETTE, ramp_colours

Colours = NDArray[np.uint8]
ColourBy = Literal["sheet", "sigma", "incidence", "coverage", "deviation"]
COLOURED_BY: tuple[ColourBy, ...] = ("sheet", "sigma", "incidence", "coverage", "deviation")
UNIT_MM = 100.0
"""Of the scene: its camera and its lights are made for things of about one unit."""
MOST_POINTS = 2_000_000
FINE_POINTS = 400_000
"""Up to so many points are sent with 32 bits a coordinate; more with 16, about their middle."""
COVERED_MM, WELL_COVERED = 2.0, 8
"""A cell of this size is well covered by so many points."""
GROWN = 1.6
"""The view follows points that have spread by more than this since it was turned to them, or
whose middle has gone half as far aside."""
IMAGE_WIDTH = 640
UNKNOWN = np.array([120, 120, 120])
STEEP_DEG = 60.0
"""Lines seen at a steeper angle scatter; colours of incidence end here."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownPoints:
    """Points to show, whatever they come from.

    Parameters
    ----------
    points_mm
        (N, 3) in their frame.
    sheet
        (N,) index of the sheet.
    sigma_mm
        (N,) standard deviation.
    incidence_deg
        (N,) angle between normal and line of sight; None where not known.
    deviation_mm
        (N,) from the model of the part; None where not compared.
    limit_mm
        At which deviation the colours end.
    """

    points_mm: FloatArray
    sheet: IntArray
    sigma_mm: FloatArray
    incidence_deg: FloatArray | None = None
    deviation_mm: FloatArray | None = None
    limit_mm: float = 0.1


def shown_points(cloud: PointCloud) -> ShownPoints:
    """Those of a cloud, with the angle at which each was seen, where the cloud knows it."""
    incidence = None
    if cloud.normals is not None and cloud.seen_from_mm is not None:
        sight = cloud.seen_from_mm[cloud.exposure] - cloud.points_mm
        sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
        cosine = np.abs(np.einsum("ni,ni->n", sight, cloud.normals))
        incidence = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
    return ShownPoints(cloud.points_mm, cloud.sheet, cloud.sigma_mm, incidence)


def rgb(colour: str) -> tuple[int, int, int]:
    """Numbers of a CSS colour ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def sheet_colour(number: int) -> tuple[int, int, int]:
    """Colour of a sheet, the same in the cloud, on images and in space."""
    return rgb(PALETTE[number % len(PALETTE)])


def point_colours(shown: ShownPoints, by: ColourBy) -> tuple[Colours, str]:
    """(N, 3) colours, and what they mean in words; by sheet where the wanted is not known."""
    if by == "sigma" and len(shown.sigma_mm):
        low, high = np.quantile(shown.sigma_mm, [0.02, 0.98])
        text = f"sigma from {low:.4f} mm (dark) to {high:.4f} mm (yellow)"
        return ramp_colours(shown.sigma_mm, low, high), text
    if by == "incidence" and shown.incidence_deg is not None:
        text = f"seen square on (dark) to {STEEP_DEG:.0f}° or more aslant (yellow); grey: unknown"
        is_known = np.isfinite(shown.incidence_deg)
        colours = ramp_colours(np.where(is_known, shown.incidence_deg, 0.0), 0.0, STEEP_DEG)
        return np.where(is_known[:, None], colours, UNKNOWN).astype(np.uint8), text
    if by == "deviation" and shown.deviation_mm is not None:
        return _deviations(shown.deviation_mm, shown.limit_mm), (
            f"blue: {shown.limit_mm:g} mm too low, pale: as the model, "
            f"red: {shown.limit_mm:g} mm too high; dark grey: not of the part"
        )
    if by == "coverage" and len(shown.points_mm):
        count = coverage(shown.points_mm, COVERED_MM)
        share = np.clip(count / WELL_COVERED, 0.0, 1.0)[:, None]
        thin, well = np.array(rgb(ALERT)), np.array([91, 140, 42])
        text = f"orange: few points in {COVERED_MM:g} mm, green: {WELL_COVERED} or more"
        return np.asarray(thin + share * (well - thin)).astype(np.uint8), text
    table = np.array([sheet_colour(k) for k in range(len(PALETTE))], dtype=np.uint8)
    missing = "" if by == "sheet" else f"{by} is not known of these points; "
    return table[shown.sheet % len(PALETTE)], f"{missing}a colour for each light sheet"


def _deviations(deviation_mm: FloatArray, limit_mm: float) -> Colours:
    is_known = np.isfinite(deviation_mm)[:, None]
    share = np.clip(np.nan_to_num(deviation_mm) / limit_mm, -1.0, 1.0)[:, None]
    low, middle, high = np.array([33, 102, 172]), np.array([205, 205, 205]), np.array([178, 24, 43])
    end = np.where(share < 0.0, low, high)
    colours = middle + np.abs(share) * (end - middle)
    return np.where(is_known, colours, UNKNOWN).astype(np.uint8)


def thinned(n: int, most: int = MOST_POINTS) -> slice:
    """Every so many of ``n`` points, so that no more than ``most`` are left."""
    return slice(None, None, max(1, -(-n // most)))


class SceneView:
    """The browser's space; lengths in mm."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        self._camera = server.initial_camera
        self._server = server
        self._cloud: viser.PointCloudHandle | None = None
        self._head: list[Any] = []
        self._has_view = False
        self._seen_mm, self._looked_at_mm = 0.0, np.zeros(3)
        server.scene.set_up_direction("+z")
        self._scene.world_axes.visible = False

    def show(self, shown: ShownPoints, by: ColourBy, most: int = MOST_POINTS) -> str:
        """Show points in place of those before, thinned; returns what their colours mean."""
        self.clear()
        if not len(shown.points_mm):
            return "no points yet"
        chosen = thinned(len(shown.points_mm), most)
        points = shown.points_mm[chosen]
        colours, text = point_colours(shown, by)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        self._cloud = self._scene.add_point_cloud(
            "/cloud",
            ((points - middle) / UNIT_MM).astype(np.float32),
            colours[chosen],
            point_size=max(0.05, 0.0016 * size) / UNIT_MM,
            point_shape="rounded",
            point_shading="flat",
            precision="float32" if len(points) <= FINE_POINTS else "float16",
            position=tuple((middle / UNIT_MM).tolist()),
        )
        moved = float(np.linalg.norm(middle - self._looked_at_mm))
        if not self._has_view or max(size, 3.0 * moved) > GROWN * self._seen_mm:
            self.look_at(middle, size)
        return f"{len(points):,} of {len(shown.points_mm):,} points; {text}"

    def look_at(self, middle_mm: FloatArray, size_mm: float) -> None:
        """Turn the view of every browser, also of those to come, to a place."""
        middle = middle_mm / UNIT_MM
        self._seen_mm, self._looked_at_mm = max(size_mm, 60.0), middle_mm
        eye = middle + self._seen_mm / UNIT_MM * np.array([0.36, -0.66, 0.5])
        self._camera.look_at, self._camera.position = middle, eye
        for client in self._server.get_clients().values():
            # in this order: what is looked at follows a new position
            client.camera.position = eye
            client.camera.look_at = middle
        self._has_view = True

    def clear(self) -> None:
        """Show no points."""
        if self._cloud is not None:
            self._cloud.remove()
            self._cloud = None

    def forget_view(self) -> None:
        """The next points decide where the view looks."""
        self._has_view = False

    def show_head(
        self,
        pose: Pose[Base, Tool] | None,
        scanner: ScannerCalibration | None,
        arm_mm: FloatArray | None = None,
    ) -> None:
        """Draw the head where it is, with its light sheets, and the arm.

        ``arm_mm``: (K, 3) from the arm's base along its axes to the tool; None for a straight line.
        """
        with self._server.atomic():
            for handle in self._head:
                handle.remove()
            self._head = []
            if pose is None or scanner is None or scanner.sensor is None:
                return
            sensor = scanner.sensor
            base_from_sensor = pose @ scanner.hand_eye.tool_from_sensor
            if arm_mm is None:
                arm_mm = np.array([np.zeros(3), pose.translation_mm])
            self._draw_arm(np.vstack([arm_mm, base_from_sensor.translation_mm]) / UNIT_MM)
            wxyz, place = _placed(base_from_sensor)
            camera = sensor.camera.camera
            fov = 2.0 * np.arctan(0.5 * camera.height_px / camera.matrix[1, 1])
            self._head.append(
                self._scene.add_camera_frustum(
                    "/head/camera",
                    fov=float(fov),
                    aspect=camera.width_px / camera.height_px,
                    scale=0.12,
                    thickness=1.5,
                    thickness_units="screen",
                    color=rgb(ACCENT),
                    wxyz=wxyz,
                    position=place,
                )
            )
            for number, corners in enumerate(sheet_corners_mm(sensor)):
                self._head.append(
                    self._scene.add_mesh_simple(
                        f"/head/sheet{number}",
                        (corners / UNIT_MM).astype(np.float32),
                        np.array([[0, 1, 2], [0, 2, 3]]),
                        color=sheet_colour(number),
                        opacity=0.12,
                        side="double",
                        cast_shadow=False,
                        receive_shadow=False,
                        wxyz=wxyz,
                        position=place,
                    )
                )

    def _draw_arm(self, joints: FloatArray) -> None:
        """Base, links between the axes as far as they are known, head."""
        self._head.append(
            self._scene.add_line_segments(
                "/head/arm",
                np.stack([joints[:-1], joints[1:]], axis=1),
                colors=np.array(rgb(MUTED), dtype=np.uint8),
                thickness=6.0,
                thickness_units="screen",
            )
        )
        for k, place in enumerate(joints[:-1]):
            self._head.append(
                self._scene.add_icosphere(
                    f"/head/joint{k}", radius=0.06, color=rgb(INK), position=tuple(place.tolist())
                )
            )
        self._head.append(self._scene.add_frame("/head/base", axes_length=0.6, axes_radius=0.02))


def _placed(pose: Pose[Any, Any]) -> tuple[Any, Any]:
    xyzw = Rotation.from_matrix(pose.rotation).as_quat()
    return np.roll(xyzw, 1), pose.translation_mm / UNIT_MM


def sheet_corners_mm(sensor: SensorCalibration) -> list[FloatArray]:
    """(4, 3) corners in Sensor of the part of each sheet that is calibrated and in the image."""
    camera = sensor.camera.camera
    focal_px = float(min(camera.matrix[0, 0], camera.matrix[1, 1]))
    widest = 0.5 * max(camera.width_px, camera.height_px) / focal_px
    found = []
    for one in sensor.sheets:
        along, deep, _ = one.sheet.axes
        corners = []
        for depth, sides in zip(one.depth_range_mm, ((-1.0, 1.0), (1.0, -1.0)), strict=True):
            # along the sheet's own axis to the depth
            is_steep = abs(deep[2]) > 1e-3
            step = (depth - one.sheet.origin_mm[2]) / deep[2] if is_steep else one.sheet.scale_mm
            half = min(one.sheet.scale_mm, widest * depth)
            middle = one.sheet.origin_mm + step * deep
            corners += [middle + side * half * along for side in sides]
        found.append(np.array(corners))
    return found


def depths_mm(sensor: SensorCalibration) -> tuple[float, float]:
    """Nearest and farthest depth between which more than half of the sheets are calibrated.

    No depth need be all sheets': the outer ones of a fan cross the view nearer and farther off. Of
    sheets that share less it is where most of them are.
    """
    ranges = np.array([one.depth_range_mm for one in sensor.sheets])
    ends = np.unique(ranges)
    covers = (ranges[:, :1] <= ends[:-1]) & (ends[1:] <= ranges[:, 1:])
    n = covers.sum(axis=0)
    is_inside = n >= min(len(ranges) // 2 + 1, n.max())
    change = np.flatnonzero(np.diff(np.r_[False, is_inside, False]))
    first, last = ends[change[::2]], ends[change[1::2]]
    longest = int(np.argmax(last - first))
    return float(first[longest]), float(last[longest])


def range_bar(depth_mm: float | None, low_mm: float, high_mm: float) -> str:
    """HTML bar of the measuring depth: green inside, a mark where the surface is."""
    span = high_mm - low_mm
    left, width = low_mm - 0.35 * span, 1.7 * span

    def share(depth: float) -> float:
        return float(np.clip(100.0 * (depth - left) / width, 0.0, 100.0))

    is_in = depth_mm is not None and low_mm <= depth_mm <= high_mm
    words = "no surface in sight" if depth_mm is None else f"{depth_mm:.0f} mm"
    if depth_mm is not None and not is_in:
        words += ": move away" if depth_mm < low_mm else ": move nearer"
    mark = ""
    if depth_mm is not None:
        mark = (
            f'<div style="position:absolute;left:calc({share(depth_mm):.1f}% - 3px);top:-3px;'
            f'width:6px;height:24px;background:{INK};border-radius:3px"></div>'
        )
    return (
        f'<div style="font-size:13px;color:{INK}"><div>Distance: <b>{words}</b></div>'
        f'<div style="position:relative;height:18px;background:{LINE};border-radius:4px;'
        'margin:6px 0 2px">'
        f'<div style="position:absolute;left:{share(low_mm):.1f}%;height:18px;background:#7db36a;'
        f'width:{share(high_mm) - share(low_mm):.1f}%"></div>{mark}</div>'
        f'<div style="font-size:11px;color:{MUTED}">green: {low_mm:.0f} to {high_mm:.0f} mm</div>'
        "</div>"
    )


def live_image(view: CameraView, names: tuple[str, ...], window: SensorWindow) -> Colours:
    """(H, W, 3) the image of a camera, small, with its stripes and the names of their sheets."""
    picture, scale = _small(view.image)
    for number in np.unique(view.sheet).tolist():
        if not 0 <= number < len(names):
            continue
        own = (view.points_px[view.sheet == number] - [window.x_px, window.y_px]) / window.binning
        points = (own * scale).round().astype(np.int64)
        for x, y in points[::2]:
            cv2.circle(picture, (int(x), int(y)), 1, sheet_colour(number), -1)
        x, y = points[len(points) // 2]
        place = (int(x) + 8, int(y) - 8)
        cv2.putText(
            picture, names[number], place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 4, cv2.LINE_AA
        )
        cv2.putText(
            picture, names[number], place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 2,
            cv2.LINE_AA,
        )  # fmt: skip
    return picture


def taken_image(exposure: Exposure) -> Colours:
    """(H, W, 3) an exposure, small."""
    return _small(exposure.image)[0]


def _small(image: NDArray[Any]) -> tuple[Colours, float]:
    scale = IMAGE_WIDTH / image.shape[1]
    size = (IMAGE_WIDTH, max(1, round(image.shape[0] * scale)))
    eight = image if image.dtype == np.uint8 else (image / max(1, image.max()) * 255.0)
    small = cv2.resize(eight.astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    full = small if small.ndim == 3 else cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
    return np.ascontiguousarray(cast(Colours, full)), scale


def paragraph(text: str, colour: str = INK, size: int = 14) -> str:
    """HTML of one paragraph of plain text; empty for no text."""
    if not text:
        return ""
    return f'<p style="margin:4px 0;color:{colour};font-size:{size}px">{escape(text)}</p>'
