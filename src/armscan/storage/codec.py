# SPDX-License-Identifier: Apache-2.0
"""Records as JSON or TOML: read within limits, every key checked by the type of its field.

A record is a dataclass and its fields are the keys; where a file says something otherwise, a
`Layout` tells how. Floats come back to the last bit. What a number may be follows from its name:
lengths and pixels (``_mm``, ``_px``) are bounded, counts and standard deviations not negative.
A key that is missing, unknown or holds what its field cannot is a `MismatchError`.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from types import NoneType
from typing import Any, Literal, NoReturn, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np

from armscan.errors import FileFormatError, InputError, shown
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import CameraRight, Pose
from armscan.storage.tables import LARGEST_MM

T = TypeVar("T")
Tree = Mapping[str, Any]

MOST_BYTES, MOST_VALUES = 64 * 2**20, 1_000_000
"""Of a document. The largest of armscan's has some ten thousand values."""
MOST_TOML_BYTES, MOST_TOML_TABLES = 2**18, 1000
MOST_DIGITS = 40
"""Of a whole number: more than any that is meant."""
LARGEST, LARGEST_SIZE_PX = 1e15, 100_000
"""Numbers that are no lengths, and images as wide, are damage beyond this: they overflow later."""
NOT_NEGATIVE = ("n_", "rms_", "sigma_", "degrees_of_freedom")
MAY_LACK = ("rms_", "sigma_")
"""Figures that calibrations of other programs do not bring."""
SYMMETRY_TOLERANCE = 1e-9
INDEFINITE_TOLERANCE = 1e-6
"""How far a correlation's eigenvalue may lie below 0 by rounding."""


def json_bytes(value: Any) -> bytes:
    """Encode as UTF-8 JSON; floats round-trip exactly, lists of plain values stay on one line.

    Raises
    ------
    ValueError
        If a float is not finite.
    """
    # bytes of names that are no text become JSON's own escapes
    return (_encode(value, "") + "\n").encode(errors="backslashreplace")


def _encode(value: Any, indent: str) -> str:
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = [f"{deeper}{json.dumps(k)}: {_encode(v, deeper)}" for k, v in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, dict | list | tuple) for v in value):
        return "[\n" + ",\n".join(deeper + _encode(v, deeper) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def is_json(data: bytes) -> bool:
    """True for content that can only be a JSON object."""
    return data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")


def parse_json(data: bytes, where: str) -> dict[str, Any]:
    """Parse a JSON object.

    Raises
    ------
    FileFormatError
        If it is cut short, too large, no JSON object, names a key twice, or holds NaN, infinity or
        a number of too many digits.
    """
    n_values = data.count(b",") + data.count(b"[") + data.count(b"{")
    if len(data) > MOST_BYTES or n_values > MOST_VALUES:
        raise FileFormatError(
            f"the JSON document is too large ({len(data)} bytes, some {n_values} values)",
            where=where,
            remedy="give a calibration, which is far smaller",
        )
    try:
        value = json.loads(
            data.decode("utf-8-sig"),
            parse_constant=_refuse_constant,
            parse_int=_whole,
            parse_float=_finite,
            object_pairs_hook=_unique,
        )
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"this is not a complete JSON document (line {error.lineno}: {error.msg})",
            where=where,
            remedy="copy the file again, or write it anew",
        ) from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(
            "this is not a JSON document", where=where, remedy="copy the file again; it may be cut"
        ) from error
    except ValueError as error:
        raise FileFormatError(
            str(error), where=where, remedy="use the file as it was written, or make it anew"
        ) from error
    if not isinstance(value, dict):
        raise FileFormatError(
            "this is not a JSON object",
            where=where,
            remedy="give a document that armscan or a camera calibration wrote",
        )
    return value


def parse_toml(data: bytes, where: str, remedy: str) -> dict[str, Any]:
    """Parse a TOML file; ``remedy`` says how lines should be."""
    try:
        n_tables = data.count(b"\n[")
        if len(data) <= MOST_TOML_BYTES and n_tables <= MOST_TOML_TABLES:
            return tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n"))
        fault = f"it has {len(data)} bytes and {n_tables} tables"
    except RecursionError:
        fault = "it is nested too deep"
    except ValueError as error:
        fault = shown(str(error), 200)
    raise FileFormatError(f"this is no TOML: {fault}", where=where, remedy=remedy)


