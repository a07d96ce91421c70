# SPDX-License-Identifier: Apache-2.0
"""Cameras, line lasers and a measuring arm as a calibrated 3-D scanner."""

from importlib.metadata import version

__version__ = version("armscan")
