# SPDX-License-Identifier: Apache-2.0
"""What the calibration of light sheets is given and asked for, and what it gives: stripes on
boards, options, the fate of every point, fits with their checks, and the reasons for
refusal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, TypeAlias

from armscan.calibration.sheets.target_edges import TargetEdges
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.estimate import Estimate
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.calibration import (
    CameraCalibration,
    Provenance,
    SecondCamera,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.light_sheet import LightSheet
from armscan.records.profile import Profile
from armscan.vision.stripe.image import LaserColour
from armscan.vision.targets.target import TargetView


@dataclass(frozen=True, slots=True)
class SheetOptions:
    """How stripes on boards become light sheets.

    Parameters
    ----------
    margin_mm
        Stripe points up to this far outside the rectangle of the target's points are used;
        negative keeps that far inside. None uses what the print covers, and of boards whose stripe
        lies beside it the carrier, as far as the boards agree.
    n_sheets
        Sheets that were on together; 0 finds out (the count of stripes that most images show).
    sheet_names
        Names to give, in the order of the stripes across the first image (left to right, or top
        to bottom where stripes lie flatter than 45 degrees); empty gives A, B, C, ...
    edge_widths
        A stripe point is left out if an edge of the target's marks that runs along the stripe is
        nearer than this many of the stripe's widths (sigma of its cross-section); 0 leaves none
        out.
    edge_angle_deg
        Largest angle between stripe and edge for this; edges that are turned further cross the
        stripe and pull it to neither side.
    line_tolerance_mm
        Half width of the band on the board in which points belong to one straight stripe, before
        robust statistics tighten it.
    outlier_sigma
        Points further than this many robust sigmas from their stripe or sheet are rejected.
    min_points
        Fewest points that make a stripe.
    lack_of_fit_p
        A bow is fitted when the plane's lack-of-fit probability is below this.
    min_boards_for_bow
        Fewest boards from which a bow is told from the boards' own errors.
    is_bow_allowed
        False holds every sheet to a plane.
    """

    margin_mm: float | None = None
    n_sheets: int = 0
    sheet_names: tuple[str, ...] = ()
    edge_widths: float = 3.0
    edge_angle_deg: float = 75.0
    line_tolerance_mm: float = 1.0
    outlier_sigma: float = 4.0
    min_points: int = 20
    lack_of_fit_p: float = 0.001
    min_boards_for_bow: int = 4
    is_bow_allowed: bool = True

    def __post_init__(self) -> None:
        _require(
            self.margin_mm is None or math.isfinite(self.margin_mm),
            f"margin of {self.margin_mm} mm",
            "give a finite length",
        )
        _require(0 <= self.n_sheets <= 32, f"{self.n_sheets} sheets", "give 0 (find out) to 32")
        _require(
            self.edge_widths >= 0.0,
            f"edges within {self.edge_widths} widths",
            "give 0 (use every point) or more",
        )
        _require(
            0.0 < self.edge_angle_deg <= 90.0,
            f"edges within {self.edge_angle_deg} deg of the stripe",
            "give an angle between 0 and 90",
        )
        _require(
            self.line_tolerance_mm > 0.0,
            f"line tolerance of {self.line_tolerance_mm} mm",
            "give a positive length",
        )
        _require(
            self.outlier_sigma >= 2.0,
            f"outlier limit of {self.outlier_sigma} sigma",
            "give at least 2, or good points are lost",
        )
        _require(self.min_points >= 5, f"{self.min_points} points a stripe", "give at least 5")
        _require(
            0.0 < self.lack_of_fit_p < 0.5,
            f"lack-of-fit probability {self.lack_of_fit_p}",
            "give a value between 0 and 0.5",
        )
        _require(
            self.min_boards_for_bow >= 3,
            f"bow from {self.min_boards_for_bow} boards",
            "give at least 3",
        )
        _require(
            len(set(self.sheet_names)) == len(self.sheet_names),
            "sheet names repeat",
            "give each sheet its own name",
        )
        _require(
            not self.sheet_names or self.n_sheets in (0, len(self.sheet_names)),
            f"{len(self.sheet_names)} names for {self.n_sheets} sheets",
            "give one name a sheet",
        )


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="light sheet options", remedy=remedy)


class PointUse(IntEnum):
    """What became of a stripe point."""

    USED = 0
    FLAGGED = 1
    """Rejected by the stripe extraction; `Profile.flags` says why."""
    NO_RAY = 2
    """The lens model has no inverse there, or the ray misses the board's plane."""
    OFF_BOARD = 3
    """Outside the rectangle of the target's points, where nothing says that the board is flat."""
    OFF_LINE = 4
    """Not on a straight stripe of the flat board: another reflection, or an outlier."""
    UNNAMED = 5
    """On a straight stripe that could not be given to a sheet."""
    OFF_SHEET = 6
    """Given to a sheet and too far from it."""
    ON_EDGE = 7
    """Next to a reflectance edge of the target that runs along the stripe and pulls its centre."""
    OUTVOTED = 8
    """On a straight line that does not lie on the sheet on which the boards agree."""

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _USE_LABELS[self]


