# SPDX-License-Identifier: Apache-2.0
"""Where photographs of real instruments lie, which are too many to travel with the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("ARMSCAN_DATA", Path(__file__).parents[3] / "shared" / "data"))


def needs(*folders: str) -> pytest.MarkDecorator:
    """Skip a test, or a file as its ``pytestmark``, where folders of `DATA` are absent."""
    is_absent = not all((DATA / folder).is_dir() for folder in folders)
    return pytest.mark.skipif(is_absent, reason="no real photographs: set ARMSCAN_DATA")
