# SPDX-License-Identifier: Apache-2.0
"""The command line."""

from __future__ import annotations

from armscan.cli.run import main

__all__ = ["main"]
