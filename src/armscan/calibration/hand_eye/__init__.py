# SPDX-License-Identifier: Apache-2.0
"""Where the sensor sits on the arm: on a flat plate (2.3.3.2) or on a sphere (2.3.3.1)."""
