# SPDX-License-Identifier: Apache-2.0
"""Light-sheet calibration on flat targets."""
