# SPDX-License-Identifier: Apache-2.0
"""Images of a twin's scenes as PNG files, rendered one by one in several processes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeAlias, cast

import cv2

from armscan.devices.registry import load_driver
from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.errors import EstimationError
from armscan.pipeline.fewer_views import FewerViews
from armscan.storage.recording_images import encoded_png
from armscan.storage.recording_writer import written_session

IMAGES_A_PROCESS = 15
"""Fewer do not pay: a process takes some seconds before its first image."""

MostViews: TypeAlias = Mapping[TwinScene, int | None]
"""Scenes in order, with the most views of each that are wanted; None for all."""

_here: list[Scenes] = []
"""The scenes of a rendering process; empty in any other process."""


@dataclass(frozen=True, slots=True)
class TwinName:
    """What a twin is built from, in any process."""

    head: str
    preset: Preset
    seed: int

    def build(self) -> Twin:
        """Build it; the simulator is found by its name.

        Raises
        ------
        OptionError
            If there is no such head or preset.
        """
        driver = load_driver("twin")
        return cast(Twin, driver(head=self.head, preset=self.preset, seed=self.seed))


@dataclass(frozen=True, slots=True, eq=False)
class Scenes:
    """Scans of one twin's scenes, each planned when it is first asked for.

    Parameters
    ----------
    twin
        What is looked through.
    most_views
        The scenes.
    """

    twin: Twin
    most_views: MostViews
    _planned: dict[TwinScene, ScanSource] = field(default_factory=dict, init=False)

    def scan(self, scene: TwinScene) -> ScanSource:
        """The views of a scene that are wanted."""
        if scene not in self._planned:
            whole, most = self.twin.scan(scene), self.most_views[scene]
            self._planned[scene] = whole if most is None else FewerViews(whole, most)
        return self._planned[scene]

    def png(self, scene: TwinScene, row: int) -> bytes:
        """Render one exposure."""
        source = self.scan(scene)
        setup = written_session(source).cameras[source.rows[row].camera]
        return encoded_png(source.exposure(row), setup)


def rendered(name: TwinName, scenes: Scenes, processes: int) -> Generator[bytes]:
    """PNG files of all rows of all scenes, in order.

    Processes take image after image, whatever scene it is of, so that none waits for another's
    scene. When the generator is closed, or an interrupt ends it, so do they, without finishing
    their images.

    Parameters
    ----------
    name, scenes
        The twin, and what is wanted of it.
    processes
        Processes that render, if there are images enough; 1 renders in this one.

    Raises
    ------
    EstimationError
        If one of the processes came to an end.
    """
    rows = [(scene, k) for scene in scenes.most_views for k in range(len(scenes.scan(scene).rows))]
    n_processes = min(processes, max(1, len(rows) // IMAGES_A_PROCESS))
    if n_processes == 1:
        for scene, row in rows:
            yield scenes.png(scene, row)
        return
    spawn = get_context("spawn")
    listener, held = spawn.Pipe(duplex=False)
    given = (listener, name, dict(scenes.most_views))
    pool = ProcessPoolExecutor(n_processes, spawn, initializer=_start_rendering, initargs=given)
    try:
        with _deaf_children():
            images = pool.map(_render, rows)
        yield from images
    except BaseException as error:
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


def _start_rendering(listener: Connection, name: TwinName, most_views: MostViews) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(listener,), daemon=True).start()
    # the processes share the cores already
    cv2.setNumThreads(1)
    _here.append(Scenes(name.build(), most_views))


def _end_with(listener: Connection) -> None:
    """End this process, in the middle of an image, as soon as the other end is closed or gone."""
    try:
        listener.recv_bytes()
    except EOFError:
        os._exit(1)


def _render(row: tuple[TwinScene, int]) -> bytes:
    return _here[0].png(*row)
