# SPDX-License-Identifier: Apache-2.0
"""Straight stripes on flat boards: which stripe points an edge of the target pulls, which lie on
one line of a board, and the observation that each line is.

A stripe that runs along an edge of the print is brighter on the one side, and every method of
finding its centre is pulled there. The edges are known, so such points can be told without looking
at their residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from armscan.calibration.sheets.board_points import (
    BoardBow,
    BoardPoints,
    HeadCameras,
    intersect_board_of,
    place_board,
)
from armscan.calibration.sheets.result import BoardStripes, PlacedBoard, PointUse
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.shapes import Line, fit_line
from armscan.models.camera import CameraModel
from armscan.records.profile import REJECTING, Profile, StripeFlag
from armscan.vision.targets.target import (
    AprilGrid,
    Charuco,
    Chessboard,
    CircleEdges,
    CircleGrid,
    Target,
    TargetView,
)

REACH_WIDTHS = 3.0
"""An edge pulls a point that is nearer to it than this many of the stripe's widths (sigma of its
cross-section): beyond three sigma there is no light."""
LARGEST_ANGLE_DEG = 75.0
"""Edges that are turned further from the stripe cross it, and pull it to neither side."""
SAMPLE_PX = 1.0
"""Spacing in the image of the points that stand for a straight edge."""
COARSE = 64
"""Points by which the part of an edge that is seen is found."""
MARGIN_PX = 20.0
"""Edges are followed this far outside the image."""
SAME_RAY = 1e-6
"""A point is the camera's own if its ray leads back to it this well, in the plane at distance 1."""
MIN_RIM_POINTS = 8
"""With fewer, the shape of a circle's rim is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetEdges:
    """Points of the target's reflectance edges in the image.

    ``points_px`` (K, 2) full-sensor pixels, about a pixel apart along an edge; ``directions_px``
    (K, 2) unit vectors along the edge, whose sign does not matter.
    """

    points_px: FloatArray
    directions_px: FloatArray


def find_target_edges(
    view: TargetView, target: Target, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> TargetEdges | None:
    """Edges of the target in the image in which it was found; None if they are not known.

    Circles have the rims that were found. The squares of a chessboard and of a ChArUco board are
    projected, the outermost ones included, and so are the borders of an AprilGrid's tags and small
    squares. Markers inside a ChArUco board's squares and the code inside of tags are left out:
    their cells are so many that hardly a point would be left.
    """
    if isinstance(target, CircleGrid):
        return None if view.edges is None else _rims(view.edges)
    return _borders(target, sensor_from_board, camera)


def runs_along_edge(profile: Profile, edges: TargetEdges) -> BoolArray:
    """(N,) True for stripe points near an edge that runs along the stripe.

    Not for those in whose fit the print is known: their sigma says what that leaves.
    """
    near = np.zeros(len(profile), dtype=np.bool_)
    if len(edges.points_px) == 0 or len(profile) == 0:
        return near
    tree = cKDTree(edges.points_px)
    found = tree.query_ball_point(profile.points_px, REACH_WIDTHS * profile.width_px)
    row = np.repeat(np.arange(len(profile)), [len(neighbours) for neighbours in found])
    edge = np.concatenate([np.asarray(neighbours, dtype=np.int64) for neighbours in found])
    across = np.einsum("ni,ni->n", profile.normals_px[row], edges.directions_px[edge])
    near[row[np.abs(across) < np.sin(np.radians(LARGEST_ANGLE_DEG))]] = True
    return np.asarray(near & ((profile.flags & int(StripeFlag.GROUND_KNOWN)) == 0))


def _rims(edges: CircleEdges) -> TargetEdges:
    """Tangents of the rims, by the ellipse that has the rim points' second moments."""
    points, directions = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for circle in np.unique(edges.circle):
        rim = edges.points_px[edges.circle == circle]
        if len(rim) < MIN_RIM_POINTS:
            continue
        offset = rim - rim.mean(axis=0)
        normal = np.linalg.solve(offset.T @ offset / len(rim), offset.T).T
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        points.append(rim)
        directions.append(tangent / np.linalg.norm(tangent, axis=1)[:, None])
    return TargetEdges(np.concatenate(points), np.concatenate(directions))


