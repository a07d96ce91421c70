# SPDX-License-Identifier: Apache-2.0
"""Points where rays of the head's cameras meet a board or a sheet, and the board's pose in Sensor.

All derivatives by the cameras' parameters are in one order: the 9 of camera 0, or of two cameras
`armscan.models.two_views.STEREO_PARAMETER_NAMES` (left 9, right 9, pose 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.adjustment import State, gather, linearise
from armscan.calibration.cameras.result import MAX_STEPS
from armscan.calibration.cameras.robust import BowTest, Solution, solve_robustly, with_board_warp
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.result import BoardStripes, PlacedBoard
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, homogeneous
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.geometry.rotations import skew
from armscan.models.calibration import CameraCalibration, SecondCamera, SensorCalibration
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.models.two_views import StereoCalibration
from armscan.vision.targets.target import TargetView

N_CAMERA = len(PARAMETER_NAMES)
LEFT_CAMERA, RIGHT_CAMERA = slice(0, 9), slice(9, 18)
RIGHT_POSE = slice(18, 24)
GRAZING = 1e-6
"""Rays within this sine of the board's plane do not meet it."""

LEAST_BOW_VIEWS = 3
"""Of fewer views, the poses take up a bow."""
LIKELY_BOARD_BOWS = np.geomspace(1e-5, 8e-4, 21)
"""Bows of boards that are called flat, in parts of half their size, each as likely as any other: of
300 mm from glass, 1.5 um, to a print on a plate, 0.12 mm. Their rms is 3e-4."""
BOW_STEPS = 3
SAME = 1e-6
"""Relative difference of variances that are the same but for rounding."""

SeenBoard = tuple[int, TargetView, Estimate[Pose[Sensor, Board]]]
"""Camera, target, and the board's pose in that camera's own frame."""


PULLED_SIGMAS = 3.5
"""Residual of a target point over the others' scatter from which on the laser's light pulls it."""
PULL_ROUNDS = 4


def pose_lit_board(
    view: TargetView, camera: CameraModel
) -> tuple[TargetView, Estimate[Pose[Sensor, Board]]] | FitFailure:
    """Pose of a board that was found with the laser on, and its view with honest covariances.

    Where the line crosses a disc or corner its light pulls the point, by many of its sigmas: its
    covariance is widened by the square of what it lies off. Misprints do not stand out so, for all
    points have them.
    """
    pose, stated = estimate_board_pose(view, camera), view
    for _ in range(PULL_ROUNDS):
        if isinstance(pose, FitFailure):
            return pose
        square = (pose.residuals**2).sum(axis=1)
        pulled = square > (PULLED_SIGMAS * robust_sigma(pose.residuals)) ** 2
        if not pulled.any():
            break
        excess = np.where(pulled, square, 0.0)[:, None, None] * np.eye(2)
        view = replace(stated, covariance_px2=stated.covariance_px2 + excess)
        pose = estimate_board_pose(view, camera)
    return pose if isinstance(pose, FitFailure) else (view, pose)


