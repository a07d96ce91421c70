# SPDX-License-Identifier: Apache-2.0
"""How a document came to be: hashes of what went in, options, time, version."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any
from uuid import uuid4

from armscan.models.calibration import InputFile, Provenance
from armscan.storage.images import read_bytes


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
