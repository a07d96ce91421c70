# SPDX-License-Identifier: Apache-2.0
# What `from armscan.reconstruction import ...` offers; loaded when it is first asked for.
from .labels import LabelledProfile as LabelledProfile
from .labels import PointStatus as PointStatus
from .labels import StripeLabeller as StripeLabeller
from .place import BaseTransform as BaseTransform
from .place import estimate_normals as estimate_normals
from .place import merge_clouds as merge_clouds
from .place import propagate_to_base as propagate_to_base
from .sync import PoseStatus as PoseStatus
from .sync import exposure_poses as exposure_poses
from .triangulate import DepthRange as DepthRange
from .triangulate import StripePoints as StripePoints
from .triangulate import intersect_sheets as intersect_sheets
from .triangulate import triangulate_stripe as triangulate_stripe
