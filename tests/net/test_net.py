# SPDX-License-Identifier: Apache-2.0
"""What every command writes is what it wrote before: the net, group by group."""

from __future__ import annotations

from pathlib import Path

import pytest

from net.cases import GROUPS
from net.compare import Limits
from net.run import compare_group

# The noise's rounds of a hand-eye end where no scatter changes by 2 %: on another machine than that
# of golden/ values moved by up to 6e-5 of themselves.
LIMITS = {"hand-eye": Limits(1e-4, 1e-2)}
# Its second recording repeats the first, so that the scatter is hardly determined: two ways of
# running it on one machine moved its sigmas by 5 %. Why is not known.
UNSETTLED = "hand-eye/several/"


@pytest.mark.parametrize("group", GROUPS)
def test_nothing_that_a_command_writes_has_changed(group: str, tmp_path: Path) -> None:
    found = compare_group(group, tmp_path, LIMITS.get(group, Limits(1e-6, 1e-2)))
    wrong = [str(one) for one in found if not one.is_warning and UNSETTLED not in str(one)]
    assert not wrong, "\n".join(wrong)
