# SPDX-License-Identifier: Apache-2.0
"""What every command writes is what it wrote before: the net, group by group."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from net.cases import GROUPS
from net.compare import Difference, Limits
from net.run import compare_group

GOLDEN_PROCESSOR, OTHER_MODEL = "Intel(R) Xeon(R) Processor", "model\t\t: 207\n"
"""On which golden/ was written; others round otherwise (fused products, widths of vectors), and so
does the newer model of the same name."""
ELSEWHERE = Limits(5e-2, 0.1)
"""On a processor of another maker the tree that wrote golden/ differs by up to 6e-3 of a value, in
figures of the smallest differences; a share of points, by one point of some hundred. On the newer
model a bow of 2e-5 mm differs by 4.5 % of itself."""
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")
# Those of cameras and pairs were written on another maker's processor (k1 of 0.004 by 3e-6 of it).
LIMITS = {name: Limits(1e-4, 1e-2) for name in ("camera", "stereo")}
WRITTEN_ELSEWHERE = {"hand-eye", "old"}
"""Written anew on another maker's processor, where all differs by more."""
# Its second recording repeats the first, so that the scatter is hardly determined: two ways of
# running it on one machine moved its sigmas by 5 %. Why is not known.
UNSETTLED = "hand-eye/several/"
ON_EDGE = "hand-eye/ball/"
"""Of whose 1,379 points the newer model leaves out one more, which moves hundredths of a sigma."""


def is_processor_of_golden() -> bool:
    """True where values must be the same to the last digits that are compared."""
    facts = Path("/proc/cpuinfo")
    text = facts.read_text("utf-8") if facts.exists() else ""
    return GOLDEN_PROCESSOR in text and OTHER_MODEL not in text


def is_rounding(one: Difference) -> bool:
    """True for texts of the same words whose numbers differ by a hundredth at most."""
    texts = (str(one.old), str(one.new))
    words = [NUMBER.sub("#", text) for text in texts]
    numbers = [[float(number) for number in NUMBER.findall(text)] for text in texts]
    if words[0] != words[1] or len(numbers[0]) != len(numbers[1]):
        return False
    return bool(np.allclose(*numbers, rtol=0.01, atol=0.0))


@pytest.mark.parametrize("group", GROUPS)
def test_nothing_that_a_command_writes_has_changed(group: str, tmp_path: Path) -> None:
    is_home = is_processor_of_golden() and group not in WRITTEN_ELSEWHERE
    limits = LIMITS.get(group, Limits(1e-6, 1e-2)) if is_home else ELSEWHERE
    found = [one for one in compare_group(group, tmp_path, limits) if not one.is_warning]
    wrong = [str(one) for one in found if UNSETTLED not in str(one)]
    if not is_home:
        wrong = [str(one) for one in found if not is_rounding(one)]
        wrong = [one for one in wrong if UNSETTLED not in one and ON_EDGE not in one]
    assert not wrong, "\n".join(wrong)


def test_texts_differ_by_more_than_rounding() -> None:
    near = Difference("a", "seen_from 9 [343.80, -30.89]", "seen_from 9 [343.81, -30.88]", False)
    far = Difference("a", "seen_from 9 [343.80, -30.89]", "seen_from 9 [349.80, -30.89]", False)
    other = Difference("a", "seen_from 9 [343.80]", "looked from 9 [343.80]", False)
    assert [is_rounding(one) for one in (near, far, other)] == [True, False, False]
