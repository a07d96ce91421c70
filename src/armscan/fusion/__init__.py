# SPDX-License-Identifier: Apache-2.0
"""Clouds that are larger than memory: kept on disk while they grow, thinned, and their normals."""
