# SPDX-License-Identifier: Apache-2.0
"""The memory that a profile tells is that of the process itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ASKS = "from armscan.pipeline.progress import peak_memory_mb; print(peak_memory_mb())"
HELD_MB = 600.0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells it there")
def test_what_the_starting_process_holds_does_not_count() -> None:
    held = np.ones(int(HELD_MB * 1e6 / 8))
    told = subprocess.run([sys.executable, "-c", ASKS], capture_output=True, text=True, check=True)
    own = float(told.stdout)
    assert held.nbytes == HELD_MB * 1e6
    assert 5.0 < own < 0.5 * HELD_MB
