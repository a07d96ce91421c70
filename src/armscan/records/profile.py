# SPDX-License-Identifier: Apache-2.0
"""Points of one light stripe, in pixels, or in mm as a profile sensor delivers them."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, floats, ints


class StripeFlag(IntFlag):
    """What is doubtful about a stripe point; several may hold at once."""

    NONE = 0
    SATURATED = 1
    """Clipped pixels in the profile: harmless when symmetric, so not a rejection by itself."""
    BACKGROUND_STEP = 2
    """The background differs on the two sides of the line: every method shifts."""
    ASYMMETRIC = 4
    """The profile leans beyond what noise explains: a reflectance edge or a bent surface."""
    NEIGHBOUR = 8
    """Another line within about four sigma pulls the centre."""
    OUTLIER = 16
    """Off the smooth course of its own segment."""
    SHORT_SEGMENT = 32
    """Belongs to a segment that is too short to be a stripe."""
    TARGET_EDGE = 64
    """Along an edge of a calibration target's marks: set by the calibration, not the extraction."""
    END = 128
    """Where something cuts the line at a slant: the fitted column or row reaches past its end."""
    NOISE_ASSUMED = 256
    """Too few points to measure their noise: the sigma rests on an assumption."""
    GROUND_KNOWN = 512
    """What is printed under the line is part of the fit, as the view without laser shows it."""
    PULLED = 1024
    """A step of the background beside an over-exposed line: the sigma holds what it may do."""


REJECTING = (
    StripeFlag.BACKGROUND_STEP
    | StripeFlag.ASYMMETRIC
    | StripeFlag.NEIGHBOUR
    | StripeFlag.OUTLIER
    | StripeFlag.SHORT_SEGMENT
    | StripeFlag.TARGET_EDGE
    | StripeFlag.END
)


class Profile(RowRecord):
    """Stripe centre points of one exposure, ordered along their segments.

    Parameters
    ----------
    points_px
        (N, 2) stripe centres, full-sensor pixels (x, y).
    normals_px
        (N, 2) unit vectors across the stripe.
    sigma_px
        (N,) standard deviation of the centre along its normal.
    width_px
        (N,) sigma of the line's Gaussian cross-section.
    intensity
        (N,) peak grey level above the background.
    flags
        (N,) bit field of `StripeFlag`.
    segment
        (N,) number of the connected segment, counted from 0; a segment's points are consecutive.
    noise_length
        (N,) correlation length of the centre's noise along the stripe, in points: the sum of its
        correlations with itself and all others, 1 where each errs on its own. The variance of a sum
        over the stripe is that of independent points times this. None where it is not known.
    """

    source: str
    points_px: FloatArray = floats("N", 2)
    normals_px: FloatArray = floats("N", 2)
    sigma_px: FloatArray = floats("N")
    width_px: FloatArray = floats("N")
    intensity: FloatArray = floats("N")
    flags: IntArray = ints("N")
    segment: IntArray = ints("N")
    noise_length: FloatArray | None = floats("N", default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not bool((self.sigma_px > 0.0).all()):
            raise InputError("sigma_px must be positive", where=self.source)

    @property
    def is_accepted(self) -> BoolArray:
        """(N,) True where no rejecting flag is set."""
        return np.asarray((self.flags & int(REJECTING)) == 0)

    @property
    def is_sure(self) -> BoolArray:
        """(N,) True for accepted points that no step pulls."""
        return np.asarray((self.flags & int(REJECTING | StripeFlag.PULLED)) == 0)


class PointProfile(RowRecord):
    """Points of one profile.

    Parameters
    ----------
    source
        Where it came from, usually the file's name.
    points_mm
        (N, 3) in the Sensor frame; places where the sensor saw nothing are left out.
    n_gaps
        Count of such places.
    """

    source: str
    points_mm: FloatArray = floats("N", 3)
    n_gaps: int = 0
