# SPDX-License-Identifier: Apache-2.0
"""Loops over stripes: ridges, profiles, sections, smoothing, and the fast way by columns."""
