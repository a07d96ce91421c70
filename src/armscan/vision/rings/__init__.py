# SPDX-License-Identifier: Apache-2.0
"""Ring markers in images: found, filtered, and their centres measured."""
