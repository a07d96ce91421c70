# SPDX-License-Identifier: Apache-2.0
"""Files read whole; files and folders that appear complete or not at all."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias
from uuid import uuid4

from armscan.errors import FileFormatError, InputError, OutputError

if TYPE_CHECKING:
    from armscan.storage.recordings.mcap_folder import McapFolder

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows has none
    fcntl = None  # type: ignore[assignment]

STALE_SECONDS = 86_400.0
"""Where files cannot be locked, what an interrupted run left is taken for a rest after a day."""


MAKE_ROOM = "free some space or choose another folder"
_NAMES_TO_COME: dict[Path, Path] = {}
"""Folders that `replaced_folder` lends, and how the folder is called whose place they take."""


def told_path(path: Path) -> Path:
    """Where a file will lie, if it lies in a folder that has not got its name yet."""
    for part, folder in _NAMES_TO_COME.items():
        if path.is_relative_to(part):
            return folder / path.relative_to(part)
    return path


def present_path(told: Path) -> Path:
    """Where a file lies now that `told_path` told of."""
    for part, folder in _NAMES_TO_COME.items():
        if told.is_relative_to(folder):
            return part / told.relative_to(folder)
    return told


def path_text(path: Path | str) -> str:
    """The path as `told_path`, with ``/``; bytes that are not UTF-8 are told as ``\\xef``."""
    text = told_path(path).as_posix() if isinstance(path, Path) else path
    return os.fsencode(text).decode("utf-8", "backslashreplace")


RECORDING_SUFFIX = ".mcap"


def packed_place(path: Path) -> tuple[Path, str] | None:
    """The file that is read as a folder and that a path leads into, and the path inside of it.

    A recording in one file is read as the folder that it holds: ``scan.mcap/exposures.csv`` is its
    list of exposures. None for all other paths.
    """
    for place in (path, *path.parents):
        if place.suffix.lower() == RECORDING_SUFFIX:
            try:
                is_packed = place.is_file()
            except (OSError, ValueError):
                return None
            if is_packed:
                return place, "" if place == path else path.relative_to(place).as_posix()
    return None


def is_file(path: Path) -> bool:
    """True for a file, also in a recording of one file; False also for a path no system takes."""
    try:
        packed = packed_place(path)
        if packed is not None and packed[1]:
            return packed[1] in _packed_folder(packed[0])
        return path.is_file()
    except (OSError, ValueError, FileFormatError):
        return False


def holds_files(path: Path) -> bool:
    """True for a folder, and for a recording in one file or a folder in it."""
    packed = packed_place(path)
    if packed is None:
        return is_folder(path)
    return not packed[1] or bool(files_in(path))


def files_in(path: Path) -> tuple[Path, ...]:
    """What lies in a folder, as `holds_files` says; of a recording in one file only files."""
    packed = packed_place(path)
    if packed is None:
        return tuple(path.iterdir())
    start = f"{packed[1]}/" if packed[1] else ""
    names = (
        name.removeprefix(start)
        for name in _packed_folder(packed[0]).names
        if name.startswith(start)
    )
    return tuple(path / name for name in names if "/" not in name)


def _packed_folder(path: Path) -> McapFolder:
    from armscan.storage.recordings.mcap_folder import folder_in  # it reads files itself

    return folder_in(path)


def packed_notes(path: Path) -> tuple[str, ...]:
    """What a recording in one file holds and its tables do not list; nothing of any other path."""
    packed = packed_place(path)
    return () if packed is None else _packed_folder(packed[0]).notes


def damaged_images(path: Path) -> tuple[str, ...]:
    """Images of a recording in one file that cannot be read; nothing of any other path."""
    packed = packed_place(path)
    return () if packed is None else _packed_folder(packed[0]).damaged_images


def is_folder(path: Path) -> bool:
    """True for a folder; False also for a path that no system takes."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def read_bytes(path: Path) -> bytes:
    """Content of a file that must exist and hold something."""
    packed = packed_place(path)
    if packed is not None and packed[1]:
        return _packed_folder(packed[0]).read(packed[1])
    with _reading(path) as file:
        data = file.read()
    if not data:
        raise _empty(path)
    return data


def sha256_of(path: Path) -> str:
    """SHA-256 of what `read_bytes` would read, which need not fit into memory."""
    packed = packed_place(path)
    if packed is not None and packed[1]:
        return hashlib.sha256(read_bytes(path)).hexdigest()
    with _reading(path) as file:
        digest, size = hashlib.file_digest(file, "sha256"), file.tell()
    if not size:
        raise _empty(path)
    return digest.hexdigest()


