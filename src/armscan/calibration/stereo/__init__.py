# SPDX-License-Identifier: Apache-2.0
"""Calibration of two cameras that look at one target."""
