# SPDX-License-Identifier: Apache-2.0
"""What a person may choose about how stripes become points."""

from __future__ import annotations

from dataclasses import dataclass, field

from armscan.reconstruction.choose_sheet import DepthRange
from armscan.vision.stripe.options import StripeOptions


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """How stripes on objects become points.

    Parameters
    ----------
    stripes
        Stripe extraction.
    depths
        Depths that are accepted; points outside are left out and counted.
    sheet
        Name of the sheet that drew all stripes; empty to find it.
    """

    stripes: StripeOptions = field(default_factory=StripeOptions)
    depths: DepthRange = field(default_factory=DepthRange)
    sheet: str = ""
