# SPDX-License-Identifier: Apache-2.0
"""The digital twin: optics of its own, truth beside the images."""
