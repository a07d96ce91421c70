# SPDX-License-Identifier: Apache-2.0
# What `from armscan.devices import ...` offers; loaded when it is first asked for.
from .clocks import ClockFit as ClockFit
from .clocks import ClockModel as ClockModel
from .clocks import ElementStatus as ElementStatus
from .clocks import StreamMonitor as StreamMonitor
from .inbox import Inbox as Inbox
from .matching import InstantMatcher as InstantMatcher
from .matching import MatchedInstant as MatchedInstant
from .matching import TimedSample as TimedSample
from .protocols import Arm as Arm
from .protocols import ArmFlag as ArmFlag
from .protocols import ArmSample as ArmSample
from .protocols import Camera as Camera
from .protocols import CameraSettings as CameraSettings
from .protocols import DeviceDriver as DeviceDriver
from .protocols import DeviceInfo as DeviceInfo
from .protocols import Frame as Frame
from .protocols import LaserController as LaserController
from .protocols import LaserEvent as LaserEvent
from .registry import DriverReport as DriverReport
from .registry import open_device as open_device
from .registry import survey_drivers as survey_drivers
from .sources import ScanSource as ScanSource
from .sources import SimulatedScan as SimulatedScan
from .sources import Twin as Twin
from .sources import driver_names as driver_names
from .sources import load_driver as load_driver
