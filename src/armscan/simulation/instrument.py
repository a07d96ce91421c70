# SPDX-License-Identifier: Apache-2.0
"""The mechanical half of the presets, and all that one twin is made of."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.devices.twin import Preset
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.hand_path import Unsteadiness
from armscan.simulation.head import Head, build_head
from armscan.simulation.held_target import made_target
from armscan.simulation.measuring_arm import ArmErrors, MeasuringArm
from armscan.simulation.plate_probing import ProbeErrors
from armscan.simulation.stations import Bench


@dataclass(frozen=True, slots=True)
class Mechanics:
    """How good the arm and its probe are, and how steady the hand.

    Parameters
    ----------
    arm, probe, hand
        Sizes of their errors.
    exposure_s
        Exposure time during scans: what the hand does meanwhile blurs the image.
    target_mm
        Standard deviation by which each circle of the target misses its place along x and y.
    """

    arm: ArmErrors
    probe: ProbeErrors
    hand: Unsteadiness = field(default_factory=Unsteadiness)
    exposure_s: float = 1e-3
    target_mm: float = 0.0003
    """The thesis's target is true to 0.001 mm (5.2.1): three of these."""


MECHANICS: dict[Preset, Mechanics] = {
    "clean": Mechanics(
        ArmErrors(0.01, 0.0, 0.0, 0.0, 0.0), ProbeErrors(0.0, 0.0, 0.0), target_mm=0.0
    ),
    "thesis": Mechanics(ArmErrors(1.0, 1.0, 0.5, 0.25, 0.001), ProbeErrors(0.0015, 0.0015, 0.0005)),
    "harsh": Mechanics(
        ArmErrors(2.7, 2.7, 1.3, 0.7, 0.0025),
        ProbeErrors(0.003, 0.004, 0.001),
        Unsteadiness(tilt_deg=2.5, depth_mm=1.5, aside_mm=2.0, speed=0.4),
        exposure_s=2e-3,
        target_mm=0.001,
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """Head, arm, bench and calibration target of one twin.

    Parameters
    ----------
    head
        Camera, laser and mounting.
    arm
        True and believed.
    bench
        What stands around.
    target
        The print of the calibration target, as it was made.
    mechanics
        What they were drawn from.
    """

    head: Head
    arm: MeasuringArm
    bench: Bench
    target: CirclePattern
    mechanics: Mechanics

    @staticmethod
    def build(head: str, preset: Preset, seed: int) -> Instrument:
        """Draw one instrument; everything follows from the seed."""
        mechanics = MECHANICS[preset]
        return Instrument(
            head=build_head(head, preset, seed),
            arm=MeasuringArm.build(mechanics.arm, np.random.default_rng([seed, 2])),
            bench=Bench.build(preset, np.random.default_rng([seed, 3])),
            target=made_target(mechanics.target_mm, np.random.default_rng([seed, 4])),
            mechanics=mechanics,
        )
