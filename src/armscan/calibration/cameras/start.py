# SPDX-License-Identifier: Apache-2.0
"""Starting values: homographies, Zhang's closed form, linear distortion, and the pose of one
board by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.adjustment import (
    Observations,
    State,
    adjust,
    condition_number,
    gather,
    linearise,
)
from armscan.calibration.cameras.result import (
    DISTORTION_PARAMETERS,
    MIN_VIEW_POINTS,
    CameraOptions,
    DistortionModel,
)
from armscan.calibration.cameras.robust import excess_variance_px2, residuals_px
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, homogeneous
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector, vector_from_rotation
from armscan.models.camera import FISHEYE_FOCALS, PARAMETER_NAMES, CameraModel, distort
from armscan.vision.targets.target import TargetView

MIN_POINTS = 4
COLLINEAR_RATIO = 1e-3
"""Width over length of a point set below which it counts as a line."""

REFINEMENT_STEPS = 6


def estimate_homography(board_xy: FloatArray, image_xy: FloatArray) -> FloatArray | FitFailure:
    """Fit ``s m' = H M'`` (eq. 2.29): normalised linear solution, then least squares in the image.

    (3, 3), of unit Frobenius norm and positive third coordinates, from (M, 2) points on the board,
    in any unit, to (M, 2) in the image, in pixels or normalised.
    """
    if len(board_xy) < MIN_POINTS:
        return FitFailure(f"{len(board_xy)} points, a homography needs {MIN_POINTS}")
    if flatness(board_xy) < COLLINEAR_RATIO or flatness(image_xy) < COLLINEAR_RATIO:
        return FitFailure("the points lie on one line", "turn the board towards the camera")
    board_norm, image_norm = _normaliser(board_xy), _normaliser(image_xy)
    board = map_points(board_norm, board_xy)
    image = map_points(image_norm, image_xy)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inner = _refine(_linear(board, image), board, image)
        homography = np.linalg.inv(image_norm) @ inner @ board_norm
    depth = homography[2, :2] @ board_xy.mean(axis=0) + homography[2, 2]
    homography = homography / np.linalg.norm(homography) * (1.0 if depth > 0.0 else -1.0)
    if not np.isfinite(homography).all():
        return FitFailure("the points do not fit a flat target")
    return np.asarray(homography)


def map_points(homography: FloatArray, xy: FloatArray) -> FloatArray:
    """Map (M, 2) points by a (3, 3) homography."""
    mapped = xy @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def flatness(xy: FloatArray) -> float:
    """Ratio of the smaller to the larger extent of (M, 2) points: 0 for points on a line."""
    singular = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
    return float(singular[1] / singular[0]) if singular[0] > 0.0 else 0.0


def _normaliser(xy: FloatArray) -> FloatArray:
    centre = xy.mean(axis=0)
    scale = float(np.sqrt(2.0 / np.mean(np.sum((xy - centre) ** 2, axis=1))))
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = -scale * centre
    return matrix


def _linear(board: FloatArray, image: FloatArray) -> FloatArray:
    ones = np.ones(len(board))
    rows = np.stack([board[:, 0], board[:, 1], ones], axis=1)
    system = np.zeros((2 * len(board), 9))
    system[0::2, 0:3] = system[1::2, 3:6] = rows
    system[0::2, 6:] = -image[:, :1] * rows
    system[1::2, 6:] = -image[:, 1:] * rows
    normal = system.T @ system if len(board) > MIN_POINTS else None
    if normal is not None:
        return np.asarray(np.linalg.eigh(normal)[1][:, 0].reshape(3, 3))
    return np.asarray(np.linalg.svd(system)[2][-1].reshape(3, 3))


def _refine(homography: FloatArray, board: FloatArray, image: FloatArray) -> FloatArray:
    """Gauss-Newton on the image distances; the points are centred, so that h33 is not zero.

    Of points that no homography maps it may be, or a point may come to lie at infinity: no step
    leads on from there (and LAPACK would never return from one).
    """
    h = homography / homography[2, 2]
    rows = homogeneous(board)
    best: FloatArray = h
    best_cost = float(np.sum((map_points(h, board) - image) ** 2))
    for _ in range(REFINEMENT_STEPS):
        mapped = rows @ h.T
        w = mapped[:, 2:]
        predicted = mapped[:, :2] / w
        jacobian = np.zeros((2 * len(board), 8))
        jacobian[0::2, 0:3] = jacobian[1::2, 3:6] = rows / w
        jacobian[0::2, 6:] = -predicted[:, :1] * board / w
        jacobian[1::2, 6:] = -predicted[:, 1:] * board / w
        error = (image - predicted).reshape(-1)
        if not (np.isfinite(jacobian).all() and np.isfinite(error).all()):
            break
        step = np.linalg.lstsq(jacobian, error, rcond=None)[0]
        h = h + np.append(step, 0.0).reshape(3, 3)
        cost = float(np.sum((map_points(h, board) - image) ** 2))
        if not cost < best_cost:
            break
        converged = best_cost - cost < 1e-12 * best_cost
        best, best_cost = h, cost
        if converged:
            break
    return best


_B11, _B22, _B13, _B23, _B33 = range(5)
_FREE_CENTRE = (_B11, _B22, _B13, _B23, _B33)
_FIXED_CENTRE = (_B11, _B22, _B33)


def constraint_rows(homography: FloatArray) -> FloatArray:
    """Two equations of one view (eq. 2.34) for ``b = (B11, B12, B22, B13, B23, B33)``.

    Parameters
    ----------
    homography
        (3, 3) from board to image.

    Returns
    -------
    rows
        (2, 6) rows ``v12`` and ``v11 - v22``.

    Notes
    -----
    The thesis prints ``v12 - v22`` in the second row, which is wrong, and lists b as ``B11 B12 B13
    B22 B23 B33``, which does not go with its own ``v_ij`` of eq. 2.33; both are corrected here.
    """

    def v(i: int, j: int) -> FloatArray:
        a, b = homography[:, i], homography[:, j]
        return np.array(
            [
                a[0] * b[0],
                a[0] * b[1] + a[1] * b[0],
                a[1] * b[1],
                a[2] * b[0] + a[0] * b[2],
                a[2] * b[1] + a[1] * b[2],
                a[2] * b[2],
            ]
        )

    return np.stack([v(0, 1), v(0, 0) - v(1, 1)])


def intrinsics_from_homographies(
    homographies: Sequence[FloatArray], width_px: int, height_px: int, *, is_centred: bool = False
) -> FloatArray | FitFailure:
    """Solve eq. 2.34 for the intrinsic matrix (3, 3) of eq. 2.18, without skew.

    From (3, 3) homographies from board to pixels: first with all five unknowns of B; if noise
    leaves no positive definite B (eq. 2.32), with the principal point in the middle of the image;
    and then with one focal length; only that if ``is_centred``.
    """
    centre = np.array([0.5 * (width_px - 1), 0.5 * (height_px - 1)])
    scale = 0.5 * (width_px + height_px)
    to_unit = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, scale]]) / scale
    blocks = []
    for homography in homographies:
        unit = to_unit @ homography
        blocks.append(constraint_rows(unit / np.linalg.norm(unit[:, :2])))
    # Without skew B12 is zero: its column drops out.
    rows = np.concatenate(blocks)[:, [0, 2, 3, 4, 5]]
    solutions = (_solve(rows, _FREE_CENTRE), _solve(rows, _FIXED_CENTRE), _solve_square(rows))
    for solution in solutions[2 * is_centred :]:
        matrix = _matrix_from_b(solution)
        if matrix is not None:
            return np.asarray(np.linalg.inv(to_unit) @ matrix)
    return FitFailure(
        "the views do not determine a focal length",
        "tilt the board by 20 to 45 degrees, in a different direction from view to view",
    )


FOCALS = np.geomspace(0.4, 6.0, 200)
"""Of the image's longer side."""
FAR_BETTER, LEAST_STRETCHED = 100.0, 0.03
"""By what factor of the squares other cells must explain views better, and how unlike squares."""


