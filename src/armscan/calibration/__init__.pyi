# SPDX-License-Identifier: Apache-2.0
# What `from armscan.calibration import ...` offers; loaded when it is first asked for.
from .cameras.calibrate import calibrate_camera as calibrate_camera
from .cameras.calibrate_stereo import calibrate_stereo as calibrate_stereo
from .cameras.pairs import StereoOptions as StereoOptions
from .cameras.pairs import StereoPair as StereoPair
from .cameras.result import CameraFit as CameraFit
from .cameras.result import CameraOptions as CameraOptions
from .cameras.stereo_result import StereoFit as StereoFit
from .hand_eye.calibrate import calibrate_on_plate as calibrate_on_plate
from .hand_eye.calibrate import calibrate_on_sphere as calibrate_on_sphere
from .hand_eye.observations import HandEyeOptions as HandEyeOptions
from .hand_eye.observations import PlateReference as PlateReference
from .hand_eye.observations import PosedStripe as PosedStripe
from .hand_eye.result import HandEyeFit as HandEyeFit
from .sheets.calibrate import calibrate_sheets as calibrate_sheets
from .sheets.result import BoardStripes as BoardStripes
from .sheets.result import LaserFit as LaserFit
from .sheets.result import SheetFit as SheetFit
from .sheets.result import SheetOptions as SheetOptions
