# SPDX-License-Identifier: Apache-2.0
"""One stripe on one board as a straight piece in space, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.ray_board import BoardPoints
from armscan.calibration.laser.result import BoardStripes, PlacedBoard, PointUse
from armscan.calibration.laser.second_view import meet_board_of, place_board
from armscan.calibration.laser.straight_stripes import find_straight_stripes
from armscan.calibration.laser.target_edges import runs_along_edge
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.records.profile import REJECTING, StripeFlag
from armscan.vision.targets.view import TargetView


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One straight stripe of one image.

    Parameters
    ----------
    rows
        (K,) rows of the image's profile, ordered along the stripe.
    ends_mm
        (2, 3) ends of the fitted straight piece, Sensor frame.
    ends_by_pose
        (2, 3, 6) their derivative by the board's pose.
    ends_by_camera
        (2, 3, P) their derivative by the cameras' parameters, the board's pose following them.
    noise_ends_mm2
        (2, 2) covariance of the ends across the stripe by the stripe's noise alone: one end goes
        up where the other goes down.
    across
        (3,) unit vector on the board across the stripe, in which this noise acts.
    middle_px
        (2,) middle of the stripe in the image.
    direction_px
        (2,) unit direction of the stripe in the image.
    """

    rows: IntArray
    ends_mm: FloatArray
    ends_by_pose: FloatArray
    ends_by_camera: FloatArray
    noise_ends_mm2: FloatArray
    across: FloatArray
    middle_px: FloatArray
    direction_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BoardImage:
    """All stripe points of one image on its board, and the straight stripes among them.

    Parameters
    ----------
    data
        What was given.
    placed
        The board's pose in Sensor.
    points
        The points on the board.
    by_camera
        (N, 3, P) their derivative by the cameras' parameters, the board's pose following them.
    sigma_mm
        (N,) stripe noise across the stripe, in space.
    use
        (N,) `PointUse` so far: `PointUse.UNNAMED` for points on a straight stripe.
    sightings
        The straight stripes, in their order across the image.
    """

    data: BoardStripes
    placed: PlacedBoard
    points: BoardPoints
    by_camera: FloatArray
    sigma_mm: FloatArray
    use: IntArray
    sightings: tuple[Sighting, ...]


TOLERANCE_PX = 2.0
"""The least half width of a straight stripe's band, where a pixel is coarser than the tolerance."""


PULLING = StripeFlag.BACKGROUND_STEP | StripeFlag.ASYMMETRIC
"""What an edge beside the stripe does to its profile."""
PULL_WIDTHS = 0.5
"""An edge under a stripe takes up to half of its light: the centre moves by up to this part of the
stripe's width."""


def printed_margin_mm(view: TargetView) -> float:
    """How far the print goes on beyond the target's points: a square, half a pitch of circles."""
    points = view.points_board_mm[:, :2]
    nearest = np.asarray(cKDTree(points).query(points, k=2)[0])
    pitch = float(np.median(nearest[:, 1]))
    return pitch if view.edges is None else 0.5 * pitch


