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
    parent_ids: Sequence[str] = (),
    warnings: Sequence[str] = (),
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
    parent_ids
        Documents on which this one rests.
    warnings
        What the program warned of.
    """
    return Provenance(
        document_id=str(uuid4()),
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        armscan_version=version("armscan"),
        command=tuple(command),
        inputs=tuple(fingerprint(path) for path in inputs),
        parent_ids=tuple(parent_ids),
        options=tuple(entry for group in options for entry in _entries(group)),
        warnings=tuple(warnings),
    )


def _entries(group: Any) -> Iterator[tuple[str, str]]:
    for item in fields(group):
        value = getattr(group, item.name)
        if is_dataclass(value):
            yield from _entries(value)
        else:
            yield f"{type(group).__name__}.{item.name}", str(value)
