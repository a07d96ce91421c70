# SPDX-License-Identifier: Apache-2.0
"""Calibrations of a camera, a sensor and a scanner, with covariance, evidence and provenance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, floats
from armscan.geometry.poses import CameraRight, Pose, Sensor, Tool
from armscan.geometry.shapes import Plane
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import BOW_TERMS, PLANE_PARAMETER_NAMES, LightSheet
from armscan.records.cloud import CalibrationMark


@dataclass(frozen=True, slots=True)
class FTest:
    """An F test of a model against a wider one, or against noise.

    Parameters
    ----------
    f_ratio
        Mean square that the model leaves over that of the noise.
    degrees_of_freedom
        Of the numerator; 0 where nothing is redundant, and the test then says nothing.
    p_value
        Probability of a ratio at least this large if the model is right.
    """

    f_ratio: float
    degrees_of_freedom: int
    p_value: float


@dataclass(frozen=True, slots=True)
class WarpedBoard:
    """The bow of the target that was solved with the camera, along x and along y, of its middle.

    It is the height over the edges, positive away from the camera.
    """

    bow_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    test: FTest


@dataclass(frozen=True, slots=True)
class CameraDiagnostics:
    """Evidence of a camera's calibration.

    Parameters
    ----------
    hold_out_rms_px
        Residual on views not used to solve, as ``rms_px``; None if there was no hold-out test.
    n_folds
        Groups of the hold-out test; 0 for none.
    condition
        Condition number of the normal matrix, poses eliminated, scaled to unit diagonal.
    noise_scale
        By how much the points scatter more than their detector says.
    covered_fraction
        Part of the image's cells that hold a target point.
    board
        The board's bow, or None if the board was taken as flat.
    """

    free_parameters: tuple[str, ...]
    model_reason: str
    hold_out_rms_px: float | None
    n_folds: int
    condition: float
    noise_scale: float
    covered_fraction: float
    board: WarpedBoard | None


@dataclass(frozen=True, slots=True)
class SheetDiagnostics:
    """Evidence of one light sheet.

    Parameters
    ----------
    rms_px
        Of the residuals across the stripe in the image.
    plane_test, final_test
        Lack of fit of a plane, and of the model in use.
    coplanarity_mm, coplanarity_sigma_mm
        Distance by which the stripes miss a common plane, and its standard deviation.
    board_angle_deg
        Largest angle between two boards.
    """

    rms_px: float
    plane_test: FTest
    final_test: FTest
    bow_decision: str
    coplanarity_mm: float
    coplanarity_sigma_mm: float
    board_angle_deg: float


@dataclass(frozen=True, slots=True)
class SensorDiagnostics:
    """Evidence of all light sheets together.

    ``noise_factor`` is the scatter of the stripe points over what their sigmas claim,
    ``correlation_points`` the points along a stripe that count as one independent point.
    """

    noise_factor: float
    correlation_points: float
    naming: str


SHEET_PARAMETER_NAMES = (*PLANE_PARAMETER_NAMES, *(f"bow_u{i}v{j}_mm" for i, j in BOW_TERMS))
"""Order of a sheet's parameters in every covariance and Jacobian; the tilts are in mm, the rise
over the sheet's scale."""

RIGHT_POSE_PARAMETER_NAMES = (
    "rotation_x_right_rad",
    "rotation_y_right_rad",
    "rotation_z_right_rad",
    "translation_x_right_mm",
    "translation_y_right_mm",
    "translation_z_right_mm",
)
"""Order of the parameters of ``right_from_sensor``: rotation-vector increment in CameraRight,
multiplied from the left (``R <- exp(dr) R``), then the increment of the translation."""

SECOND_PARAMETER_NAMES = (
    *(f"right.{name}" for name in CAMERA_PARAMETER_NAMES),
    *(f"right.{name}" for name in RIGHT_POSE_PARAMETER_NAMES),
)
"""What a second camera adds to a sensor's parameters, after the sheets'."""


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that went into a calibration."""

    path: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Provenance:
    """How a document came to be.

    Parameters
    ----------
    created_utc
        ISO 8601 time.
    parent_ids
        Documents on which this one rests.
    options
        (name, value as text) of the options in force.
    forced
        Why it was refused, where it was written all the same on request (``--force-bad``), with
        the reasons of the documents on which it rests; empty for a document that was not refused.
    is_simulated
        True if it was made of rendered images; documents from before do not tell.
    """

    document_id: str
    created_utc: str
    armscan_version: str
    command: tuple[str, ...]
    inputs: tuple[InputFile, ...]
    parent_ids: tuple[str, ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    forced: tuple[str, ...] = ()
    is_simulated: bool = False

    @property
    def mark(self) -> CalibrationMark:
        """What points carry of the calibration that they were measured with."""
        return CalibrationMark(self.document_id, self.created_utc)


WHOLLY_ALIKE = 1e-9
"""Share of the focal lengths' variance below which that of their difference is rounding."""


