# SPDX-License-Identifier: Apache-2.0
"""Light sheets: laser stripes on boards give each sheet in the frame of the camera."""
