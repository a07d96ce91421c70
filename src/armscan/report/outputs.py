# SPDX-License-Identifier: Apache-2.0
"""Where a calibration's files go: the document, its observations and its page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from armscan.errors import OptionError
from armscan.storage.atomic import check_outputs


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """Files that are written together.

    Parameters
    ----------
    document
        The result itself.
    """

    document: Path

    @property
    def observations(self) -> Path:
        """What a calibration rests on, beside it."""
        return self.document.with_suffix(".npz")

    @property
    def page(self) -> Path:
        """The report beside it."""
        return self.document.with_suffix(".html")

    @property
    def refused_page(self) -> Path:
        """The page of a run that wrote no document; an earlier document keeps its own page."""
        return self.document.with_suffix(".refused.html")


def calibration_outputs(document: Path, *, is_overwriting: bool) -> OutputFiles:
    """Check the place of ``NAME.json``, and of ``NAME.npz`` and ``NAME.html`` beside it.

    Raises
    ------
    OptionError
        If the name does not end in ``.json``.
    OutputError
        If a file exists or could not be written.
    """
    files = _named(document, (".json",))
    check_outputs((files.document, files.observations, files.page), is_overwriting=is_overwriting)
    return files


def document_and_page(document: Path, *, is_overwriting: bool) -> OutputFiles:
    """Check the place of ``NAME.json``, and of ``NAME.html`` beside it; raises the same."""
    files = _named(document, (".json",))
    check_outputs((files.document, files.page), is_overwriting=is_overwriting)
    return files


def cloud_outputs(document: Path, *, is_overwriting: bool) -> OutputFiles:
    """Check the place of ``NAME.ply`` or ``NAME.xyz``, and of ``NAME.html``; raises the same."""
    files = _named(document, (".ply", ".xyz"))
    check_outputs((files.document, files.page), is_overwriting=is_overwriting)
    return files


def _named(document: Path, suffixes: tuple[str, ...]) -> OutputFiles:
    if document.suffix.lower() not in suffixes:
        raise OptionError(
            f"the output's name ends in '{document.suffix}'",
            where=f"-o {document}",
            remedy=f"end it in {' or '.join(suffixes)}",
        )
    return OutputFiles(document)
