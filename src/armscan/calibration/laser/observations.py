# SPDX-License-Identifier: Apache-2.0
"""Stripe points given to sheets, as the arrays that the solver needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.laser.naming import NamedStripes, board_numbers
from armscan.calibration.laser.sightings import BoardImage
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.light_sheet import LightSheet


@dataclass(frozen=True, slots=True, eq=False)
class SheetObservations:
    """N stripe points on boards, each given to a sheet, ordered by image, then along each stripe.

    Parameters
    ----------
    image, row
        (N,) image, and row of its profile.
    board
        (N,) board placement: images of one placement share it.
    sheet
        (N,) index of the sheet.
    stripe
        (N,) number of the stripe (one image, one sheet) that the point belongs to.
    points_mm
        (N, 3) in the Sensor frame, boards as measured.
    across_mm_px
        (N, 3) movement of the point for one pixel across the stripe.
    sigma_px
        (N,) stripe noise across the stripe.
    by_pose
        (N, 3, 6) derivative by the pose of the point's own board.
    by_camera
        (N, 3, P) total derivative by the cameras' parameters, the boards' poses following them.
    """

    image: IntArray
    row: IntArray
    board: IntArray
    sheet: IntArray
    stripe: IntArray
    points_mm: FloatArray
    across_mm_px: FloatArray
    sigma_px: FloatArray
    by_pose: FloatArray
    by_camera: FloatArray

    def __len__(self) -> int:
        """Count of points."""
        return len(self.image)

    def select(self, keep: BoolArray) -> SheetObservations:
        """Return the observations where ``keep`` (N,) is True."""
        return SheetObservations(
            self.image[keep],
            self.row[keep],
            self.board[keep],
            self.sheet[keep],
            self.stripe[keep],
            self.points_mm[keep],
            self.across_mm_px[keep],
            self.sigma_px[keep],
            self.by_pose[keep],
            self.by_camera[keep],
        )

    def as_one_sheet(self) -> SheetObservations:
        """Return the same points as points of sheet 0, for a fit of one sheet alone."""
        return replace(self, sheet=np.zeros(len(self), dtype=np.int64))

    def residuals_px(
        self, sheets: Sequence[LightSheet]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Distances from the sheets and their derivatives.

        Returns
        -------
        height_mm
            (N,) distance of each point from its sheet along the normal.
        residual_px
            (N,) the same as a movement of the stripe across itself in the image.
        dr_dsheet
            (N, 8) derivative of ``residual_px`` by the parameters of the point's own sheet.
        dr_dpoint
            (N, 3) derivative of ``residual_px`` by the point, px/mm.
        """
        height = np.zeros(len(self))
        by_point = np.zeros((len(self), 3))
        by_sheet = np.zeros((len(self), 8))
        for k, sheet in enumerate(sheets):
            own = self.sheet == k
            height[own], by_point[own], by_sheet[own] = sheet.height_with_jacobian(
                self.points_mm[own]
            )
        mm_per_px = np.einsum("ni,ni->n", by_point, self.across_mm_px)
        return (
            height,
            height / mm_per_px,
            by_sheet / mm_per_px[:, None],
            by_point / mm_per_px[:, None],
        )


def placement_covariances(images: Sequence[BoardImage]) -> list[FloatArray]:
    """(6, 6) covariance of the pose of each board placement, in the order of their numbers."""
    boards = board_numbers(images)
    return [images[boards.index(board)].placed.covariance for board in range(max(boards) + 1)]


def collect_observations(images: Sequence[BoardImage], named: NamedStripes) -> SheetObservations:
    """Gather all named stripe points."""
    parts: list[tuple[int, IntArray, int]] = [
        (i, sighting.rows, sheet)
        for i, (image, sheets) in enumerate(zip(images, named.sheets, strict=True))
        for sighting, sheet in zip(image.sightings, sheets, strict=True)
        if sheet >= 0
    ]
    across = [
        np.einsum(
            "nij,nj->ni",
            images[i].points.dpoint_dq[rows],
            images[i].data.profile.normals_px[rows],
        )
        for i, rows, _ in parts
    ]
    by_pose = [images[i].points.dpoint_dpose[rows] for i, rows, _ in parts]
    by_camera = [images[i].by_camera[rows] for i, rows, _ in parts]
    boards = board_numbers(images)
    return SheetObservations(
        np.concatenate([np.full(len(rows), i) for i, rows, _ in parts]),
        np.concatenate([rows for _, rows, _ in parts]),
        np.concatenate([np.full(len(rows), boards[i]) for i, rows, _ in parts]),
        np.concatenate([np.full(len(rows), sheet) for _, rows, sheet in parts]),
        np.concatenate([np.full(len(rows), k) for k, (_, rows, _) in enumerate(parts)]),
        np.concatenate([images[i].points.points_mm[rows] for i, rows, _ in parts]),
        np.concatenate(across),
        np.concatenate([images[i].data.profile.sigma_px[rows] for i, rows, _ in parts]),
        np.concatenate(by_pose),
        np.concatenate(by_camera),
    )
