# SPDX-License-Identifier: Apache-2.0
"""A scan whose lasers are chosen while it is taken: exposed, labelled, chosen again."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from armscan.devices.sources import SimulatedScan, TwinScene
from armscan.errors import InputError
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.instants import Instant, InstantImages
from armscan.pipeline.measure import MeasureOptions, measure_instants
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.scan import sensor_poses
from armscan.pipeline.simulate import SimulatedPart, TwinName, in_processes
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.labels import PASS_GAP_NS, StripeLabeller
from armscan.reconstruction.sync import exposure_poses
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session
from armscan.storage.recording import encoded_png, write_recording, written_session

Keep = Callable[[int, Exposure], None]
"""Told of every exposure that was taken, with its row."""
STAGE = "scan with chosen lasers"


@dataclass(frozen=True, slots=True)
class TakenPass:
    """Rows of one pass, in order of time, and the sources that were on in each."""

    rows: tuple[int, ...]
    lasers: tuple[tuple[str, ...], ...]


def scan_passes(rows: Sequence[ExposureRow], gap_ns: int = PASS_GAP_NS) -> tuple[range, ...]:
    """Rows of each pass: exposures in order of time without a pause longer than ``gap_ns``.

    Raises
    ------
    InputError
        If the rows are not in order of time.
    """
    starts = [0]
    for k in range(1, len(rows)):
        step = rows[k].t_ns - rows[k - 1].t_ns
        if step < 0:
            raise InputError(
                f"exposure {rows[k].index} was taken before the one that precedes it",
                remedy="give the exposures in order of time",
            )
        if step > gap_ns:
            starts.append(k)
    return tuple(
        range(first, stop) for first, stop in zip(starts, [*starts[1:], len(rows)], strict=True)
    )


def take_pass(
    scan: SimulatedScan,
    rows: Sequence[int],
    labeller: StripeLabeller,
    scanner: ScannerCalibration,
    *,
    keep: Keep | None = None,
) -> TakenPass:
    """Take one pass, exposure by exposure, with the lasers that the labeller asks for.

    Passes do not depend on each other, so that several processes may take one each.

    Parameters
    ----------
    scan
        What exposes.
    rows
        Rows of the pass, from `scan_passes`.
    labeller
        Forgets what it knew first.
    scanner
        The calibrated scanner.
    keep
        Told of every exposure.

    Raises
    ------
    InputError
        If the scanner has no camera, or as `exposure_poses`.
    EstimationError
        As `exposure_poses`.
    """
    if scanner.sensor is None:
        raise InputError("a scanner without camera has no stripes to label")
    poses = exposure_poses(scan.rows, scan.arm, scan.session.clock, scanner.latency_ns)
    base_from_sensor = sensor_poses(poses, scanner)
    lasers = []

    def exposures() -> Iterator[InstantImages]:
        for row in rows:
            lasers.append(labeller.next_lasers())
            exposure = scan.expose(row, lasers[-1])
            if keep is not None:
                keep(row, exposure)
            instant = Instant((row,), scan.rows[row].t_ns)
            yield InstantImages(((exposure, None),), base_from_sensor(instant), instant)

    labeller.reset()
    for _ in measure_instants(
        exposures(), labeller, scanner.sensor, MeasureOptions(), is_pass=True, reads_ahead=False
    ):
        """The labels of one exposure choose the lasers of the next."""
    return TakenPass(tuple(rows), tuple(lasers))


@dataclass(frozen=True, slots=True, eq=False)
class ChosenLasers:
    """A scan with the lasers that were chosen for its rows, as a source like any other.

    Written as a recording, its rows name their lasers, so that the same exposures are read and
    labelled again.

    Parameters
    ----------
    scan
        What exposes.
    lasers
        Sources that were on in each row.
    taken
        Exposures that are kept; others are taken again, which gives the same.
    """

    scan: SimulatedScan
    lasers: tuple[tuple[str, ...], ...]
    taken: Mapping[int, Exposure] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.lasers) != len(self.scan.rows):
            raise InputError(
                f"lasers of {len(self.lasers)} exposures for {len(self.scan.rows)} rows",
                where=self.scan.name,
            )

    @staticmethod
    def of_passes(scan: SimulatedScan, taken: Sequence[TakenPass]) -> ChosenLasers:
        """Join the passes of a scan.

        Raises
        ------
        InputError
            If they are not all its rows, each once.
        """
        lasers = {row: on for one in taken for row, on in zip(one.rows, one.lasers, strict=True)}
        if sorted(lasers) != list(range(len(scan.rows))):
            raise InputError(
                f"passes with {len(lasers)} of {len(scan.rows)} exposures", where=scan.name
            )
        return ChosenLasers(scan, tuple(lasers[row] for row in range(len(scan.rows))))

    @property
    def name(self) -> str:
        """Name of the scan."""
        return self.scan.name

    @property
    def session(self) -> Session:
        """Session of the scan."""
        return self.scan.session

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """Its rows, with the lasers that were on."""
        return tuple(
            replace(row, lasers=on) for row, on in zip(self.scan.rows, self.lasers, strict=True)
        )

    @property
    def arm(self) -> ArmTrack | None:
        """What the arm reported."""
        return self.scan.arm

    @property
    def is_simulated(self) -> bool:
        """As the scan."""
        return self.scan.is_simulated

    def exposure(self, row: int) -> Exposure:
        """The exposure of ``rows[row]`` with its pixels."""
        if row in self.taken:
            return self.taken[row]
        return self.scan.expose(row, self.lasers[row])


@dataclass(frozen=True, slots=True, eq=False)
class _Rig:
    """What takes passes in one process: a scene of a twin, of each pass its first exposures."""

    scan: SimulatedScan
    scanner: ScannerCalibration

    @staticmethod
    def of(
        name: TwinName, scene: TwinScene, scanner: ScannerCalibration, longest_pass: int | None
    ) -> _Rig:
        scan = name.build().scan(scene)
        if longest_pass is not None:
            kept = [row for rows in scan_passes(scan.rows) for row in rows[:longest_pass]]
            scan = SimulatedPart(scan, tuple(kept))
        return _Rig(scan, scanner)

    def take(self, rows: range) -> tuple[TakenPass, list[bytes]]:
        """Take one pass; its images as PNG files."""
        if self.scanner.sensor is None:
            raise ValueError("a scanner without sensor labels no stripes")
        setup = written_session(self.scan).cameras[0]
        images: list[bytes] = []
        taken = take_pass(
            self.scan,
            rows,
            CrossLabeller(self.scanner.sensor),
            self.scanner,
            keep=lambda _, exposure: images.append(encoded_png(exposure, setup)),
        )
        return taken, images


_here: list[_Rig] = []
"""What this process takes passes with; empty in any but a process of the pool."""


def record_adaptively(
    folder: Path,
    name: TwinName,
    scene: TwinScene,
    scanner: ScannerCalibration,
    *,
    longest_pass: int | None = None,
    processes: int = 2,
    progress: Progress = silent,
) -> None:
    """Take a scene of a twin with the lasers that the labelling asks for; write the recording.

    Parameters
    ----------
    folder
        Must not exist or be empty.
    name, scene
        The twin, and what it looks at.
    scanner
        The calibrated scanner.
    longest_pass
        Exposures that are taken of each pass, its first ones; None for all.
    processes
        Processes that take passes; 1 takes them in this one.
    progress
        Told of every pass.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    EstimationError
        If a process came to an end.
    """
    given = (name, scene, scanner, longest_pass)
    rig = _Rig.of(*given)
    ranges = scan_passes(rig.scan.rows)
    done: list[TakenPass] = []
    images: list[bytes] = []
    with closing(_taken(rig, ranges, processes, given)) as results:
        for taken, encoded in results:
            progress(ProgressEvent(STAGE, len(done), len(ranges), scene))
            done.append(taken)
            images += encoded
    progress(ProgressEvent(STAGE, len(ranges), len(ranges)))
    write_recording(folder, ChosenLasers.of_passes(rig.scan, done), encoded=images)


def _taken(
    rig: _Rig, ranges: Sequence[range], processes: int, given: tuple[Any, ...]
) -> Generator[tuple[TakenPass, list[bytes]]]:
    n_processes = min(processes, len(ranges))
    if n_processes > 1:
        yield from in_processes(_take, ranges, n_processes, _prepare, given)
        return
    yield from (rig.take(rows) for rows in ranges)


def _prepare(*given: Any) -> None:
    _here.append(_Rig.of(*given))


def _take(rows: range) -> tuple[TakenPass, list[bytes]]:
    return _here[0].take(rows)