_USE_LABELS = {
    PointUse.USED: "used",
    PointUse.FLAGGED: "flagged by the stripe extraction",
    PointUse.NO_RAY: "no ray meets the board",
    PointUse.OFF_BOARD: "off the known region of the board",
    PointUse.OFF_LINE: "off the straight stripe on the flat board",
    PointUse.UNNAMED: "stripe not given to a sheet",
    PointUse.OFF_SHEET: "off the sheet",
    PointUse.ON_EDGE: "along an edge of the target",
    PointUse.OUTVOTED: "on a line off the common sheet",
}


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBoard:
    """A board's pose in the Sensor frame.

    Parameters
    ----------
    sensor_from_board
        The pose.
    covariance
        (6, 6) by the noise of the target's points: rotation-vector increment (rad, Sensor frame,
        from the left), then translation (mm).
    by_cameras
        (6, P) how it follows the parameters of the cameras, P as in
        `armscan.calibration.sheets.board_points.HeadCameras`.
    """

    sensor_from_board: Pose[Sensor, Board]
    covariance: FloatArray
    by_cameras: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BoardStripes:
    """Stripes on a flat target whose pose is known: the input of the calibration.

    Parameters
    ----------
    profile
        Stripe points of the exposure with the laser on.
    view
        The target as found in the same exposure, or in one without laser of the same placement.
    sensor_from_board
        The board's pose with its (6, 6) covariance: rotation-vector increment (rad, Sensor frame,
        multiplied from the left), then translation (mm), the camera being held fixed.
    lasers
        Names of the sources that were on; empty when not known.
    edges
        Edges of the target's marks; None if they are not known, and then no point is left out for
        them.
    camera
        The camera of profile and view: 0, or 1 for the right one of a stereo head.
    placed
        The pose in Sensor where it rests on more than this view; else ``sensor_from_board`` holds,
        which is always the pose in the camera's own frame.
    placement
        Images of equal placement saw the board in one place, so that they share its pose and the
        error of that; empty stands for the view's source.
    """

    profile: Profile
    view: TargetView
    sensor_from_board: Estimate[Pose[Sensor, Board]]
    lasers: tuple[str, ...] = ()
    edges: TargetEdges | None = None
    camera: int = 0
    placed: PlacedBoard | None = None
    placement: str = ""

    @property
    def place(self) -> str:
        """Name of the board's placement."""
        return self.placement or self.view.source


@dataclass(frozen=True, slots=True)
class SkippedImage:
    """An image that gave nothing, and why."""

    source: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class SheetImage:
    """What one image gave.

    Parameters
    ----------
    profile
        All N stripe points, rejected ones included.
    view
        The board; ``view.source`` is the image in which it was found.
    sensor_from_board
        The board's pose in Sensor before the fit.
    use
        (N,) `PointUse` of each stripe point.
    sheet
        (N,) index of its sheet, -1 for none.
    points_mm
        (N, 3) on the board, Sensor frame; NaN where there is no ray.
    residual_mm
        (N,) distance from the sheet with the board as measured; NaN where no sheet is given.
    residual_px
        (N,) the same across the stripe in the image.
    remaining_px
        (N,) what remains after the board's pose is moved within its uncertainty.
    pose_shift_sigma
        Length of the shift of the board's pose that the fit chose, in its own sigmas: for six
        free numbers about 2.4 is typical, and above 4 the pose or the flatness is doubtful.
    """

    profile: Profile
    view: TargetView
    sensor_from_board: Pose[Sensor, Board]
    use: IntArray
    sheet: IntArray
    points_mm: FloatArray
    residual_mm: FloatArray
    residual_px: FloatArray
    remaining_px: FloatArray
    pose_shift_sigma: float

    def __post_init__(self) -> None:
        n = len(self.profile)
        for name in ("use", "sheet"):
            object.__setattr__(self, name, frozen_ints(getattr(self, name), (n,), name))
        for name in ("residual_mm", "residual_px", "remaining_px"):
            values = frozen_floats(getattr(self, name), (n,), name, allow_nan=True)
            object.__setattr__(self, name, values)
        points = frozen_floats(self.points_mm, (n, 3), "points_mm", allow_nan=True)
        object.__setattr__(self, "points_mm", points)

    @property
    def source(self) -> str:
        """Source name of the image with the stripes."""
        return self.profile.source

    def count(self, use: PointUse) -> int:
        """Count of points with this fate."""
        return int((self.use == int(use)).sum())