def _empty(path: Path) -> FileFormatError:
    return FileFormatError(
        "the file is empty (0 bytes)", where=path_text(path), remedy="copy the file again"
    )


@contextmanager
def _reading(path: Path) -> Iterator[FileIO]:
    """Open a file that must exist, and say why it cannot be read."""
    where = path_text(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise FileFormatError("this is a folder, not a file", where=where, remedy="name a file")
        if not stat.S_ISREG(mode):
            raise FileFormatError(
                "this is a pipe or a device, not a file", where=where, remedy="name a file"
            )
        with path.open("rb", buffering=0) as file:
            yield file
    except FileNotFoundError as error:
        raise FileFormatError(
            "there is no such file", where=where, remedy="check the path"
        ) from error
    except (OSError, ValueError) as error:
        fact = error.strerror if isinstance(error, OSError) else error
        raise FileFormatError(
            f"the file cannot be read ({fact})", where=where, remedy="check the path and its rights"
        ) from error


@contextmanager
def told_of(where: str, *, remedy: str = "") -> Iterator[None]:
    """Say of an `InputError` in which file the input stands."""
    try:
        yield
    except InputError as error:
        raise FileFormatError(error.what, where=where, remedy=remedy or error.remedy) from error


def check_outputs(paths: Iterable[Path], *, is_overwriting: bool = False) -> None:
    """Raise before long work if a result could not be written afterwards.

    ``is_overwriting`` allows files that exist; folders are refused all the same.
    """
    for path in paths:
        folder, where = path.parent, path_text(path)
        _check_parent(folder)
        if path.is_dir():
            raise OutputError("this is a folder", where=where, remedy="name a file to write")
        if path.exists() and not is_overwriting:
            raise _existing(path)
        if not os.access(folder, os.W_OK):
            raise OutputError(
                "the folder may not be written",
                where=path_text(folder),
                remedy="choose another folder",
            )


Content: TypeAlias = bytes | Iterable[bytes]
"""Of a file: all of it, or pieces that follow each other."""


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}.before")


def check_aside(path: Path) -> None:
    """Raise `OutputError` if a file that `set_aside` moved was never brought back or removed."""
    if _aside(path).exists():
        raise OutputError(
            f"an earlier file of this name lies in {_aside(path).name}: the run that was to "
            "replace it was killed, or still goes on",
            where=path_text(path),
            remedy="rename that file to keep it or remove it, or choose another name",
        )


@dataclass(frozen=True, slots=True)
class SetAside:
    """A file that was given another name, and what it was then.

    Parameters
    ----------
    path
        Where it lies.
    state
        Which file it is, how long and when it was written last.
    """

    path: Path
    state: tuple[int, ...]

    def remove(self) -> bool:
        """Remove it; False where it is another file, or grew since: it stays then."""
        with suppress(OSError):
            if _state(self.path) != self.state:
                return False
            self.path.unlink()
        return not self.path.exists()


def _state(path: Path) -> tuple[int, ...]:
    # opened, for a file system of a network may tell what it knew of it before
    with path.open("rb") as file:
        found = os.fstat(file.fileno())
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def set_aside(path: Path, *, is_overwriting: bool = False) -> SetAside | None:
    """Give a file another name until its successor is there; None where there is no file.

    Where nothing can be locked a file that another run writes is not known: it only grows later.

    Raises
    ------
    OutputError
        As `check_outputs` and `check_aside`, or if another run writes the file now.
    """
    check_outputs((path,), is_overwriting=is_overwriting)
    check_aside(path)
    if not path.exists():
        return None
    if _is_held(path):
        raise OutputError(
            "another run writes this file",
            where=path_text(path),
            remedy="wait for its end, or choose another name",
        )
    with _refusing("the file cannot be replaced", path, "choose another name"):
        state = _state(path)
        _rename(path, _aside(path))
    return SetAside(_aside(path), state)


def bring_back(aside: SetAside, path: Path) -> None:
    """Undo `set_aside`; raises `OutputError` where another program took the name meanwhile."""
    remedy = "both files are whole: rename them as you like"
    with _refusing(f"what was there before lies in {aside.path.name}", path, remedy):
        _rename(aside.path, path)


def settle_aside(path: Path) -> None:
    """End what a killed run left of `set_aside`: its file goes, or takes a name that is free."""
    with _refusing("the file cannot be replaced", path):
        if path.exists():
            _aside(path).unlink(missing_ok=True)
        elif _aside(path).exists():
            _rename(_aside(path), path)


