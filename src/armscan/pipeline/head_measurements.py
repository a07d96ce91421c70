# SPDX-License-Identifier: Apache-2.0
"""What a calibrated arm scanner measures of the twin's things, against their truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import TwinTruth
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import PlaneInspection, SphereInspection, StepInspection
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.step import inspect_step
from armscan.pipeline.head_calibration import Instrument, succeeded
from armscan.pipeline.measure_options import MeasureOptions
from armscan.pipeline.reconstruct import reconstruct
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.reconstruction.choose_sheet import DepthRange
from armscan.reconstruction.sync import exposure_poses
from armscan.records.cloud import PointCloud

STILL_HEIGHT_MM = 20.0
STEREO_STILL_HEIGHT_MM = 5.0
STILL_MARGIN = 0.3
"""The block fills the view, and its lower face lies up to 13 mm beyond the 55 mm of depth in which
the crossed lines are calibrated."""
PART_REACH_MM = 1.0
"""Points of the part's scan further than this from its surface lie on what stands around it."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPart:
    """A free-form part against its true surface.

    Parameters
    ----------
    scan
        The scan of it.
    rows
        (N,) rows, in its cloud, of the points within `PART_REACH_MM` of the true surface.
    distance_mm
        (N,) their signed distances from it.
    n_elsewhere
        Points further away.
    normalised_rms
        Root mean square of these distances over the stated sigma along the surface's normal.
    """

    scan: ScanReconstruction
    rows: IntArray
    distance_mm: FloatArray
    n_elsewhere: int
    normalised_rms: float

    @property
    def rms_mm(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean(self.distance_mm**2)))

    def fraction_within(self, limit_mm: float) -> float:
        """Share of the points within a distance of the true surface."""
        return float(np.mean(np.abs(self.distance_mm) <= limit_mm))


def inspect_plate(scan: ScanReconstruction, instrument: Instrument) -> PlaneInspection:
    """Points of the plate against the fitted and the probed plane.

    Raises
    ------
    EstimationError
        If no plane was found.
    """
    plane = instrument.plate.plane
    return succeeded(inspect_plane(scan.cloud, plane, reference_text="the probed plane"), "plate")


def inspect_ball(scan: ScanReconstruction, diameter_mm: float) -> SphereInspection:
    """Points of the ball against fitted and nominal diameter; raises the same."""
    return succeeded(inspect_sphere(scan.cloud, diameter_mm), "ball")


def inspect_steps(
    scan: ScanReconstruction, heights_mm: tuple[float, ...]
) -> tuple[StepInspection, ...]:
    """Heights of gauge blocks through the arm; raises the same."""
    return tuple(succeeded(inspect_step(scan.cloud, height), "steps") for height in heights_mm)


def still_height_mm(instrument: Instrument) -> float:
    """Height of the block of the scene ``still-step``: figure 5.19, or 5.33 with two cameras."""
    return STILL_HEIGHT_MM if instrument.sensor.second is None else STEREO_STILL_HEIGHT_MM


def measure_still_step(
    source: ScanSource, instrument: Instrument, normal_base: FloatArray, height_mm: float
) -> tuple[StepInspection, FloatArray]:
    """Height of a block from one exposure, in the Sensor frame; raises the same.

    Within the light sheet the faces stand further apart than the height if the sheet leans; how
    far it leans follows from the arm's pose and the faces' direction in Base.

    Parameters
    ----------
    source
        One exposure, of each camera.
    instrument
        The scanner.
    normal_base
        (3,) normal of the faces in Base, as the scan of the blocks gave it.
    height_mm
        Nominal height.

    Returns
    -------
    step, normal_sensor
        The inspection, and the normal (3,) in the Sensor frame that it rests on.
    """
    poses = exposure_poses(source.rows, source.arm, source.session.clock)
    base_from_sensor = poses.pose(0) @ instrument.scanner.hand_eye.tool_from_sensor
    normal = base_from_sensor.rotation.T @ normal_base
    first, *others = (source.exposure(row) for row in range(len(source.rows)))
    options = MeasureOptions(depths=DepthRange(margin=STILL_MARGIN))
    cloud = reconstruct([first], instrument.sensor, rights=others, options=options).cloud
    return succeeded(inspect_step(cloud, height_mm, normal=normal), source.name), normal


def inspect_part(scan: ScanReconstruction, truth: TwinTruth) -> MeasuredPart:
    """Points of the free-form part against the true surface; raises the same."""
    cloud = scan.cloud
    distance = truth.part_distance_mm(cloud.points_mm)
    rows = np.flatnonzero(np.abs(distance) <= PART_REACH_MM)
    if len(rows) == 0:
        raise EstimationError("no measured point lies on the part")
    sigma = _sigma_along(cloud, truth, rows)
    normalised = float(np.sqrt(np.mean((distance[rows] / sigma) ** 2)))
    return MeasuredPart(scan, rows, distance[rows], len(cloud) - len(rows), normalised)


def _sigma_along(cloud: PointCloud, truth: TwinTruth, rows: IntArray) -> FloatArray:
    normals = truth.part_normals(cloud.points_mm[rows])
    variance = np.einsum("ni,nij,nj->n", normals, cloud.covariance_mm2[rows], normals)
    return np.asarray(np.sqrt(variance))
