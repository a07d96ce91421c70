# SPDX-License-Identifier: Apache-2.0
"""Frames, poses, shapes and fits, in mm and rad."""
