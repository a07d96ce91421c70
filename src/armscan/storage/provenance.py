# SPDX-License-Identifier: Apache-2.0
"""How a document came to be: hashes of what went in, options, time, version."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import fields
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
        Options dataclasses in force; every field is recorded as ``Class.field``.
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
        options=tuple(
            (f"{type(group).__name__}.{item.name}", str(getattr(group, item.name)))
            for group in options
            for item in fields(group)
        ),
        warnings=tuple(warnings),
    )
