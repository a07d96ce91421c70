# SPDX-License-Identifier: Apache-2.0
"""Estimation of cameras, light sheets and hand-eye."""
