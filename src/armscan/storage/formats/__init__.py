# SPDX-License-Identifier: Apache-2.0
"""Files in which clouds are kept and handed on, one format a module."""
