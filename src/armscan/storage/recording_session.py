# SPDX-License-Identifier: Apache-2.0
"""What holds for a folder recording (``session.toml``) and its list of exposures
(``exposures.csv``).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import ImageArray, IntArray
from armscan.geometry.rotations import EulerConvention
from armscan.records.exposure import SensorWindow
from armscan.records.recording import (
    NO_TRIGGER,
    CameraSetup,
    Clock,
    ExposureRow,
    PoseForm,
    Session,
    SessionKind,
)
from armscan.storage.codec import (
    LARGEST_SIZE_PX,
    Layout,
    MismatchError,
    RecordCodec,
    parse_toml,
    toml_bytes,
)
from armscan.storage.files import is_file, path_text, read_bytes
from armscan.storage.tables import CsvTable
from armscan.vision.stripe.ridge import near_lines

SESSION_FILE = "session.toml"


@dataclass(frozen=True, slots=True)
class _PoseKeys:
    """``[pose]``."""

    form: PoseForm = Session().pose_form
    rotation: EulerConvention = Session().rotation


@dataclass(frozen=True, slots=True)
class _TimeKeys:
    """``[time]``."""

    clock: Clock = Session().clock


@dataclass(frozen=True, slots=True)
class _SessionKeys:
    """The whole file."""

    kind: SessionKind = Session().kind
    head: str | None = None
    simulated: bool = False
    stripe_band: bool = False
    pose: _PoseKeys = _PoseKeys()
    time: _TimeKeys = _TimeKeys()
    camera: tuple[CameraSetup, ...] = ()


WINDOW_KEYS = ("window_x_px", "window_y_px")
IS_WINDOW = "is_window"
"""True says that an image is a window, also one in the sensor's corner. Two zeros do not: files
bear them of whole images, too."""
WINDOW_PX = (0, LARGEST_SIZE_PX)
LAYOUTS: Mapping[type, Layout] = {
    _SessionKeys: Layout(optional=("simulated", "stripe_band")),
    CameraSetup: Layout(flat=("window",), limits={"bits_used": (1, 16)}),
    SensorWindow: Layout(
        keys={"x_px": WINDOW_KEYS[0], "y_px": WINDOW_KEYS[1], "is_stated": IS_WINDOW},
        optional=("binning", "is_stated"),
        limits={"x_px": WINDOW_PX, "y_px": WINDOW_PX, "binning": (1, 1000)},
    ),
}


@dataclass(frozen=True, slots=True)
class SessionFile:
    """What ``session.toml`` says, defaults elsewhere; its keys, as ``camera.0.colour``."""

    session: Session
    stated: frozenset[str] = frozenset()
    warnings: tuple[str, ...] = ()


def read_session_file(path: Path) -> SessionFile:
    """Read ``session.toml``."""
    where = path_text(path)
    content = parse_toml(read_bytes(path), where, 'write lines as kind = "scan"')
    unknown: list[str] = []
    try:
        keys = RecordCodec(LAYOUTS, unknown).read(_SessionKeys, content)
    except MismatchError as error:
        remedy = "write it as in the reference of folder recordings"
        if isinstance(content.get("camera"), dict):
            remedy = "write [[camera]] with two brackets, once a camera"
        raise FileFormatError(str(error), where=where, remedy=remedy) from error
    stated = frozenset(_stated(content))
    cameras = (
        one if f"camera.{k}.{IS_WINDOW}" in stated else replace(one, window=_by_corner(one.window))
        for k, one in enumerate(keys.camera)
    )
    session = Session(
        kind=keys.kind,
        cameras=tuple(cameras),
        clock=keys.time.clock,
        pose_form=keys.pose.form,
        rotation=keys.pose.rotation,
        head=keys.head,
        is_simulated=keys.simulated,
        is_stripe_band=keys.stripe_band,
    )
    odd = tuple(f"{path.name}: the key {fact}" for fact in unknown)
    return SessionFile(session, stated, odd)


def _by_corner(window: SensorWindow) -> SensorWindow:
    return replace(window, is_stated=(window.x_px, window.y_px) != (0, 0))


def session_toml(session: Session) -> bytes:
    """Text of ``session.toml`` with every key, but for windows that nobody stated.

    It reads back as the same session.
    """
    keys = _SessionKeys(
        kind=session.kind,
        head=session.head,
        simulated=session.is_simulated,
        stripe_band=session.is_stripe_band,
        pose=_PoseKeys(session.pose_form, session.rotation),
        time=_TimeKeys(session.clock),
        camera=session.cameras,
    )
    assumed = "".join(f"# assumed: {' '.join(fact.split())}\n" for fact in session.assumed)
    tree = RecordCodec(LAYOUTS).write(keys)
    for setup, table in zip(session.cameras, tree["camera"], strict=True):
        corner = setup.window.x_px, setup.window.y_px
        table.pop(IS_WINDOW, None)
        if setup.window.is_stated:
            table[IS_WINDOW] = True
        elif corner == (0, 0):
            for key in WINDOW_KEYS:
                del table[key]
    return assumed.encode() + toml_bytes(tree)


def _stated(content: Mapping[str, Any]) -> Iterator[str]:
    """Names of the keys that the file holds, those of tables with the table's name before."""
    for name, value in content.items():
        yield name
        tables = value if isinstance(value, list) else [value]
        for k, table in enumerate(tables):
            place = f"{name}.{k}" if isinstance(value, list) else name
            yield from (f"{place}.{key}" for key in table) if isinstance(table, dict) else ()


