# SPDX-License-Identifier: Apache-2.0
"""What a description of a rig may ask of its lasers."""

from __future__ import annotations

from typing import Any

import pytest

from armscan.errors import OptionError
from armscan.pipeline.live.rig import Rig, RigDescription
from unit.live.test_session import Device, Lasers


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"lasers": "c", "schedule": ("A", "C")}, "schedule: no laser is called 'C'"),
        ({"schedule": ("A",)}, "schedule says which lasers are on"),
        ({"chooses_lasers": True}, "chooses_lasers says which lasers are on"),
    ],
)
def test_lasers_that_nothing_would_switch_are_refused(given: dict[str, Any], words: str) -> None:
    def open_device(kind: str, address: str) -> Any:
        return Lasers(address, []) if kind == "lasers" else Device(address, [])

    with pytest.raises(OptionError, match=words):
        Rig.open(RigDescription(("a",), **given), open_device)