def _rename(path: Path, free: Path) -> None:
    """Give a name that nothing has; raise `FileExistsError` where something does."""
    _give_name(path, free, is_overwriting=False)
    path.unlink(missing_ok=True)


def make_folder(folder: Path, *, with_parents: bool = False) -> None:
    """Make a folder where there is none; those above it, too, only where that is asked for."""
    with _refusing("the folder cannot be made", folder, "choose another place"):
        folder.mkdir(parents=with_parents, exist_ok=True)


@contextmanager
def _refusing(fact: str, where: Path, remedy: str = MAKE_ROOM) -> Iterator[None]:
    """Tell what the system refuses as an `OutputError` of this fact, with the system's reason."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{fact} ({error.strerror or error})", where=path_text(where), remedy=remedy
        ) from error


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Hold a folder while the block runs; what a killed run held is free again.

    Where folders cannot be locked (some file systems of networks), nothing is held.
    """
    if fcntl is None:
        yield
        return
    remedy = "check its rights, or choose another folder"
    with _refusing("the folder cannot be read", folder, remedy):
        handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise OutputError(
            "another run writes into this folder",
            where=path_text(folder),
            remedy="wait for its end, or name another folder",
        ) from error
    except OSError:  # no locks there
        pass
    try:
        yield
    finally:
        os.close(handle)


def write_files(contents: Mapping[Path, Content], *, is_overwriting: bool = False) -> None:
    """Write files that belong together, each of them complete.

    Each is written under another name in its folder, and all get their names at the end, so that a
    full disk or an interrupt leaves what was there before. What a killed run left of files of
    these names is removed.

    Raises
    ------
    OutputError
        As `check_outputs`, also if another program wrote such a file meanwhile; or if the disk is
        full or refuses. If it refuses one of the names, the message says which files were written.
    """
    check_outputs(contents, is_overwriting=is_overwriting)
    parts = {path: _part_name(path) for path in contents}
    done: list[Path] = []
    try:
        with ExitStack() as locks:
            for path, part in parts.items():
                _remove_rests(path)
                _write_part(part, contents[path], locks)
            for path, part in parts.items():
                _give_name(part, path, is_overwriting=is_overwriting)
                done.append(path)
    except FileExistsError as error:
        for path in done:
            path.unlink()
        raise _existing(Path(error.filename2)) from error
    except OSError as error:
        what = f"only {', '.join(path.name for path in done)}" if done else "nothing"
        raise OutputError(
            f"{what} was written ({error.strerror})",
            where=", ".join(path_text(path) for path in contents),
            remedy=MAKE_ROOM,
        ) from error
    finally:
        for part in parts.values():
            with suppress(OSError):
                part.unlink(missing_ok=True)


