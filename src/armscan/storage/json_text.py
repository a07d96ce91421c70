# SPDX-License-Identifier: Apache-2.0
"""JSON that keeps floats exactly, refuses NaN and repeated keys, and reads well."""

from __future__ import annotations

import json
from typing import Any, NoReturn

from armscan.errors import FileFormatError


def json_bytes(value: Any) -> bytes:
    """Encode as UTF-8 JSON; floats round-trip exactly, lists of plain values stay on one line.

    Raises
    ------
    ValueError
        If a float is not finite.
    """
    return (_encode(value, "") + "\n").encode()


def parse_json(data: bytes, where: str) -> dict[str, Any]:
    """Parse a JSON object.

    Raises
    ------
    FileFormatError
        If it is cut short, no JSON object, names a key twice, or holds NaN or infinity.
    """
    try:
        value = json.loads(
            data.decode("utf-8-sig"), parse_constant=_refuse, object_pairs_hook=_unique
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


def _encode(value: Any, indent: str) -> str:
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = [f"{deeper}{json.dumps(k)}: {_encode(v, deeper)}" for k, v in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, (list, tuple)) and any(isinstance(v, (dict, list, tuple)) for v in value):
        return "[\n" + ",\n".join(deeper + _encode(v, deeper) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"the document holds {constant} where a number is needed")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {repeated!r} appears twice")
    return result