def sight_stripes(
    data: BoardStripes,
    cameras: HeadCameras,
    options: SheetOptions,
    margin_mm: float | None = None,
    n_lines: int = 0,
) -> BoardImage:
    """Carry the stripe points of one image to its board and sort them into straight stripes.

    Points that an edge beside the stripe may pull are left out. Where nothing else shows a stripe,
    because it runs along the target's pattern, they are used as what they are: less certain.

    Parameters
    ----------
    data
        The image's stripe points and its board.
    cameras
        The cameras.
    options
        In force.
    margin_mm
        Points so far outside the rectangle of the target's points count as on the board; what the
        print covers if None.
    n_lines
        Stripes to look for, those with the most points; 0 for all.
    """
    if margin_mm is None:
        margin_mm = printed_margin_mm(data.view)
    seen = ((data.camera, data.view, data.sensor_from_board),)
    placed = data.placed or place_board(seen, cameras)
    profile, pose = data.profile, placed.sensor_from_board
    points = meet_board_of(profile.points_px, data.camera, pose, cameras)
    by_camera = points.dpoint_dcamera + points.dpoint_dpose @ placed.by_cameras
    on_board = ((points.points_mm - pose.translation_mm) @ pose.rotation)[:, :2]
    corners = data.view.points_board_mm[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    with np.errstate(invalid="ignore"):
        known = (on_board >= low - margin_mm) & (on_board <= high + margin_mm)
    is_known = points.is_valid & known.all(axis=1)
    use = np.full(len(profile), int(PointUse.OFF_LINE))
    pulled = (profile.flags & int(REJECTING) & ~int(PULLING)) == 0
    if data.edges is not None:
        on_edge = runs_along_edge(profile, data.edges, options.edge_widths, options.edge_angle_deg)
        use[on_edge] = PointUse.ON_EDGE
        pulled &= on_edge | ~profile.is_accepted
    use[~known.all(axis=1)] = PointUse.OFF_BOARD
    use[~points.is_valid] = PointUse.NO_RAY
    use[~profile.is_accepted] = PointUse.FLAGGED
    across = np.einsum("nij,nj->ni", points.dpoint_dq, profile.normals_px)
    sigma_mm = np.linalg.norm(across, axis=1) * profile.sigma_px
    image = BoardImage(data, placed, points, by_camera, sigma_mm, use, ())
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    found = _with_stripes(image, use == PointUse.OFF_LINE, on_board, size, options, n_lines=n_lines)
    if found.sightings or not pulled.any():
        return found
    less_sure = _with_pull(image, pulled)
    sure = is_known & (pulled | (use == PointUse.OFF_LINE))
    return _with_stripes(less_sure, sure, on_board, size, options, n_lines=n_lines)


def _with_pull(image: BoardImage, pulled: BoolArray) -> BoardImage:
    """The image with what an edge may do to a centre in the sigmas of the points that it pulls."""
    profile = image.data.profile
    sigma_px = np.where(
        pulled, np.hypot(profile.sigma_px, PULL_WIDTHS * profile.width_px), profile.sigma_px
    )
    data = replace(image.data, profile=replace(profile, sigma_px=sigma_px))
    return replace(image, data=data, sigma_mm=image.sigma_mm * sigma_px / profile.sigma_px)


def _with_stripes(
    image: BoardImage,
    is_open: BoolArray,
    on_board_mm: FloatArray,
    size_mm: tuple[float, float],
    options: SheetOptions,
    *,
    n_lines: int,
) -> BoardImage:
    """Sort the points that are open (N,) into straight stripes on the board."""
    candidates = np.flatnonzero(is_open)
    profile, use = image.data.profile, image.use.copy()
    mm_px = image.sigma_mm[candidates] / profile.sigma_px[candidates]
    coarse = TOLERANCE_PX * float(np.median(mm_px)) if len(mm_px) else 0.0
    stripes = find_straight_stripes(
        on_board_mm[candidates],
        image.sigma_mm[candidates],
        profile.segment[candidates],
        size_mm,
        replace(options, line_tolerance_mm=max(options.line_tolerance_mm, coarse)),
        n_lines=n_lines,
    )
    for stripe in stripes:
        use[candidates[stripe.rows]] = PointUse.UNNAMED
    image = replace(image, use=use)
    sightings = [_sighting(image, candidates[stripe.rows]) for stripe in stripes]
    return replace(image, sightings=tuple(_across_image(sightings)))


def _sighting(image: BoardImage, rows: IntArray) -> Sighting:
    """Fit a straight line in space through the points and express it by its two ends."""
    here, weight = image.points.points_mm[rows], image.sigma_mm[rows] ** -2.0
    along = here - here[0]
    direction = along[-1] / np.linalg.norm(along[-1])
    t = along @ direction
    design = np.stack([np.ones_like(t), t], axis=1)
    normal = np.linalg.inv(design.T @ (design * weight[:, None]))
    at_ends = np.array([[1.0, t.min()], [1.0, t.max()]])
    gain = at_ends @ normal @ (design * weight[:, None]).T
    q = image.data.profile.points_px[rows]
    direction_px = (q[-1] - q[0]) / np.linalg.norm(q[-1] - q[0])
    return Sighting(
        rows,
        gain @ here,
        np.einsum("ek,kij->eij", gain, image.points.dpoint_dpose[rows]),
        np.einsum("ek,kij->eij", gain, image.by_camera[rows]),
        at_ends @ normal @ at_ends.T,
        np.cross(image.placed.sensor_from_board.rotation[:, 2], direction),
        0.5 * (q[0] + q[-1]),
        direction_px,
    )


def _across_image(sightings: list[Sighting]) -> list[Sighting]:
    """Order stripes left to right, or top to bottom where they lie flatter than 45 degrees."""
    if not sightings:
        return []
    doubled = np.stack([s.direction_px for s in sightings])
    is_flat = float((doubled[:, 0] ** 2).mean()) > 0.5
    return sorted(sightings, key=lambda s: float(s.middle_px[1 if is_flat else 0]))
