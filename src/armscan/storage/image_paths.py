# SPDX-License-Identifier: Apache-2.0
"""Files, folders and patterns on the command line to a list of image files, and whether these
were rendered.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path

from armscan.errors import FileFormatError, OptionError, begun
from armscan.storage.codec import parse_json, parse_toml
from armscan.storage.files import (
    files_in,
    holds_files,
    is_file,
    packed_place,
    present_path,
    read_bytes,
)

IMAGE_SUFFIXES = frozenset({".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm", ".ppm"})

LISTED = 8

MAGIC = re.compile(r"[*?\[]")


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key in which ``frame2`` comes before ``frame10``; ties are broken by the text."""
    words = re.split(r"(\d+)", text)
    key = [(1, int(word), "") if word.isdecimal() else (0, 0, word) for word in words]
    return (*key, (0, 0, text))


def expand_paths(patterns: Iterable[str | Path]) -> tuple[Path, ...]:
    """Turn files, folders and quoted patterns into image files.

    A folder stands for the images in it, a pattern for the files that match; each is sorted in
    natural order, and the order of the arguments is kept. A file that is named twice is taken once.
    Hidden files (``._photo.jpg``) are left out unless they are named.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        for path in _expand(str(pattern)):
            found.setdefault(path)
    if not found:
        raise FileFormatError("no image was given", remedy="name files, a folder or a pattern")
    return tuple(found)


def named_by(patterns: Iterable[str], names: Sequence[str]) -> tuple[str, ...]:
    """Names that ``--leave-out`` with names and patterns stands for, in the order of ``names``.

    Parameters
    ----------
    patterns
        Each is a name, its last parts (the file's name without its folders), or a pattern with
        ``*``, ``?`` and ``[...]`` of either.
    names
        What there is.

    Raises
    ------
    OptionError
        If one of them names nothing.
    """
    chosen: set[str] = set()
    for pattern in patterns:
        found = {name for name in names if _is_named(name, pattern)}
        if not found:
            raise OptionError(
                f"'{pattern}' is the name of none of {len(names)} images ({begun(names, LISTED)})",
                where="--leave-out",
                remedy="give names as reports show them, or a quoted pattern",
            )
        chosen |= found
    return tuple(name for name in names if name in chosen)


def _is_named(name: str, pattern: str) -> bool:
    parts = name.split("/")
    tails = ["/".join(parts[k:]) for k in range(len(parts))]
    return pattern in tails or any(fnmatchcase(tail, pattern) for tail in tails)


def _expand(pattern: str) -> list[Path]:
    try:
        return _found(pattern)
    except OSError as error:
        raise FileFormatError(
            f"the path cannot be read ({error.strerror})", where=pattern, remedy="check the path"
        ) from error


def _found(pattern: str) -> list[Path]:
    path = Path(pattern)
    if holds_files(path):
        images = [item for item in files_in(path) if _is_image_name(item.name)]
        if not images and path.suffix.lower() == ".mcap":
            raise FileFormatError(
                "this is a recording in one file, where images are asked for",
                where=pattern,
                remedy=f"write its images with `armscan convert {path} FOLDER`, and name "
                "FOLDER/images",
            )
        if not images:
            raise FileFormatError(
                "the folder holds no image",
                where=pattern,
                remedy="name the folder that holds the PNG, BMP, JPEG, TIFF or PGM files",
            )
        return sorted(images, key=lambda item: natural_key(item.as_posix()))
    if path.exists() or is_file(path):
        return [path]
    if not MAGIC.search(pattern):
        raise FileFormatError("there is no such file", where=pattern, remedy="check the path")
    root = Path(path.anchor)
    if packed_place(path.parent) is not None:
        files = [one for one in files_in(path.parent) if fnmatchcase(one.name, path.name)]
    else:
        # the name of a folder that is there may hold the signs of a pattern
        start = path.parent if path.parent.is_dir() else root
        files = [match for match in start.glob(str(path.relative_to(start))) if match.is_file()]
    if not path.name.startswith("."):
        files = [one for one in files if not one.name.startswith(".")]
    if not files:
        raise FileFormatError(
            "no file matches the pattern",
            where=pattern,
            remedy="check the folder and the ending, and put quotes around the pattern",
        )
    return sorted(files, key=lambda item: natural_key(item.as_posix()))


def _is_image_name(name: str) -> bool:
    """Hidden files are none: macOS leaves ``._photo.jpg`` beside ``photo.jpg`` on other disks."""
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


LEVELS = 4


def are_simulated(paths: Iterable[Path]) -> bool:
    """True if any file lies, up to four folders deep, beside a mark of the simulator.

    The mark is ``simulated = true`` in a recording's ``session.toml``, or ``"simulated": true`` in
    the ``truth.json`` of rendered photographs; the truth itself is never read.
    """
    present = (present_path(path).resolve() for path in paths)
    folders = {folder for path in present for folder in islice(path.parents, LEVELS)}
    names = ("truth.json", "session.toml")
    return any(_says_simulated(folder / name) for folder in folders for name in names)


def _says_simulated(path: Path) -> bool:
    try:
        data, is_toml = read_bytes(path), path.suffix == ".toml"
        said = parse_toml(data, path.name, "") if is_toml else parse_json(data, path.name)
    except FileFormatError:
        return False
    return said.get("simulated") is True
