# SPDX-License-Identifier: Apache-2.0
"""What a calibration saw, in one ``.npz``: enough to solve again and to draw, without pixels.

The records of one kind are one after the other in arrays ``KIND_FIELD``; ``KIND_n_points`` says how
many rows each has. Numbers, texts and poses have an entry a record.
"""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.errors import FileFormatError, InputError
from armscan.geometry.poses import Pose
from armscan.records.profile import Profile
from armscan.storage.files import path_text, read_bytes
from armscan.vision.targets.target import TargetView

R = TypeVar("R")
Arrays = Mapping[str, NDArray[Any]]

MOST_BYTES = 512 * 2**20
"""Of all arrays together; a file of some megabytes may claim any size."""
MOST_RECORDS = 1_000_000
NOT_KEPT = {TargetView: ("edges",), PosedStripe: ("by_sensor",)}
"""Fields that follow from the rest, or that nothing needs again: the derivatives of a stripe's
points follow from the points, their sheets and the sensor."""
DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError, InputError, OSError, EOFError),
    *(ValueError, TypeError, KeyError, IndexError, OverflowError, SyntaxError, RecursionError),
    *(NotImplementedError, RuntimeError, MemoryError),
)
"""What the libraries raise for content that is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What images showed.

    Parameters
    ----------
    views
        Target points of each image, without the edge points of circles.
    profiles
        Stripe points, one profile a view where there are any.
    sha256
        Hash of the image of each source name.
    stripes
        Points of a hand-eye's exposures in the Sensor frame, with the arm's poses and without
        derivatives.
    """

    views: tuple[TargetView, ...] = ()
    profiles: tuple[Profile, ...] = ()
    sha256: Mapping[str, str] | None = None
    stripes: tuple[PosedStripe, ...] = ()


def pack_observations(
    views: Sequence[TargetView] = (),
    profiles: Sequence[Profile] = (),
    sha256: Mapping[str, str] | None = None,
    *,
    stripes: Sequence[PosedStripe] = (),
) -> bytes:
    """Content of the ``.npz`` file; see `Observations`."""
    hashes = {} if sha256 is None else sha256
    arrays: dict[str, NDArray[Any]] = {
        "image_source": np.array(list(hashes), dtype=np.str_),
        "image_sha256": np.array(list(hashes.values()), dtype=np.str_),
        **_packed("view", views),
        **_packed("profile", profiles),
    }
    if stripes:
        arrays |= _packed("stripe", stripes)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def read_observations(path: Path) -> Observations:
    """Read what `pack_observations` wrote.

    Raises
    ------
    FileFormatError
        If the file is cut short, damaged, too large or is no such file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
            if sum(item.file_size for item in archive.infolist()) > MOST_BYTES:
                raise ValueError("too large")
            arrays = {
                name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()
            }
        hashes = zip(arrays["image_source"], arrays["image_sha256"], strict=True)
        return Observations(
            views=_unpacked(TargetView, "view", arrays),
            profiles=_unpacked(Profile, "profile", arrays),
            sha256={str(source): str(digest) for source, digest in hashes},
            stripes=_unpacked(PosedStripe, "stripe", arrays),
        )
    except DAMAGE as error:
        raise FileFormatError(
            "this is not a complete file of observations",
            where=path_text(path),
            remedy="copy the file again, or calibrate again",
        ) from error


def _array(content: bytes) -> NDArray[Any]:
    """Array of an ``.npy`` file, once its header claims no more than there is."""
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("another version of .npy")
    shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    if kind.kind not in "biufU" or math.prod(shape) * kind.itemsize > len(content):
        raise ValueError("an array larger than its file")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _kept(kind: type[Any]) -> dict[str, Any]:
    """Fields of a record and their types."""
    hints = get_type_hints(kind)
    return {
        item.name: hints[item.name]
        for item in fields(kind)
        if item.name not in NOT_KEPT.get(kind, ())
    }


def _packed(word: str, records: Sequence[Any]) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {
        f"{word}_n_points": np.array([len(record) for record in records], dtype=np.int64),
        f"{word}_source": np.array([record.source for record in records], dtype=np.str_),
    }
    for name, hint in _kept(type(records[0])).items() if records else ():
        values = [getattr(record, name) for record in records]
        if (get_origin(hint) or hint) is Pose:
            arrays[f"{word}_rotation"] = np.array([pose.rotation for pose in values])
            arrays[f"{word}_translation_mm"] = np.array([pose.translation_mm for pose in values])
        elif isinstance(values[0], np.ndarray):
            arrays[f"{word}_{name}"] = np.concatenate(_equally_wide(values))
        else:
            arrays[f"{word}_{name}"] = np.array(values)
    return arrays


def _equally_wide(values: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Arrays filled up with zeros to the longest last axis: noises of one camera or two."""
    widest = max(value.shape[-1] for value in values)
    if values[0].ndim < 3 or all(value.shape[-1] == widest for value in values):
        return values
    return [np.pad(item, [(0, 0), (0, 0), (0, widest - item.shape[-1])]) for item in values]


def _unpacked(kind: type[R], word: str, arrays: Arrays) -> tuple[R, ...]:
    counts = arrays.get(f"{word}_n_points", np.zeros(0, dtype=np.int64))
    if counts.ndim != 1 or len(counts) > MOST_RECORDS or (counts < 0).any():
        raise ValueError("counts of points that are none")
    ends = np.cumsum(counts)
    columns: dict[str, Sequence[Any]] = {}
    for name, hint in _kept(kind).items() if len(counts) else ():
        if (get_origin(hint) or hint) is Pose:
            turns, shifts = arrays[f"{word}_rotation"], arrays[f"{word}_translation_mm"]
            columns[name] = [Pose(*pair) for pair in zip(turns, shifts, strict=True)]
            continue
        array = arrays[f"{word}_{name}"]
        if np.ndarray in (get_origin(hint), *map(get_origin, get_args(hint))):
            if len(array) != ends[-1]:
                raise ValueError(f"{name} has not a row a point")
            columns[name] = np.split(array, ends[:-1])
        else:
            columns[name] = array.tolist()
    if any(len(column) != len(counts) for column in columns.values()):
        raise ValueError("records that do not fit each other")
    return tuple(
        kind(**{name: column[k] for name, column in columns.items()}) for k in range(len(counts))
    )
