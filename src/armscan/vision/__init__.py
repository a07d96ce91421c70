# SPDX-License-Identifier: Apache-2.0
"""From pixels to stripe centres and target points."""