def _borders(
    target: Chessboard | Charuco | AprilGrid,
    sensor_from_board: Pose[Sensor, Board],
    camera: CameraModel,
) -> TargetEdges:
    """Borders of all squares, corner to corner and one square beyond the inner corners.

    Of an AprilGrid these are the tags' borders and the small squares, which lie on lines, too.
    """
    corners = target.points_board_mm[:, :2]
    if isinstance(target, AprilGrid):
        square_mm = np.full(2, target.spacing * target.tag_mm)
    else:
        stretch = target.stretch if isinstance(target, Chessboard) else 1.0
        square_mm = target.square_mm * np.array([1.0, stretch])
    low, high = corners.min(axis=0) - square_mm, corners.max(axis=0) + square_mm
    x, y = (np.unique([low[i], *corners[:, i].round(9), high[i]]) for i in range(2))
    lines = [np.array([[value, low[1]], [value, high[1]]]) for value in x]
    lines += [np.array([[low[0], value], [high[0], value]]) for value in y]
    points, directions = [], []
    for ends in lines:
        image, is_seen = _image_of_line(ends, sensor_from_board, camera)
        step = np.gradient(image, axis=0)
        length = np.linalg.norm(step, axis=1)
        is_seen &= np.isfinite(length) & (length > 0.0)
        points.append(image[is_seen])
        directions.append(step[is_seen] / length[is_seen, None])
    return TargetEdges(np.concatenate(points), np.concatenate(directions))


