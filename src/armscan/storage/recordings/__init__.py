# SPDX-License-Identifier: Apache-2.0
"""Recordings in one file that survive a crash."""
