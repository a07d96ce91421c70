# SPDX-License-Identifier: Apache-2.0
# What `from armscan.markers import ...` offers; loaded when it is first asked for.
from .alignments import MarkerMatchOptions as MarkerMatchOptions
from .alignments import Matched as Matched
from .alignments import NoMatch as NoMatch
from .alignments import NotUnique as NotUnique
from .candidates import RingMatchOptions as RingMatchOptions
from .join_views import JoinedViews as JoinedViews
from .join_views import join_views as join_views
from .match_3d import match_markers as match_markers
from .stereo_matching import StereoMatches as StereoMatches
from .stereo_matching import match_rings as match_rings
