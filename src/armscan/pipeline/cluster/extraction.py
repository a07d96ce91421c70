# SPDX-License-Identifier: Apache-2.0
"""Stripes of a recording extracted by the workers of a Dask cluster.

Chunks of instants go out, profiles come back and are taken in order of time: names, points and the
cloud are made here, as without a cluster, and are the same to the last bit. A chunk whose worker
is lost is done again by another. Few chunks are under way, so that memory does not grow.
"""

from __future__ import annotations

import platform
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

from armscan.errors import ArmscanError, InputError, OptionError
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.camera import CameraModel
from armscan.pipeline.instants import Instant, InstantImages, ScanInstants
from armscan.pipeline.measure import extract_profile
from armscan.pipeline.progress import Progress, ProgressEvent
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.records.recording import CameraSetup, ExposureRow
from armscan.storage.detection_cache import DetectionCache, code_version
from armscan.storage.files import is_file
from armscan.storage.recording import FolderRecording, read_recorded
from armscan.storage.recording_session import EXPOSURES_FILE
from armscan.vision.stripe.image import StripeOptions

CHUNK_INSTANTS = 8
"""Instants of a chunk: long enough to send, short enough to do again."""
AHEAD = 3
"""Chunks under way for each thread of a worker."""
CONNECT_SECONDS, LOOK_SECONDS, LOST_SECONDS = 10.0, 2.0, 30.0
"""Until the cluster must answer, between looks at its workers, and until it counts as lost when it
has none."""
WHERE = "--cluster"
RowPair: TypeAlias = tuple[ExposureRow, ExposureRow | None]


