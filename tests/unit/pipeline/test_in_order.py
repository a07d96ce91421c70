# SPDX-License-Identifier: Apache-2.0
"""Items in a few threads: in order, few at a time, ended by the first error and by closing."""

import threading
import time
from collections.abc import Iterator

import pytest

from armscan.pipeline import progress
from armscan.pipeline.progress import in_order

WAIT_S = 30.0


@pytest.fixture(autouse=True)
def three_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "count_cores", lambda: 3)


def test_results_come_in_order_though_the_first_item_is_done_last() -> None:
    second_done = threading.Event()

    def work(item: int) -> int:
        if item == 0:
            assert second_done.wait(WAIT_S), "nothing else is worked on meanwhile"
        elif item == 1:
            second_done.set()
        return item * item

    assert list(in_order(work, range(7), 8)) == [(k, k * k) for k in range(7)]


@pytest.mark.parametrize("most_threads", [1, 2, 8])
def test_no_more_than_a_few_items_are_taken_ahead(most_threads: int) -> None:
    taken = []

    def items() -> Iterator[int]:
        for k in range(50):
            taken.append(k)
            yield k

    n_threads = min(3, most_threads)
    for n_back, (_item, _) in enumerate(in_order(lambda item: item, items(), most_threads), 1):
        assert len(taken) <= n_back + n_threads
    assert len(taken) == 50


@pytest.mark.parametrize("most_threads", [1, 8])
def test_the_first_error_ends_it_after_what_came_before(most_threads: int) -> None:
    def work(item: int) -> int:
        if item == 3:
            raise ValueError(item)
        return item

    results = in_order(work, range(9), most_threads)
    assert [next(results)[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="3"):
        next(results)


def test_closing_drops_what_waits() -> None:
    started: list[int] = []
    going_on = threading.Event()

    def work(item: int) -> int:
        started.append(item)
        if item:
            going_on.wait(WAIT_S)
        return item

    results = in_order(work, range(100), 2)
    assert next(results) == (0, 0)
    going_on.set()
    results.close()
    assert len(started) <= 4


def test_an_interrupt_does_not_wait_for_work_that_was_begun() -> None:
    release = threading.Event()
    under_way = threading.Event()

    def work(item: int) -> None:
        under_way.set()
        release.wait(WAIT_S)

    def items() -> Iterator[int]:
        yield 0
        assert under_way.wait(WAIT_S)
        raise KeyboardInterrupt

    try:
        start = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            list(in_order(work, items(), 2))
        assert time.monotonic() - start < 0.5 * WAIT_S
    finally:
        release.set()


@pytest.mark.parametrize("is_in_items", [True, False], ids=["items", "consumer"])
def test_an_error_waits_for_work_that_was_begun(is_in_items: bool) -> None:
    """It may use what the caller clears away next."""
    is_done = threading.Event()
    under_way = threading.Event()

    def work(item: int) -> None:
        if item:
            under_way.set()
            time.sleep(0.2)
            is_done.set()

    def items() -> Iterator[int]:
        yield from range(4)
        assert under_way.wait(WAIT_S)
        if is_in_items:
            raise ValueError("no more")

    def consume() -> None:
        for _ in in_order(work, items(), 2):
            assert under_way.wait(WAIT_S)
            raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        list(in_order(work, items(), 2)) if is_in_items else consume()
    assert is_done.is_set()
