# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: plain arrays in, plain arrays out."""
