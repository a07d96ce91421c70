# SPDX-License-Identifier: Apache-2.0
"""From stripe profiles to points in millimetres."""