@dataclass(frozen=True, slots=True, eq=False)
class HeadCameras:
    """Camera 0, whose frame is Sensor, and camera 1 of a stereo head.

    ``covariance`` (P, P) is that of the P parameters that all images have in common: 9, or 24.
    """

    left: CameraCalibration
    second: SecondCamera | None
    covariance: FloatArray

    @staticmethod
    def of(calibration: CameraCalibration | StereoCalibration | SensorCalibration) -> HeadCameras:
        """The cameras of a calibration of one or of two, or of a calibrated sensor."""
        if isinstance(calibration, CameraCalibration):
            return HeadCameras(calibration, None, calibration.covariance)
        if isinstance(calibration, SensorCalibration):
            places = np.arange(len(calibration.covariance))
            places = np.append(places[:N_CAMERA], places[calibration.second_parameter_slice])
            covariance = calibration.covariance[np.ix_(places, places)]
            return HeadCameras(calibration.camera, calibration.second, covariance)
        second = SecondCamera(
            camera=calibration.right, right_from_sensor=calibration.right_from_left
        )
        return HeadCameras(calibration.left, second, calibration.covariance)

    @property
    def n_parameters(self) -> int:
        """Count P of the cameras' parameters."""
        return len(self.covariance)

    @property
    def has_covariance(self) -> bool:
        """False if a camera came without uncertainty."""
        return self.left.has_covariance and (
            self.second is None or self.second.camera.has_covariance
        )

    def model(self, camera: int) -> CameraModel:
        """The model of camera 0 or 1; `InputError` if there is no such camera."""
        return self.left.camera if camera == 0 else self.right(camera).camera.camera

    def camera_from_sensor(self, camera: int) -> Pose[CameraRight, Sensor]:
        """Where the Sensor frame lies in that of camera 0, which it is, or of camera 1."""
        if camera == 0:
            return Pose(np.eye(3), np.zeros(3))
        return self.right(camera).right_from_sensor

    def centre_mm(self, camera: int) -> FloatArray:
        """(3,) where the rays of camera 0 or 1 start, in Sensor."""
        return self.camera_from_sensor(camera).inverse().translation_mm

    def right(self, camera: int = 1) -> SecondCamera:
        """Camera 1; `InputError` if there is none."""
        if self.second is None or camera != 1:
            raise InputError(
                f"an image of camera {camera} is given, and that camera is not calibrated",
                remedy="give the stereo calibration of the head, or the images of camera 0 alone",
            )
        return self.second

    def by_parameters(self, camera: int, by_camera: FloatArray, by_pose: FloatArray) -> FloatArray:
        """Derivatives (..., P) by all parameters from those by a camera's own 9 and its pose's 6.

        Camera 0 has no pose: it stands where the Sensor frame is.
        """
        wide = np.zeros((*by_camera.shape[:-1], self.n_parameters))
        wide[..., RIGHT_CAMERA if camera else LEFT_CAMERA] = by_camera
        if camera:
            wide[..., RIGHT_POSE] = by_pose
        return wide


@dataclass(frozen=True, slots=True, eq=False)
class BoardPoints:
    """Points of a board's plane behind (N, 2) pixels, with derivatives.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame; NaN where there is none.
    is_valid
        (N,) False where the lens model has no inverse or the ray misses the plane.
    dpoint_dq
        (N, 3, 2) by the pixel, mm/px.
    dpoint_dpose
        (N, 3, 6) by the rotation-vector increment (rad, Sensor frame, from the left) and the
        translation (mm) of ``sensor_from_board``.
    dpoint_dcamera
        (N, 3, 9) by the camera's parameters, the pose being held; (N, 3, P) by those of all
        cameras of a head.
    """

    points_mm: FloatArray
    is_valid: BoolArray
    dpoint_dq: FloatArray
    dpoint_dpose: FloatArray
    dpoint_dcamera: FloatArray


