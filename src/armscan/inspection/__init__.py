# SPDX-License-Identifier: Apache-2.0
"""Measured points against what a part should be: planes, balls, steps."""
