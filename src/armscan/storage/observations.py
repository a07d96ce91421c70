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
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.sheets.result import LaserFit, PlacedBoard, PointUse
from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import BoolArray, IntArray
from armscan.geometry.poses import Pose
from armscan.records.profile import Profile, StripeFlag
from armscan.storage.files import path_text, read_bytes
from armscan.vision.targets.target import TargetView

LASERS_APART = "\n"
R = TypeVar("R")
Arrays = Mapping[str, NDArray[Any]]

ADDED = ("is_square",)
"""Fields that earlier files lack, whose defaults stand for them."""
MOST_BYTES = 512 * 2**20
"""Of all arrays together; a file of some megabytes may claim any size."""
MOST_RECORDS = 1_000_000
DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError, InputError, OSError, EOFError),
    *(ValueError, TypeError, KeyError, IndexError, OverflowError, SyntaxError, RecursionError),
    *(NotImplementedError, RuntimeError, MemoryError),
)
"""What the libraries raise for content that is none."""


@dataclass(frozen=True, slots=True, eq=False)
class StripeContext:
    """What belongs to a stripe image on a board besides its points.

    Parameters
    ----------
    lasers
        Names of the sources that were on.
    camera
        0, or 1 for the right camera of a stereo head.
    placement
        Images of equal placement saw the board in one place.
    on_edge
        (N,) points along an edge of the target's marks; None if the edges are not known.
    has_rims
        True for a target of circles whose rims were seen.
    placed
        The board's pose in Sensor.
    """

    lasers: tuple[str, ...]
    camera: int
    placement: str
    on_edge: BoolArray | None
    has_rims: bool
    placed: PlacedBoard


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
    contexts
        One entry a profile; empty in files of versions before they were kept.
    stripes
        Points of a hand-eye's exposures in the Sensor frame, with the arm's poses and without
        derivatives.
    """

    views: tuple[TargetView, ...] = ()
    profiles: tuple[Profile, ...] = ()
    sha256: Mapping[str, str] = field(default_factory=dict)
    contexts: tuple[StripeContext, ...] = ()
    stripes: tuple[PosedStripe, ...] = ()


def pack_observations(
    views: Sequence[TargetView], profiles: Sequence[Profile], sha256: Mapping[str, str]
) -> bytes:
    """Content of the ``.npz`` file of a camera or a pair; see `Observations`."""
    return _content(_arrays(views, profiles, sha256))


def pack_posed_stripes(stripes: Sequence[PosedStripe], sha256: Mapping[str, str]) -> bytes:
    """Content of the ``.npz`` file of a hand-eye: points of each exposure and the arm's pose."""
    return _content(_arrays((), (), sha256) | _packed("stripe", stripes))


def pack_board_stripes(fit: LaserFit, sha256: Mapping[str, str]) -> bytes:
    """Content of the ``.npz`` file of light sheets: all that their calibration was given.

    Points that lie along an edge of the target and are not used for that are flagged.

    Raises
    ------
    InputError
        If the pose of a board in Sensor was not given.
    """
    boards, profiles, placed, on_edge = fit.boards, [], [], []
    for board, image in zip(boards, fit.images, strict=True):
        is_on_edge = image.use == int(PointUse.ON_EDGE)
        flags = board.profile.flags | np.where(is_on_edge, int(StripeFlag.TARGET_EDGE), 0)
        profiles.append(replace(board.profile, flags=flags))
        known = np.zeros(len(board.profile), dtype=np.bool_)
        on_edge.append(known if board.on_edge is None else board.on_edge)
        if board.placed is None:
            raise InputError(f"{board.view.source}: the board's pose in Sensor is not given")
        placed.append(board.placed)
    lasers = [LASERS_APART.join(board.lasers) for board in boards]
    return _content(
        _arrays([board.view for board in boards], profiles, sha256)
        | {
            "board_lasers": np.array(lasers, dtype=np.str_),
            "board_camera": np.array([board.camera for board in boards]),
            "board_placement": np.array([board.placement for board in boards], dtype=np.str_),
            "profile_on_edge": np.concatenate(on_edge),
            "board_has_edges": np.array([board.on_edge is not None for board in boards]),
            "board_has_rims": np.array([board.view.edges is not None for board in boards]),
            "board_rotation": np.stack([one.sensor_from_board.rotation for one in placed]),
            "board_translation_mm": np.stack(
                [one.sensor_from_board.translation_mm for one in placed]
            ),
            "board_covariance": np.stack([one.covariance for one in placed]),
            "board_by_cameras": np.stack([one.by_cameras for one in placed]),
        }
    )


def _arrays(
    views: Sequence[TargetView], profiles: Sequence[Profile], sha256: Mapping[str, str]
) -> dict[str, NDArray[Any]]:
    return {
        "image_source": np.array(list(sha256), dtype=np.str_),
        "image_sha256": np.array(list(sha256.values()), dtype=np.str_),
        **_packed("view", views),
        **_packed("profile", profiles),
    }


def _content(arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def read_observations(path: Path) -> Observations:
    """Read what `pack_observations` wrote."""
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
            contexts=_contexts(arrays) if "board_camera" in arrays else (),
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
    """Fields of a record and their types, without those that may be None.

    Those follow from the rest (the derivatives of a stripe's points from the points, their sheets
    and the sensor), or nothing needs them again (the edge points of circles).
    """
    hints = get_type_hints(kind)
    return {
        item.name: hints[item.name]
        for item in fields(kind)
        if NoneType not in get_args(hints[item.name])
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


def _counts(word: str, arrays: Arrays) -> IntArray:
    """Rows of each record of a kind."""
    counts = arrays.get(f"{word}_n_points", np.zeros(0, dtype=np.int64))
    if counts.ndim != 1 or len(counts) > MOST_RECORDS or (counts < 0).any():
        raise ValueError("counts of points that are none")
    return counts


def _unpacked(kind: type[R], word: str, arrays: Arrays) -> tuple[R, ...]:
    counts = _counts(word, arrays)
    ends = np.cumsum(counts)
    columns: dict[str, Sequence[Any]] = {}
    for name, hint in _kept(kind).items() if len(counts) else ():
        if (get_origin(hint) or hint) is Pose:
            turns, shifts = arrays[f"{word}_rotation"], arrays[f"{word}_translation_mm"]
            columns[name] = [Pose(*pair) for pair in zip(turns, shifts, strict=True)]
            continue
        if name in ADDED and f"{word}_{name}" not in arrays:
            continue
        array = arrays[f"{word}_{name}"]
        if get_origin(hint) is np.ndarray:
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


def _contexts(arrays: Mapping[str, NDArray[Any]]) -> tuple[StripeContext, ...]:
    counts = _counts("profile", arrays)
    if len(arrays["profile_on_edge"]) != counts.sum():
        raise ValueError("edges that are not of the points")
    on_edge = np.split(arrays["profile_on_edge"], np.cumsum(counts)[:-1])
    return tuple(
        StripeContext(
            lasers=tuple(filter(None, str(arrays["board_lasers"][k]).split(LASERS_APART))),
            camera=int(arrays["board_camera"][k]),
            placement=str(arrays["board_placement"][k]),
            on_edge=on_edge[k] if arrays["board_has_edges"][k] else None,
            has_rims=bool(arrays["board_has_rims"][k]),
            placed=PlacedBoard(
                Pose(arrays["board_rotation"][k], arrays["board_translation_mm"][k]),
                arrays["board_covariance"][k],
                arrays["board_by_cameras"][k],
            ),
        )
        for k in range(len(on_edge))
    )