def toml_bytes(tree: Tree) -> bytes:
    """TOML of plain values, tables and lists of tables; keys without a value are left out."""
    return ("\n".join(_toml_lines(tree)) + "\n").encode()


def _toml_lines(tree: Tree, path: str = "") -> Iterator[str]:
    inner = {key: value for key, value in tree.items() if isinstance(value, dict)}
    lists = {
        key: value
        for key, value in tree.items()
        if isinstance(value, list) and value and all(isinstance(item, dict) for item in value)
    }
    for key, value in tree.items():
        if key not in inner and key not in lists and value is not None:
            text = json.dumps(value, allow_nan=False, ensure_ascii=False)
            yield f"{key} = " + text.replace("\x7f", "\\u007f")
    for key, table in inner.items():
        yield from ("", f"[{path}{key}]", *_toml_lines(table, f"{path}{key}."))
    for key, tables in lists.items():
        for table in tables:
            yield from ("", f"[[{path}{key}]]", *_toml_lines(table, f"{path}{key}."))


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"the document holds {constant} where a number is needed")


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"the document holds a whole number of {len(digits)} digits")
    return int(digits)


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"the number {digits:.40} of the document is not finite")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise ValueError(f"the key {name[:60]!r} appears twice")
        result[name] = value
    return result


class MismatchError(ValueError):
    """A key does not hold what it should."""

    def __init__(self, key: str, why: str) -> None:
        super().__init__(f"'{shown(key, 120)}' {why}" if key else why)


@dataclass(frozen=True, slots=True)
class FieldCodec:
    """How the value of a field stands in a file where its type does not say it.

    ``read`` takes the tree and its key, for messages.
    """

    write: Callable[[Any], Any]
    read: Callable[[Any, str], Any]


@dataclass(frozen=True, slots=True)
class Layout:
    """How a record stands in a file where that is not by the names of its fields.

    Parameters
    ----------
    keys
        Key of a field.
    codecs
        Fields that are written in a way of their own.
    spread
        Fields whose entries have keys of their own.
    flat
        Fields with a record whose keys stand among this one's.
    optional
        Fields that are left out where they have their default.
    required
        Fields whose default does not stand for a key that is missing.
    given
        Fields that stand with the record that holds this one.
    lends
        Key under which the ``provenance`` of the record in a field stands.
    constants
        Keys that always have this value.
    covariance_names
        Names of the rows of the field ``covariance`` of a record.
    is_evidence
        Numbers may be unknown: ``null`` in the file, NaN in the program.
    limits
        Least and most of numbers, in place of those of their names.
    check
        What is wrong with a record that its class allows; empty for nothing.
    """

    keys: Mapping[str, str] = field(default_factory=dict)
    codecs: Mapping[str, FieldCodec] = field(default_factory=dict)
    spread: Mapping[str, Sequence[str]] = field(default_factory=dict)
    flat: Sequence[str] = ()
    optional: Sequence[str] = ()
    required: Sequence[str] = ()
    given: Sequence[str] = ()
    lends: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, str] = field(default_factory=dict)
    covariance_names: Callable[[Any], tuple[str, ...]] | None = None
    is_evidence: bool = False
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    check: Callable[[Any], str] | None = None

    def may_lack(self, name: str) -> bool:
        """True if the number of that name may be unknown."""
        return self.is_evidence or name.startswith(MAY_LACK)


PLAIN = Layout()


@dataclass(frozen=True, slots=True)
class _Slot:
    """What a field takes: its type, the key where it stands, its record's layout and its name."""

    hint: Any
    key: str
    layout: Layout
    name: str = ""