EXPOSURES_FILE = "exposures.csv"
MOST_CAMERAS = 100
REQUIRED = ("index", "t_ns", "camera", "file", "lasers")
OPTIONAL = ("trigger_id", "view")
FLAGS = "flags"
"""Marks that a live recording gives its exposures, joined by +."""
DRIVE = re.compile(r"[A-Za-z]:")

Columns = Mapping[str, tuple[str, ...]]


def exposure_rows(table: CsvTable) -> tuple[tuple[ExposureRow, ...], Columns]:
    """Rows of ``exposures.csv`` in order of time, and its unknown columns in the same order.

    Raises
    ------
    FileFormatError
        If a column is missing, a cell is wrong, an index or trigger id appears twice, a camera's
        times do not increase, or a path leaves the recording.
    """
    table.require(REQUIRED)
    if not len(table):
        raise FileFormatError(
            "the table lists no exposure", where=table.where, remedy="write one line an image"
        )
    n = len(table)
    index, times = table.ints("index"), table.ints("t_ns")
    camera = table.ints("camera")
    triggers = table.ints("trigger_id", NO_TRIGGER) if "trigger_id" in table else None
    views = table.columns.get("view", ("",) * n)
    marks = table.columns.get(FLAGS, ("",) * n)
    cells = table.columns["lasers"]
    lasers = {cell: _lasers(cell, table.place(cells.index(cell))) for cell in dict.fromkeys(cells)}
    rows = [
        ExposureRow(
            index=int(index[k]),
            t_ns=int(times[k]),
            camera=int(camera[k]),
            source=_relative(table.columns["file"][k], table.place(k)),
            lasers=lasers[cells[k]],
            trigger_id=_trigger(table, triggers, k),
            view=views[k] or None,
            flags=tuple(filter(None, marks[k].split("+"))),
        )
        for k in range(n)
    ]
    _check(rows, table)
    order = sorted(range(n), key=lambda k: (rows[k].t_ns, rows[k].camera))
    extra = {
        name: tuple(cells[k] for k in order)
        for name, cells in table.columns.items()
        if name not in REQUIRED + OPTIONAL
    }
    return tuple(rows[k] for k in order), extra


def exposure_columns(rows: Sequence[ExposureRow], extra: Columns) -> dict[str, tuple[str, ...]]:
    """Columns of ``exposures.csv``; optional ones only where a row has something to say."""
    columns = {
        "index": tuple(str(row.index) for row in rows),
        "t_ns": tuple(str(row.t_ns) for row in rows),
        "camera": tuple(str(row.camera) for row in rows),
        "file": tuple(row.source for row in rows),
        "lasers": tuple("+".join(row.lasers) for row in rows),
    }
    if any(row.trigger_id is not None for row in rows):
        ids = (row.trigger_id for row in rows)
        columns["trigger_id"] = tuple("" if number is None else str(number) for number in ids)
    if any(row.view is not None for row in rows):
        columns["view"] = tuple(row.view or "" for row in rows)
    if any(row.flags for row in rows):
        columns[FLAGS] = tuple("+".join(row.flags) for row in rows)
    return {**columns, **extra}