@dataclass(frozen=True, slots=True)
class LackOfFit:
    """Does the model explain the stripes' shape? An F test against the noise along each stripe.

    Parameters
    ----------
    f_ratio
        Mean square of what the model leaves of each stripe's low-order shape (weights as in the
        fit, boards free within their covariance), over the mean square of the noise around it.
    degrees_of_freedom
        Of the numerator; 0 when nothing is redundant.
    p_value
        Probability of a ratio at least this large if the model is right.
    """

    f_ratio: float
    degrees_of_freedom: int
    p_value: float


PlaneMethod: TypeAlias = Literal["algebraic", "total least squares", "cross ratio"]


@dataclass(frozen=True, slots=True)
class PlaneComparison:
    """How the plane of a simpler method lies to the sheet in use, over the calibrated region.

    Parameters
    ----------
    method
        ``algebraic`` is eq. 2.44; ``cross ratio`` is the thesis's way to the points.
    plane
        ``a b c D`` with a unit normal and D in mm.
    angle_deg
        Between the planes.
    largest_mm
        Largest distance between the two over the points used.
    """

    method: PlaneMethod
    plane: tuple[float, float, float, float]
    angle_deg: float
    largest_mm: float


@dataclass(frozen=True, slots=True)
class BoardDistances:
    """Distances of points from the plane of their board; positive beyond it.

    Parameters
    ----------
    n_points
        Count; 0 if there are none, and then all figures are NaN.
    mean_mm, sigma_mean_mm
        Mean, and the standard deviation that the calibration claims for it.
    rms_mm, claimed_rms_mm
        Root mean square, and what the calibration claims for it.
    """

    n_points: int
    mean_mm: float
    sigma_mean_mm: float
    rms_mm: float
    claimed_rms_mm: float


@dataclass(frozen=True, slots=True)
class BoardPointCheck:
    """Points of one sheet on one board.

    Parameters
    ----------
    source
        Image of its stripe, the first one.
    depth_mm
        Mean Z of the points.
    fitted
        The board took part in the fit.
    left_out
        It did not; None where the other boards do not determine the sheet.
    """

    source: str
    depth_mm: float
    fitted: BoardDistances
    left_out: BoardDistances | None


@dataclass(frozen=True, slots=True)
class SheetPointCheck:
    """Points of one sheet.

    Parameters
    ----------
    fitted
        All points, every board having taken part in the fit.
    left_out_rms_mm, left_out_claimed_mm
        Root mean square of the distances when each point's own board is left out, and what the
        calibration claims for it; NaN where no board can be left out.
    boards
        One entry a board.
    """

    fitted: BoardDistances
    left_out_rms_mm: float
    left_out_claimed_mm: float
    boards: tuple[BoardPointCheck, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SheetFit:
    """One calibrated sheet with what a reader needs to trust it or not.

    Parameters
    ----------
    calibration
        The sheet and its key figures.
    covariance
        (8, 8) in the order of `armscan.models.calibration.SHEET_PARAMETER_NAMES`, camera included.
    rms_px
        Of the residuals across the stripe, boards as measured.
    plane_test
        Lack of fit of the plane.
    final_test
        Lack of fit of the model in use (equal to ``plane_test`` where there is no bow).
    bow_decision
        Why there is a bow, or none, in words.
    tilt_sigma_deg
        Standard deviation of the normal's direction, the worse axis.
    offset_sigma_mm
        Standard deviation of the sheet's position in the middle of the calibrated region.
    coplanarity_mm
        The one residual of two straight stripes: the distance that the lines, taken as they were
        measured, miss a common plane by; for more boards the largest over pairs.
    coplanarity_sigma_mm
        Its standard deviation by the boards' covariance and the stripe noise.
    board_angle_deg
        Largest angle between two of its boards.
    comparisons
        Simpler methods on the same points.
    warnings
        What is weak, in words.
    points
        Points that the stored calibration makes of its own stripes, against their boards.
    """

    calibration: SheetCalibration
    covariance: FloatArray
    rms_px: float
    plane_test: LackOfFit
    final_test: LackOfFit
    bow_decision: str
    tilt_sigma_deg: float
    offset_sigma_mm: float
    coplanarity_mm: float
    coplanarity_sigma_mm: float
    board_angle_deg: float
    comparisons: tuple[PlaneComparison, ...]
    warnings: tuple[str, ...]
    points: SheetPointCheck

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (8, 8), "covariance"))

    @property
    def name(self) -> str:
        """Name of the sheet."""
        return self.calibration.name

    @property
    def sheet(self) -> LightSheet:
        """The model in the Sensor frame."""
        return self.calibration.sheet


