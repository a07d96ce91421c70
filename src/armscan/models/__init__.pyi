# SPDX-License-Identifier: Apache-2.0
# What `from armscan.models import ...` offers; loaded when it is first asked for.
from .arm import ArmModel as ArmModel
from .arm import forward as forward
from .arm import parameter_jacobian as parameter_jacobian
from .calibration import ArmNoise as ArmNoise
from .calibration import CameraCalibration as CameraCalibration
from .calibration import HandEyeCalibration as HandEyeCalibration
from .calibration import Provenance as Provenance
from .calibration import ScannerCalibration as ScannerCalibration
from .calibration import SensorCalibration as SensorCalibration
from .calibration import SheetCalibration as SheetCalibration
from .camera import CameraModel as CameraModel
from .light_sheet import LightSheet as LightSheet
from .two_views import StereoCalibration as StereoCalibration
from .two_views import TwoViews as TwoViews
from .two_views import triangulate_points as triangulate_points
