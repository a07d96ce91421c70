# SPDX-License-Identifier: Apache-2.0
# What `from armscan.pipeline import ...` offers; loaded when it is first asked for.
from .cameras import calibrate_camera_from_exposures as calibrate_camera_from_exposures
from .cameras import calibrate_stereo_from_exposures as calibrate_stereo_from_exposures
from .cameras import camera_calibration as camera_calibration
from .cameras import pair_lists as pair_lists
from .cameras import stereo_calibration as stereo_calibration
from .hand_eye import observe_stripes as observe_stripes
from .hand_eye import posed_stripes_from_profiles as posed_stripes_from_profiles
from .instants import pair_by_view as pair_by_view
from .instants import pair_exposures as pair_exposures
from .laser import LaserOptions as LaserOptions
from .laser import calibrate_sheets_again as calibrate_sheets_again
from .laser import calibrate_sheets_from_pairs as calibrate_sheets_from_pairs
from .measure import MeasureOptions as MeasureOptions
from .measure import Reconstruction as Reconstruction
from .measure import measure_instants as measure_instants
from .measure import reconstruct as reconstruct
from .progress import Progress as Progress
from .progress import ProgressEvent as ProgressEvent
from .register import register_place as register_place
from .register import register_views as register_views
from .scan import ScanOptions as ScanOptions
from .scan import ScanReconstruction as ScanReconstruction
from .scan import measure_scan as measure_scan
from .scan import place_profiles as place_profiles
from .verify import verify_on_ball as verify_on_ball
from .verify import verify_on_plate as verify_on_plate