def _image_of_line(
    ends_mm: FloatArray, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> tuple[FloatArray, BoolArray]:
    """(K, 2) pixels at most `SAMPLE_PX` apart along a straight line on the board, and (K,) where.

    Only the part of the line in and near the image is sampled finely. Not seen are points behind
    the camera, far outside the image, and beyond the lens model's fold: those the model throws
    back into the image, and the pixel's own ray does not lead to them.
    """

    def image(low: float, high: float, n: int) -> tuple[FloatArray, BoolArray]:
        t = np.linspace(low, high, n)[:, None]
        on_board = np.pad(ends_mm[0] + t * (ends_mm[1] - ends_mm[0]), ((0, 0), (0, 1)))
        points = on_board @ sensor_from_board.rotation.T + sensor_from_board.translation_mm
        q = camera.project(points)
        is_seen = camera.is_inside(q, -MARGIN_PX)
        xy, has_ray = camera.undistort(np.where(is_seen[:, None], q, 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            ideal = points[:, :2] / points[:, 2:]
            is_own = (np.abs(ideal - xy) < SAME_RAY).all(axis=1)
        return q, is_seen & has_ray & is_own

    coarse, is_seen = image(0.0, 1.0, COARSE)
    seen = np.flatnonzero(is_seen)
    if len(seen) == 0:
        return coarse, is_seen
    first, last = max(int(seen[0]) - 1, 0), min(int(seen[-1]) + 1, COARSE - 1)
    steps = np.linalg.norm(np.diff(coarse[is_seen], axis=0), axis=1)
    # A line that leaves the image may end within a step of the last point seen.
    length_px = float(steps.sum()) + 2.0 * float(steps.max(initial=SAMPLE_PX))
    n = max(int(np.ceil(length_px / SAMPLE_PX)), 2)
    return image(first / (COARSE - 1), last / (COARSE - 1), n)


MIN_POINTS = 20
"""Fewest points that make a stripe: enough to tell a line from a chance row of reflections."""
OUTLIER_SIGMA = 4.0
"""Points further than this many robust sigmas from their stripe or sheet are rejected: of normal
noise one in 16,000."""
LINE_TOLERANCE_MM = 1.0
"""Half width of the band on the board in which points belong to one straight stripe, before robust
statistics tighten it: lines of a fan lie further apart, bows and bent boards less."""
LINE_TOLERANCE = 0.02
"""The same as a part of the longer side of what is seen of the print, for boards of less than 50
mm: on them lines may lie a millimetre apart. It holds what `OUTLIER_SIGMA` lets pass."""
TOLERANCE_PX = 2.0
"""The least half width of this band, where a pixel is coarser."""
TRIALS = 300
"""Pairs of points whose lines are tried; of a stripe with a tenth of the points, half of them
within one segment, some ten hit."""
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
PULLING = StripeFlag.BACKGROUND_STEP | StripeFlag.ASYMMETRIC
"""What an edge beside the stripe does to its profile."""
PULL_WIDTHS = 0.5
"""An edge under a stripe takes up to half of its light: the centre moves by up to this part of the
stripe's width."""


@dataclass(frozen=True, slots=True, eq=False)
class StripeObservation:
    """One straight stripe of one image, its points being ``rows`` (K,) of the image's profile.

    Parameters
    ----------
    ends_mm, dends_dpose, dends_dcamera
        (2, 3) ends of the fitted straight piece, Sensor frame, with their derivatives (2, 3, 6) by
        the board's pose and (2, 3, P) by the cameras' parameters, the pose following them.
    noise_ends_mm2, across
        (2, 2) covariance of the ends by the stripe's noise alone, one going up where the other goes
        down, along (3,) the unit vector on the board across the stripe.
    middle_px, direction_px
        (2,) middle and unit direction of the stripe in the image.
    pose_covariance, camera_covariance
        (6, 6) of the board's pose, (P, P) of the cameras.
    """

    rows: IntArray
    ends_mm: FloatArray
    dends_dpose: FloatArray
    dends_dcamera: FloatArray
    noise_ends_mm2: FloatArray
    across: FloatArray
    middle_px: FloatArray
    direction_px: FloatArray
    pose_covariance: FloatArray
    camera_covariance: FloatArray

    def own_covariance_mm2(self, normal: FloatArray) -> FloatArray:
        """(2, 2) covariance of the ends along ``normal`` by the board's pose and stripe noise."""
        by_pose = np.einsum("i,eij->ej", normal, self.dends_dpose)
        noise = self.noise_ends_mm2 * float(self.across @ normal) ** 2
        return np.asarray(by_pose @ self.pose_covariance @ by_pose.T + noise)

    def height_covariance_mm2(self, normal: FloatArray) -> FloatArray:
        """(2, 2) covariance of the ends along ``normal``, the camera's error included."""
        by_camera = np.einsum("i,eij->ej", normal, self.dends_dcamera)
        return np.asarray(
            self.own_covariance_mm2(normal) + by_camera @ self.camera_covariance @ by_camera.T
        )


@dataclass(frozen=True, slots=True, eq=False)
class BoardImage:
    """All N stripe points of one image on its board, and the straight stripes among them.

    Parameters
    ----------
    data, placed
        What was given, and the board's pose in Sensor.
    points, dpoint_dcamera
        The points on the board, and their derivative (N, 3, P) by the cameras' parameters, the
        board's pose following them.
    sigma_mm
        (N,) stripe noise across the stripe, in space.
    use
        (N,) `PointUse` so far: `PointUse.UNNAMED` for points on a straight stripe.
    camera_covariance
        (P, P) of the cameras' parameters, and, last, of the target's bow, if it has one.
    bow
        Of the target; None where it is flat.
    stripes
        In their order across the image.
    """

    data: BoardStripes
    placed: PlacedBoard
    points: BoardPoints
    dpoint_dcamera: FloatArray
    sigma_mm: FloatArray
    use: IntArray
    camera_covariance: FloatArray
    bow: BoardBow | None = None
    stripes: tuple[StripeObservation, ...] = ()

    def mm_per_px(self, rows: IntArray) -> float:
        """Median size in space of a pixel across the stripe, over some points."""
        return float(np.median(self.sigma_mm[rows] / self.data.profile.sigma_px[rows]))

    def on_board_mm(self) -> FloatArray:
        """(N, 2) the points in the board's plane."""
        pose = self.placed.sensor_from_board
        on_board = (self.points.points_mm - pose.translation_mm) @ pose.rotation
        return np.asarray(on_board[:, :2])


def printed_margin_mm(view: TargetView) -> float:
    """How far the print goes on beyond the target's points: a square, half a pitch of circles."""
    points = view.points_board_mm[:, :2]
    nearest = np.asarray(cKDTree(points).query(points, k=2)[0])
    pitch = float(np.median(nearest[:, 1]))
    return pitch if view.edges is None else 0.5 * pitch


def observe_board_stripes(
    data: BoardStripes,
    cameras: HeadCameras,
    margin_mm: float | None = None,
    n_lines: int = 0,
    bow: BoardBow | None = None,
) -> BoardImage:
    """Carry the stripe points of one image to its board and sort them into straight stripes.

    Points that an edge beside the stripe may pull are left out. Where nothing else shows a stripe,
    because it runs along the target's pattern, they are used as what they are: less certain.

    Points up to ``margin_mm`` outside the rectangle of the target's points count as on the board,
    those on the print if None. Of ``n_lines`` stripes those with the most points are looked for; 0
    for all.
    """
    if margin_mm is None:
        margin_mm = printed_margin_mm(data.view)
    profile = data.profile
    use = np.full(len(profile), int(PointUse.OFF_LINE))
    image = _on_board(data, cameras, use, bow)
    points = image.points
    corners = data.view.points_board_mm[:, :2]
    low, high = corners.min(axis=0) - margin_mm, corners.max(axis=0) + margin_mm
    on_board = image.on_board_mm()
    with np.errstate(invalid="ignore"):
        is_within = ((on_board >= low) & (on_board <= high)).all(axis=1)
    pulled = (profile.flags & int(REJECTING) & ~int(PULLING)) == 0
    if data.on_edge is not None:
        use[data.on_edge] = PointUse.ON_EDGE
        pulled &= data.on_edge | ~profile.is_sure
    use[~is_within] = PointUse.OFF_BOARD
    use[~points.is_valid] = PointUse.NO_RAY
    use[~profile.is_sure] = PointUse.FLAGGED
    found = _with_stripes(image, use == PointUse.OFF_LINE, n_lines)
    if found.stripes or not pulled.any():
        return found
    is_open = points.is_valid & is_within & (pulled | (use == PointUse.OFF_LINE))
    return _with_stripes(_with_pull(image, pulled), is_open, n_lines)


def _on_board(
    data: BoardStripes, cameras: HeadCameras, use: IntArray, bow: BoardBow | None
) -> BoardImage:
    """The points on the board, bowed or not, before any is sorted."""
    placed = data.placed or place_board(
        ((data.camera, data.view, data.sensor_from_board),), cameras, bow
    )
    profile, pose = data.profile, placed.sensor_from_board
    points = intersect_board_of(profile.points_px, data.camera, pose, cameras)
    covariance, dpoint_dcamera = cameras.covariance, points.dpoint_dcamera
    if bow is not None:
        carried, by_bow = bow.carried(points.points_mm, pose, cameras.centre_mm(data.camera))
        points = replace(points, points_mm=carried)
        dpoint_dcamera = np.concatenate([dpoint_dcamera, by_bow], axis=2)
        covariance = block_diag(covariance, bow.covariance_mm2)
    dpoint_dcamera = dpoint_dcamera + points.dpoint_dpose @ placed.by_cameras
    if bow is not None:
        n = cameras.n_parameters
        dpoint_dcamera[:, :, :n] += dpoint_dcamera[:, :, n:] @ bow.by_cameras
    across = np.einsum("nij,nj->ni", points.dpoint_dq, profile.normals_px)
    sigma_mm = np.linalg.norm(across, axis=1) * profile.sigma_px
    return BoardImage(data, placed, points, dpoint_dcamera, sigma_mm, use, covariance, bow)


def _with_pull(image: BoardImage, pulled: BoolArray) -> BoardImage:
    """The image with what an edge may do to a centre in the sigmas of the points that it pulls."""
    profile = image.data.profile
    sigma_px = np.where(
        pulled, np.hypot(profile.sigma_px, PULL_WIDTHS * profile.width_px), profile.sigma_px
    )
    data = replace(image.data, profile=replace(profile, sigma_px=sigma_px))
    return replace(image, data=data, sigma_mm=image.sigma_mm * sigma_px / profile.sigma_px)


def _with_stripes(image: BoardImage, is_open: BoolArray, n_lines: int) -> BoardImage:
    """Sort the points that are open (N,) into straight stripes, left to right in the image.

    From top to bottom where they lie flatter than 45 degrees.
    """
    candidates = np.flatnonzero(is_open)
    width_mm, height_mm = np.ptp(image.data.view.points_board_mm[:, :2], axis=0).tolist()
    tolerance_mm = LINE_TOLERANCE * max(width_mm, height_mm)
    if len(candidates):
        scatter_mm = OUTLIER_SIGMA * float(np.median(image.sigma_mm[candidates]))
        tolerance_mm = min(max(tolerance_mm, scatter_mm), LINE_TOLERANCE_MM)
        tolerance_mm = max(tolerance_mm, TOLERANCE_PX * image.mm_per_px(candidates))
    found = find_straight_stripes(
        image.on_board_mm()[candidates],
        image.sigma_mm[candidates],
        image.data.profile.segment[candidates],
        shortest_mm=MIN_SPAN * min(width_mm, height_mm),
        tolerance_mm=tolerance_mm,
        n_lines=n_lines,
    )
    use = image.use.copy()
    for rows in found:
        use[candidates[rows]] = PointUse.UNNAMED
    stripes = [_observation(image, candidates[rows]) for rows in found]
    if stripes:
        x_share = float((np.stack([s.direction_px for s in stripes])[:, 0] ** 2).mean())
        axis = 1 if x_share > 0.5 else 0
        stripes.sort(key=lambda s: float(s.middle_px[axis]))
    return replace(image, use=use, stripes=tuple(stripes))


def _observation(image: BoardImage, rows: IntArray) -> StripeObservation:
    """Fit a straight line in space through the points and express it by its two ends."""
    points, weight = image.points.points_mm[rows], image.sigma_mm[rows] ** -2.0
    along = points - points[0]
    direction = along[-1] / np.linalg.norm(along[-1])
    t = along @ direction
    design = np.stack([np.ones_like(t), t], axis=1)
    normal = np.linalg.inv(design.T @ (design * weight[:, None]))
    at_ends = np.array([[1.0, t.min()], [1.0, t.max()]])
    gain = at_ends @ normal @ (design * weight[:, None]).T
    q = image.data.profile.points_px[rows]
    return StripeObservation(
        rows=rows,
        ends_mm=gain @ points,
        dends_dpose=np.einsum("ek,kij->eij", gain, image.points.dpoint_dpose[rows]),
        dends_dcamera=np.einsum("ek,kij->eij", gain, image.dpoint_dcamera[rows]),
        noise_ends_mm2=at_ends @ normal @ at_ends.T,
        across=np.cross(image.placed.sensor_from_board.rotation[:, 2], direction),
        middle_px=0.5 * (q[0] + q[-1]),
        direction_px=(q[-1] - q[0]) / np.linalg.norm(q[-1] - q[0]),
        pose_covariance=image.placed.covariance,
        camera_covariance=image.camera_covariance,
    )


def find_straight_stripes(
    points_mm: FloatArray,
    sigma_mm: FloatArray,
    segment: IntArray,
    *,
    shortest_mm: float,
    tolerance_mm: float = LINE_TOLERANCE_MM,
    n_lines: int = 0,
) -> list[IntArray]:
    """Group points on the board into straight stripes, the one with the most points first.

    Lines through two points of one segment, or of two, are tried with a fixed seed; the best
    supported one is refined, its points are taken away, and the search goes on.

    Points (N, 2) are in the board's plane, with a sigma (N,) across the stripe and the number (N,)
    of their connected segment; a stripe is ``shortest_mm`` long at least, and its band
    ``tolerance_mm`` wide to each side. At most ``n_lines`` are looked for, 0 for all. Rows (K,) are
    ordered along each stripe.
    """
    stripes: list[IntArray] = []
    lines: list[Line] = []
    rest = np.arange(len(points_mm))
    generator = np.random.default_rng(SEED)

    def is_repeat(line: Line, points: FloatArray) -> bool:
        """True if the line runs along a stripe already found over all of its points."""
        along = line.along(points)
        ends = line.at(np.array([along.min(), along.max()]))
        return any(bool((np.abs(a.distance(ends)) < 2.0 * tolerance_mm).all()) for a in lines)

    while len(rest) >= MIN_POINTS and len(stripes) < (n_lines or len(points_mm)):
        line = _best_line(points_mm[rest], segment[rest], tolerance_mm, generator)
        if line is None:
            break
        near = np.abs(line.distance(points_mm[rest])) < tolerance_mm
        keep = _on_course(points_mm[rest], sigma_mm[rest], line, near)
        chosen = rest[keep]
        if len(chosen) < MIN_POINTS:
            break
        # Outliers of a stripe already found must not come back as a stripe of their own.
        rest = rest[~keep & ~(near & is_repeat(line, points_mm[chosen]))]
        refined = fit_line(points_mm[chosen], sigma_mm[chosen] ** -2.0)
        if isinstance(refined, FitFailure):
            break
        along = refined.along(points_mm[chosen])
        if not is_repeat(refined, points_mm[chosen]) and float(np.ptp(along)) >= shortest_mm:
            lines.append(refined)
            stripes.append(chosen[np.argsort(along)])
    return sorted(stripes, key=lambda rows: -len(rows))


def _best_line(
    points: FloatArray, segment: IntArray, tolerance_mm: float, generator: np.random.Generator
) -> Line | None:
    """Try lines through pairs of points; half of the pairs within one segment."""
    n = len(points)
    first = generator.integers(n, size=TRIALS)
    second = generator.integers(n, size=TRIALS)
    _, number, counts = np.unique(segment, return_inverse=True, return_counts=True)
    by_segment = np.argsort(number, kind="stable")
    starts = np.cumsum(counts) - counts
    half = number[first[::2]]
    second[::2] = by_segment[starts[half] + generator.integers(counts[half])]
    step = points[second] - points[first]
    length = np.linalg.norm(step, axis=1)
    usable = length > 2.0 * tolerance_mm
    if not usable.any():
        return None
    first, step, length = first[usable], step[usable], length[usable]
    direction = step / length[:, None]
    scored = points[:: max(1, n // MAX_SCORED)]
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=1) / tolerance_mm
    distance = across @ scored.T
    distance -= (across * points[first]).sum(axis=1)[:, None]
    # Truncated squares rather than counts: of two lines in one band the centred one wins.
    np.square(distance, out=distance)
    np.minimum(distance, 1.0, out=distance)
    score = -distance.sum(axis=1)
    best = int(np.argmax(score))
    line = Line(points[first[best]], direction[best])
    for _ in range(3):
        refined = fit_line(points[np.abs(line.distance(points)) < tolerance_mm])
        if isinstance(refined, FitFailure):
            return None
        line = refined
    return line


def _on_course(points: FloatArray, sigma_mm: FloatArray, line: Line, near: BoolArray) -> BoolArray:
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
        scale = max(1.0, robust_sigma(missed))
        weight = HUBER * scale / np.maximum(missed, HUBER * scale)
    normalised = (across - design @ course) / sigma_mm
    return np.asarray(near & (np.abs(normalised) < OUTLIER_SIGMA * scale))
