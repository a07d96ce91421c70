# SPDX-License-Identifier: Apache-2.0
"""Work shared among processes that end when this one does, however it ends."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import cv2

from armscan.errors import EstimationError

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    processes: int,
    prepare: Callable[..., None],
    given: tuple[Any, ...],
) -> Generator[Result]:
    """Results of ``work`` on every item, in order.

    When the generator is closed, or an interrupt ends it, the processes end too, without finishing
    their items.

    Parameters
    ----------
    work
        A function of a module, so that other processes find it.
    items
        What it is called with, one after the other.
    processes
        How many share the work.
    prepare, given
        Called in every process first, with these arguments.

    Raises
    ------
    EstimationError
        If one of the processes came to an end.
    """
    spawn = get_context("spawn")
    listener, held = spawn.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        processes, spawn, initializer=_begin, initargs=(listener, prepare, given)
    )
    try:
        with _deaf_children():
            results = pool.map(work, items)
        yield from results
    except BaseException as error:
        # the pool forgets what waits before its processes end: it cannot fail what is cancelled
        pool.shutdown(wait=False, cancel_futures=True)
        held.close()
        if isinstance(error, BrokenProcessPool):
            raise EstimationError(
                "a process that rendered images came to an end",
                remedy="free some memory, or let one process render",
            ) from error
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        held.close()
        listener.close()


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Processes that are started meanwhile never hear an interrupt; this one hears it afterwards.

    It is for the process that waits, which ends the others.
    """
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(listener: Connection, prepare: Callable[..., None], given: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(listener,), daemon=True).start()
    # the processes share the cores already
    cv2.setNumThreads(1)
    prepare(*given)


def _end_with(listener: Connection) -> None:
    """End this process, in the middle of an item, as soon as the other end is closed or gone."""
    try:
        listener.recv_bytes()
    except EOFError:
        os._exit(1)
