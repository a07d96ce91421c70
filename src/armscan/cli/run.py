# SPDX-License-Identifier: Apache-2.0
"""From the words after armscan to an exit code; failures become a sentence."""

from __future__ import annotations

import atexit
import gc
import io
import os
import signal
import stat
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn, cast

import typer

from armscan.errors import ArmscanError

VARIABLE = "NUMBA_CACHE_DIR"


def give_kernels_a_folder(package: Path, temporary: Path | None = None) -> None:
    """Point numba at a folder of this user if it would find none, as in a container.

    Without one, numba refuses every kernel. What a folder holds is run as code, so that one that
    another user made, or may write, is not taken.

    Parameters
    ----------
    package
        The installed package, beside whose kernels numba keeps them where it can.
    temporary
        Folder for temporary files; that of the system if None.
    """
    if VARIABLE in os.environ:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    if _may_be_written(package / "kernels" / "__pycache__") or _may_be_written(
        Path(home) / "numba"
    ):
        return
    place = Path(tempfile.gettempdir()) if temporary is None else temporary
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = place / f"armscan-kernels-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == user
        if not is_own or status.st_mode & 0o022:
            folder = Path(tempfile.mkdtemp(prefix="armscan-kernels-", dir=place))
    except OSError:
        return
    os.environ[VARIABLE] = str(folder)


def _may_be_written(folder: Path) -> bool:
    """Whether a file can be made in a folder, tried as numba tries it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


YOUNG_OBJECTS = 20_000
"""So many more, and cycles are looked for: imports and pages make few. At Python's 700 it took a
twentieth of a calibration."""
USAGE_ERROR = cast(type[Exception], typer.BadParameter.__bases__[0])
EXIT_INPUT = 2
EXIT_BUG = 70
EXIT_INTERRUPTED = 130
EXIT_ENDED = 128 + signal.SIGTERM


@dataclass(slots=True)
class Ending:
    """Whether another program asked this one to end."""

    is_asked: bool = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Unwind as on Ctrl-C, so that what is half-written goes."""
        self.is_asked = True
        raise KeyboardInterrupt


@contextmanager
def ended_in_order() -> Iterator[Ending]:
    """While the block runs, SIGTERM (of kill, of a service, of a shutdown) is as Ctrl-C."""
    ending = Ending()
    if threading.current_thread() is not threading.main_thread():
        # Python takes handlers from the main thread only
        yield ending
        return
    before = signal.signal(signal.SIGTERM, ending.interrupt)
    try:
        yield ending
    finally:
        signal.signal(signal.SIGTERM, before)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``armscan`` and return its exit code.

    0 means done, 1 that a check was made and not passed, 2 that the input or the disk stood in the
    way (one sentence on standard error says what to do), 130 that a person interrupted, 143 that
    another program asked it to end, 70 a bug.

    Parameters
    ----------
    arguments
        Words after ``armscan``; those of the process if None. An interrupt then ends the process.
    """
    gc.set_threshold(YOUNG_OBJECTS)
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    give_kernels_a_folder(Path(__file__).parents[1])
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a terminal that has no sign for ± or ° shows a question mark instead of failing
        sys.stdout.reconfigure(errors="replace")
    with ended_in_order() as ending:
        try:
            code = _run(arguments)
        except KeyboardInterrupt:
            # a second one, while the first was told
            code = EXIT_INTERRUPTED
    if code != EXIT_INTERRUPTED:
        return code
    word = "ended" if ending.is_asked else "interrupted"
    code = EXIT_ENDED if ending.is_asked else EXIT_INTERRUPTED
    sentence = f"{word}; no file is left half-written"
    return _leave(sentence, code) if arguments is None else _fail(sentence, code, prefix="")


def _leave(sentence: str, code: int) -> NoReturn:
    """End the process without waiting for threads, whose work nobody wants any more.

    Nor does Python end it, which takes an interrupt within ``exec`` for one that nobody caught, and
    ends by the signal instead of with the code.
    """
    try:
        # nobody may read the streams any more
        with suppress(OSError, ValueError):
            _fail(sentence, code, prefix="")
        atexit._run_exitfuncs()
        with suppress(OSError, ValueError):
            sys.stdout.flush()
        with suppress(OSError, ValueError):
            sys.stderr.flush()
    finally:
        os._exit(code)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        from armscan.cli.app import command

        result = command()(
            args=None if arguments is None else list(arguments),
            prog_name="armscan",
            standalone_mode=False,
        )
        return result if isinstance(result, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        with suppress(ValueError):
            # of another thread than the main one
            if arguments is None:
                signal.signal(signal.SIGINT, signal.SIG_IGN)
        return EXIT_INTERRUPTED
    except (ArmscanError, OSError, MemoryError, USAGE_ERROR) as error:
        return _fail(_sentence(error), EXIT_INPUT)
    except Exception as error:
        if os.environ.get("ARMSCAN_DEBUG"):
            raise
        return _fail(
            f"this is a bug in armscan ({type(error).__name__}: {error}). "
            "Run again with ARMSCAN_DEBUG=1 and report what it prints.",
            EXIT_BUG,
        )


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror or error}. Check the path, its permissions and the space."
    if isinstance(error, MemoryError):
        return "there is not enough memory. Use fewer or smaller images."
    if isinstance(error, ArmscanError):
        return str(error)
    message = cast(str, getattr(error, "format_message", error.__str__)())
    message = message.replace(": Value error, ", ": ")
    hint = "Put quotes around patterns" if "unexpected extra arg" in message else "Add -h for help"
    message = message.replace("\n", " ").rstrip(".")
    return f"{message}{'' if message.endswith('?') else '.'} {hint}."


def _fail(sentence: str, code: int, prefix: str = "error: ") -> int:
    typer.echo(f"{prefix}{sentence}", err=True)
    sys.stderr.flush()
    return code
