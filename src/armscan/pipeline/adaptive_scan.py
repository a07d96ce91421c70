# SPDX-License-Identifier: Apache-2.0
"""A scan whose lasers are chosen while it is taken: switched on, exposed, named, chosen again."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from armscan.devices.sources import SimulatedScan, TwinScene
from armscan.errors import InputError
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.scan_part import ScanPart
from armscan.pipeline.simulate import TwinName, in_processes
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.labels import STROKE_GAP_NS, LabelledProfile, StripeLabeller
from armscan.reconstruction.sync import ExposurePoses, exposure_poses
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session
from armscan.storage.recording import encoded_png, write_recording, written_session
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions

Keep = Callable[[int, Exposure], None]
"""Told of every exposure that was taken, with its row."""


@dataclass(frozen=True, slots=True, eq=False)
class TakenPass:
    """What one stroke of a hand gave.

    Parameters
    ----------
    rows
        Its rows of the scan, in order of time.
    lasers
        Sources that were on in each.
    named
        Its stripe points and their sheets.
    """

    rows: tuple[int, ...]
    lasers: tuple[tuple[str, ...], ...]
    named: tuple[LabelledProfile, ...]


def strokes(rows: Sequence[ExposureRow], gap_ns: int = STROKE_GAP_NS) -> tuple[range, ...]:
    """Rows of each stroke: exposures in order of time without a pause longer than ``gap_ns``.

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


def sensor_poses(
    scan: SimulatedScan, scanner: ScannerCalibration
) -> Callable[[int], Pose[Base, Sensor] | None]:
    """Where the sensor was in each row of a scan; None where the arm's pose is not known.

    Raises
    ------
    InputError, EstimationError
        As `exposure_poses`.
    """
    poses: ExposurePoses = exposure_poses(
        scan.rows, scan.arm, scan.session.clock, scanner.latency_ns
    )

    def pose(row: int) -> Pose[Base, Sensor] | None:
        if not poses.has_pose[row]:
            return None
        return poses.pose(row) @ scanner.hand_eye.tool_from_sensor

    return pose


def take_stroke(
    scan: SimulatedScan,
    rows: Sequence[int],
    namer: StripeLabeller,
    base_from_sensor: Callable[[int], Pose[Base, Sensor] | None],
    *,
    stripes: StripeOptions | None = None,
    keep: Keep | None = None,
) -> TakenPass:
    """Take one stroke, exposure by exposure, with the lasers that the namer asks for.

    Strokes do not depend on each other, so that several processes may take one each.

    Parameters
    ----------
    scan
        What exposes.
    rows
        Rows of the stroke, from `strokes`.
    namer
        Forgets what it knew first.
    base_from_sensor
        From `sensor_poses`.
    stripes
        Stripe extraction; defaults if None.
    keep
        Told of every exposure.
    """
    namer.reset()
    lasers, named = [], []
    for row in rows:
        lasers.append(namer.next_lasers())
        exposure = scan.expose(row, lasers[-1])
        if keep is not None:
            keep(row, exposure)
        profile = extract_stripes(exposure, stripes)
        named.append(namer.name(profile, lasers[-1], base_from_sensor(row), scan.rows[row].t_ns))
    return TakenPass(tuple(rows), tuple(lasers), tuple(named))


