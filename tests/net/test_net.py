# SPDX-License-Identifier: Apache-2.0
"""What every command writes is what it wrote before: the net, group by group."""

from __future__ import annotations

from pathlib import Path

import pytest

from net.cases import GROUPS
from net.compare import Limits
from net.run import compare_group


@pytest.mark.parametrize("group", GROUPS)
def test_nothing_that_a_command_writes_has_changed(group: str, tmp_path: Path) -> None:
    found = compare_group(group, tmp_path, Limits(1e-6, 1e-2))
    wrong = [str(difference) for difference in found if not difference.is_warning]
    assert not wrong, "\n".join(wrong)