def is_aspect_held(covariance: FloatArray) -> bool:
    """True if the focal lengths of a camera's covariance (9, 9) err as one: fy was held to fx."""
    fx, fy = (CAMERA_PARAMETER_NAMES.index(name) for name in ("fx_px", "fy_px"))
    both = covariance[fx, fx] + covariance[fy, fy]
    apart = both - covariance[fx, fy] - covariance[fy, fx]
    return bool(both > 0.0 and apart <= WHOLLY_ALIKE * both)


def independent_parameters(covariance: FloatArray) -> IntArray:
    """Numbers of the parameters that a camera's covariance (9, 9) knows with an error of their own.

    Parameters that were held are none, and of focal lengths that err as one fy is none: without
    them the covariance has an inverse.
    """
    is_own = np.diag(covariance) > 0.0
    if is_aspect_held(covariance):
        is_own[CAMERA_PARAMETER_NAMES.index("fy_px")] = False
    return np.flatnonzero(is_own)


class CameraCalibration(ArrayRecord):
    """A camera with its uncertainty.

    Parameters
    ----------
    covariance
        (9, 9) in the order of `armscan.models.camera.PARAMETER_NAMES`; rows of parameters that
        were held fixed, or of a calibration that came without covariance, are zero.
    has_covariance
        False for a foreign calibration that brings no uncertainty.
    rms_px
        Root mean square over points of the length of the reprojection residual vector (the
        definition of OpenCV).
    sigma_point_px
        Standard deviation of one detected coordinate, per axis, told of the residuals.
    covered_px
        (4,) smallest x, smallest y, largest x, largest y of the points used: validity in the image.
    diagnostics
        Evidence for a reader; None where there is none, as in a foreign calibration.
    """

    camera: CameraModel
    covariance: FloatArray = floats(9, 9)
    has_covariance: bool
    rms_px: float
    sigma_point_px: float
    n_views: int
    n_points: int
    covered_px: FloatArray = floats(4)
    provenance: Provenance
    diagnostics: CameraDiagnostics | None = None

    def updated(self, step: FloatArray, covariance: FloatArray) -> CameraCalibration:
        """The camera with its parameters moved by a step (9,), known to another covariance."""
        moved = self.camera.moved_to(self.camera.parameters + step)
        return replace(self, camera=moved, covariance=covariance)


def without_covariance(figures: str, camera: str = "the camera") -> str:
    """The warning that ``figures`` do not hold what a camera errs by."""
    return f"{camera} came without covariance: {figures} leave its errors out"


@dataclass(frozen=True, slots=True, eq=False)
class SheetCalibration:
    """One light sheet and what it rests on.

    Parameters
    ----------
    sheet
        The model in the Sensor frame.
    rms_mm
        Root mean square distance of the points used from the sheet.
    depth_range_mm
        Smallest and largest Z of the points used: the sheet is valid there.
    is_redundant
        False when two boards only just determine the plane, so that no residual checks it.
    shape_mm
        Standard deviation by which the sheet leaves its model (a plane or its bow), smooth over
        the sheet, estimated from what the boards' stripes show alike; None in a document that is
        older than the estimate.
    """

    name: str
    sheet: LightSheet
    rms_mm: float
    n_boards: int
    n_points: int
    depth_range_mm: tuple[float, float]
    is_redundant: bool
    diagnostics: SheetDiagnostics | None = None
    shape_mm: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SecondCamera:
    """The right camera of a stereo head (eqs. 4.15 and 4.16).

    Parameters
    ----------
    camera
        Its calibration.
    right_from_sensor
        Where the Sensor frame, that of the left camera, lies in the right camera's.
    """

    camera: CameraCalibration
    right_from_sensor: Pose[CameraRight, Sensor]


