# SPDX-License-Identifier: Apache-2.0
# What `from armscan.inspection import ...` offers; loaded when it is first asked for.
from .conformity import Check as Check
from .conformity import check_size as check_size
from .conformity import judge as judge
from .features import FeatureInspection as FeatureInspection
from .features import Relation as Relation
from .features import inspect_feature as inspect_feature
from .features import relate as relate
from .plane import inspect_plane as inspect_plane
from .recipe import follow_recipe as follow_recipe
from .results import Deviations as Deviations
from .results import MeasuredLength as MeasuredLength
from .results import PlaneInspection as PlaneInspection
from .results import SphereInspection as SphereInspection
from .results import StepInspection as StepInspection
from .search import WantedFeature as WantedFeature
from .selection import InspectionOptions as InspectionOptions
from .selection import StepOptions as StepOptions
from .sphere import inspect_sphere as inspect_sphere
from .step import inspect_step as inspect_step