@dataclass(frozen=True, slots=True)
class RecordCodec:
    """Records to trees of dicts, lists, numbers and text, and back.

    ``unknown`` takes a sentence for each key that is not known; None refuses them.
    """

    layouts: Mapping[type, Layout] = field(default_factory=dict)
    unknown: list[str] | None = None

    def write(self, record: Any) -> dict[str, Any]:
        """Tree of a record."""
        hints = _hints(type(record))
        layout = self.layouts.get(type(record), PLAIN)
        tree: dict[str, Any] = dict(layout.constants)
        for item in fields(record):
            name, value = item.name, getattr(record, item.name)
            if name in layout.given or (name in layout.optional and _is_default(item, value)):
                continue
            key = layout.keys.get(name, name)
            if name in layout.flat:
                tree |= self.write(value)
            elif name in layout.spread:
                tree |= dict(zip(layout.spread[name], np.asarray(value).tolist(), strict=True))
            elif name in layout.codecs:
                tree[key] = None if value is None else layout.codecs[name].write(value)
            elif name == "covariance" and layout.covariance_names is not None:
                tree[key] = matrix_tree(value, parameter_names=layout.covariance_names(record))
            else:
                tree[key] = self._tree(value, hints[name], layout.may_lack(name))
            if name in layout.lends:
                tree[layout.lends[name]] = self.write(value.provenance)
        return tree

    def _tree(self, value: Any, hint: Any, may_lack: bool) -> Any:
        if isinstance(value, Pose):
            rows = {"rotation_rows": value.rotation.tolist()}
            return rows | {_translation_key(hint): value.translation_mm.tolist()}
        if is_dataclass(value):
            return self.write(value)
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, tuple):
            return [self._tree(item, None, may_lack) for item in value]
        return None if may_lack and isinstance(value, float) and not math.isfinite(value) else value

    def read(self, kind: type[T], tree: Any, key: str = "", **given: Any) -> T:
        """Record of a tree that the file holds under ``key``; ``given`` are fields that are not in
        it.
        """
        if not isinstance(tree, dict):
            raise MismatchError(key, "is no table of keys")
        used: set[str] = set()
        record = self._record(kind, tree, key, used, given)
        for name in tree:
            if name not in used:
                near = get_close_matches(name[:60], used, 1)
                hint = f"; '{near[0]}' is" if near else ""
                if self.unknown is None:
                    raise MismatchError(_join(key, name), f"is not known{hint}")
                fact = f"is not known and has no effect{hint}"
                self.unknown.append(str(MismatchError(_join(key, name), fact)))
        return record

    def _record(
        self, kind: type[T], tree: Tree, key: str, used: set[str], given: Mapping[str, Any]
    ) -> T:
        layout, hints = self.layouts.get(kind, PLAIN), _hints(kind)
        used.update(layout.constants, layout.lends.values())
        for name, constant in layout.constants.items():
            if tree.get(name) != constant:
                raise MismatchError(_join(key, name), f"is not {constant!r}")
        values = dict(given)
        for item in fields(cast(Any, kind)):
            if item.name not in given:
                values |= self._field(item, _Slot(hints[item.name], key, layout), tree, used)
        try:
            record = kind(**values)
        except InputError as error:
            raise MismatchError(key, error.what) from error
        if layout.covariance_names is not None:
            names = tuple(tree["covariance"]["parameter_names"])
            if names != layout.covariance_names(record):
                raise MismatchError(_join(key, "covariance"), "has not the model's parameter names")
        if layout.check is not None and (fault := layout.check(record)):
            raise MismatchError(key, fault)
        return record

    def _field(self, item: Field[Any], slot: _Slot, tree: Tree, used: set[str]) -> dict[str, Any]:
        """Value of one field by its name; empty if the tree has none and its default holds."""
        name, key, layout = item.name, slot.key, slot.layout
        if name in layout.flat:
            return {name: self._record(slot.hint, tree, key, used, {})}
        if name in layout.spread:
            used.update(layout.spread[name])
            rows = [numbers(_taken(tree, own, key), _join(key, own)) for own in layout.spread[name]]
            is_tuple = get_origin(slot.hint) is tuple
            return {name: tuple(map(float, rows)) if is_tuple else np.array(rows)}
        own = layout.keys.get(name, name)
        used.add(own)
        has_default = item.default is not MISSING or item.default_factory is not MISSING
        if own not in tree and has_default and name not in layout.required:
            return {}
        content, place = _taken(tree, own, key), _join(key, own)
        if name in layout.codecs:
            is_none = content is None and name not in layout.required
            return {name: None if is_none else layout.codecs[name].read(content, place)}
        if name in layout.lends:
            lent = layout.lends[name]
            kind = _hints(slot.hint)["provenance"]
            origin = self.read(kind, _taken(tree, lent, key), _join(key, lent))
            return {name: self.read(slot.hint, content, place, provenance=origin)}
        if name == "covariance" and layout.covariance_names is not None:
            value = symmetric(read_matrix(content, place, "parameter_names"), place)
        else:
            value = self._value(content, replace(slot, key=place, name=name))
        return {name: value}

    def _value(self, content: Any, slot: _Slot) -> Any:
        args, kind = get_args(slot.hint), get_origin(slot.hint) or slot.hint
        if NoneType in args:
            inner = next(arg for arg in args if arg is not NoneType)
            return None if content is None else self._value(content, replace(slot, hint=inner))
        if kind is tuple:
            return self._tuple(content, slot)
        if kind is np.ndarray:
            return numbers(content, slot.key)
        if kind is Pose:
            return _read_pose(slot.hint, content, slot.key)
        if is_dataclass(kind):
            return self.read(cast(type[Any], kind), content, slot.key)
        return _scalar(content, slot)

    def _tuple(self, content: Any, slot: _Slot) -> tuple[Any, ...]:
        if not isinstance(content, list):
            raise MismatchError(slot.key, "is no list")
        args = get_args(slot.hint)
        kinds = (args[0],) * len(content) if args[-1] is Ellipsis else args
        if len(kinds) != len(content):
            raise MismatchError(slot.key, f"has {len(content)} entries, not {len(kinds)}")
        return tuple(
            self._value(item, replace(slot, hint=kind, key=f"{slot.key}.{k}"))
            for k, (kind, item) in enumerate(zip(kinds, content, strict=True))
        )


