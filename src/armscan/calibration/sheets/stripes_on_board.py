# SPDX-License-Identifier: Apache-2.0
"""Straight stripes on flat boards: which stripe points lie on one line of a board, and the
observation that each line is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from armscan.calibration.sheets.board_points import (
    BoardPoints,
    HeadCameras,
    intersect_board_of,
    place_board,
)
from armscan.calibration.sheets.result import BoardStripes, PlacedBoard, PointUse, SheetOptions
from armscan.calibration.sheets.target_edges import runs_along_edge
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Line, fit_line
from armscan.records.profile import REJECTING, StripeFlag
from armscan.vision.targets.target import TargetView

TRIALS = 300
MAX_SCORED = 1500
"""Points that vote on a trial line; more are thinned out evenly."""
MIN_SPAN = 0.15
"""A stripe is at least this long, as a fraction of the board's shorter side."""
COURSE_DEGREE = 3
"""Degree of the gentle curve that a bowed sheet may draw on a flat board."""
COURSE_ROUNDS = 20
HUBER = 1.0
"""In robust sigmas: low, because what is off a stripe may be many points on one side."""
SEED = 20


@dataclass(frozen=True, slots=True, eq=False)
class StraightStripe:
    """Points of one straight stripe: ``rows`` (K,) into the points given, and its line (2-D)."""

    rows: IntArray
    line: Line


def find_straight_stripes(
    points_board_mm: FloatArray,
    sigma_mm: FloatArray,
    segment: IntArray,
    board_size_mm: tuple[float, float],
    options: SheetOptions,
    *,
    n_lines: int = 0,
) -> list[StraightStripe]:
    """Group points on the board into straight stripes, the one with the most points first.

    Lines through two points of one segment, or of two, are tried with a fixed seed; the best
    supported one is refined, its points are taken away, and the search goes on.

    Parameters
    ----------
    points_board_mm
        (N, 2) points in the board's plane.
    sigma_mm
        (N,) standard deviation across the stripe.
    segment
        (N,) connected segment of each point.
    board_size_mm
        Width and height of the board's known region.
    options
        Tolerances.
    n_lines
        Most stripes to look for; 0 for all.
    """
    stripes: list[StraightStripe] = []
    rest = np.arange(len(points_board_mm))
    shortest_mm = MIN_SPAN * min(board_size_mm)
    limit = n_lines or len(points_board_mm)
    generator = np.random.default_rng(SEED)
    while len(rest) >= options.min_points and len(stripes) < limit:
        line = _best_line(points_board_mm[rest], segment[rest], options, generator)
        if line is None:
            break
        near = np.abs(line.distance(points_board_mm[rest])) < options.line_tolerance_mm
        keep = _on_course(points_board_mm[rest], sigma_mm[rest], line, near, options)
        chosen = rest[keep]
        if len(chosen) < options.min_points:
            break
        # Outliers of a stripe already found must not come back as a stripe of their own.
        rest = rest[~keep & ~(near & _is_repeat(line, points_board_mm[chosen], stripes, options))]
        refined = fit_line(points_board_mm[chosen], sigma_mm[chosen] ** -2.0)
        if isinstance(refined, FitFailure):
            break
        along = refined.along(points_board_mm[chosen])
        repeats = _is_repeat(refined, points_board_mm[chosen], stripes, options)
        if not repeats and float(np.ptp(along)) >= shortest_mm:
            stripes.append(StraightStripe(chosen[np.argsort(along)], refined))
    return sorted(stripes, key=lambda stripe: -len(stripe.rows))


