# SPDX-License-Identifier: Apache-2.0
"""What the calibration of light sheets is given and asked for, and what it gives.

Stripes on boards and options go in; sheets come out with the use of every point, the checks of
each sheet, and the reasons for which a result must be refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal, TypeAlias

from scipy.special import chdtri

from armscan.errors import OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, IntArray, floats, ints
from armscan.geometry.estimate import Estimate
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.calibration import (
    CameraCalibration,
    LaserColour,
    Provenance,
    SecondCamera,
    SensorCalibration,
    SensorDiagnostics,
    SheetCalibration,
    SheetDiagnostics,
)
from armscan.models.light_sheet import LightSheet
from armscan.records.profile import Profile
from armscan.vision.targets.target import TargetView

LACK_OF_FIT_P = 0.001
"""A model is rejected when the probability of its lack of fit is below this: of a thousand good
sheets one is given a bow that it does not need, which costs a little precision and no bias."""
LARGEST_RMS = 0.003
"""Of the image's diagonal, residual across the stripe: 2.4 px of 640 x 480. The plainest real sets
at hand have 0.0005."""
LARGEST_MISS = 0.03
"""Of the depth: how far points of a board lie off it if the sheet rests on the other boards. Real
sets at hand have 0.0001 to 0.007, the largest at a triangulation angle of 4 degrees."""


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
    is_bow_allowed
        False holds every sheet to a plane.
    target_bow_mm
        What the target may be bowed by (one standard deviation of the height of its middle over its
        edges) where its views show no bow; 0 for one that is known to be flat. None takes any
        size from 1e-5 to 8e-4 of half the target.
    """

    margin_mm: float | None = None
    n_sheets: int = 0
    sheet_names: tuple[str, ...] = ()
    is_bow_allowed: bool = True
    target_bow_mm: float | None = None

    def __post_init__(self) -> None:
        n = len(self.sheet_names)
        for holds, what, remedy in (
            (
                self.margin_mm is None or math.isfinite(self.margin_mm),
                f"margin of {self.margin_mm} mm",
                "give a finite length",
            ),
            (0 <= self.n_sheets <= 32, f"{self.n_sheets} sheets", "give 0 (find out) to 32"),
            (
                len(set(self.sheet_names)) == n,
                "sheet names repeat",
                "give each sheet its own name",
            ),
            (
                all(name.strip() for name in self.sheet_names),
                "a sheet name is empty",
                "give each sheet a name that can be read",
            ),
            (
                not n or self.n_sheets in (0, n),
                f"{n} names for {self.n_sheets} sheets",
                "give one name a sheet",
            ),
            (
                self.target_bow_mm is None or 0.0 <= self.target_bow_mm < math.inf,
                f"target bowed by {self.target_bow_mm} mm",
                "give a height of 0 or more",
            ),
        ):
            if not holds:
                raise OptionError(what, where="light sheet options", remedy=remedy)


class PointUse(IntEnum):
    """What became of a stripe point; `Profile.flags` says why one is flagged."""

    USED = 0
    FLAGGED = 1
    NO_RAY = 2
    OFF_BOARD = 3
    OFF_LINE = 4
    UNNAMED = 5
    OFF_SHEET = 6
    ON_EDGE = 7
    OUTVOTED = 8

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _USE_LABELS[self]


_USE_LABELS = {
    PointUse.USED: "used",
    PointUse.FLAGGED: "flagged by the stripe extraction",
    # The lens model has no inverse there, or the ray misses the board's plane.
    PointUse.NO_RAY: "no ray meets the board",
    PointUse.OFF_BOARD: "off the known region of the board",
    # Another reflection, or an outlier.
    PointUse.OFF_LINE: "off the straight stripe on the flat board",
    PointUse.UNNAMED: "stripe not given to a sheet",
    PointUse.OFF_SHEET: "off the sheet",
    # The edge runs along the stripe and pulls its centre.
    PointUse.ON_EDGE: "along an edge of the target",
    PointUse.OUTVOTED: "on a line off the common sheet",
}


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBoard:
    """A board's pose in the Sensor frame.

    ``covariance`` (6, 6) is by the noise of the target's points: rotation-vector increment (rad,
    Sensor frame, from the left), then translation (mm). ``by_cameras`` (6, P) is its derivative by
    the P parameters of `HeadCameras`; then by the two of the target's bow, if it has one.
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
        N stripe points of the exposure with the laser on.
    view
        The target as found in the same exposure, or in one without laser of the same placement.
    sensor_from_board
        The board's pose in its camera's own frame with its (6, 6) covariance: rotation-vector
        increment (rad, from the left), then translation (mm), the camera being held fixed.
    lasers
        Names of the sources that were on; empty when not known.
    on_edge
        (N,) True for points next to an edge of the target's marks that runs along the stripe;
        None if the edges are not known.
    camera
        The camera of profile and view: 0, or 1 for the right one of a stereo head.
    placed
        The pose in Sensor where it rests on more than this view.
    placement
        Images of equal placement saw the board in one place, so that they share its pose and the
        error of that; empty stands for the view's source.
    """

    profile: Profile
    view: TargetView
    sensor_from_board: Estimate[Pose[Sensor, Board]]
    lasers: tuple[str, ...] = ()
    on_edge: BoolArray | None = None
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


