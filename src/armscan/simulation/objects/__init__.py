# SPDX-License-Identifier: Apache-2.0
"""What stands in the scene: shapes, targets, plates, markers."""
