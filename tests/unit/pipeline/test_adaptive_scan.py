# SPDX-License-Identifier: Apache-2.0
"""Lasers chosen while a scan is taken: what is asked for is exposed, passes stay apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from armscan.devices.sources import TrueStripe
from armscan.errors import InputError
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.pipeline.adaptive_scan import (
    ChosenLasers,
    TakenPass,
    scan_passes,
    take_pass,
)
from armscan.reconstruction.labels import (
    PASS_GAP_NS,
    LabelledInstant,
    LabelledProfile,
    PointStatus,
)
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.records.recording import ArmTrack, ExposureRow, Session
from rigs.placing_rig import BASE_FROM_TOOL, TOOL_FROM_SENSOR, scanner

TICK_NS = 12_500_000
TIMES_NS = [*(k * TICK_NS for k in range(4)), *(10**9 + k * TICK_NS for k in range(3))]
BOTH = ("A", "B")


def rows() -> tuple[ExposureRow, ...]:
    return tuple(
        ExposureRow(index=k, t_ns=t_ns, camera=0, source=f"{k}.png", lasers=BOTH, trigger_id=k + 1)
        for k, t_ns in enumerate(TIMES_NS)
    )


@dataclass
class DarkScan:
    """A scan of nothing that remembers what it was asked to expose."""

    asked: list[tuple[int, tuple[str, ...]]] = field(default_factory=list)
    name: str = "dark"
    session: Session = field(default_factory=Session)
    is_simulated: bool = True
    rows: tuple[ExposureRow, ...] = field(default_factory=rows)

    @property
    def arm(self) -> ArmTrack:
        n = len(TIMES_NS)
        pose = np.tile(BASE_FROM_TOOL.rotation, (n, 1, 1))
        place = np.tile(BASE_FROM_TOOL.translation_mm, (n, 1))
        known = np.arange(n) != 2
        ids = np.arange(1, n + 1)
        return ArmTrack(
            t_ns=np.array(TIMES_NS),
            rotations=pose,
            translations_mm=place,
            is_known=known,
            trigger_ids=ids,
        )

    def exposure(self, row: int) -> Exposure:
        return self.expose(row, self.rows[row].lasers)

    def expose(self, row: int, lasers: tuple[str, ...]) -> Exposure:
        self.asked.append((row, lasers))
        image = np.full((1536, 2048), 4, np.uint8)
        return Exposure(image, f"{row}.png", lasers=lasers, t_ns=self.rows[row].t_ns)

    def true_stripes(self, row: int) -> Sequence[TrueStripe]:
        return ()


@dataclass
class Counting:
    """Asks for A in the first exposure of a stroke, else for both; notes what it is told."""

    told: list[tuple[tuple[str, ...], bool, int]] = field(default_factory=list)
    n_since_reset: int = 0

    def label(
        self,
        profiles: Sequence[Profile],
        lasers: tuple[str, ...] = (),
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> LabelledInstant:
        (profile,) = profiles
        self.n_since_reset += 1
        self.told.append((lasers, base_from_sensor is not None, t_ns))
        if base_from_sensor is not None:
            expected = BASE_FROM_TOOL @ TOOL_FROM_SENSOR
            assert np.allclose(base_from_sensor.matrix, expected.matrix)
        n = len(profile)
        status = np.full(n, int(PointStatus.AMBIGUOUS))
        labelled = LabelledProfile(profile=profile, sheet=np.full(n, -1), status=status, reason="")
        return LabelledInstant((labelled,))

    def next_lasers(self) -> tuple[str, ...]:
        return ("A",) if self.n_since_reset == 0 else BOTH

    def left_out(self, lasers: tuple[str, ...]) -> str:
        return ""

    def reset(self) -> None:
        self.n_since_reset = 0


EXPECTED = (("A",), BOTH, BOTH, BOTH, ("A",), BOTH, BOTH)


def test_passes_end_at_pauses() -> None:
    assert scan_passes(rows()) == (range(4), range(4, 7))
    assert scan_passes(rows(), gap_ns=TICK_NS - 1) == tuple(range(k, k + 1) for k in range(7))
    gap = [replace(row, t_ns=k * PASS_GAP_NS) for k, row in enumerate(rows())]
    assert scan_passes(gap) == (range(7),)
    with pytest.raises(InputError, match="order of time"):
        scan_passes(rows()[::-1])


def test_what_the_namer_asks_for_is_exposed_and_named() -> None:
    scan, namer = DarkScan(), Counting()
    kept: list[int] = []
    taken = [
        take_pass(scan, r, namer, scanner(), keep=lambda row, exposure: kept.append(row))
        for r in scan_passes(scan.rows)
    ]
    chosen = ChosenLasers.of_passes(scan, taken)
    assert tuple(on for _, on in scan.asked) == EXPECTED
    assert [t_ns for *_, t_ns in namer.told] == TIMES_NS
    # the arm's pose of row 2 is not known: the namer is told so, nothing is made up
    assert [has_pose for _, has_pose, _ in namer.told] == [k != 2 for k in range(7)]
    assert chosen.lasers == EXPECTED
    assert kept == list(range(7))


def test_passes_can_be_taken_in_any_order() -> None:
    scan = DarkScan()
    taken = [take_pass(scan, r, Counting(), scanner()) for r in scan_passes(scan.rows)[::-1]]
    assert [one.lasers for one in taken] == [EXPECTED[4:], EXPECTED[:4]]
    assert ChosenLasers.of_passes(scan, taken).lasers == EXPECTED


def test_the_rows_of_the_result_name_their_lasers_and_are_exposed_so() -> None:
    scan = DarkScan()
    chosen = ChosenLasers(scan, EXPECTED, {1: scan.expose(1, BOTH)})
    scan.asked.clear()
    assert tuple(row.lasers for row in chosen.rows) == EXPECTED
    assert [replace(row, lasers=BOTH) for row in chosen.rows] == list(scan.rows)
    assert chosen.exposure(4).lasers == ("A",)
    assert chosen.exposure(1).lasers == BOTH
    assert scan.asked == [(4, ("A",))]
    assert chosen.is_simulated
    assert chosen.name == "dark"


def test_missing_passes_and_rows_are_refused() -> None:
    scan = DarkScan()
    with pytest.raises(InputError, match="lasers of 1 exposures for 7 rows"):
        ChosenLasers(scan, (BOTH,))
    part = TakenPass((0, 1), (BOTH, BOTH))
    with pytest.raises(InputError, match="2 of 7"):
        ChosenLasers.of_passes(scan, [part])