def seen_stretch(homographies: Sequence[FloatArray], width_px: int, height_px: int) -> float | None:
    """How many times as far apart as columns rows lie, where square cells explain no view.

    A pinhole with its axis in the middle of the image sees the board's x and y as two directions at
    right angles, of one length. Focal length and ratio of lengths are found from V homographies
    (3, 3) of flat boards, as by eq. 2.34 with one unknown more; None where square
    cells do about as well.
    """
    to_middle = np.array(
        [[1.0, 0.0, -0.5 * width_px], [0.0, 1.0, -0.5 * height_px], [0.0, 0.0, 1.0]]
    )
    columns = np.array([to_middle @ each for each in homographies])[:, :, :2]
    best, least, least_square = 1.0, np.inf, np.inf
    for focal_px in FOCALS * max(width_px, height_px):
        turned = columns / np.array([focal_px, focal_px, 1.0])[:, None]
        length = np.linalg.norm(turned, axis=1)
        cosine = (turned[:, :, 0] * turned[:, :, 1]).sum(axis=1) / length.prod(axis=1)
        ratio = np.log(length[:, 1] / length[:, 0])
        common = float(np.median(ratio))
        misfit = float((cosine**2).sum() + ((ratio - common) ** 2).sum())
        least_square = min(least_square, float((cosine**2).sum() + (ratio**2).sum()))
        if misfit < least:
            best, least = float(np.exp(common)), misfit
    is_told = least_square > FAR_BETTER * least and abs(np.log(best)) > LEAST_STRETCHED
    return best if is_told else None