def _scalar(content: Any, slot: _Slot) -> Any:
    """A number, a text, true or false, or one of some texts."""
    hint, key = slot.hint, slot.key
    if get_origin(hint) is Literal:
        if not (isinstance(content, str) and content in get_args(hint)):
            choices = ", ".join(map(str, get_args(hint)))
            raise MismatchError(key, f"is {_told(content)}, not one of {choices}")
    elif hint is float:
        if content is None and slot.layout.may_lack(slot.name):
            return math.nan
        return _number(content, key, slot.layout.limits.get(slot.name))
    elif hint is int:
        if isinstance(content, float):
            raise MismatchError(key, f"is {_told(content)}, which is no whole number")
        _number(content, key, slot.layout.limits.get(slot.name))
    elif type(content) is not hint:
        kind = "text" if hint is str else "true or false"
        raise MismatchError(key, f"is {_told(content)}, not {kind}")
    return content


def numbers(content: Any, key: str) -> FloatArray:
    """Array of nested lists of finite numbers, all of one length."""
    for item in _flat(content, key, 3):
        _number(item, key)
    try:
        return np.array(content, dtype=np.float64)
    except ValueError as error:
        raise MismatchError(key, "has rows of different lengths") from error


def _flat(content: Any, key: str, depth: int) -> Iterator[Any]:
    if not isinstance(content, list):
        yield content
    elif not depth:
        raise MismatchError(key, "is nested too deep")
    else:
        for item in content:
            yield from _flat(item, key, depth - 1)


def named(*names: str) -> FieldCodec:
    """Codec of an array whose entries or rows have names."""

    def read(content: Any, key: str) -> FloatArray:
        if not isinstance(content, dict) or set(content) != set(names):
            raise MismatchError(key, f"needs the keys {', '.join(names)} and no others")
        return numbers([content[name] for name in names], key)

    return FieldCodec(lambda values: dict(zip(names, values.tolist(), strict=True)), read)


