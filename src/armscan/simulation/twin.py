# SPDX-License-Identifier: Apache-2.0
"""The digital twin: head, arm and bench as one instrument, drawn from one seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast, get_args

import numpy as np

from armscan.devices.twin import Preset, TwinScene
from armscan.errors import OptionError
from armscan.records.session import SessionKind
from armscan.simulation.arm_scenes import (
    Recorded,
    hand_eye_scene,
    marker_scene,
    scan_scene,
    still_step_scene,
)
from armscan.simulation.head import HEADS
from armscan.simulation.held_target import TARGET
from armscan.simulation.instrument import Instrument
from armscan.simulation.plate_probing import PlateProbing, probe_plate
from armscan.simulation.scan_plan import SweptScene
from armscan.simulation.target_scenes import camera_shots, laser_shots
from armscan.simulation.twin_scan import TwinScan
from armscan.simulation.twin_truth import InstrumentTruth

_SCENES: tuple[TwinScene, ...] = get_args(TwinScene)
_PLAN, _NOISE, _PROBING = 10, 11, 12
"""Streams of random numbers, besides those that the instrument is drawn from."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedInstrument:
    """See `armscan.devices.twin.Twin`.

    Parameters
    ----------
    instrument
        What it is made of.
    preset, seed
        What that was drawn from.
    """

    instrument: Instrument
    preset: Preset
    seed: int

    @property
    def head(self) -> str:
        """Name of the head."""
        return self.instrument.head.name

    @property
    def target(self) -> str:
        """The calibration target as the command line names it."""
        return TARGET

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the laser sources, each switched by itself."""
        return self.instrument.head.sources

    @property
    def truth(self) -> InstrumentTruth:
        """What it was made from."""
        return InstrumentTruth(self.instrument, self.preset, self.seed)

    def scan(self, scene: TwinScene) -> TwinScan:
        """The recording of one scene; pixels are rendered when an exposure is asked for.

        Raises
        ------
        OptionError
            If there is no such scene, or if it gives no images, as ``probing``.
        """
        images = tuple(name for name in _SCENES if name != "probing")
        if scene not in images:
            raise OptionError(
                f"the twin has no images of a scene '{scene}'",
                remedy=f"choose one of: {', '.join(images)}",
            )
        number = _SCENES.index(scene)
        rng = np.random.default_rng([self.seed, _PLAN, number])
        name = f"{self.head} {self.preset} {scene}"
        noise = (self.seed, _NOISE, number)
        head = self.instrument.head
        if scene in ("camera", "laser"):
            shots_of = camera_shots if scene == "camera" else laser_shots
            shots = shots_of(head, self.instrument.target, rng)
            return TwinScan(name, "calibration", head, shots, None, noise)
        shots, track = self._with_arm(scene, rng)
        kind: SessionKind = "calibration" if scene == "hand-eye" else "scan"
        return TwinScan(name, kind, head, shots, track, noise)

    def probe_plate(self) -> PlateProbing:
        """Touch the plate of the scene ``hand-eye``."""
        rng = np.random.default_rng([self.seed, _PROBING])
        tools = self.instrument
        return probe_plate(tools.arm, tools.bench, tools.mechanics.probe, rng)

    def _with_arm(self, scene: TwinScene, rng: np.random.Generator) -> Recorded:
        tools = self.instrument
        if scene == "hand-eye":
            return hand_eye_scene(tools, rng)
        if scene == "still-step":
            return still_step_scene(tools, rng)
        if scene in ("markers", "markers-moved"):
            return marker_scene(tools, scene == "markers-moved", rng)
        return scan_scene(tools, cast(SweptScene, scene), rng)


def build_twin(
    head: str = "thesis-single", preset: Preset = "thesis", seed: int = 1
) -> SimulatedInstrument:
    """Draw one instrument.

    Parameters
    ----------
    head
        Kind of the head.
    preset
        How good it is and how kind the surroundings are.
    seed
        Everything random follows from it.

    Raises
    ------
    OptionError
        If there is no such head or preset, or if the seed is negative.
    """
    if head not in HEADS:
        raise OptionError(
            f"no simulated head is called '{head}'", remedy=f"choose one of: {', '.join(HEADS)}"
        )
    if preset not in get_args(Preset):
        raise OptionError(
            f"no preset is called '{preset}'",
            remedy=f"choose one of: {', '.join(get_args(Preset))}",
        )
    if seed < 0:
        raise OptionError(f"seed {seed} is negative", remedy="give 0 or more")
    return SimulatedInstrument(Instrument.build(head, preset, seed), preset, seed)
