# SPDX-License-Identifier: Apache-2.0
# What `from armscan.vision import ...` offers; loaded when it is first asked for.
from .rings import RingOptions as RingOptions
from .rings import detect_rings as detect_rings
from .stripe.extract import extract_stripes as extract_stripes
from .stripe.image import StripeOptions as StripeOptions
from .targets.detect import detect_target as detect_target
from .targets.target import TargetView as TargetView
from .targets.target import format_target as format_target
from .targets.target import parse_target as parse_target
