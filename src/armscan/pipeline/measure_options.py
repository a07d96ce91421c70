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
        Depths that are accepted; points outside are left out and counted. None for those that the
        head's own rule takes: `DepthRange` of one camera, `StereoNamingOptions.depths` of two.
    sheet
        Name of the sheet that drew all stripes; empty to find it. For one camera only.
    """

    stripes: StripeOptions = field(default_factory=StripeOptions)
    depths: DepthRange | None = None
    sheet: str = ""
