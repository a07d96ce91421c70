# SPDX-License-Identifier: Apache-2.0
"""The one place where failures become a sentence and an exit code."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import typer

from armscan.errors import ArmscanError

USAGE_ERROR = cast(type[Exception], typer.BadParameter.__bases__[0])
EXIT_INPUT = 2
EXIT_BUG = 70
EXIT_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``armscan`` and return its exit code.

    0 means done, 1 that a check was made and not passed, 2 that the input or the disk stood in the
    way (one sentence on standard error says what to do), 130 that a person interrupted, 70 a bug.

    Parameters
    ----------
    arguments
        Words after ``armscan``; those of the process if None.
    """
    from armscan.cli.app import command
    from armscan.cli.compiled_kernels import give_kernels_a_folder

    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    give_kernels_a_folder(Path(__file__).parents[1])
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a terminal that has no sign for ± or ° shows a question mark instead of failing
        sys.stdout.reconfigure(errors="replace")
    try:
        result = command()(
            args=None if arguments is None else list(arguments),
            prog_name="armscan",
            standalone_mode=False,
        )
        code = result if isinstance(result, int) else 0
        return _interrupted() if code == EXIT_INTERRUPTED else code
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
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
    return f"{message.replace(chr(10), ' ').rstrip('.')}. {hint}."


def _interrupted() -> int:
    return _fail("interrupted; no file is left half-written", EXIT_INTERRUPTED, prefix="")


def _fail(sentence: str, code: int, prefix: str = "error: ") -> int:
    typer.echo(f"{prefix}{sentence}", err=True)
    sys.stderr.flush()
    return code
