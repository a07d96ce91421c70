# SPDX-License-Identifier: Apache-2.0
"""Cameras, one or two: a plane target seen from many sides gives intrinsics and covariance."""