@dataclass(frozen=True, slots=True)
class ClusterAddress:
    """Of a Dask scheduler, as ``tcp://host:8786``.

    Raises
    ------
    OptionError
        If it is no address, or the extra ``cluster`` is not installed.
    """

    url: str

    def __post_init__(self) -> None:
        kind, _, rest = self.url.partition("://")
        if kind not in ("tcp", "tls", "ws", "wss") or ":" not in rest:
            raise OptionError(
                f"'{self.url}' is no address of a scheduler",
                where=WHERE,
                remedy="give tcp://HOST:PORT, as `dask scheduler` prints it",
            )

    def connect(self) -> Any:
        """A client of the cluster.

        Raises
        ------
        OptionError
            If Dask is not installed, nothing answers, or there is no worker.
        """
        try:
            distributed = import_module("distributed")
        except ImportError as error:
            raise OptionError(
                "Dask is not installed", where=WHERE, remedy="pip install 'armscan[cluster]'"
            ) from error
        try:
            client = distributed.Client(self.url, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise OptionError(
                "no scheduler answers there",
                where=f"{WHERE} {self.url}",
                remedy="start one with `dask scheduler` and workers with `dask worker`",
            ) from error
        if not _n_threads(client):
            client.close()
            raise OptionError(
                "the cluster has no worker",
                where=f"{WHERE} {self.url}",
                remedy="start workers with `dask worker`, where armscan is installed",
            )
        return client


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Instants that one worker does in one go.

    Parameters
    ----------
    folder
        Of the recording, as every worker sees it.
    instants
        Rows of each instant, one a camera, with those of their backgrounds.
    setups, cameras
        How each camera of the recording was set, and as calibrated.
    stripes
        Stripe extraction.
    cache
        Keeps stripes in a folder that every worker sees; None to keep none.
    version
        Of the code that must do it.
    """

    folder: Path
    instants: tuple[tuple[RowPair, ...], ...]
    setups: tuple[CameraSetup, ...]
    cameras: tuple[CameraModel, ...]
    stripes: StripeOptions
    cache: DetectionCache | None
    version: str


Found: TypeAlias = "tuple[Profile, ...] | ArmscanError"


def extract_chunk(chunk: Chunk) -> list[Found]:
    """Stripes of each instant, or why it could not be read; runs on a worker.

    Raises
    ------
    InputError
        If the worker has other code, does not see the recording's folder, or an image is not of
        its camera's sensor.
    """
    if code_version() != chunk.version:
        raise InputError(
            "a worker of the cluster runs another version of armscan or of its libraries",
            where=WHERE,
            remedy="install the same ones everywhere",
        )
    if not is_file(chunk.folder / EXPOSURES_FILE):
        raise InputError(
            f"the worker on {platform.node()} does not see the recording",
            where=str(chunk.folder),
            remedy="put it in a folder that every worker sees under the same path",
        )
    dark: dict[int, tuple[ExposureRow, Exposure]] = {}

    def read(row: ExposureRow) -> Exposure:
        return read_recorded(chunk.folder, row, chunk.setups[row.camera])

    def background(row: ExposureRow | None) -> Exposure | None:
        if row is None:
            return None
        if row.camera not in dark or dark[row.camera][0] != row:
            dark[row.camera] = (row, read(row))
        return dark[row.camera][1]

    found: list[Found] = []
    for pairs in chunk.instants:
        try:
            images = [(read(lit), background(off)) for lit, off in pairs]
        except ArmscanError as error:
            found.append(error)
            continue
        found.append(
            tuple(
                extract_profile(pair, camera, chunk.stripes, chunk.cache)
                for pair, camera in zip(images, chunk.cameras, strict=True)
            )
        )
    return found


@dataclass(frozen=True, slots=True, eq=False)
class ClusterReader:
    """Reads the instants of a recording by workers, as `ScanInstants.read` reads them here.

    Parameters
    ----------
    address
        Of the cluster.
    recording
        In a folder that every worker sees under the same path.
    cameras, stripes, cache
        As of `Chunk`.
    """

    address: ClusterAddress
    recording: FolderRecording
    cameras: tuple[CameraModel, ...]
    stripes: StripeOptions
    cache: DetectionCache | None = None

    def read(
        self,
        scan: ScanInstants,
        instants: Sequence[Instant],
        stage: str,
        progress: Progress,
        base_from_sensor: Callable[[Instant], Pose[Base, Sensor] | None],
    ) -> Iterator[InstantImages]:
        """Instants in order, with profiles and without pixels; what cannot be read is kept in
        ``scan.unreadable``.

        Raises
        ------
        OptionError
            If the cluster does not answer, or all workers are lost.
        InputError
            If a worker has other code, or an image is not of its camera's sensor.
        """
        done, rows = 0, self.recording.rows
        for chunk, results in self._results(scan, instants):
            for one, found in zip(chunk, results, strict=True):
                row = rows[one.rows[0]]
                progress(ProgressEvent(stage, done, len(instants), row.source))
                done += 1
                if isinstance(found, ArmscanError):
                    scan.unreadable.update(dict.fromkeys(one.rows, str(found)))
                    continue
                yield InstantImages((), base_from_sensor(one), one, profiles=found)
        progress(ProgressEvent(stage, done, len(instants)))

    def _results(
        self, scan: ScanInstants, instants: Sequence[Instant]
    ) -> Iterator[tuple[tuple[Instant, ...], list[Found]]]:
        with ExitStack() as stack:
            client = stack.enter_context(self.address.connect())
            pending: deque[tuple[tuple[Instant, ...], Any]] = deque()
            stack.callback(lambda: client.cancel([future for _, future in pending]))
            most = AHEAD * _n_threads(client)
            for first in range(0, len(instants), CHUNK_INSTANTS):
                chunk = tuple(instants[first : first + CHUNK_INSTANTS])
                future = client.submit(extract_chunk, self._chunk(scan, chunk), pure=False)
                pending.append((chunk, future))
                if len(pending) >= most:
                    yield self._next(client, pending)
            while pending:
                yield self._next(client, pending)

    def _next(
        self, client: Any, pending: deque[tuple[tuple[Instant, ...], Any]]
    ) -> tuple[tuple[Instant, ...], list[Found]]:
        """Wait for the first chunk; the others go on meanwhile."""
        chunk, future = pending[0]
        seen = time.monotonic()
        while not future.done():
            time.sleep(0.002)
            if time.monotonic() - seen < LOOK_SECONDS:
                continue
            if _n_threads(client):
                seen = time.monotonic()
            elif time.monotonic() - seen > LOST_SECONDS:
                raise self._lost()
        if future.status != "finished":
            error = future.exception() if future.status == "error" else None
            raise self._failure(error) from error
        results: list[Found] = future.result()
        pending.popleft()
        return chunk, results

    def _failure(self, error: BaseException | None) -> ArmscanError:
        if isinstance(error, ArmscanError):
            return error
        # Dask's own name for work whose workers died again and again
        if error is None or type(error).__name__ == "KilledWorker":
            return self._lost()
        text = str(error).strip().partition("\n")[0]
        return InputError(
            f"a worker of the cluster failed: {type(error).__name__}" + f": {text}" * bool(text),
            where=f"{WHERE} {self.address.url}",
            remedy="see what the workers say; without --cluster the scan is done here",
        )

    def _lost(self) -> OptionError:
        return OptionError(
            "the cluster's workers were lost",
            where=f"{WHERE} {self.address.url}",
            remedy="see what they say, and run again: stripes that were found are kept",
        )

    def _chunk(self, scan: ScanInstants, instants: Sequence[Instant]) -> Chunk:
        rows = self.recording.rows

        def pair(row: int) -> RowPair:
            dark = scan.background_row(row)
            return rows[row], None if dark is None else rows[dark]

        kept = self.cache
        return Chunk(
            self.recording.folder.resolve(),
            tuple(tuple(pair(row) for row in one.rows) for one in instants),
            tuple(self.recording.session.cameras),
            self.cameras,
            self.stripes,
            None if kept is None else replace(kept, folder=kept.folder.resolve()),
            code_version(),
        )


def _n_threads(client: Any) -> int:
    """Threads of all workers."""
    return sum(client.nthreads().values())
