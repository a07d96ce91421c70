# SPDX-License-Identifier: Apache-2.0
"""What holds for a folder recording (``session.toml``) and its list of exposures
(``exposures.csv``).
"""

from __future__ import annotations

import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from armscan.errors import FileFormatError
from armscan.geometry.arrays import IntArray
from armscan.geometry.rotations import EulerConvention
from armscan.records.exposure import SensorWindow
from armscan.records.recording import (
    NO_TRIGGER,
    CameraSetup,
    Clock,
    ExposureRow,
    PixelAlignment,
    PixelColour,
    PoseForm,
    Session,
    SessionKind,
)
from armscan.storage.files import read_bytes
from armscan.storage.tables import CsvTable

SESSION_FILE = "session.toml"


class Keys(BaseModel):
    """Keys of one table: wrong types are refused, unknown keys are kept to be warned of."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)


class CameraKeys(Keys):
    """``[[camera]]``."""

    width_px: int | None = Field(None, ge=1)
    height_px: int | None = Field(None, ge=1)
    window_x_px: int = Field(SensorWindow().x_px, ge=0)
    window_y_px: int = Field(SensorWindow().y_px, ge=0)
    binning: int = Field(SensorWindow().binning, ge=1)
    bits_used: int = Field(CameraSetup().bits_used, ge=1, le=16)
    align: PixelAlignment = CameraSetup().align
    colour: PixelColour = CameraSetup().colour


class PoseKeys(Keys):
    """``[pose]``."""

    form: PoseForm = Session().pose_form
    rotation: EulerConvention = Session().rotation


class TimeKeys(Keys):
    """``[time]``."""

    clock: Clock = Session().clock


class SessionKeys(Keys):
    """The whole file."""

    kind: SessionKind = Session().kind
    head: str | None = None
    simulated: bool = False
    pose: PoseKeys = PoseKeys()
    time: TimeKeys = TimeKeys()
    camera: list[CameraKeys] = Field(default_factory=list)


@dataclass(frozen=True, slots=True)
class SessionFile:
    """What ``session.toml`` says.

    Parameters
    ----------
    session
        Its facts, defaults where it says nothing; no cameras if it names none.
    stated
        Keys that it holds, as ``pose.form`` or ``camera.0.colour``.
    warnings
        What is odd in it.
    """

    session: Session
    stated: frozenset[str] = frozenset()
    warnings: tuple[str, ...] = ()


def read_session_file(path: Path) -> SessionFile:
    """Read ``session.toml``.

    Raises
    ------
    FileFormatError
        If it is no TOML, or a key has a wrong type or value.
    """
    content = _toml(read_bytes(path), str(path))
    try:
        keys = SessionKeys.model_validate(content)
    except ValidationError as error:
        raise _invalid(error, str(path)) from error
    session = Session(
        kind=keys.kind,
        cameras=tuple(_setup(camera) for camera in keys.camera),
        clock=keys.time.clock,
        pose_form=keys.pose.form,
        rotation=keys.pose.rotation,
        head=keys.head,
        is_simulated=keys.simulated,
    )
    return SessionFile(session, frozenset(_stated(keys)), tuple(_unknown(keys, path.name)))


def session_toml(session: Session) -> bytes:
    """Text of ``session.toml`` with every key; reads back as the same session."""
    lines = [f"# assumed: {' '.join(fact.split())}" for fact in session.assumed]
    lines.append(f"kind = {_quoted(session.kind)}")
    if session.head is not None:
        lines.append(f"head = {_quoted(session.head)}")
    if session.is_simulated:
        lines.append("simulated = true")
    lines += ["", "[pose]", f"form = {_quoted(session.pose_form)}"]
    lines.append(f"rotation = {_quoted(session.rotation)}")
    lines += ["", "[time]", f"clock = {_quoted(session.clock)}"]
    for camera in session.cameras:
        lines += ["", "[[camera]]"]
        if camera.width_px is not None:
            lines.append(f"width_px = {camera.width_px}")
        if camera.height_px is not None:
            lines.append(f"height_px = {camera.height_px}")
        lines += [
            f"window_x_px = {camera.window.x_px}",
            f"window_y_px = {camera.window.y_px}",
            *([f"binning = {camera.window.binning}"] if camera.window.binning > 1 else []),
            f"bits_used = {camera.bits_used}",
            f"align = {_quoted(camera.align)}",
            f"colour = {_quoted(camera.colour)}",
        ]
    return ("\n".join(lines) + "\n").encode()


def _toml(data: bytes, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n"))
    except UnicodeDecodeError as error:
        raise FileFormatError(
            "this is not UTF-8 text", where=where, remedy="save it as UTF-8"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(
            f"this is no TOML: {error}", where=where, remedy='write lines as kind = "scan"'
        ) from error


def _setup(keys: CameraKeys) -> CameraSetup:
    return CameraSetup(
        width_px=keys.width_px,
        height_px=keys.height_px,
        window=SensorWindow(keys.window_x_px, keys.window_y_px, keys.binning),
        bits_used=keys.bits_used,
        align=keys.align,
        colour=keys.colour,
    )


def _invalid(error: ValidationError, where: str) -> FileFormatError:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    hint = "write it as in the reference of folder recordings"
    if key == "camera":
        hint = "write [[camera]] with two brackets, once a camera"
    return FileFormatError(
        f"'{key}' is {first['input']!r}: {first['msg'].lower()}", where=where, remedy=hint
    )


def _stated(keys: Keys, prefix: str = "") -> Iterator[str]:
    """Names of all keys that the file holds, tables' keys with the table's name before."""
    for name in keys.model_fields_set:
        value = getattr(keys, name)
        yield prefix + name
        if isinstance(value, Keys):
            yield from _stated(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            # a list that nobody knows may hold anything
            for k, item in enumerate(value):
                if isinstance(item, Keys):
                    yield from _stated(item, f"{prefix}{name}.{k}.")


def _unknown(keys: Keys, file: str, prefix: str = "") -> Iterator[str]:
    """A sentence for each key that is not known, with the nearest name that is."""
    known = type(keys).model_fields
    for name in keys.model_extra or {}:
        near = get_close_matches(name, known, 1)
        hint = f"; '{near[0]}' is" if near else ""
        yield f"{file}: the key '{prefix}{name}' is not known and has no effect{hint}"
    for name in known:
        value = getattr(keys, name)
        items = value if isinstance(value, list) else [value]
        for item in items:
            if isinstance(item, Keys):
                yield from _unknown(item, file, f"{prefix}{name}.")


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


EXPOSURES_FILE = "exposures.csv"
REQUIRED = ("index", "t_ns", "camera", "file", "lasers")
OPTIONAL = ("trigger_id", "view")
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
    rows = [
        ExposureRow(
            index=int(index[k]),
            t_ns=int(times[k]),
            camera=int(camera[k]),
            source=_relative(table.columns["file"][k], table.place(k)),
            lasers=_lasers(table.columns["lasers"][k], table.place(k)),
            trigger_id=_trigger(table, triggers, k),
            view=views[k] or None,
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
    return {**columns, **extra}


def check_files(folder: Path, rows: Sequence[ExposureRow]) -> None:
    """Raise if an image that is listed does not exist.

    Raises
    ------
    FileFormatError
        Naming the first one and the count.
    """
    missing = [row.source for row in rows if not (folder / row.source).is_file()]
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
        if row.camera < 0:
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
