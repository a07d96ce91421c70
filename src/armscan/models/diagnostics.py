# SPDX-License-Identifier: Apache-2.0
"""How well a calibration is founded: figures to judge it by, none of which measuring needs."""

from __future__ import annotations

from dataclasses import dataclass


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
class BowedBoard:
    """The bow of the target that was solved with the camera.

    Parameters
    ----------
    bow_mm
        Along x and along y: the height of the middle over the edges, positive away from the camera.
    sigma_mm
        Standard deviations of the two.
    test
        Of a flat board.
    """

    bow_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    test: FTest


@dataclass(frozen=True, slots=True)
class CameraDiagnostics:
    """Evidence of a camera's calibration.

    Parameters
    ----------
    free_parameters
        Names of the parameters that were solved.
    model_reason
        Why these were free.
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
    board: BowedBoard | None


@dataclass(frozen=True, slots=True)
class SheetDiagnostics:
    """Evidence of one light sheet.

    Parameters
    ----------
    rms_px
        Of the residuals across the stripe in the image.
    plane_test, final_test
        Lack of fit of a plane, and of the model in use.
    bow_decision
        Why there is a bow, or none.
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

    Parameters
    ----------
    noise_factor
        Scatter of the stripe points over what their sigmas claim.
    correlation_points
        Points along a stripe that count as one independent point.
    naming
        How the stripes were given to sheets.
    """

    noise_factor: float
    correlation_points: float
    naming: str
