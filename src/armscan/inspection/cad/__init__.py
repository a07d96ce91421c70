# SPDX-License-Identifier: Apache-2.0
"""Measured points against the model of a part: distance, alignment, verdict."""