def intersect_board(
    q_px: FloatArray, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> BoardPoints:
    """Intersect the rays of (N, 2) full-sensor pixels with the board's plane ``z = 0``.

    The ray is ``(x, y, 1)`` of eq. 2.14 and the plane takes the place of the light sheet in
    eq. 2.21.
    """
    xy, is_valid, dxy_dq, dxy_dcamera = camera.undistort_with_jacobian(q_px)
    rays = homogeneous(xy)
    normal = sensor_from_board.rotation[:, 2]
    slope = rays @ normal
    is_valid = is_valid & (np.abs(slope) > GRAZING * np.linalg.norm(rays, axis=1))
    slope = np.where(is_valid, slope, 1.0)
    depth = float(normal @ sensor_from_board.translation_mm) / slope
    is_valid = is_valid & (depth > 0.0)
    points = np.where(is_valid[:, None], rays * depth[:, None], np.nan)
    dpoint_dxy = rays[:, :, None] * (-depth / slope)[:, None, None] * normal[None, None, :2]
    dpoint_dxy[:, 0, 0] += depth
    dpoint_dxy[:, 1, 1] += depth
    lever = sensor_from_board.translation_mm - points
    ddepth_dpose = np.zeros((len(xy), 6))
    ddepth_dpose[:, :3] = np.cross(normal, lever)
    ddepth_dpose[:, 3:] = normal
    dpoint_dpose = rays[:, :, None] * (ddepth_dpose / slope[:, None])[:, None, :]
    return BoardPoints(
        points, is_valid, dpoint_dxy @ dxy_dq, dpoint_dpose, dpoint_dxy @ dxy_dcamera
    )


def intersect_board_of(
    q_px: FloatArray, camera: int, sensor_from_board: Pose[Sensor, Board], cameras: HeadCameras
) -> BoardPoints:
    """As `intersect_board` for camera 0 or 1: points in Sensor, derivatives by all cameras."""
    place = cameras.camera_from_sensor(camera)
    turn, shift = place.rotation, place.translation_mm
    camera_from_board = place @ sensor_from_board
    # The function knows one frame: to it, the camera's is the sensor's.
    as_sensor: Pose[Sensor, Board] = Pose(
        camera_from_board.rotation, camera_from_board.translation_mm
    )
    found = intersect_board(q_px, as_sensor, cameras.model(camera))
    follow = np.eye(6)
    follow[3:, :3] = -skew(turn @ sensor_from_board.translation_mm)
    carried = np.concatenate(
        [skew(found.points_mm - shift), np.tile(-np.eye(3), (len(q_px), 1, 1))], axis=2
    )
    return BoardPoints(
        (found.points_mm - shift) @ turn,
        found.is_valid,
        turn.T @ found.dpoint_dq,
        turn.T @ found.dpoint_dpose @ _twice(turn),
        cameras.by_parameters(
            camera,
            turn.T @ found.dpoint_dcamera,
            turn.T @ (found.dpoint_dpose @ follow + carried),
        ),
    )


def intersect_sheet_of(
    q_px: FloatArray, camera: int, sheet: LightSheet, cameras: HeadCameras
) -> tuple[FloatArray, BoolArray]:
    """Points (N, 3) in Sensor where the rays of pixels (N, 2) of one camera meet a sheet.

    With the second value (N,), False where there is none; what reconstruction does with a stripe.
    """
    xy, has_ray = cameras.model(camera).undistort(q_px)
    if camera:
        place = cameras.camera_from_sensor(camera)
        points, is_met = sheet.in_frame(place.rotation, place.translation_mm).intersect(xy)
        return (points - place.translation_mm) @ place.rotation, is_met & has_ray
    points, is_met = sheet.intersect(xy)
    return points, is_met & has_ray


def dpose_dcamera(
    view: TargetView,
    sensor_from_board: Pose[Sensor, Board],
    camera: CameraModel,
    bow: BoardBow | None = None,
) -> FloatArray:
    """(6, 9) derivative of the board's pose, as estimated from ``view``, by the camera.

    The pose minimises the weighted reprojection error, so at the optimum a change of the camera
    moves it by ``-(Jp' W Jp)^-1 Jp' W Jc`` (Gauss-Newton form of the implicit function theorem).
    (6, 11) with the derivative by the board's bow, if there is one.
    """
    rotated = view.points_board_mm @ sensor_from_board.rotation.T
    _, dq_dpoint, dq_dcamera = camera.project_with_jacobian(
        rotated + sensor_from_board.translation_mm
    )
    dq_dpose = np.concatenate([-dq_dpoint @ skew(rotated), dq_dpoint], axis=2)
    if bow is not None:
        by_height = dq_dpoint @ sensor_from_board.rotation[:, 2]
        by_bow = by_height[:, :, None] * bow.shape(view.points_board_mm)[:, None, :]
        dq_dcamera = np.concatenate([dq_dcamera, by_bow], axis=2)
    weight = np.linalg.inv(view.covariance_px2)
    weighted = np.einsum("nki,nkl->nil", dq_dpose, weight)
    normal = np.einsum("nik,nkj->ij", weighted, dq_dpose)
    return np.asarray(-np.linalg.solve(normal, np.einsum("nik,nkj->ij", weighted, dq_dcamera)))


def place_board(
    seen: Sequence[SeenBoard], cameras: HeadCameras, bow: BoardBow | None = None
) -> PlacedBoard:
    """Pose of a board in Sensor from what one or both cameras saw of it, one entry a camera.

    The mean of the poses weighted by their covariances, the cameras being held; the derivative
    tells how it follows the cameras' errors, which the two views do not share, and, last, the
    error of the bow, if the board has one.
    """
    poses = [_in_sensor(one, cameras, bow) for one in seen]
    first = poses[0]
    if len(poses) == 1:
        return first
    second = poses[1]
    information = [np.linalg.inv(pose.covariance) for pose in poses]
    covariance = np.linalg.inv(information[0] + information[1])
    gain = covariance @ information[1]
    a = first.sensor_from_board
    pose = a.retract(gain @ second.sensor_from_board.step_from(a))
    follow = first.by_cameras + gain @ (second.by_cameras - first.by_cameras)
    return PlacedBoard(pose, 0.5 * (covariance + covariance.T), follow)


def poses_chi2(left: SeenBoard, right: SeenBoard, cameras: HeadCameras) -> float:
    """How far two cameras disagree about a board: 6 on average, the cameras' errors included."""
    a, b = _in_sensor(left, cameras), _in_sensor(right, cameras)
    follow = b.by_cameras - a.by_cameras
    covariance = a.covariance + b.covariance + follow @ cameras.covariance @ follow.T
    step = b.sensor_from_board.step_from(a.sensor_from_board)
    return float(step @ np.linalg.solve(covariance, step))


def _in_sensor(seen: SeenBoard, cameras: HeadCameras, bow: BoardBow | None = None) -> PlacedBoard:
    camera, view, found = seen
    place = cameras.camera_from_sensor(camera)
    back, offset = place.rotation.T, found.value.translation_mm - place.translation_mm
    turned = _twice(back)
    by_pose = np.zeros((6, 6))
    by_pose[:3, :3] = by_pose[3:, 3:] = -back
    by_pose[3:, :3] = back @ skew(offset)
    follow = turned @ dpose_dcamera(view, found.value, cameras.model(camera), bow)
    pose: Pose[Sensor, Board] = Pose(back @ found.value.rotation, back @ offset)
    by_cameras = cameras.by_parameters(camera, follow[:, :N_CAMERA], by_pose)
    by_cameras = np.concatenate([by_cameras, follow[:, N_CAMERA:]], axis=1)
    return PlacedBoard(pose, turned @ found.covariance @ turned.T, by_cameras)


def _twice(turn: FloatArray) -> FloatArray:
    """(6, 6) a rotation (3, 3) acting on both halves of a pose's increment."""
    return np.asarray(np.kron(np.eye(2), turn), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class BoardBow:
    """The common bow of a target, as its views show it.

    Parameters
    ----------
    bow_mm
        (2,) as of `armscan.calibration.cameras.result.BoardWarp`; zero where it is not significant.
    covariance_mm2
        (2, 2) by the noise of the target's points, the cameras being held; where the bow is held at
        zero, with the square of what is likely of it.
    by_cameras
        (2, P) derivative by the cameras' parameters.
    low_mm, high_mm
        (2,) the target's extent.

    Of a target that quarter turns leave alike both bows are their mean, for each view is numbered
    by its image and may swap them: their covariance leaves the difference open.
    """

    bow_mm: FloatArray
    covariance_mm2: FloatArray
    by_cameras: FloatArray
    low_mm: FloatArray
    high_mm: FloatArray

    def shape(self, board_mm: FloatArray) -> FloatArray:
        """(N, 2) factors ``1 - u^2`` and ``1 - v^2`` of the bow at places (N, 2 or 3)."""
        half = 0.5 * (self.high_mm - self.low_mm)
        unit = (board_mm[:, :2] - 0.5 * (self.low_mm + self.high_mm)) / half
        return np.asarray(1.0 - unit**2)

    def bent(self, view: TargetView) -> TargetView:
        """The view with its target's points where the bow puts them."""
        board = view.points_board_mm.copy()
        board[:, 2] = self.shape(board) @ self.bow_mm
        return replace(view, points_board_mm=board)

    def held_at_zero(self, sizes_mm: FloatArray) -> BoardBow:
        """No bow, and the mean square of what it may be where this one was found.

        Means over ``sizes_mm`` (S,) that boards may bow by, each as likely beforehand, weighed by
        how probable they make the bow that was found (MacKay 1992).
        """
        found_mm, covariance = self.bow_mm, self.covariance_mm2
        whole = covariance + sizes_mm[:, None, None] ** 2 * np.eye(2)
        inverse = np.linalg.inv(whole)
        evidence = -0.5 * (np.linalg.slogdet(whole)[1] + found_mm @ (inverse @ found_mm).T)
        weight = np.exp(evidence - evidence.max())
        gain = np.eye(2) - covariance @ inverse
        mean_mm = gain @ found_mm
        square = gain @ covariance + np.einsum("si,sj->sij", mean_mm, mean_mm)
        return replace(
            self,
            bow_mm=np.zeros(2),
            covariance_mm2=np.average(square, axis=0, weights=weight),
            by_cameras=np.average(gain, axis=0, weights=weight) @ self.by_cameras,
        )

    def of_either_axis(self, sizes_mm: FloatArray) -> BoardBow:
        """The mean of both bows, which does not depend on which axis is x.

        Half their difference may be as large as the mean is and as bows (S,) are that are likely.
        """
        mean_mm, variance = float(self.bow_mm.mean()), float(self.covariance_mm2.mean())
        apart = mean_mm**2 + float(np.mean(sizes_mm**2))
        return replace(
            self,
            bow_mm=np.full(2, mean_mm),
            covariance_mm2=variance + apart * np.array([[1.0, -1.0], [-1.0, 1.0]]),
            by_cameras=np.tile(self.by_cameras.mean(axis=0), (2, 1)),
        )

    def height_mm(self, points_mm: FloatArray, pose: Pose[Sensor, Board]) -> FloatArray:
        """(N,) height of the bowed board over its plane below points (N, 3) in Sensor."""
        local = (points_mm - pose.translation_mm) @ pose.rotation
        return np.asarray(self.shape(local) @ self.bow_mm)

    def carried(
        self, points_mm: FloatArray, pose: Pose[Sensor, Board], centre_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of the plane moved along their rays to the bowed board.

        With their derivative (N, 3, 2) by the bow, the pose being held.
        """
        rays = points_mm - centre_mm
        rays = rays / (rays @ pose.rotation[:, 2])[:, None]
        points = points_mm
        for _ in range(BOW_STEPS):
            points = points_mm + self.height_mm(points, pose)[:, None] * rays
        local = (points - pose.translation_mm) @ pose.rotation
        return points, rays[:, :, None] * self.shape(local)[:, None, :]


def find_bow(
    boards: Sequence[BoardStripes], cameras: HeadCameras, likely_mm: float | None
) -> tuple[BoardBow | None, Sequence[BoardStripes]]:
    """The target's bow, and the boards placed with it; where it is not zero, estimated anew.

    It is that of the views of the camera that saw most boards.
    """
    views: dict[int, dict[str, TargetView]] = {}
    for board in boards:
        views.setdefault(board.camera, {})[board.view.source] = board.view
    camera = max(sorted(views), key=lambda k: len(views[k]), default=0)
    bow = find_board_bow(list(views.get(camera, {}).values()), cameras, likely_mm, camera)
    if bow is None:
        return None, boards
    found: dict[tuple[int, str], SeenBoard] = {}
    placements: dict[str, dict[int, tuple[SeenBoard, SeenBoard]]] = {}
    for board in boards:
        key = board.camera, board.view.source
        flat = board.camera, board.view, board.sensor_from_board
        if key not in found and not bow.bow_mm.any():
            found[key] = flat
        elif key not in found:
            view = bow.bent(board.view)
            pose = estimate_board_pose(view, cameras.model(board.camera), allow_ambiguous=True)
            if isinstance(pose, FitFailure):
                return None, boards
            found[key] = board.camera, view, pose
        placements.setdefault(board.place, {})[board.camera] = flat, found[key]
    given = {board.place: board.placed for board in boards}
    placed = {
        place: _placed_with_bow([seen[k] for k in sorted(seen)], given[place], cameras, bow)
        for place, seen in placements.items()
    }
    return bow, [
        replace(
            board,
            view=found[board.camera, board.view.source][1],
            sensor_from_board=found[board.camera, board.view.source][2],
            placed=placed[board.place],
        )
        for board in boards
    ]


def _placed_with_bow(
    seen: Sequence[tuple[SeenBoard, SeenBoard]],
    given: PlacedBoard | None,
    cameras: HeadCameras,
    bow: BoardBow,
) -> PlacedBoard:
    """A board by what cameras saw of it, taken for flat and with its bow.

    Where it was ``given`` by the other camera, too, which shows no stripe on it, that counts; what
    the bow moves in that camera's view, of which the points are not at hand, these tell.
    """
    bowed = place_board([one for _, one in seen], cameras, bow)
    if given is None or cameras.second is None or len(seen) > 1:
        return bowed
    ((camera, view, pose), _) = seen[0]
    flat = _in_sensor((camera, view, pose), cameras)
    if np.allclose(np.diag(flat.covariance), np.diag(given.covariance), rtol=SAME, atol=0.0):
        return bowed
    place = cameras.camera_from_sensor(1 - camera)
    there = place @ given.sensor_from_board
    as_sensor: Pose[Sensor, Board] = Pose(there.rotation, there.translation_mm)
    by_other = dpose_dcamera(view, as_sensor, cameras.model(1 - camera), bow)[:, N_CAMERA:]
    own_share = given.covariance @ np.linalg.inv(flat.covariance)
    by_bow = _twice(place.rotation.T) @ by_other
    by_bow += own_share @ (bowed.by_cameras[:, cameras.n_parameters :] - by_bow)
    return PlacedBoard(
        given.sensor_from_board.retract(by_bow @ bow.bow_mm),
        given.covariance,
        np.concatenate([given.by_cameras, by_bow], axis=1),
    )


def find_board_bow(
    views: Sequence[TargetView],
    cameras: HeadCameras,
    likely_mm: float | None = None,
    camera: int = 0,
) -> BoardBow | None:
    """Bow of the target that one camera saw in several views, the camera being held.

    One that is not significant is held at zero, with the mean square of what the views leave likely
    of it where ``likely_mm`` is known beforehand (None: `LIKELY_BOARD_BOWS`); of fewer than
    `LEAST_BOW_VIEWS` views, and where a view's pose has no solution, that is all that is likely.
    None where the bow is known to be zero and the views do not contradict.
    """
    if not views:
        return None
    board = np.concatenate([view.points_board_mm[:, :2] for view in views])
    low_mm, high_mm = board.min(axis=0), board.max(axis=0)
    half_mm = 0.5 * float((high_mm - low_mm).max())
    sizes_mm = LIKELY_BOARD_BOWS * half_mm if likely_mm is None else np.array([likely_mm])
    solved = _solved_bow(views, cameras, camera) if len(views) >= LEAST_BOW_VIEWS else None
    if solved is None:
        likely = np.mean(sizes_mm**2) * np.eye(2)
        of_cameras = np.zeros((2, cameras.n_parameters))
        bow = BoardBow(np.zeros(2), likely, of_cameras, low_mm, high_mm)
    elif solved[1]:
        bow, _ = solved
        return bow.of_either_axis(sizes_mm) if views[0].is_square else bow
    else:
        bow = solved[0].held_at_zero(sizes_mm)
    return None if likely_mm == 0.0 else bow


def _solved_bow(
    views: Sequence[TargetView], cameras: HeadCameras, camera: int
) -> tuple[BoardBow, bool] | None:
    """The bow as the views show it, and whether it is significant."""
    flat = _held_camera(views, cameras.model(camera))
    bowed = None if flat is None else with_board_warp(flat, MAX_STEPS)
    if flat is None or bowed is None or isinstance(bowed, FitFailure):
        return None
    equations = linearise(bowed.observations, bowed.state, np.eye(N_CAMERA + 2), bowed.weights)
    if equations is None:
        return None
    reduced = equations.shared - np.einsum(
        "vij,vjk,vlk->il", equations.cross, np.linalg.inv(equations.pose), equations.cross
    )
    of_bow = np.linalg.inv(reduced[N_CAMERA:, N_CAMERA:])
    by_cameras = np.zeros((2, cameras.n_parameters))
    own = RIGHT_CAMERA if camera else LEFT_CAMERA
    by_cameras[:, own] = -of_bow @ reduced[N_CAMERA:, :N_CAMERA]
    covariance = bowed.variance_factor * of_bow
    board = np.concatenate([view.points_board_mm[:, :2] for view in views])
    ends = board.min(axis=0), board.max(axis=0)
    bow = BoardBow(bowed.state.shared[N_CAMERA:], covariance, by_cameras, *ends)
    return bow, BowTest.of(flat, bowed).is_significant


def _held_camera(views: Sequence[TargetView], model: CameraModel) -> Solution | None:
    """The flat board's poses under a camera that is held; None where one has no solution."""
    poses = [estimate_board_pose(view, model, allow_ambiguous=True) for view in views]
    known = [pose.value for pose in poses if not isinstance(pose, FitFailure)]
    if len(known) < len(views):
        return None
    start = State.from_poses(np.append(model.parameters, np.zeros(2)), known)
    trusted = np.ones(len(views), dtype=np.bool_)
    held = np.zeros((N_CAMERA + 2, 0))
    flat = solve_robustly(gather(views, model.lens), start, held, trusted, MAX_STEPS)
    return None if isinstance(flat, FitFailure) else flat
