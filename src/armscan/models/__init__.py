# SPDX-License-Identifier: Apache-2.0
"""Forward physics with analytic Jacobians, and the calibration documents."""
