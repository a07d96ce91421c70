# SPDX-License-Identifier: Apache-2.0
"""Jobs with the digital twin: recordings of its scenes, and demos of whole chains."""