class SensorCalibration(ArrayRecord):
    """Camera or cameras and the light sheets that they see: what turns stripes into points.

    Parameters
    ----------
    covariance
        (P, P) joint covariance in the order of ``parameter_names``: the camera's 9 parameters, each
        sheet's 8 (`SHEET_PARAMETER_NAMES`), then the 15 of a second camera
        (`SECOND_PARAMETER_NAMES`), if there is one.
    second
        The right camera of a stereo head; None for a head of one camera.
    laser_colour
        The channel of colour images in which the stripes of the calibration were found, and in
        which stripes are sought from then on; ``auto`` where none was chosen.
    lasers_without_sheet
        Lasers that images of the calibration name and of which no sheet came.
    """

    camera: CameraCalibration
    sheets: tuple[SheetCalibration, ...]
    covariance: FloatArray = floats("P", "P")
    provenance: Provenance
    diagnostics: SensorDiagnostics | None = None
    second: SecondCamera | None = None
    laser_colour: str = "auto"
    lasers_without_sheet: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sheets:
            raise InputError("a sensor calibration needs at least one light sheet")
        names = [sheet.name for sheet in self.sheets]
        if len(set(names)) != len(names):
            raise InputError(f"light sheets share a name: {', '.join(names)}")
        if len(self.covariance) != len(self.parameter_names):
            raise InputError(
                f"covariance of {len(self.covariance)} parameters for {len(self.parameter_names)}"
            )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of ``covariance``."""
        names = list(CAMERA_PARAMETER_NAMES)
        for sheet in self.sheets:
            names += [f"{sheet.name}.{name}" for name in SHEET_PARAMETER_NAMES]
        if self.second is not None:
            names += SECOND_PARAMETER_NAMES
        return tuple(names)

    def sheet_parameter_slice(self, index: int) -> slice:
        """Columns of ``covariance`` that belong to sheet number ``index``."""
        start = len(CAMERA_PARAMETER_NAMES) + index * len(SHEET_PARAMETER_NAMES)
        return slice(start, start + len(SHEET_PARAMETER_NAMES))

    @property
    def has_camera_covariance(self) -> bool:
        """False if a camera came without covariance."""
        return self.camera.has_covariance and (
            self.second is None or self.second.camera.has_covariance
        )

    @property
    def second_parameter_slice(self) -> slice:
        """Columns of ``covariance`` that belong to the second camera; empty without one."""
        start = self.sheet_parameter_slice(len(self.sheets)).start
        return slice(start, len(self.parameter_names))

    def updated(self, step: FloatArray, covariance: FloatArray) -> SensorCalibration:
        """The sensor with its parameters moved by a step (P,), known to another covariance (P, P).

        The provenance stays that of the calibration which gave it.
        """
        n, of_second = len(CAMERA_PARAMETER_NAMES), self.second_parameter_slice
        sheets = tuple(
            replace(sheet, sheet=sheet.sheet.updated(step[self.sheet_parameter_slice(k)]))
            for k, sheet in enumerate(self.sheets)
        )
        second = self.second
        if second is not None:
            of_camera = slice(of_second.start, of_second.start + n)
            second = SecondCamera(
                second.camera.updated(step[of_camera], covariance[of_camera, of_camera]),
                second.right_from_sensor.retract(step[of_camera.stop :]),
            )
        return replace(
            self,
            camera=self.camera.updated(step[:n], covariance[:n, :n]),
            sheets=sheets,
            second=second,
            covariance=covariance,
        )


HAND_EYE_PARAMETER_NAMES = (
    "rotation_x_tool_rad",
    "rotation_y_tool_rad",
    "rotation_z_tool_rad",
    "translation_x_tool_mm",
    "translation_y_tool_mm",
    "translation_z_tool_mm",
)
"""Order of the hand-eye's parameters: rotation-vector increment in Tool, multiplied from the left
(``R <- exp(dr) R``), then the increment of the translation."""

HandEyeMethod = Literal["plate", "sphere", "board"]
LaserColour = Literal[
    "auto",
    "red",
    "green",
    "blue",
    "grey",
    "red-excess",
    "green-excess",
    "blue-excess",
    "red-green",
    "red-blue",
    "green-red",
    "green-blue",
    "blue-red",
    "blue-green",
]
"""What of a colour image shows the line: `armscan.vision.stripe.image.StripeOptions`."""


@dataclass(frozen=True, slots=True)
class ArmNoise:
    """How much the arm's reported pose scatters, one standard deviation an axis.

    Independent parts: a shift, a turn about the scan point (the middle of the sensor's working
    range) and a turn about the origin of Tool. A point p from the scan point and q from the origin
    of Tool scatters by ``position_mm^2 I + rotation_rad^2 [p]x [p]x' + tool_rotation_rad^2 [q]x
    [q]x'``.

    Parameters
    ----------
    position_mm
        Of the shift, common to a posture.
    rotation_rad
        Of the turn about the scan point, common to a posture.
    exposure_position_mm, exposure_rotation_rad
        The part that is new in every exposure.
    tool_rotation_rad, exposure_tool_rotation_rad
        Of the turn about the origin of Tool; 0 in documents that were written without it.
    """

    position_mm: float
    rotation_rad: float
    exposure_position_mm: float = 0.0
    exposure_rotation_rad: float = 0.0
    tool_rotation_rad: float = 0.0
    exposure_tool_rotation_rad: float = 0.0

    @property
    def variances(self) -> tuple[float, float, float]:
        """Of the shift (mm^2), the turns about scan point and Tool (rad^2), in one exposure."""
        return (
            self.position_mm**2 + self.exposure_position_mm**2,
            self.rotation_rad**2 + self.exposure_rotation_rad**2,
            self.tool_rotation_rad**2 + self.exposure_tool_rotation_rad**2,
        )


@dataclass(frozen=True, slots=True)
class HandEyeDiagnostics:
    """Evidence of a hand-eye calibration.

    Parameters
    ----------
    rank, condition
        Of the whitened and scaled system of the hand-eye's six parameters.
    weakest
        The combination of parameters that is known least, in words.
    plate_flatness_mm, flatness_length_mm
        Standard deviation and correlation length of the plate's flatness in the noise model.
    is_noise_estimated
        True if variances came from the data, not from the user.
    is_arm_given
        True if that of the arm's shift came from the user; not told by documents from before.
    left_out_rotation_deg, left_out_translation_mm
        Largest change when one posture is left out.
    chi2_probability
        Probability of residuals at least this large under the noise model.
    region_factor
        Factor on the usual limit of ``e' C^-1 e`` from which the joint 95 % region of the hand-eye
        holds 95 %: above 1 where the scatter had to be estimated from few postures.
    """

    method: HandEyeMethod
    rank: int
    condition: float
    weakest: str
    plate_flatness_mm: float
    flatness_length_mm: float
    is_noise_estimated: bool
    left_out_rotation_deg: float
    left_out_translation_mm: float
    chi2_probability: float
    region_factor: float = 1.0
    is_arm_given: bool = False


class HandEyeCalibration(ArrayRecord):
    """Where the sensor sits on the arm's last link.

    Parameters
    ----------
    covariance
        (6, 6) in the order of `HAND_EYE_PARAMETER_NAMES`: arm, plate and stripe noise, the sensor
        being held fixed.
    dhand_eye_dsensor
        (6, P) derivative of these parameters by the sensor's, in the order of the sensor's
        ``parameter_names``: an error of the sensor moves the hand-eye. None where points came
        without a sensor's calibration.
    arm_noise
        Of the arm during the calibration; scans are given the same.
    rms_mm
        Root mean square distance of the points from the reference.
    plate
        The plate in Base: frame "Base"; None after a sphere or a target.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    covariance: FloatArray = floats(6, 6)
    dhand_eye_dsensor: FloatArray | None = floats(6, None)
    arm_noise: ArmNoise
    rms_mm: float
    n_postures: int
    n_exposures: int
    n_points: int
    plate: Plane | None = None
    diagnostics: HandEyeDiagnostics | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ScannerCalibration:
    """All that turns exposures and arm samples into points in Base.

    Parameters
    ----------
    sensor
        Camera and sheets; None for a sensor that delivers points itself.
    latency_ns
        Added to an exposure's time before the arm's pose is looked up by time.
    latency_sigma_ns
        Its standard deviation; None where it was not calibrated.
    """

    sensor: SensorCalibration | None
    hand_eye: HandEyeCalibration
    provenance: Provenance
    latency_ns: int = 0
    latency_sigma_ns: float | None = None

    def __post_init__(self) -> None:
        coupling = self.hand_eye.dhand_eye_dsensor
        if self.sensor is None or coupling is None:
            return
        if coupling.shape[1] != len(self.sensor.parameter_names):
            raise InputError(
                f"the hand-eye depends on {coupling.shape[1]} parameters, but the sensor has "
                f"{len(self.sensor.parameter_names)}"
            )

    @property
    def covariance(self) -> FloatArray:
        """(P + 6, P + 6) joint covariance of the sensor's parameters and the hand-eye's.

        An error of the sensor and what it does to the hand-eye largely cancel in the points, so
        the two must not be taken as independent.
        """
        if self.sensor is None:
            return self.hand_eye.covariance
        coupling = self.hand_eye.dhand_eye_dsensor
        n = len(self.sensor.parameter_names)
        follow = np.zeros((6, n)) if coupling is None else coupling
        follow_all = np.vstack([np.eye(n), follow])
        joint = follow_all @ self.sensor.covariance @ follow_all.T
        joint[n:, n:] += self.hand_eye.covariance
        return np.asarray(joint)
