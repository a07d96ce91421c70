# SPDX-License-Identifier: Apache-2.0
"""What was found in images, kept in a folder so that the next run need not look again.

An entry's name is the hash of all that it follows from: the image's pixels and how they are
read, the options, and the code that looks. Nothing is ever updated: another image, option or
version of the code is another name. An entry states its own hash and name; one that is cut,
changed, renamed or not understood counts as absent. The folder may be deleted at any time.
"""

from __future__ import annotations

import atexit
import hashlib
import io
import json
import os
import threading
import time
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias, get_args
from uuid import uuid4

import cv2
import numpy as np
from numpy.typing import NDArray

import armscan
from armscan.errors import InputError
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.vision.targets.target import CircleEdges, OtherCountSeen, TargetView

FOLDER_NAME = "armscan-cache"
SUFFIX = ".found"
MOST_BYTES = 2**30
"""The folder is trimmed to this: some thousand images; what was not used for longest goes."""
STALE_SECONDS = 3600.0
"""A temporary file that is older was left by a program that was stopped."""
CODE = ("vision", "kernels", "records", "geometry", "models")
"""Packages whose source an entry depends on."""
TAG = """Signature: 8a477f597d28d172789f06886806bc55
# Target and stripe points that armscan found in images, so that the next run is quicker.
# This folder may be deleted at any time.
"""

_WRITING = threading.Lock()
WAITED_S = 1.0
"""An interrupted program waits at most so long for the entry that is being written."""


@atexit.register
def end_writing() -> None:
    """Let no entry be cut: what is being written is finished, and no other begun."""
    _WRITING.acquire(timeout=WAITED_S)


Found: TypeAlias = TargetView | Profile | FitFailure
KEPT: Mapping[str, type[Any]] = {
    kind.__name__: kind for kind in (*get_args(Found), CircleEdges, OtherCountSeen)
}


@dataclass(frozen=True, slots=True)
class DetectionCache:
    """Entries in one folder, made when the first is kept; names of those given and kept."""

    folder: Path
    reused: set[str] = field(default_factory=set, compare=False, repr=False)
    made: set[str] = field(default_factory=set, compare=False, repr=False)

    @property
    def n_earlier(self) -> int:
        """Entries given that an earlier run had kept."""
        return len(self.reused - self.made)

    @classmethod
    def beside(cls, document: Path) -> DetectionCache:
        """The cache of all documents in one folder."""
        return cls(document.parent / FOLDER_NAME)

    def get(self, key: str) -> Found | None:
        """The entry of that name; None if there is none that can be trusted."""
        path = self.folder / f"{key}{SUFFIX}"
        try:
            found = _unpacked(path.read_bytes(), key)
        except OSError:
            return None
        if found is not None:
            self.reused.add(key)
            with suppress(OSError):
                os.utime(path)
        return found

    def put(self, key: str, found: Found) -> None:
        """Keep an entry; where the disk refuses, the next run looks again."""
        self.made.add(key)
        content = _packed(found, key)
        if content is None:
            return
        temporary = self.folder / f".{uuid4().hex}.part"
        try:
            with _WRITING:
                if not self.folder.is_dir():
                    self.folder.mkdir(exist_ok=True)
                    (self.folder / "CACHEDIR.TAG").write_text(TAG, "utf-8")
                temporary.write_bytes(content)
                temporary.replace(self.folder / f"{key}{SUFFIX}")
        except OSError:
            return
        finally:
            with suppress(OSError):
                temporary.unlink()

    def trim(self, most_bytes: int = MOST_BYTES) -> None:
        """Delete what was not used for longest until the folder is small enough."""
        with suppress(OSError):
            files = [(path.stat(), path) for path in self.folder.iterdir() if path.is_file()]
            entries = sorted(
                (stat.st_mtime, stat.st_size, path) for stat, path in files if path.suffix == SUFFIX
            )
            total = sum(size for _, size, _ in entries)
            for _, size, path in entries:
                if total <= most_bytes:
                    break
                path.unlink(missing_ok=True)
                total -= size
            for stat, path in files:
                if path.suffix == ".part" and time.time() - stat.st_mtime > STALE_SECONDS:
                    path.unlink(missing_ok=True)


def detection_key(
    what: str, exposure: Exposure, options: tuple[Any, ...], background: Exposure | None = None
) -> str:
    """Name of the entry of what is looked for in an image, and in the same without laser.

    Every pixel counts, and how they are read. ``options`` are frozen dataclasses of plain values.
    """
    digest = hashlib.sha256(f"{what}\n{code_version()}\n{options!r}\n".encode())
    for image in (exposure, background):
        if image is None:
            digest.update(b"none\n")
            continue
        facts = {
            item.name: getattr(image, item.name)
            for item in fields(image)
            if item.name not in ("image", "t_ns", "trigger_id", "view")
        }
        digest.update(f"{facts!r}{image.image.dtype}{image.image.shape}\n".encode())
        digest.update(image.image.data)
    return digest.hexdigest()


@cache
def code_version() -> str:
    """Hash of the code that looks: the sources of `CODE`, and the libraries' versions."""
    digest = hashlib.sha256()
    for name in ("armscan", "numpy", "scipy", "numba"):
        digest.update(f"{name} {version(name)}\n".encode())
    digest.update(f"opencv {cv2.__version__}\n".encode())
    root = Path(armscan.__file__).parent
    for path in sorted(path for package in CODE for path in (root / package).rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _packed(found: Found, key: str) -> bytes | None:
    """Content of an entry: the hash of the rest, then arrays and a description of the object."""
    arrays: dict[str, Any] = {}
    tree = _described(found, "found", arrays)
    if tree is None:
        return None
    buffer = io.BytesIO()
    arrays["description"] = np.array(json.dumps({"key": key, "found": tree}))
    np.savez(buffer, **arrays)
    content = buffer.getvalue()
    return hashlib.sha256(content).digest() + content


def _unpacked(data: bytes, key: str) -> Found | None:
    stated, content = data[:32], data[32:]
    if hashlib.sha256(content).digest() != stated:
        return None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        text = json.loads(str(arrays["description"]))
        found = _rebuilt(text["found"], arrays) if text["key"] == key else None
    except (ValueError, KeyError, TypeError, InputError, zipfile.BadZipFile):
        return None
    return found if isinstance(found, get_args(Found)) else None


def _described(value: Any, place: str, arrays: dict[str, Any]) -> dict[str, Any] | None:
    """JSON of a value, its arrays beside it; None for what this file does not know."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        arrays[place] = value
        return {"array": place}
    if value is None or type(value) in (bool, int, float, str):
        return {"value": value}
    if not (is_dataclass(value) and type(value).__name__ in KEPT):
        return None
    parts = {
        item.name: _described(getattr(value, item.name), f"{place}.{item.name}", arrays)
        for item in fields(value)
    }
    if any(part is None for part in parts.values()):
        return None
    return {"kind": type(value).__name__, "fields": parts}


def _rebuilt(tree: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Any:
    if "kind" in tree:
        parts = {name: _rebuilt(part, arrays) for name, part in tree["fields"].items()}
        return KEPT[tree["kind"]](**parts)
    return arrays[tree["array"]] if "array" in tree else tree["value"]
