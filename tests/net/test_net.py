# SPDX-License-Identifier: Apache-2.0
"""What every command writes is what it wrote before: the net, group by group."""

from __future__ import annotations

from pathlib import Path

import pytest

from net.cases import GROUPS
from net.compare import Limits
from net.run import compare_group

# The noise's rounds of a hand-eye end where no scatter changes by 2 %, and an exposure may be just
# there: what another machine rounds otherwise moves the rest by parts of 1e-4, 0.02 sigma at most.
LIMITS = {"hand-eye": Limits(1e-3, 3e-2)}


@pytest.mark.parametrize("group", GROUPS)
def test_nothing_that_a_command_writes_has_changed(group: str, tmp_path: Path) -> None:
    found = compare_group(group, tmp_path, LIMITS.get(group, Limits(1e-6, 1e-2)))
    wrong = [str(difference) for difference in found if not difference.is_warning]
    assert not wrong, "\n".join(wrong)
