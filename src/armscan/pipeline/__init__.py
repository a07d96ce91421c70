# SPDX-License-Identifier: Apache-2.0
"""Chains of stages over files, with progress as events."""