class SheetImage(ArrayRecord):
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
    use: IntArray = ints("N")
    sheet: IntArray = ints("N")
    points_mm: FloatArray = floats("N", 3, nan=True)
    residual_mm: FloatArray = floats("N", nan=True)
    residual_px: FloatArray = floats("N", nan=True)
    remaining_px: FloatArray = floats("N", nan=True)
    pose_shift_sigma: float

    @property
    def source(self) -> str:
        """Source name of the image with the stripes."""
        return self.profile.source

    def count(self, use: PointUse) -> int:
        """Count of points with this use."""
        return int((self.use == int(use)).sum())


PlaneMethod: TypeAlias = Literal["algebraic", "total least squares", "cross ratio"]


@dataclass(frozen=True, slots=True)
class PlaneComparison:
    """How the plane of a simpler method lies to the sheet in use, over the calibrated region.

    ``algebraic`` is eq. 2.44, ``cross ratio`` the thesis's way to the points. The plane is ``a b c
    D`` with a unit normal and D in mm; ``largest_mm`` is the largest distance over the points used.
    """

    method: PlaneMethod
    plane: tuple[float, float, float, float]
    angle_deg: float
    largest_mm: float


@dataclass(frozen=True, slots=True)
class BoardDistances:
    """Distances of ``n_points`` points from the plane of their board, positive beyond it.

    Mean and root mean square, and what the calibration claims for them; NaN if there is no point.
    """

    n_points: int
    mean_mm: float
    sigma_mean_mm: float
    rms_mm: float
    claimed_rms_mm: float


@dataclass(frozen=True, slots=True)
class BoardPointCheck:
    """Points of one sheet on one board, at their mean Z; ``source`` is the first image of them.

    ``fitted`` if the board took part in the fit, ``left_out`` if it did not; None where the other
    boards do not determine the sheet.
    """

    source: str
    depth_mm: float
    fitted: BoardDistances
    left_out: BoardDistances | None


BEYOND_CLAIM = 1.5
BY_CHANCE = 1e-3