def check_new_folder(folder: Path) -> None:
    """Raise before long work if a folder could not be written afterwards."""
    target, where = folder.resolve(), path_text(folder)
    if target in (Path.cwd(), Path(target.anchor)):
        raise OutputError(
            "this is the current folder or a root, which cannot be made anew",
            where=where,
            remedy="name a new folder, as scan",
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError("this exists and is not empty", where=where, remedy="name a new folder")
    _check_parent(target.parent)


@contextmanager
def new_folder(folder: Path, beside: Mapping[Path, bytes] | None = None) -> Iterator[Path]:
    """Give a folder of another name to write into; it gets its name when the block has ended.

    If the block raises or is interrupted, nothing is left of it; what a killed run left of a folder
    of this name is removed.

    Files ``beside`` it must not exist; they are written when it is complete, just before it gets
    its name, so that it is never seen without them.
    """
    check_new_folder(folder)
    target = folder.resolve()
    _remove_rests(target)
    partial = _part_name(target)
    try:
        with _refusing("nothing was written", folder):
            partial.mkdir()
            with locked(partial):
                yield partial
                write_files(beside or {})
                try:
                    if target.exists():
                        target.rmdir()
                    partial.rename(target)
                except BaseException:
                    for path in beside or ():
                        path.unlink(missing_ok=True)
                    raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def replaced_folder(folder: Path, check: Callable[[], None]) -> Iterator[Path]:
    """Give a folder of another name to write into; it takes the folder's place when it is complete.

    Until then the folder stays as it is, also if the block raises or the run is killed. A folder
    that a killed run moved away and did not replace comes back, what else it left is removed.
    Documents written meanwhile name files where they will lie.

    ``check`` raises if the folder may not be replaced; it is asked before anything is written and
    at the end.
    """
    target = folder.resolve()
    partial = _part_name(target)
    try:
        with _refusing("nothing was written", folder):
            target.parent.mkdir(parents=True, exist_ok=True)
            _bring_back(target)
            check()
            _remove_rests(target)
            partial.mkdir()
            with locked(partial):
                _NAMES_TO_COME[partial] = folder
                yield partial
                check()
                _swap(partial, target)
    finally:
        _NAMES_TO_COME.pop(partial, None)
        shutil.rmtree(partial, ignore_errors=True)


def _swap(partial: Path, target: Path) -> None:
    """Exchange them: what is now the partial one, whole or not, is a rest that goes."""
    if not target.exists():
        partial.rename(target)
        return
    old = partial.with_suffix(".old")
    with locked(target):
        target.rename(old)
        try:
            partial.rename(target)
        except BaseException:
            old.rename(target)
            raise
        old.rename(partial)


def _bring_back(target: Path) -> None:
    """Undo the half exchange of a killed run, where nothing else has the name."""
    for old in _rests(target, ".old"):
        if _is_abandoned(old):
            with suppress(OSError):
                target.rmdir()
            if not target.exists():
                old.rename(target)


def _check_parent(folder: Path) -> None:
    if folder.is_dir():
        return
    is_file = folder.exists()
    raise OutputError(
        "this is a file, not a folder to write to" if is_file else "there is no such folder",
        where=path_text(folder),
        remedy="choose another folder" if is_file else "create it first",
    )


def _existing(path: Path) -> OutputError:
    return OutputError(
        "the file exists", where=path_text(path), remedy="choose another name or give --force"
    )


def _part_stem(path: Path) -> str:
    """What all temporary names of one file begin with: short, so that long names have one too."""
    return f".{path.name[:40]}.{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:12]}."


def _part_name(path: Path) -> Path:
    return path.with_name(f"{_part_stem(path)}{uuid4().hex[:12]}.part")


@contextmanager
def scratch_folder(document: Path) -> Iterator[Path]:
    """Give a folder beside a document for what grows while it is made; it goes with the block.

    What a killed run left of it is removed by the next one that makes this document.
    """
    _remove_rests(document)
    folder = _part_name(document)
    with _refusing("nothing can be written there", folder.parent):
        folder.mkdir()
    try:
        with locked(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write_part(part: Path, content: Content, locks: ExitStack) -> None:
    with part.open("xb") as file:
        locks.enter_context(locked(part))
        for piece in (content,) if isinstance(content, bytes) else content:
            file.write(piece)
        file.flush()
        os.fsync(file.fileno())


def _give_name(part: Path, path: Path, *, is_overwriting: bool) -> None:
    """Rename a complete file; raise `FileExistsError` if another program took the name."""
    if not is_overwriting:
        try:
            os.link(part, path)
        except FileExistsError:
            raise
        except OSError:
            # a file system without hard links: between question and answer another may write
            if path.exists():
                raise FileExistsError(17, "exists", str(part), None, str(path)) from None
        else:
            return
    part.replace(path)


@contextmanager
def locked(part: Path) -> Iterator[None]:
    """Hold a lock while something is written, so that a second run does not take it for a rest."""
    if fcntl is None:
        yield
        return
    handle = _opened(part)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def _opened(path: Path) -> int:
    """A handle to lock: NFS gives an exclusive lock to those alone that may write."""
    if not path.is_dir():
        with suppress(OSError):
            return os.open(path, os.O_RDWR)
    return os.open(path, os.O_RDONLY)


def _is_held(path: Path) -> bool:
    """Whether a run has it `locked`; False where files cannot be locked."""
    if fcntl is None:
        return False
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _remove_rests(path: Path) -> None:
    """Remove what killed runs left of a file or folder of this name."""
    with suppress(OSError):
        for rest in _rests(path, ".part", ".old"):
            if _is_abandoned(rest):
                shutil.rmtree(rest, ignore_errors=True) if rest.is_dir() else rest.unlink()


def _rests(path: Path, *suffixes: str) -> list[Path]:
    stem = _part_stem(path)
    found = path.parent.iterdir()
    return sorted(item for item in found if item.name.startswith(stem) and item.suffix in suffixes)


def _is_abandoned(part: Path) -> bool:
    if fcntl is None:
        return time.time() - part.stat().st_mtime > STALE_SECONDS
    handle = _opened(part)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(handle)
    return True
