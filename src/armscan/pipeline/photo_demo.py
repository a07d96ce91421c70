# SPDX-License-Identifier: Apache-2.0
"""Photographs rendered for `demo photos`, and the errors of what was measured from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from armscan.devices.registry import load_driver
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.truth import SheetErrors, camera_errors, sheet_errors
from armscan.records.cloud import PointCloud

ON_OBJECT_MM = 2.0
"""Points farther from the object lie on the table or the wall behind it."""


class PhotoTruth(Protocol):
    """What the simulator tells of a photo set; lengths in mm, Sensor frame."""

    @property
    def target(self) -> str:
        """The board, as the command line names it."""

    @property
    def camera_parameters(self) -> FloatArray:
        """(9,) ``fx fy cx cy k1 k2 p1 p2 k3``."""

    @property
    def sheet_points_mm(self) -> FloatArray:
        """(N, 3) true points of the sheet where the boards were."""

    def object_distance_mm(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) from the object's surface."""

    def object_normals(self, points_sensor_mm: FloatArray) -> FloatArray:
        """(N, 3) normals of the object's surface next to points (N, 3)."""


@dataclass(frozen=True, slots=True)
class PhotoErrors:
    """Errors of the whole chain against the truth.

    Parameters
    ----------
    focal_px, focal_sigma_px
        Error and stated sigma of fx.
    camera_normalised, n_camera_parameters
        Length of the error of all free camera parameters in their own sigmas, and their count.
    sheet
        The light sheet.
    n_points, n_on_object
        Measured points, and those of them on the object.
    points_rms_mm, points_median_mm
        Root mean square and median size of their distances from the object's true surface.
    points_normalised_rms, points_within_2_sigma
        Of these distances over the stated sigma along the surface's normal: root mean square, and
        the fraction below 2.
    """

    focal_px: float
    focal_sigma_px: float
    camera_normalised: float
    n_camera_parameters: int
    sheet: SheetErrors
    n_points: int
    n_on_object: int
    points_rms_mm: float
    points_median_mm: float
    points_normalised_rms: float
    points_within_2_sigma: float


def render_photos(folder: Path, seed: int, progress: Progress = silent) -> PhotoTruth:
    """Render the photo set into a folder; the simulator is found by its name.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """

    def report(done: int, total: int, item: str) -> None:
        progress(ProgressEvent("render photographs", done, total, item))

    return cast(PhotoTruth, load_driver("photo-set")(folder, seed, report))


def compare_with_truth(
    sensor: SensorCalibration, cloud: PointCloud, truth: PhotoTruth
) -> PhotoErrors:
    """Compare a calibrated sensor with one sheet, and the cloud it measured, with the truth."""
    camera = camera_errors(sensor.camera, truth.camera_parameters)
    distance = truth.object_distance_mm(cloud.points_mm)
    is_on = np.abs(distance) < ON_OBJECT_MM
    normals = truth.object_normals(cloud.points_mm[is_on])
    variance = np.einsum("ni,nij,nj->n", normals, cloud.covariance_mm2[is_on], normals)
    on_object = distance[is_on]
    normalised = on_object / np.sqrt(variance)
    return PhotoErrors(
        focal_px=camera.focal_px,
        focal_sigma_px=camera.focal_sigma_px,
        camera_normalised=camera.normalised,
        n_camera_parameters=camera.n_parameters,
        sheet=sheet_errors(
            sensor.sheets[0],
            sensor.covariance[sensor.sheet_parameter_slice(0), sensor.sheet_parameter_slice(0)],
            truth.sheet_points_mm,
        ),
        n_points=len(cloud),
        n_on_object=int(is_on.sum()),
        points_rms_mm=float(np.sqrt(np.mean(on_object**2))),
        points_median_mm=float(np.median(np.abs(on_object))),
        points_normalised_rms=float(np.sqrt(np.mean(normalised**2))),
        points_within_2_sigma=float(np.mean(np.abs(normalised) < 2.0)),
    )
