# SPDX-License-Identifier: Apache-2.0
"""``session.toml``: what holds for a whole folder recording."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from armscan.errors import FileFormatError
from armscan.geometry.euler import EulerConvention
from armscan.records.sensor_window import SensorWindow
from armscan.records.session import (
    CameraSetup,
    Clock,
    PixelAlignment,
    PixelColour,
    PoseForm,
    Session,
    SessionKind,
)
from armscan.storage.images import read_bytes

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
