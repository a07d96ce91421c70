# SPDX-License-Identifier: Apache-2.0
"""A seeded part of ``benchmarks/mutated_inputs.py``: readers raise nothing but their own errors."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "mutated_inputs.py"


@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory are those of Linux")
def test_mutated_inputs_are_read_or_refused() -> None:
    """Fifteen cases of each of the 31 readers, in a process whose memory is limited."""
    command = [sys.executable, str(SCRIPT), "--work", "--cases", "15", "--seed", "7"]
    done = subprocess.run(command, capture_output=True, check=True, timeout=120)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    outcomes = [line for line in told if "outcome" in line]
    assert len(outcomes) == 465
    assert [line for line in outcomes if line["outcome"] not in ("accepted", "refused")] == []
