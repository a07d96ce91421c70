# SPDX-License-Identifier: Apache-2.0
"""Calibration documents: numbers with covariance, evidence, validity and provenance."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES
from armscan.models.camera import CameraModel
from armscan.models.diagnostics import CameraDiagnostics, SensorDiagnostics, SheetDiagnostics
from armscan.models.light_sheet import BOW_TERMS, PLANE_PARAMETER_NAMES, LightSheet

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
    document_id
        Unique id of this document.
    created_utc
        ISO 8601 time.
    armscan_version
        Version that wrote it.
    command
        The command line, one word an entry.
    inputs
        Files with their hashes.
    parent_ids
        Documents on which this one rests.
    options
        (name, value as text) of the options in force.
    warnings
        What the program warned of.
    forced
        Why it was refused, where it was written all the same on request (``--force-bad``), with
        the reasons of the documents on which it rests; empty for a document that was not refused.
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


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera with its uncertainty.

    Parameters
    ----------
    camera
        The model.
    covariance
        (9, 9) in the order of `armscan.models.camera.PARAMETER_NAMES`; rows of parameters that
        were held fixed, or of a calibration that came without covariance, are zero.
    has_covariance
        False for a foreign calibration that brings no uncertainty.
    rms_px
        Root mean square over points of the length of the reprojection residual vector (the
        definition of OpenCV).
    sigma_point_px
        Estimated standard deviation of one detected coordinate, per axis.
    n_views, n_points
        What was used.
    covered_px
        (4,) smallest x, smallest y, largest x, largest y of the points used: validity in the image.
    provenance
        How it came to be.
    diagnostics
        Evidence for a reader; None where there is none, as in a foreign calibration.
    """

    camera: CameraModel
    covariance: FloatArray
    has_covariance: bool
    rms_px: float
    sigma_point_px: float
    n_views: int
    n_points: int
    covered_px: FloatArray
    provenance: Provenance
    diagnostics: CameraDiagnostics | None = None

    def __post_init__(self) -> None:
        n = len(CAMERA_PARAMETER_NAMES)
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (n, n), "covariance"))
        object.__setattr__(self, "covered_px", frozen_floats(self.covered_px, (4,), "covered_px"))


@dataclass(frozen=True, slots=True, eq=False)
class SheetCalibration:
    """One light sheet and what it rests on.

    Parameters
    ----------
    name
        Name of the sheet, for example ``A``.
    sheet
        The model in the Sensor frame.
    rms_mm
        Root mean square distance of the points used from the sheet.
    n_boards, n_points
        What was used.
    depth_range_mm
        Smallest and largest Z of the points used: the sheet is valid there.
    is_redundant
        False when two boards only just determine the plane, so that no residual checks it.
    diagnostics
        Evidence for a reader; None where there is none.
    """

    name: str
    sheet: LightSheet
    rms_mm: float
    n_boards: int
    n_points: int
    depth_range_mm: tuple[float, float]
    is_redundant: bool
    diagnostics: SheetDiagnostics | None = None


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


@dataclass(frozen=True, slots=True, eq=False)
class SensorCalibration:
    """Camera or cameras and the light sheets that they see: what turns stripes into points.

    Parameters
    ----------
    camera
        The camera's calibration.
    sheets
        One entry a light sheet.
    covariance
        (P, P) joint covariance in the order of ``parameter_names``: the camera's 9 parameters, each
        sheet's 8 (`SHEET_PARAMETER_NAMES`), then the 15 of a second camera
        (`SECOND_PARAMETER_NAMES`), if there is one.
    provenance
        How it came to be.
    diagnostics
        Evidence for a reader; None where there is none.
    second
        The right camera of a stereo head; None for a head of one camera.
    laser_colour
        The channel of colour images in which the stripes of the calibration were found, and in
        which stripes are sought from then on; ``auto`` where none was chosen.
    """

    camera: CameraCalibration
    sheets: tuple[SheetCalibration, ...]
    covariance: FloatArray
    provenance: Provenance
    diagnostics: SensorDiagnostics | None = None
    second: SecondCamera | None = None
    laser_colour: str = "auto"

    def __post_init__(self) -> None:
        if not self.sheets:
            raise InputError("a sensor calibration needs at least one light sheet")
        names = [sheet.name for sheet in self.sheets]
        if len(set(names)) != len(names):
            raise InputError(f"light sheets share a name: {', '.join(names)}")
        n = len(self.parameter_names)
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (n, n), "covariance"))

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
    def second_parameter_slice(self) -> slice:
        """Columns of ``covariance`` that belong to the second camera; empty without one."""
        start = self.sheet_parameter_slice(len(self.sheets)).start
        return slice(start, len(self.parameter_names))