def _best_line(
    points: FloatArray, segment: IntArray, options: SheetOptions, generator: np.random.Generator
) -> Line | None:
    """Try lines through pairs of points; half of the pairs within one segment."""
    n = len(points)
    first = generator.integers(n, size=TRIALS)
    second = generator.integers(n, size=TRIALS)
    _, own, counts = np.unique(segment, return_inverse=True, return_counts=True)
    by_segment = np.argsort(own, kind="stable")
    starts = np.cumsum(counts) - counts
    half = own[first[::2]]
    second[::2] = by_segment[starts[half] + generator.integers(counts[half])]
    step = points[second] - points[first]
    length = np.linalg.norm(step, axis=1)
    usable = length > 2.0 * options.line_tolerance_mm
    if not usable.any():
        return None
    first, step, length = first[usable], step[usable], length[usable]
    direction = step / length[:, None]
    scored = points[:: max(1, n // MAX_SCORED)]
    offset = scored[None, :, :] - points[first][:, None, :]
    distance = np.abs(
        direction[:, None, 0] * offset[:, :, 1] - direction[:, None, 1] * offset[:, :, 0]
    )
    # Truncated squares rather than counts: of two lines in one band the centred one wins.
    score = np.maximum(1.0 - (distance / options.line_tolerance_mm) ** 2, 0.0).sum(axis=1)
    best = int(np.argmax(score))
    line = Line(points[first[best]], direction[best])
    for _ in range(3):
        near = np.abs(line.distance(points)) < options.line_tolerance_mm
        refined = fit_line(points[near])
        if isinstance(refined, FitFailure):
            return None
        line = refined
    return line


def _on_course(
    points: FloatArray, sigma_mm: FloatArray, line: Line, near: BoolArray, options: SheetOptions
) -> BoolArray:
    """Keep the points within the outlier limit of a gentle curve along the line."""
    along, across = line.along(points), line.distance(points)
    reach = max(float(np.abs(along[near]).max(initial=0.0)), 1e-9)
    design = np.polynomial.legendre.legvander(along / reach, COURSE_DEGREE)
    if int(near.sum()) <= 2 * (COURSE_DEGREE + 1):
        return near
    scaled, target = design[near] / sigma_mm[near, None], across[near] / sigma_mm[near]
    weight = np.ones(len(target))
    for _ in range(COURSE_ROUNDS):
        root = np.sqrt(weight)
        course = np.linalg.lstsq(scaled * root[:, None], target * root, rcond=None)[0]
        missed = np.abs(target - scaled @ course)
        scale = max(1.0, 1.4826 * float(np.median(missed)))
        weight = HUBER * scale / np.maximum(missed, HUBER * scale)
    normalised = (across - design @ course) / sigma_mm
    return np.asarray(near & (np.abs(normalised) < options.outlier_sigma * scale))


def _is_repeat(
    line: Line, points: FloatArray, stripes: list[StraightStripe], options: SheetOptions
) -> bool:
    """True if the line runs along a stripe already found over all of its points."""
    ends = line.at(np.array([line.along(points).min(), line.along(points).max()]))
    limit = 2.0 * options.line_tolerance_mm
    return any(bool((np.abs(s.line.distance(ends)) < limit).all()) for s in stripes)


@dataclass(frozen=True, slots=True, eq=False)
class StripeObservation:
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
    sightings: tuple[StripeObservation, ...]


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


def observe_board_stripes(
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
    points = intersect_board_of(profile.points_px, data.camera, pose, cameras)
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


def _sighting(image: BoardImage, rows: IntArray) -> StripeObservation:
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
    return StripeObservation(
        rows,
        gain @ here,
        np.einsum("ek,kij->eij", gain, image.points.dpoint_dpose[rows]),
        np.einsum("ek,kij->eij", gain, image.by_camera[rows]),
        at_ends @ normal @ at_ends.T,
        np.cross(image.placed.sensor_from_board.rotation[:, 2], direction),
        0.5 * (q[0] + q[-1]),
        direction_px,
    )


def _across_image(sightings: list[StripeObservation]) -> list[StripeObservation]:
    """Order stripes left to right, or top to bottom where they lie flatter than 45 degrees."""
    if not sightings:
        return []
    doubled = np.stack([s.direction_px for s in sightings])
    is_flat = float((doubled[:, 0] ** 2).mean()) > 0.5
    return sorted(sightings, key=lambda s: float(s.middle_px[1 if is_flat else 0]))
