# SPDX-License-Identifier: Apache-2.0
"""Work in a process: its result, its failures, and its end by a person or by the system."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from armscan.console.work import WorkCancelledError, Worker
from armscan.errors import EstimationError, OptionError
from armscan.pipeline.progress import ProgressEvent
from rigs.console_work import fail, halves, refuse, wait_for


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    found = Worker()
    yield found
    found.close()


def started(worker: Worker, mark: Path) -> tuple[threading.Thread, list[BaseException]]:
    """Begin work that lasts, and wait until it has begun."""
    errors: list[BaseException] = []
    begun = threading.Event()

    def run() -> None:
        try:
            worker.run(wait_for, mark, progress=lambda _: begun.set())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    assert begun.wait(60.0)
    return thread, errors


def test_gives_results_progress_and_errors_as_they_were_raised(worker: Worker) -> None:
    told: list[ProgressEvent] = []
    assert worker.run(halves, 7, progress=told.append) == 3.5
    assert told == [ProgressEvent("halve", 1, 1)]
    pid = worker.pid
    with pytest.raises(OptionError, match=r"^no such thing; take another\.$"):
        worker.run(refuse)
    with pytest.raises(EstimationError, match="a bug in armscan"):
        worker.run(fail)
    assert worker.run(halves, 4) == 2.0 and worker.pid == pid, "the process stays"


def test_cancelled_work_writes_nothing_and_the_next_runs(worker: Worker, tmp_path: Path) -> None:
    thread, errors = started(worker, tmp_path / "mark")
    with pytest.raises(EstimationError, match="under way"):
        worker.run(halves, 2)
    start = time.monotonic()
    worker.cancel()
    thread.join(10.0)
    assert time.monotonic() - start < 5.0
    assert isinstance(errors[0], WorkCancelledError)
    assert not (tmp_path / "mark").exists()
    assert worker.run(halves, 2) == 1.0


def test_a_killed_process_is_told_and_the_next_work_runs(worker: Worker, tmp_path: Path) -> None:
    thread, errors = started(worker, tmp_path / "mark")
    os.kill(worker.pid, signal.SIGKILL)
    thread.join(10.0)
    assert isinstance(errors[0], EstimationError) and "nothing was written" in str(errors[0])
    assert worker.run(halves, 2) == 1.0