def matrix_tree(matrix: FloatArray, **names: Sequence[str]) -> dict[str, Any]:
    """Tree of a matrix with the names of its rows, or of rows and columns."""
    return {**{key: list(words) for key, words in names.items()}, "matrix": matrix.tolist()}


def read_matrix(content: Any, key: str, *names: str) -> FloatArray:
    """Matrix of a tree, whose lists of names have the lengths of its sides."""
    if not isinstance(content, dict) or set(content) != {*names, "matrix"}:
        raise MismatchError(key, f"needs the keys {', '.join(names)}, matrix and no others")
    sides = [content[name] for name in names]
    matrix = numbers(content["matrix"], f"{key}.matrix")
    for side in sides:
        if not isinstance(side, list) or not all(isinstance(name, str) for name in side):
            raise MismatchError(key, "has names that are no list of texts")
    if matrix.shape != (len(sides[0]), len(sides[-1])):
        raise MismatchError(key, f"is not a {len(sides[0])} x {len(sides[-1])} matrix")
    return matrix


def symmetric(matrix: FloatArray, key: str) -> FloatArray:
    """The matrix, if it can be a covariance."""
    variances = np.diag(matrix)
    scale = np.sqrt(np.outer(np.abs(variances), np.abs(variances)))
    is_even = np.abs(matrix - matrix.T) <= SYMMETRY_TOLERANCE * (scale + np.abs(matrix))
    if variances.min(initial=0.0) < 0.0 or not is_even.all():
        raise MismatchError(key, "is not symmetric with a positive diagonal")
    correlation = np.divide(matrix, scale, out=np.zeros_like(matrix), where=scale > 0.0)
    least = float(np.linalg.eigvalsh(correlation).min(initial=0.0))
    if least < -INDEFINITE_TOLERANCE or bool(matrix[scale == 0.0].any()):
        raise MismatchError(key, "is no covariance: it makes some variance negative")
    return matrix


def _number(content: Any, key: str, limits: tuple[float, float] | None = None) -> float:
    """A finite number within limits, by default those of its key's name."""
    if isinstance(content, bool) or not isinstance(content, int | float):
        raise MismatchError(key, f"is {_told(content)}, which is no number")
    least, most = (
        _limits(key.rstrip(".0123456789").rpartition(".")[2]) if limits is None else limits
    )
    if not least <= content <= most:
        raise MismatchError(key, f"is {_told(content)}, not within {least:g} and {most:g}")
    return float(content)


def _limits(name: str) -> tuple[float, float]:
    if name in ("width_px", "height_px"):
        return 1, LARGEST_SIZE_PX
    most = LARGEST_MM if name.endswith(("_mm", "_px")) else LARGEST
    return 0.0 if name.startswith(NOT_NEGATIVE) else -most, most


def _told(content: Any) -> str:
    """What stands there, for messages."""
    if isinstance(content, dict | list):
        return "a table" if isinstance(content, dict) else "a list"
    return shown(repr(content), 60)


def _read_pose(hint: Any, content: Any, key: str) -> Pose[Any, Any]:
    wanted = {"rotation_rows", _translation_key(hint)}
    if not isinstance(content, dict) or set(content) != wanted:
        raise MismatchError(key, f"needs the keys {', '.join(sorted(wanted))} and no others")
    try:
        return Pose(*(numbers(content[name], f"{key}.{name}") for name in sorted(wanted)))
    except InputError as error:
        raise MismatchError(key, error.what) from error


def _translation_key(hint: Any) -> str:
    frame = get_args(hint)[0]
    return f"translation_{'right' if frame is CameraRight else frame.__name__.lower()}_mm"


_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)


def _is_default(item: Field[Any], value: Any) -> bool:
    default = item.default if item.default_factory is MISSING else item.default_factory()
    return default is not MISSING and np.array_equal(value, default)


def _taken(tree: Tree, name: str, key: str) -> Any:
    if name not in tree:
        raise MismatchError(_join(key, name), "is missing")
    return tree[name]


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name
