# SPDX-License-Identifier: Apache-2.0
# What `from armscan.geometry import ...` offers; loaded when it is first asked for.
from .arrays import Box as Box
from .estimate import Estimate as Estimate
from .estimate import FitFailure as FitFailure
from .features import Shape as Shape
from .features import fit_shape as fit_shape
from .poses import Base as Base
from .poses import Board as Board
from .poses import Cad as Cad
from .poses import Part as Part
from .poses import Plate as Plate
from .poses import Points as Points
from .poses import Pose as Pose
from .poses import Probe as Probe
from .poses import Sensor as Sensor
from .poses import Tool as Tool
from .registration import PointPairs as PointPairs
from .registration import register_points as register_points
from .shapes import Circle as Circle
from .shapes import Line as Line
from .shapes import Plane as Plane
from .shapes import Sphere as Sphere
from .shapes import fit_circle as fit_circle
from .shapes import fit_line as fit_line
from .shapes import fit_plane as fit_plane
from .shapes import fit_sphere as fit_sphere