def _solve(rows: FloatArray, free: tuple[int, ...]) -> FloatArray:
    b = np.zeros(5)
    b[list(free)] = np.linalg.svd(rows[:, free])[2][-1]
    return b


def _solve_square(rows: FloatArray) -> FloatArray:
    reduced = np.stack([rows[:, _B11] + rows[:, _B22], rows[:, _B33]], axis=1)
    b = np.zeros(5)
    b[[_B11, _B33]] = np.linalg.svd(reduced)[2][-1]
    b[_B22] = b[_B11]
    return b


def _matrix_from_b(b: FloatArray) -> FloatArray | None:
    """Intrinsic matrix in unit coordinates from B, or None if B is not definite or absurd."""
    b = b * (1.0 if b[_B11] > 0.0 else -1.0)
    if b[_B11] <= 0.0 or b[_B22] <= 0.0:
        return None
    cx, cy = -b[_B13] / b[_B11], -b[_B23] / b[_B22]
    factor = b[_B33] - b[_B13] ** 2 / b[_B11] - b[_B23] ** 2 / b[_B22]
    if factor <= 0.0:
        return None
    fx, fy = np.sqrt(factor / b[_B11]), np.sqrt(factor / b[_B22])
    if max(abs(cx), abs(cy)) > 1.0 or not 0.05 < min(fx, fy) <= max(fx, fy) < 500.0:
        return None
    if not 0.5 < fx / fy < 2.0:
        return None
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pose_from_homography(homography: FloatArray, matrix: FloatArray) -> Pose[Sensor, Board]:
    """Pose of a flat board from its homography (3, 3), mm to pixels (eq. 2.35), made a rotation."""
    columns = np.linalg.solve(matrix, homography)
    scale = 0.5 * (np.linalg.norm(columns[:, 0]) + np.linalg.norm(columns[:, 1]))
    columns = columns / scale * (1.0 if columns[2, 2] > 0.0 else -1.0)
    third = np.cross(columns[:, 0], columns[:, 1])
    rotation = nearest_rotation(np.column_stack([columns[:, 0], columns[:, 1], third]))
    return Pose(rotation, columns[:, 2])


def linear_distortion(
    ideal_xy: FloatArray, observed_xy: FloatArray, free: Sequence[int]
) -> FloatArray:
    """Distortion (5,) by linear least squares, ``K = (L'L)^-1 L'F`` (eqs. 2.36 to 2.38).

    From normalised coordinates (N, 2) without distortion and as observed. ``free`` are indices into
    ``k1 k2 p1 p2 k3``, of which the thesis has the first four; the others are zero.
    """
    coefficients = np.zeros(5)
    if not len(free):
        return coefficients
    _, _, by_coefficient = distort(ideal_xy, coefficients)
    design = by_coefficient[:, :, list(free)].reshape(-1, len(free))
    difference = (observed_xy - ideal_xy).reshape(-1)
    coefficients[list(free)] = np.linalg.lstsq(design, difference, rcond=None)[0]
    return coefficients


SUSPECT_HOMOGRAPHY = 6.0
"""A view whose homography fits this much worse than the median is not used for the start."""

EDGE_ON = 0.02


def view_homography(view: TargetView) -> FloatArray | FitFailure:
    """Homography of a view, or why the view cannot be used at all."""
    if len(view) < MIN_VIEW_POINTS:
        return FitFailure(f"only {len(view)} target points, needs {MIN_VIEW_POINTS}")
    if flatness(view.points_px) < EDGE_ON:
        return FitFailure("the board is seen edge-on")
    return estimate_homography(view.points_board_mm[:, :2], view.points_px)