def check_files(folder: Path, rows: Sequence[ExposureRow]) -> None:
    """Raise if an image that is listed does not exist."""
    missing = [row.source for row in rows if not is_file(folder / row.source)]
    if missing:
        raise FileFormatError(
            f"{len(missing)} of {len(rows)} images that are listed do not exist, the first is "
            f"{missing[0]}",
            where=str(folder / EXPOSURES_FILE),
            remedy="copy the images into the recording, or remove their lines",
        )


def _check(rows: Sequence[ExposureRow], table: CsvTable) -> None:
    latest: dict[int, int] = {}
    seen: dict[tuple[str, int, int], int] = {}
    for k, row in enumerate(rows):
        where = table.place(k)
        if not 0 <= row.camera < MOST_CAMERAS:
            raise FileFormatError(
                f"camera {row.camera}", where=where, remedy="count cameras from 0"
            )
        if (row.trigger_id or 0) < 0 or row.index < 0:
            raise FileFormatError(
                "index and trigger_id are not negative", where=where, remedy="count from 0"
            )
        keys = [("index", row.index, 0)]
        if row.trigger_id is not None:
            keys.append(("trigger_id", row.trigger_id, row.camera))
        for key in keys:
            if key in seen:
                raise FileFormatError(
                    f"{key[0]} {key[1]} appears again (first in line {table.lines[seen[key]]})",
                    where=where,
                    remedy="give each exposure of a camera its own",
                )
            seen[key] = k
        if row.t_ns <= latest.get(row.camera, row.t_ns - 1):
            fact = "repeats" if row.t_ns == latest[row.camera] else "goes back from"
            raise FileFormatError(
                f"t_ns of camera {row.camera} {fact} {latest[row.camera]}",
                where=where,
                remedy="sort the lines by time and give each exposure its own",
            )
        latest[row.camera] = row.t_ns


def repeated_files(rows: Sequence[ExposureRow]) -> list[str]:
    """Images that are listed more than once."""
    counts = Counter(row.source for row in rows)
    return [name for name, count in counts.items() if count > 1]


def is_inside(name: str) -> bool:
    """True for a relative path with ``/`` that does not leave the recording."""
    path = PurePosixPath(name)
    has_other_marks = "\\" in name or DRIVE.match(name) is not None
    return bool(name) and not (path.is_absolute() or ".." in path.parts or has_other_marks)


def _relative(name: str, where: str) -> str:
    if not is_inside(name):
        raise FileFormatError(
            f"'{name}' is no path inside the recording",
            where=where,
            remedy="write it relative to the recording, with / and without ..",
        )
    return name


def _lasers(cell: str, where: str) -> tuple[str, ...]:
    if not cell:
        return ()
    names = tuple(name.strip() for name in cell.split("+"))
    if "" in names or len(set(names)) < len(names):
        raise FileFormatError(
            f"lasers '{cell}' name a source twice or not at all",
            where=where,
            remedy="join the names of the sources by +, as A+B",
        )
    return names


def _trigger(table: CsvTable, triggers: IntArray | None, row: int) -> int | None:
    if triggers is None or not table.columns["trigger_id"][row]:
        return None
    return int(triggers[row])


def has_band(row: ExposureRow, setup: CameraSetup, *, is_lit: bool = False) -> bool:
    """Whether extraction takes this image as it is: of a view, the one without laser comes off.

    ``is_lit``: also if it names no laser.
    """
    return (bool(row.lasers) or is_lit) and row.view is None and setup.colour == "mono"


def banded_image(
    row: ExposureRow, image: ImageArray | bytes, setup: CameraSetup, *, is_lit: bool = False
) -> ImageArray | None:
    """Pixels near stripes; None for images that stay whole."""
    if isinstance(image, bytes) or image.ndim != 2 or not has_band(row, setup, is_lit=is_lit):
        return None
    bits = setup.bits_used if setup.align == "low" else 8 * image.dtype.itemsize
    keep = near_lines(image.astype(np.float32) * np.float32(255.0 / ((1 << bits) - 1)))
    return np.where(keep, image, image.dtype.type(0))
