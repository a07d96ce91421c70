# SPDX-License-Identifier: Apache-2.0
"""The net: runs every command on small inputs and compares what comes out with what once came out.

    python tests/net/run.py compare [--only reconstruct] [--sigma]
    python tests/net/run.py make [--only reconstruct]

Only the command line and the files it writes are used, so that anything inside may be rebuilt.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    # as the tests: sums in another order end the hand-eye's noise rounds elsewhere
    os.environ.setdefault(library, "1")

from net.cases import DOCUMENTS, GROUPS, prepare  # noqa: E402
from net.compare import Difference, Limits, Tree, differences, masked, plain, read_result, told  # noqa: E402

GOLDEN = HERE / "golden"
INPUTS = HERE / "inputs"


def run_command(words: list[str], workspace: Path) -> dict[str, Tree]:
    """Exit code, standard output and error of one command, and the files it wrote or changed."""
    from armscan.cli import main

    before = listing(workspace)
    out, err = io.StringIO(), io.StringIO()
    with watch_errors() as errors, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    stderr = masked(err.getvalue(), workspace)
    result: dict[str, Tree] = {"exit": code}
    if code not in (0, 1):
        result["error"] = next((n for n, text in errors[::-1] if text in err.getvalue()), "")
        result["says"] = first_words(stderr)
    result["~stderr"] = stderr.strip()
    text = out.getvalue()
    if "--json" in words and text.startswith(("{", "[")):
        result["json"] = plain(json.loads(text), workspace)
    else:
        result["has_output"] = bool(text)
        result["~stdout"] = masked(text, workspace).splitlines()[:60]
    changed = [path for path, stamp in listing(workspace).items() if before.get(path) != stamp]
    result["files"] = {str(path): read_result(workspace / path, workspace) for path in changed}
    return result


def first_words(sentence: str) -> str:
    words = [word for word in sentence.split() if re.fullmatch(r"[A-Za-z'-]+[:,;.]?", word)]
    return " ".join(words[:3])


@contextlib.contextmanager
def watch_errors() -> Iterator[list[tuple[str, str]]]:
    """Types and sentences of the package's own errors that were made meanwhile."""
    from armscan.errors import ArmscanError

    made: list[BaseException] = []
    texts: list[tuple[str, str]] = []

    def new(cls: type, *_args: object, **_named: object) -> BaseException:
        error = Exception.__new__(cls, *_args)
        made.append(error)
        return error

    ArmscanError.__new__ = new  # type: ignore[method-assign,assignment]
    try:
        yield texts
    finally:
        del ArmscanError.__new__
        texts += [(type(error).__name__, str(error)) for error in made if str(error)]


def listing(workspace: Path) -> dict[Path, tuple[int, int]]:
    found = {}
    for folder, folders, names in os.walk(workspace):
        folders[:] = sorted(set(folders) - {"armscan-cache"})
        for name in sorted(names):
            path = Path(folder) / name
            stat = path.stat()
            found[path.relative_to(workspace)] = (stat.st_size, stat.st_mtime_ns)
    return found


def run_group(name: str, root: Path) -> dict[str, Tree]:
    workspace = root / name
    shutil.copytree(INPUTS, workspace)
    shutil.copytree(HERE / "old", workspace / "old")
    prepare(workspace)
    results: dict[str, Tree] = {}
    with contextlib.chdir(workspace):
        for case, command in GROUPS[name]:
            start = time.perf_counter()
            found = run_command(shlex.split(command), workspace)
            results[case] = {"~command": command, **found}
            spent = time.perf_counter() - start
            if os.environ.get("NET_VERBOSE"):
                print(f"{name}/{case}  exit {found['exit']}  {spent:.1f} s", file=sys.stderr)
    return results


def make_documents() -> None:
    """Calibrations, clouds and lists that the other commands start from, into ``inputs/``."""
    with tempfile.TemporaryDirectory() as temporary:
        workspace = Path(temporary) / "w"
        shutil.copytree(INPUTS, workspace, ignore=shutil.ignore_patterns("documents"))
        (workspace / "documents").mkdir()
        with contextlib.chdir(workspace):
            for _, command in DOCUMENTS:
                result = run_command(shlex.split(command), workspace)
                if result["exit"] != 0:
                    raise SystemExit(f"{command}\n{result}")
        shutil.rmtree(INPUTS / "documents", ignore_errors=True)
        for path in workspace.rglob("documents/*.ply"):
            thin(path)
        unkept = shutil.ignore_patterns(
            "*.html", "armscan-cache", "multi.npz", "cross.npz", "right.npz"
        )
        shutil.copytree(workspace / "documents", INPUTS / "documents", ignore=unkept)


def thin(path: Path, n_kept: int = 300) -> None:
    """Keep evenly spread points of a binary cloud."""
    head, _, rows = path.read_bytes().partition(b"end_header\n")
    found = re.search(rb"element vertex (\d+)", head)
    assert found
    n = int(found[1])
    size = len(rows) // n
    kept = [k * n // n_kept for k in range(n_kept)]
    head = head.replace(found[0], b"element vertex %d" % n_kept)
    body = b"".join(rows[k * size : (k + 1) * size] for k in kept)
    path.write_bytes(head + b"end_header\n" + body)


def golden_file(name: str) -> Path:
    return GOLDEN / f"{name}.json"


def compare_group(name: str, root: Path, limits: Limits) -> list[Difference]:
    old = json.loads(golden_file(name).read_text("utf-8"))
    new = json.loads(json.dumps(run_group(name, root)))
    return list(differences(old, new, limits, name))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["compare", "make", "make-inputs"])
    parser.add_argument("--only", action="append", choices=sorted(GROUPS), help="group; repeatable")
    parser.add_argument(
        "--sigma",
        type=float,
        nargs="?",
        const=1e-2,
        metavar="PART",
        help="another machine: this part of each value's sigma (1e-2), else 1e-6 of it",
    )
    parser.add_argument("--all", action="store_true", help="all, not the worst 4 of a case")
    parser.add_argument("--no-warnings", action="store_true", help="leave prose differences out")
    options = parser.parse_args(arguments)
    if options.what == "make-inputs":
        make_documents()
        return 0
    limits = Limits(1e-6, options.sigma) if options.sigma else Limits()
    n_wrong = 0
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.only or GROUPS:
            if options.what == "make":
                results = run_group(name, Path(temporary))
                GOLDEN.mkdir(exist_ok=True)
                text = json.dumps(results, indent=1, ensure_ascii=False)
                text = re.sub(r"\[[^\[\]{}\"]*\]", lambda m: re.sub(r"\s+", " ", m[0]), text)
                golden_file(name).write_text(text + "\n", "utf-8")
                continue
            found = compare_group(name, Path(temporary), limits)
            wrong = [d for d in found if not d.is_warning]
            n_wrong += len(wrong)
            shown = wrong if options.no_warnings else found
            if shown:
                print(told(shown, is_whole=options.all))
            print(f"{name}: {len(wrong)} differ, {len(found) - len(wrong)} warnings", flush=True)
    print(f"{time.perf_counter() - start:.0f} s")
    return 1 if n_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
