# SPDX-License-Identifier: Apache-2.0
# What `from armscan.records import ...` offers; loaded when it is first asked for.
from .cloud import PointCloud as PointCloud
from .exposure import Exposure as Exposure
from .exposure import SensorWindow as SensorWindow
from .points import MarkerSet as MarkerSet
from .points import ProbedPoints as ProbedPoints
from .points import RingImages as RingImages
from .profile import PointProfile as PointProfile
from .profile import Profile as Profile
from .profile import StripeFlag as StripeFlag
from .recording import ArmTrack as ArmTrack
from .recording import CameraSetup as CameraSetup
from .recording import ExposureRow as ExposureRow
from .recording import Session as Session