@dataclass(frozen=True, slots=True)
class SheetPointCheck:
    """Points of one sheet: all, every board having taken part in the fit, and board by board.

    ``left_out_rms_mm`` is the root mean square of the distances when each point's own board is left
    out, with what the calibration claims for it; NaN where no board can be left out.
    """

    fitted: BoardDistances
    left_out_rms_mm: float
    left_out_claimed_mm: float
    boards: tuple[BoardPointCheck, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Says that points lie farther off boards that took no part than is claimed for them.

        Boards share the camera's errors and weigh unlike, so that they tell no more than half as
        many would that err apart.
        """
        n = 0.5 * sum(1 for board in self.boards if board.left_out is not None)
        ratio = self.left_out_rms_mm / self.left_out_claimed_mm if n else 0.0
        if not ratio > max(BEYOND_CLAIM, math.sqrt(chdtri(max(n, 0.5), BY_CHANCE) / max(n, 0.5))):
            return ()
        return (
            f"points lie {self.left_out_rms_mm:.3g} mm (rms) off boards that were left out, where "
            f"{self.left_out_claimed_mm:.3g} mm is claimed: take sigmas for {ratio:.1f} times as "
            "large; is the camera that of these photographs, and are the boards flat?",
        )


class SheetFit(ArrayRecord):
    """One calibrated sheet with what a reader needs to trust it or not.

    Parameters
    ----------
    covariance
        (8, 8) in the order of `armscan.models.calibration.SHEET_PARAMETER_NAMES`, camera included.
    is_bow_free
        Whether a test asked for a bow; else it is the likeliest one of those that lines usually
        have, or none where a plane was asked for.
    tilt_sigma_deg
        Standard deviation of the normal's direction, the worse axis.
    offset_sigma_mm
        Standard deviation of the sheet's position in the middle of the calibrated region.
    """

    calibration: SheetCalibration
    diagnostics: SheetDiagnostics
    covariance: FloatArray = floats(8, 8)
    is_bow_free: bool
    tilt_sigma_deg: float
    offset_sigma_mm: float
    comparisons: tuple[PlaneComparison, ...]
    points: SheetPointCheck
    warnings: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the sheet."""
        return self.calibration.name

    @property
    def sheet(self) -> LightSheet:
        """The model in the Sensor frame."""
        return self.calibration.sheet


class LaserFit(ArrayRecord):
    """Calibrated light sheets and all evidence.

    Parameters
    ----------
    images
        One entry an image, in the order given.
    camera, second
        The camera that was used, the left one of two, and the right one if there is one.
    covariance
        Joint covariance as `SensorCalibration` wants it: (9 + 8 S, 9 + 8 S), with 15 more for a
        second camera.
    boards
        What was given: enough to solve again.
    warnings
        On the whole calibration; those of one sheet are with the sheet.
    laser_colour
        The channel of colour images in which the stripes were found.
    channel_reason
        Why that channel, in words; empty where nothing was to be chosen.
    print_reason
        Why the target's print was subtracted, in words; empty where it was not.
    board_bow_mm
        (2,) bow of the board along x and along y that stripes were placed with; zero where its
        views show none, empty where nothing of it was asked of them.
    lasers_without_sheet
        Lasers that images name and of which no sheet came.
    """

    sheets: tuple[SheetFit, ...]
    images: tuple[SheetImage, ...]
    camera: CameraCalibration
    second: SecondCamera | None
    covariance: FloatArray = floats("P", "P")
    diagnostics: SensorDiagnostics
    boards: tuple[BoardStripes, ...]
    options: SheetOptions
    warnings: tuple[str, ...]
    skipped: tuple[SkippedImage, ...] = ()
    laser_colour: LaserColour = "auto"
    channel_reason: str = ""
    print_reason: str = ""
    board_bow_mm: tuple[float, ...] = ()
    lasers_without_sheet: tuple[str, ...] = ()

    @property
    def sheet_names(self) -> tuple[str, ...]:
        """Names in the order of ``sheets``; `SheetImage.sheet` points into it."""
        return tuple(sheet.name for sheet in self.sheets)

    def to_calibration(self, provenance: Provenance) -> SensorCalibration:
        """The document's content, diagnostics included."""
        return SensorCalibration(
            camera=self.camera,
            sheets=tuple(
                replace(sheet.calibration, diagnostics=sheet.diagnostics) for sheet in self.sheets
            ),
            covariance=self.covariance,
            provenance=provenance,
            diagnostics=self.diagnostics,
            second=self.second,
            laser_colour=self.laser_colour,
            lasers_without_sheet=self.lasers_without_sheet,
        )


def reasons_to_refuse(fit: LaserFit) -> tuple[str, ...]:
    """Why solved sheets must not be written as if they were some; empty if nothing speaks against.

    The limits lie far outside what photographs of a laser on a board give, however plain: a
    refusal means a mistake (stripes of another light, boards of another size, images that do not
    belong together), not a poor set.
    """
    camera = fit.camera.camera
    largest_px = LARGEST_RMS * math.hypot(camera.width_px, camera.height_px)
    found = []
    for sheet in fit.sheets:
        rms_px = sheet.diagnostics.rms_px
        if rms_px > largest_px:
            found.append(
                f"sheet {sheet.name}: its stripes lie {rms_px:.1f} px (rms) from it, "
                f"{largest_px:.1f} px is the limit"
            )
        alone = sheet.points.left_out_rms_mm
        rms_mm = alone if math.isfinite(alone) else sheet.points.fitted.rms_mm
        miss = rms_mm / (0.5 * sum(sheet.calibration.depth_range_mm))
        if miss > LARGEST_MISS:
            others = " if the sheet rests on the other boards" if math.isfinite(alone) else ""
            found.append(
                f"sheet {sheet.name}: points on a board lie {rms_mm:.3g} mm (rms) off it{others}, "
                f"{100.0 * miss:.1f} % of the depth: {100.0 * LARGEST_MISS:.0f} % is the limit (is "
                "the camera's calibration that of these photographs, its focus and zoom unmoved?)"
            )
    return tuple(found)
