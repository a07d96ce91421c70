# SPDX-License-Identifier: Apache-2.0
"""JSON that keeps floats exactly, refuses NaN and repeated keys, and reads well; how a document
came to be.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn
from uuid import uuid4

from armscan.errors import FileFormatError
from armscan.models.calibration import InputFile, Provenance
from armscan.storage.images import read_bytes


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


def fingerprint(path: Path) -> InputFile:
    """Path as given, with ``/``, and SHA-256 of the content."""
    return InputFile(path.as_posix(), hashlib.sha256(read_bytes(path)).hexdigest())


def new_provenance(
    inputs: Iterable[Path],
    *,
    command: Sequence[str],
    options: Iterable[Any] = (),
    parents: Sequence[Provenance] = (),
    warnings: Sequence[str] = (),
    forced: Sequence[str] = (),
) -> Provenance:
    """Describe a document that is about to be written.

    Parameters
    ----------
    inputs
        Files that went in; each is hashed.
    command
        The command line, one word an entry.
    options
        Options dataclasses in force; every field is recorded as ``Class.field``, one
        that is a dataclass itself by its own class and fields.
    parents
        Of the documents on which this one rests; their reasons for a refusal go on.
    warnings
        What the program warned of.
    forced
        Why this document was refused, if it is written all the same.
    """
    return Provenance(
        document_id=str(uuid4()),
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        armscan_version=version("armscan"),
        command=tuple(command),
        inputs=tuple(fingerprint(path) for path in inputs),
        parent_ids=tuple(parent.document_id for parent in parents),
        options=tuple(entry for group in options for entry in _entries(group)),
        warnings=tuple(warnings),
        forced=tuple(
            dict.fromkeys((*(text for parent in parents for text in parent.forced), *forced))
        ),
    )


def _entries(group: Any) -> Iterator[tuple[str, str]]:
    for item in fields(group):
        value = getattr(group, item.name)
        if is_dataclass(value):
            yield from _entries(value)
        else:
            yield f"{type(group).__name__}.{item.name}", str(value)