@dataclass(frozen=True, slots=True, eq=False)
class ChosenLasers:
    """A scan with the lasers that were chosen for its rows, as a source like any other.

    Written as a recording, its rows name their lasers, so that the same exposures are read and
    named again.

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
    def of_strokes(scan: SimulatedScan, taken: Sequence[TakenPass]) -> ChosenLasers:
        """Join the strokes of a scan.

        Raises
        ------
        InputError
            If they are not all its rows, each once.
        """
        lasers = {
            row: on for stroke in taken for row, on in zip(stroke.rows, stroke.lasers, strict=True)
        }
        if sorted(lasers) != list(range(len(scan.rows))):
            raise InputError(
                f"strokes with {len(lasers)} of {len(scan.rows)} exposures", where=scan.name
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


def scan_adaptively(
    scan: SimulatedScan,
    scanner: ScannerCalibration,
    namer: StripeLabeller,
    *,
    stripes: StripeOptions | None = None,
    keep: Keep | None = None,
) -> tuple[ChosenLasers, tuple[TakenPass, ...]]:
    """Take all strokes of a scan one after the other.

    Parameters
    ----------
    scan
        What exposes.
    scanner
        The calibrated scanner.
    namer
        Of the scanner's sensor.
    stripes
        Stripe extraction; defaults if None.
    keep
        Told of every exposure.

    Raises
    ------
    InputError, EstimationError
        As `exposure_poses`, and if the rows are not in order of time.
    """
    pose = sensor_poses(scan, scanner)
    taken = tuple(
        take_stroke(scan, rows, namer, pose, stripes=stripes, keep=keep)
        for rows in strokes(scan.rows)
    )
    return ChosenLasers.of_strokes(scan, taken), taken


STAGE = "scan with chosen lasers"


@dataclass(frozen=True, slots=True)
class _Taken:
    """A stroke with its images as PNG files."""

    stroke: TakenPass
    images: tuple[bytes, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Rig:
    """What takes strokes in one process."""

    scan: SimulatedScan
    scanner: ScannerCalibration

    def take(self, rows: range) -> _Taken:
        """Take one stroke, and keep its images."""
        scan, sensor = self.scan, self.scanner.sensor
        if sensor is None:
            raise ValueError("a scanner without sensor names no stripes")
        setup = written_session(scan).cameras[0]
        images: list[bytes] = []

        def keep(_row: int, exposure: Exposure) -> None:
            images.append(encoded_png(exposure, setup))

        pose = sensor_poses(scan, self.scanner)
        stroke = take_stroke(scan, rows, CrossLabeller(sensor), pose, keep=keep)
        return _Taken(stroke, tuple(images))


_here: list[_Rig] = []
"""What this process takes strokes with; empty in any but a process of the pool."""


def record_adaptively(
    folder: Path,
    name: TwinName,
    scene: TwinScene,
    scanner: ScannerCalibration,
    *,
    longest_stroke: int | None = None,
    processes: int = 2,
    progress: Progress = silent,
) -> None:
    """Take a scene of a twin with the lasers that the naming asks for, and write the recording.

    Parameters
    ----------
    folder
        Must not exist or be empty.
    name, scene
        The twin, and what it looks at.
    scanner
        The calibrated scanner.
    longest_stroke
        Exposures that are taken of each stroke, its first ones; None for all.
    processes
        Processes that take strokes; 1 takes them in this one.
    progress
        Told of every stroke.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    EstimationError
        If a process came to an end.
    """
    scan = _planned(name, scene, longest_stroke)
    pieces = strokes(scan.rows)
    done: list[_Taken] = []
    given = (name, scene, scanner, longest_stroke)
    with closing(_taken(pieces, processes, given)) as results:
        for taken in results:
            progress(ProgressEvent(STAGE, len(done), len(pieces), scene))
            done.append(taken)
    progress(ProgressEvent(STAGE, len(pieces), len(pieces)))
    chosen = ChosenLasers.of_strokes(scan, [taken.stroke for taken in done])
    write_recording(folder, chosen, encoded=[image for taken in done for image in taken.images])


_Given = tuple[TwinName, TwinScene, ScannerCalibration, int | None]
"""What a rig is made of, in any process."""


def _taken(pieces: Sequence[range], processes: int, given: _Given) -> Generator[_Taken]:
    n_processes = min(processes, len(pieces))
    if n_processes > 1:
        yield from in_processes(_take, pieces, n_processes, _prepare, given)
        return
    rig = _rig(*given)
    for rows in pieces:
        yield rig.take(rows)


def _planned(name: TwinName, scene: TwinScene, longest_stroke: int | None) -> SimulatedScan:
    """The scene, of each stroke as many exposures as are wanted."""
    whole = name.build().scan(scene)
    if longest_stroke is None:
        return whole
    kept = [row for rows in strokes(whole.rows) for row in rows[:longest_stroke]]
    return ScanPart(whole, tuple(kept))


def _rig(
    name: TwinName, scene: TwinScene, scanner: ScannerCalibration, longest_stroke: int | None
) -> _Rig:
    return _Rig(_planned(name, scene, longest_stroke), scanner)


def _prepare(*given: Any) -> None:
    _here.append(_rig(*given))


def _take(rows: range) -> _Taken:
    return _here[0].take(rows)