def homography_rms_px(view: TargetView, homography: FloatArray) -> float:
    """Root median square distance of a view's points from its homography."""
    error = map_points(homography, view.points_board_mm[:, :2]) - view.points_px
    return float(np.sqrt(np.median(np.sum(error**2, axis=1))))


def starting_state(
    views: Sequence[TargetView],
    observations: Observations,
    homographies: Sequence[FloatArray],
    model: DistortionModel,
    options: CameraOptions,
    *,
    is_centred: bool = False,
) -> tuple[State, BoolArray] | FitFailure:
    """Closed-form camera and poses, from one homography (3, 3) a view, from board mm to pixels.

    ``is_centred`` puts the principal point in the middle of the image and takes pixels as square.

    Returns
    -------
    state
        Starting values with those parameters at rest that are not free.
    trusted
        (V,) False for views that fit a plane so badly that they had no say.
    or why there are none.
    """
    if model == "fisheye":
        return _fisheye_start(views, observations)
    width, height = observations.width_px, observations.height_px
    rms = np.array([homography_rms_px(v, h) for v, h in zip(views, homographies, strict=True)])
    trusted = np.asarray(rms <= max(SUSPECT_HOMOGRAPHY * float(np.median(rms)), 1e-6))
    chosen = [h for h, ok in zip(homographies, trusted, strict=True) if ok]
    matrix = intrinsics_from_homographies(chosen, width, height, is_centred=is_centred)
    if isinstance(matrix, FitFailure) and is_centred:
        return matrix
    if isinstance(matrix, FitFailure):
        # lines that are bent by much hide what the closed form looks for
        bent = _fisheye_start(views, replace(observations, lens="fisheye"))
        if isinstance(bent, FitFailure):
            return matrix
        return _with_distortion(bent[0], observations, bent[1], model), bent[1]
    matrix = _held(matrix, width, height, options)
    shared = np.zeros(11)
    shared[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    state = State.from_poses(shared, [pose_from_homography(h, matrix) for h in homographies])
    return _with_distortion(state, observations, trusted, model), trusted


_FOCAL_VIEWS = 24
"""So many views, evenly spread, choose a fisheye's focal length to start from."""


def _fisheye_start(
    views: Sequence[TargetView], observations: Observations
) -> tuple[State, BoolArray] | FitFailure:
    """Poses before a fisheye without distortion, of the focal length at which boards fit best."""
    size = np.array([observations.width_px, observations.height_px])
    judges = views[:: -(-len(views) // _FOCAL_VIEWS)]
    best, least = None, np.inf
    for focal in FISHEYE_FOCALS * size.max():
        shared = np.array([focal, focal, *(0.5 * (size - 1.0)), *np.zeros(7)])
        camera = observations.camera(shared[:9])
        middle = float(np.median([_flat_pose(view, camera)[1] for view in judges]))
        if middle < least:
            best, least = shared, middle
    if best is None:
        return FitFailure("the points do not fit a flat target before a fisheye lens")
    camera = observations.camera(best[:9])
    poses, rms = zip(*(_flat_pose(view, camera) for view in views), strict=True)
    return State.from_poses(best, poses), np.asarray(np.array(rms) <= SUSPECT_HOMOGRAPHY * least)


def _flat_pose(view: TargetView, camera: CameraModel) -> tuple[Pose[Sensor, Board], float]:
    """A board's pose from its homography, and how far it misses, px rms; infinite for none."""
    xy, is_valid = camera.undistort(view.points_px)
    homography = estimate_homography(view.points_board_mm[is_valid, :2], xy[is_valid])
    if isinstance(homography, FitFailure) or not is_valid.all():
        return Pose(np.eye(3), np.array([0.0, 0.0, 1.0])), np.inf
    pose = pose_from_homography(homography, np.eye(3))
    seen = camera.project(view.points_board_mm @ pose.rotation.T + pose.translation_mm)
    rms = np.sqrt(np.mean((seen - view.points_px) ** 2))
    return pose, float(np.nan_to_num(rms, nan=np.inf))


def _held(matrix: FloatArray, width: int, height: int, options: CameraOptions) -> FloatArray:
    matrix = matrix.copy()
    if options.is_principal_point_fixed:
        matrix[:2, 2] = 0.5 * (width - 1), 0.5 * (height - 1)
    if options.is_aspect_fixed:
        matrix[0, 0] = matrix[1, 1] = np.sqrt(matrix[0, 0] * matrix[1, 1])
    return matrix


def _with_distortion(
    state: State, observations: Observations, trusted: BoolArray, model: DistortionModel
) -> State:
    """Add linear distortion (eqs. 2.36 to 2.38) where it is small enough to be believed."""
    free = [PARAMETER_NAMES.index(name) - 4 for name in DISTORTION_PARAMETERS[model]]
    # k3 is told from k1 and k2 only poorly before the poses are refined.
    free = [index for index in free if index != 4]
    points = np.concatenate(
        [
            observations.board_mm[observations.rows(v)] @ state.rotations[v].T
            + state.translations_mm[v]
            for v in range(observations.n_views)
        ]
    )
    ideal = points[:, :2] / points[:, 2:]
    observed = (observations.points_px - state.shared[2:4]) / state.shared[:2]
    rows = trusted[observations.view_of_point]
    if not rows.any() or not (points[rows, 2] > 0.0).all():
        return state
    coefficients = linear_distortion(ideal[rows], observed[rows], free)
    radius = float(np.sum(observed[rows] ** 2, axis=1).max())
    if abs(coefficients[0]) * radius + abs(coefficients[1]) * radius**2 > 0.5:
        return state
    shared = state.shared.copy()
    shared[4:9] = coefficients
    return State(shared, state.rotations, state.translations_mm)


POSE_PARAMETER_NAMES = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
AMBIGUOUS_CHI2 = 9.0
"""The second solution is refuted if its chi2, over the noise variance, is larger by this much:
three standard deviations."""

SAME_POSE_RAD = 1e-3
SCALED_FROM_DEGREES_OF_FREEDOM = 10

_POSE_ONLY = np.zeros((11, 0))
_CAMERA = np.eye(11, 9)


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """A local minimum of a flat board's reprojection error; ``chi2`` by the detector's sigmas."""

    sensor_from_board: Pose[Sensor, Board]
    chi2: float


def board_pose_candidates(
    view: TargetView, camera: CameraModel, bow_mm: FloatArray | None = None
) -> tuple[PoseCandidate, ...] | FitFailure:
    """The one or two poses of a flat board that a view allows, the better first.

    The first comes from the homography (eq. 2.35). A distant board seen with little perspective
    fits almost as well when its normal is mirrored at the line of sight: that pose starts the
    second.

    ``bow_mm`` (2,) is the bow of the board as in `BoardWarp`; flat if None.

    Raises
    ------
    InputError
        If view and camera do not belong to images of one size.
    """
    if (view.width_px, view.height_px) != (camera.width_px, camera.height_px):
        raise InputError(
            f"the image is {view.width_px}x{view.height_px} px, the camera was calibrated with "
            f"{camera.width_px}x{camera.height_px} px",
            where=view.source,
            remedy="use images of the size that the camera was calibrated with",
        )
    xy, is_valid = camera.undistort(view.points_px)
    homography = estimate_homography(view.points_board_mm[is_valid, :2], xy[is_valid])
    if isinstance(homography, FitFailure):
        return homography
    observations = gather([view], camera.lens)
    shared = _shared(camera, bow_mm)
    centre = view.points_board_mm.mean(axis=0)
    first = _refined(observations, shared, pose_from_homography(homography, np.eye(3)))
    if isinstance(first, FitFailure):
        return first
    second = _refined(observations, shared, mirrored_pose(first.sensor_from_board, centre))
    if isinstance(second, FitFailure) or _is_same(first, second):
        return (first,)
    return (first, second) if first.chi2 <= second.chi2 else (second, first)


def mirrored_pose(pose: Pose[Sensor, Board], centre_board_mm: FloatArray) -> Pose[Sensor, Board]:
    """Turn a board so that its normal is mirrored at the line of sight to ``centre_board_mm``."""
    centre = pose.rotation @ centre_board_mm + pose.translation_mm
    sight = centre / np.linalg.norm(centre)
    normal = pose.rotation[:, 2]
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    angle = 2.0 * float(np.arctan2(sine, normal @ sight))
    turn = rotation_from_vector(axis * (angle / sine)) if sine > 1e-9 else np.eye(3)
    rotation = turn @ pose.rotation
    return Pose(rotation, centre - rotation @ centre_board_mm)


def estimate_board_pose(
    view: TargetView,
    camera: CameraModel,
    *,
    bow_mm: FloatArray | None = None,
    allow_ambiguous: bool = False,
) -> Estimate[Pose[Sensor, Board]] | FitFailure:
    """``sensor_from_board`` in one view.

    Covariance (6, 6) of (rotation-vector increment in rad in the Sensor frame, applied on the left;
    translation in mm), residuals (M, 2) in px. The points' covariances give the weights (see
    `armscan.calibration.cameras.robust`), the residuals the level: the covariance is scaled by chi2
    over the degrees of freedom (with fewer than ten of them never below 1). ``bow_mm`` (2,) is the
    board's, as in `BoardWarp`; flat if None. There is no pose of too few points, points on a line,
    or of two poses that fit alike, of which ``allow_ambiguous`` takes the better.
    """
    found = estimate_board_poses(view, camera, bow_mm=bow_mm)
    if isinstance(found, FitFailure):
        return found
    if len(found) > 1 and not allow_ambiguous:
        return FitFailure(
            "two poses of the board fit alike, mirrored at the line of sight",
            "tilt the board more, bring it nearer, or use a larger one",
        )
    return found[0]


def estimate_board_poses(
    view: TargetView,
    camera: CameraModel,
    *,
    bow_mm: FloatArray | None = None,
) -> tuple[Estimate[Pose[Sensor, Board]], ...] | FitFailure:
    """All poses of a board that one view does not refute, the best first.

    Parameters and the content of each estimate as in `estimate_board_pose`.
    """
    degrees = 2 * len(view) - 6
    candidates = board_pose_candidates(view, camera, bow_mm)
    if not isinstance(candidates, FitFailure):
        noisier = _with_excess(view, camera, candidates[0], bow_mm)
        if noisier is not view:
            view, candidates = noisier, board_pose_candidates(noisier, camera, bow_mm)
    if isinstance(candidates, FitFailure):
        return candidates
    best = candidates[0]
    factor = best.chi2 / max(degrees, 1)
    if degrees < SCALED_FROM_DEGREES_OF_FREEDOM:
        factor = max(factor, 1.0)
    observations = gather([view], camera.lens)
    found = []
    for candidate in candidates:
        if candidate.chi2 - best.chi2 >= AMBIGUOUS_CHI2 * factor and candidate is not best:
            continue
        state = State.from_poses(_shared(camera, bow_mm), [candidate.sensor_from_board])
        equations = linearise(observations, state, _CAMERA, np.ones(len(view)))
        if equations is None or not condition_number(equations.pose[0]) < 1e13:
            return FitFailure("the points do not determine a pose", "show more of the board")
        covariance = factor * np.linalg.inv(equations.pose[0])
        found.append(
            Estimate(
                value=candidate.sensor_from_board,
                parameter_names=POSE_PARAMETER_NAMES,
                covariance=0.5 * (covariance + covariance.T),
                residuals=residuals_px(observations, state),
                degrees_of_freedom=degrees,
                chi2=candidate.chi2,
            )
        )
    return tuple(found)


def _shared(camera: CameraModel, bow_mm: FloatArray | None) -> FloatArray:
    return np.append(camera.parameters, np.zeros(2) if bow_mm is None else bow_mm)


def _with_excess(
    view: TargetView, camera: CameraModel, best: PoseCandidate, bow_mm: FloatArray | None
) -> TargetView:
    """The view with the variance that explains its residuals, see `calibration.camera.noise`."""
    state = State.from_poses(_shared(camera, bow_mm), [best.sensor_from_board])
    residuals = residuals_px(gather([view], camera.lens), state)
    excess = excess_variance_px2(residuals, view.covariance_px2, best.chi2, 2 * len(view) - 6)
    if excess <= 0.0:
        return view
    return replace(view, covariance_px2=view.covariance_px2 + excess * np.eye(2))


def _refined(
    observations: Observations, shared: FloatArray, start: Pose[Sensor, Board]
) -> PoseCandidate | FitFailure:
    result = adjust(observations, State.from_poses(shared, [start]), _POSE_ONLY)
    if isinstance(result, FitFailure):
        return result
    return PoseCandidate(result.state.pose(0), result.system.chi2)


def _is_same(a: PoseCandidate, b: PoseCandidate) -> bool:
    turn = vector_from_rotation(a.sensor_from_board.rotation.T @ b.sensor_from_board.rotation)
    return float(np.linalg.norm(turn)) < SAME_POSE_RAD
