# SPDX-License-Identifier: Apache-2.0
"""Images of a twin's scenes as PNG files, rendered one by one in several processes."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias, cast

from armscan.devices.registry import load_driver
from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.pipeline.child_processes import in_processes
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
    given = (name, dict(scenes.most_views))
    yield from in_processes(_render, rows, n_processes, _start_rendering, given)


def _start_rendering(name: TwinName, most_views: MostViews) -> None:
    _here.append(Scenes(name.build(), most_views))


def _render(row: tuple[TwinScene, int]) -> bytes:
    return _here[0].png(*row)
