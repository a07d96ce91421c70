# SPDX-License-Identifier: Apache-2.0
"""The observations and unknowns of a camera adjustment, flat in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.options import DISTORTION_PARAMETERS, CameraOptions, DistortionModel
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.vision.targets.view import TargetView

WARP_NAMES = ("bow_x_mm", "bow_y_mm")
SHARED_NAMES = (*PARAMETER_NAMES, *WARP_NAMES)
"""Unknowns that all views share: the camera, and the bow of the board."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Target points of V views, one after the other.

    Parameters
    ----------
    points_px
        (N, 2) observed image points.
    whitening
        (N, 2, 2) matrices L with ``L' L`` the inverse of each point's covariance.
    board_mm
        (N, 3) points of the flat board.
    bow_shape
        (N, 2) height of the board per unit of the two bow parameters.
    starts
        (V + 1,) first row of each view, and N.
    width_px, height_px
        Size of the image.
    """

    points_px: FloatArray
    whitening: FloatArray
    board_mm: FloatArray
    bow_shape: FloatArray
    starts: tuple[int, ...]
    width_px: int
    height_px: int

    @property
    def n_views(self) -> int:
        """Count of views."""
        return len(self.starts) - 1

    def rows(self, view: int) -> slice:
        """Rows of one view."""
        return slice(self.starts[view], self.starts[view + 1])

    @property
    def view_of_point(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """(N,) the view of each point."""
        return np.repeat(np.arange(self.n_views), np.diff(self.starts))


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all unknowns.

    Parameters
    ----------
    shared
        (11,) in the order of `SHARED_NAMES`.
    rotations
        (V, 3, 3) of ``sensor_from_board``.
    translations_mm
        (V, 3) of ``sensor_from_board``.
    """

    shared: FloatArray
    rotations: FloatArray
    translations_mm: FloatArray

    def camera(self, width_px: int, height_px: int) -> CameraModel:
        """The camera of this state."""
        return CameraModel.from_parameters(self.shared[:9], width_px, height_px)

    def pose(self, view: int) -> Pose[Sensor, Board]:
        """``sensor_from_board`` of one view."""
        return Pose(self.rotations[view], self.translations_mm[view])

    @staticmethod
    def from_poses(shared: FloatArray, poses: Sequence[Pose[Sensor, Board]]) -> State:
        """Put a state together from the shared unknowns and one pose a view."""
        return State(
            np.asarray(shared, dtype=np.float64),
            np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
            np.array([pose.translation_mm for pose in poses]).reshape(-1, 3),
        )


def gather(views: Sequence[TargetView]) -> Observations:
    """Collect the points of views, which must show images of one size.

    Raises
    ------
    InputError
        If the images differ in size or no view is given.
    """
    if not views:
        raise InputError("no views of the target were given")
    sizes = {(view.width_px, view.height_px) for view in views}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise InputError(
            f"the views come from images of different sizes: {listed} px",
            remedy="calibrate each camera, and each sensor setting, on its own images",
        )
    board = np.concatenate([view.points_board_mm for view in views])
    covariance = np.concatenate([view.covariance_px2 for view in views])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance)) if len(board) else covariance
    return Observations(
        np.concatenate([view.points_px for view in views]),
        np.asarray(whitening, dtype=np.float64),
        board,
        bow_shape(board),
        tuple(int(n) for n in np.cumsum([0] + [len(view) for view in views])),
        views[0].width_px,
        views[0].height_px,
    )


def bow_shape(board_mm: FloatArray) -> FloatArray:
    """(N, 2) factors ``1 - u^2`` and ``1 - v^2`` of the bow (see `BoardWarp`).

    The factors refer to the extent of all points of the target that were seen in any view.
    """
    if not len(board_mm):
        return np.zeros((0, 2))
    low, high = board_mm[:, :2].min(axis=0), board_mm[:, :2].max(axis=0)
    half = np.maximum(0.5 * (high - low), np.finfo(np.float64).tiny)
    unit = (board_mm[:, :2] - 0.5 * (low + high)) / half
    return np.asarray(1.0 - unit**2)


def free_basis(
    model: DistortionModel, options: CameraOptions, *, with_warp: bool
) -> tuple[FloatArray, tuple[str, ...]]:
    """Directions in the shared unknowns that are solved.

    Returns
    -------
    basis
        (11, F): a step is ``basis @ free_step``.
    names
        Names of the camera's free parameters; with a fixed aspect ``fy_px`` follows ``fx_px``.
    """
    names = ["fx_px"] + ([] if options.is_aspect_fixed else ["fy_px"])
    if not options.is_principal_point_fixed:
        names += ["cx_px", "cy_px"]
    names += [name for name in PARAMETER_NAMES[4:] if name in DISTORTION_PARAMETERS[model]]
    solved = names + (list(WARP_NAMES) if with_warp else [])
    return basis_of(solved, is_aspect_fixed=options.is_aspect_fixed), tuple(names)


def basis_of(names: Sequence[str], *, is_aspect_fixed: bool) -> FloatArray:
    """(11, F) directions of F shared unknowns; with a fixed aspect fy follows fx, the first."""
    basis = np.zeros((len(SHARED_NAMES), len(names)))
    for column, name in enumerate(names):
        basis[SHARED_NAMES.index(name), column] = 1.0
    if is_aspect_fixed:
        basis[SHARED_NAMES.index("fy_px"), 0] = 1.0
    return basis
