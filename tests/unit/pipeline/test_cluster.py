# SPDX-License-Identifier: Apache-2.0
"""A scan extracted by the workers of a cluster is the scan extracted here."""

from __future__ import annotations

import os
import re
import shutil
import signal
import warnings
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from armscan.errors import ArmscanError, InputError, OptionError
from armscan.pipeline.cluster import extraction
from armscan.pipeline.cluster.extraction import Chunk, ClusterAddress, ClusterReader, extract_chunk
from armscan.pipeline.measure import cameras_of
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.scan import ScanReconstruction, measure_long_scan, scan_spool
from armscan.storage.clouds import ply_bytes
from armscan.storage.detection_cache import DetectionCache, code_version
from armscan.storage.recording import FolderRecording, read_recording, write_recording
from armscan.vision.stripe.image import StripeOptions
from rigs.scan_fake import as_source, fake_scan, scanner

N = 30
if not os.environ.get("CI"):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> FolderRecording:
    folder = tmp_path_factory.mktemp("cluster") / "scan"
    write_recording(folder, as_source(fake_scan(N)))
    return read_recording(folder)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A scheduler and two workers on this machine, each a process of its own."""
    distributed = import_module("distributed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        )
        yield found
        found.close()


def measured(
    recording: FolderRecording,
    address: str = "",
    *,
    progress: Progress = silent,
    cache: DetectionCache | None = None,
) -> tuple[ScanReconstruction, bytes]:
    device = scanner()
    assert device.sensor is not None
    reader = None
    if address:
        cameras = cameras_of(device.sensor)
        reader = ClusterReader(ClusterAddress(address), recording, cameras, StripeOptions(), cache)
    with scan_spool(device) as points, warnings.catch_warnings():
        warnings.simplefilter("ignore", category=ResourceWarning)
        scan = measure_long_scan(recording, device, points, progress=progress, reader=reader)
        return scan, ply_bytes(points.cloud())


def test_a_lost_worker_changes_nothing_and_what_was_found_is_kept(
    recording: FolderRecording, cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extraction, "CHUNK_INSTANTS", 2)
    monkeypatch.setattr(extraction, "AHEAD", 2)
    whole, content = measured(recording)
    killed: list[int] = []

    def kill(event: ProgressEvent) -> None:
        if event.done == 4 and not killed:
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    cache = DetectionCache(tmp_path / "kept")
    found, again = measured(recording, cluster.scheduler_address, progress=kill, cache=cache)
    assert killed
    assert again == content
    assert found.warnings == whole.warnings
    assert found.counts == whole.counts
    assert len(list(cache.folder.glob("*.found"))) == N


def test_an_image_that_no_worker_can_read_is_named(
    recording: FolderRecording, cluster: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "scan"
    shutil.copytree(recording.folder, folder)
    damaged = folder / recording.rows[3].source
    damaged.write_bytes(damaged.read_bytes()[:100])
    broken = read_recording(folder)
    here, content = measured(broken)
    there, again = measured(broken, cluster.scheduler_address)
    assert again == content
    assert there.unreadable == here.unreadable
    assert len(there.unreadable) == 1


def test_workers_with_other_code_are_refused(recording: FolderRecording) -> None:
    chunk = Chunk(recording.folder, (), (), (), StripeOptions(), None, "another")
    with pytest.raises(InputError, match="another version"):
        extract_chunk(chunk)
    assert extract_chunk(replace(chunk, version=code_version())) == []


@pytest.mark.parametrize("url", ["", "host", "host:8786", "http://host:1", "tcp://host"])
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(OptionError):
        ClusterAddress(url)


def test_a_cluster_that_does_not_answer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extraction, "CONNECT_SECONDS", 0.3)
    with pytest.raises(OptionError, match="no scheduler answers"):
        ClusterAddress("tcp://127.0.0.1:9").connect()


def test_a_worker_that_does_not_see_the_recording_is_refused(
    recording: FolderRecording, tmp_path: Path
) -> None:
    """Else each of its instants would be unreadable by itself, and the scan thinner."""
    chunk = Chunk(tmp_path / "unmounted", (), (), (), StripeOptions(), None, code_version())
    with pytest.raises(InputError, match="does not see the recording"):
        extract_chunk(chunk)
    assert extract_chunk(replace(chunk, folder=recording.folder)) == []


class _Failed:
    """A chunk that ended with an error, as Dask gives it."""

    status = "error"

    def __init__(self, error: Exception) -> None:
        self.error = error

    def done(self) -> bool:
        return True

    def exception(self) -> Exception:
        return self.error


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError("no room for 9 GB\nmore"), "failed: MemoryError: no room for 9 GB$"),
        (ValueError(), "failed: ValueError$"),
        (type("KilledWorker", (Exception,), {})("x"), "workers were lost"),
    ],
)
def test_what_failed_on_a_worker_is_named(
    recording: FolderRecording, error: Exception, told: str
) -> None:
    reader = ClusterReader(ClusterAddress("tcp://host:1"), recording, (), StripeOptions())
    with pytest.raises(ArmscanError) as caught:
        reader._next(None, deque([((), _Failed(error))]))
    assert re.search(told, caught.value.what)
