# SPDX-License-Identifier: Apache-2.0
"""Camera calibration on flat targets."""
