# SPDX-License-Identifier: Apache-2.0
"""Where the demo's scans come from: rendered when they are read, or recorded first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Twin, TwinScene
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.adaptive_scan import scan_adaptively
from armscan.pipeline.fewer_views import FewerViews
from armscan.pipeline.progress import Progress
from armscan.reconstruction.identify_cross import CrossNamer
from armscan.records.exposure import Exposure


class TwinScans(Protocol):
    """Gives the scans of a twin, in the order in which the chain asks for them."""

    def calibration(self, scene: TwinScene) -> ScanSource:
        """A scan that a calibration rests on."""

    def scanned(
        self, scene: TwinScene, scanner: ScannerCalibration, progress: Progress
    ) -> ScanSource:
        """A scan by hand with the calibrated scanner, which may choose its lasers meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedScans:
    """Scans in memory; pixels are rendered when an exposure is asked for.

    Parameters
    ----------
    twin
        The simulated instrument.
    most_views
        Views of a scene that are used, evenly chosen; scenes that are not named are used whole.
    """

    twin: Twin
    most_views: Mapping[TwinScene, int] = field(default_factory=dict)

    def calibration(self, scene: TwinScene) -> ScanSource:
        """See `TwinScans`."""
        whole, most = self.twin.scan(scene), self.most_views.get(scene)
        return whole if most is None else FewerViews(whole, most)

    def scanned(
        self, scene: TwinScene, scanner: ScannerCalibration, progress: Progress
    ) -> ScanSource:
        """See `TwinScans`."""
        sensor = scanner.sensor
        if len(self.twin.sources) < 2 or scene == "still-step" or sensor is None:
            return self.calibration(scene)
        taken: dict[int, Exposure] = {}
        namer = CrossNamer(sensor)
        chosen, _ = scan_adaptively(self.twin.scan(scene), scanner, namer, keep=taken.__setitem__)
        return replace(chosen, taken=taken)
