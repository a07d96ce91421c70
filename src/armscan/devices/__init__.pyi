# SPDX-License-Identifier: Apache-2.0
# What `from armscan.devices import ...` offers; loaded when it is first asked for.
from .sources import ScanSource as ScanSource
from .sources import SimulatedScan as SimulatedScan
from .sources import Twin as Twin
from .sources import driver_names as driver_names
from .sources import load_driver as load_driver