@dataclass(frozen=True, slots=True, eq=False)
class LaserFit:
    """Calibrated light sheets and all evidence.

    Parameters
    ----------
    sheets
        One entry a sheet.
    images
        One entry an image, in the order given.
    camera
        The camera that was used, the left one of two.
    covariance
        Joint covariance as `SensorCalibration` wants it: (9 + 8 S, 9 + 8 S), with 15 more for a
        second camera.
    noise_factor
        Scatter of the stripe points around smooth stripes over what their sigmas claim.
    correlation_points
        Points along a stripe that count as one independent point (1: white noise).
    naming
        How the stripes were given to sheets, in words.
    options
        In force.
    warnings
        On the whole calibration; those of one sheet are with the sheet.
    skipped
        Images that gave nothing.
    second
        The right camera of a stereo head.
    laser_colour
        The channel of colour images in which the stripes were found, as
        `armscan.vision.stripe.image.StripeOptions.laser_colour`.
    channel_reason
        Why that channel, in words; empty where nothing was to be chosen.
    """

    sheets: tuple[SheetFit, ...]
    images: tuple[SheetImage, ...]
    camera: CameraCalibration
    covariance: FloatArray
    noise_factor: float
    correlation_points: float
    naming: str
    options: SheetOptions
    warnings: tuple[str, ...]
    skipped: tuple[SkippedImage, ...] = ()
    second: SecondCamera | None = None
    laser_colour: LaserColour = "auto"
    channel_reason: str = ""

    def __post_init__(self) -> None:
        n = 9 + 8 * len(self.sheets) + (15 if self.second is not None else 0)
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (n, n), "covariance"))

    @property
    def sheet_names(self) -> tuple[str, ...]:
        """Names in the order of ``sheets``; `SheetImage.sheet` points into it."""
        return tuple(sheet.name for sheet in self.sheets)

    def to_calibration(self, provenance: Provenance) -> SensorCalibration:
        """Return the document that reconstruction needs."""
        sheets = tuple(sheet.calibration for sheet in self.sheets)
        return SensorCalibration(
            camera=self.camera,
            sheets=sheets,
            covariance=self.covariance,
            provenance=provenance,
            diagnostics=None,
            second=self.second,
            laser_colour=self.laser_colour,
        )


LARGEST_RMS = 0.003
"""Of the image's diagonal, residual across the stripe: 2.4 px of 640 x 480. The plainest real sets
at hand have 0.0005."""
LARGEST_MISS = 0.03
"""Of the depth: how far points of a board lie off it if the sheet rests on the other boards. Real
sets at hand have 0.0001 to 0.007, the largest at a triangulation angle of 4 degrees."""


def reasons_to_refuse(fit: LaserFit) -> tuple[str, ...]:
    """Why solved sheets must not be written as if they were some; empty if nothing speaks against.

    Parameters
    ----------
    fit
        The sheets with their evidence.
    """
    camera = fit.camera.camera
    diagonal_px = math.hypot(camera.width_px, camera.height_px)
    return tuple(
        f"sheet {sheet.name}: {reason}"
        for sheet in fit.sheets
        for reason in _reasons(sheet, LARGEST_RMS * diagonal_px)
    )


def _reasons(sheet: SheetFit, largest_rms_px: float) -> tuple[str, ...]:
    found = []
    if sheet.rms_px > largest_rms_px:
        found.append(
            f"its stripes lie {sheet.rms_px:.1f} px (rms) from it, {largest_rms_px:.1f} px is the "
            "limit"
        )
    low, high = sheet.calibration.depth_range_mm
    alone = sheet.points.left_out_rms_mm
    rms_mm = alone if math.isfinite(alone) else sheet.points.fitted.rms_mm
    miss = rms_mm / (0.5 * (low + high))
    if miss > LARGEST_MISS:
        others = " if the sheet rests on the other boards" if math.isfinite(alone) else ""
        found.append(
            f"points on a board lie {rms_mm:.3g} mm (rms) off it{others}, {100.0 * miss:.1f} % of "
            f"the depth: {100.0 * LARGEST_MISS:.0f} % is the limit"
        )
    return tuple(found)
