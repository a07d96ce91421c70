# SPDX-License-Identifier: Apache-2.0
"""What armscan's readers do with damaged and hostile files: seeded mutations of valid ones.

Of each reader's valid files, bytes, numbers, words, lines or the name are changed. The reader must
return something or raise an `ArmscanError`. Any other exception, more than `LIMIT_S` seconds of
work or more than `LIMIT_MB` megabytes is a fault. The cases run in other processes, whose memory
is limited.

    python benchmarks/mutated_inputs.py                                 # 31 readers, 1500 each
    python benchmarks/mutated_inputs.py --readers ply png --cases 200
    python benchmarks/mutated_inputs.py --readers ply --first 37 --cases 1 --keep case
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from readers_and_files import Reader, readers

from armscan.errors import ArmscanError

LIMIT_S, LIMIT_MB = 5.0, 1000.0
SILENT_S = 20.0
"""A worker that says nothing for so long hangs in compiled code and is ended."""
LONG_SENTENCE = 400
SEED = 20261122


# mutations --------------------------------------------------------------------------------------

NUMBERS = (
    *("nan", "NaN", "inf", "-inf", "1e999", "-1e999", "1e308", "-1e300", "1e-320", "0", "-0", "-1"),
    *(
        "1e18",
        "9223372036854775808",
        "18446744073709551616",
        "4294967296",
        "2147483648",
        "900000000",
    ),
    *("0x10", "1_000", "1,5", "1.5.2", "--1", "+", "", "null", "true", '"1"', "[]", "{}", "\u00b2"),
    *("1" * 400, "9" * 6000, "0." + "3" * 6000, "\u0661\u0662"),
)
WORDS = (
    *(
        "",
        " ",
        "nan",
        "null",
        "schema",
        "\u00b2",
        "\u00fc",
        "\x00",
        "\x1b]0;x\x07",
        "../../x",
        "/etc/passwd",
    ),
    *(
        "C:\\x",
        "x" * 6000,
        "j300000000_rad",
        "j1000000_rad",
        "x_m",
        "{{7*7}}",
        "<script>",
        "=",
        "a.b.c",
    ),
    *(
        "[",
        "]",
        "{",
        "}",
        '"',
        "'",
        ",",
        ";",
        "\n",
        "#",
        "&#0;",
        "%",
        "[[",
        "]]",
        "-",
        ":",
        "\ufeff",
    ),
)
LINES = (
    *('operators = ["Anna","Bob"]', "[[lens]]", 'name = "x"', "[pose]", "[a.b.c]", "# comment"),
    *(
        "a = " + "[" * 3000,
        "{" * 3000,
        "[" * 5000,
        "<a>" * 3000,
        "a." * 3000 + "b = 1",
        "- " * 3000,
    ),
    *("comment sheet 0 " + "[" * 5000, "property list uchar int x", "property double x"),
    *("element vertex " + "9" * 30, "element vertex 1000000000000", "# point = x", "# frame = x"),
    *("1,2,3", "nan nan nan", ",,,,,,,,", "\t\t", "---", "...", "x: !!python/object:os.system y"),
)
TOKEN = re.compile(rb"[-+]?\d[\d.eE+-]*")
WORD = re.compile(rb"[A-Za-z_][\w./-]*")
FIELDS = (
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x7f\xff\xff\xff",
    b"\0\0\0\0",
    b"\0\0\x7d\0",
    b"\x80\0\0\0",
)


def mutated(data: bytes, rng: np.random.Generator, *, is_text: bool) -> bytes:
    """Content after one to three mutations."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        kinds = TEXT_MUTATIONS if is_text and rng.random() < 0.75 else BYTE_MUTATIONS
        data = kinds[int(rng.integers(len(kinds)))](data, rng)
    return data


def _span(data: bytes, rng: np.random.Generator, most: int) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, min(len(data), start + int(rng.integers(1, most + 1)))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    if not data:
        return data
    content = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 4, 16]))):
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _flip_head(data: bytes, rng: np.random.Generator) -> bytes:
    return _flip(data[:64], rng) + data[64:]


def _cut_end(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _cut_out(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 64)
    return data[:start] + data[end:]


def _zero(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 16)
    return data[:start] + bytes(end - start) + data[end:]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    start, _ = _span(data, rng, 1)
    return data[:start] + rng.bytes(int(rng.integers(1, 64))) + data[start:]


def _double(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 400)
    return data[:end] + data[start:end] * int(rng.choice([1, 2, 50])) + data[end:]


def _field(data: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(min(len(data), 256) + 1))
    value = FIELDS[int(rng.integers(len(FIELDS)))][: int(rng.choice([2, 4]))]
    return data[:start] + value + data[start + len(value) :]


def _odd_whole(data: bytes, rng: np.random.Generator) -> bytes:
    wholes = (
        b"",
        b"\n",
        b"\xff\xfe",
        data + data,
        b"\xef\xbb\xbf" + data,
        rng.bytes(300),
        data[::-1],
    )
    return wholes[int(rng.integers(len(wholes)))]


def _replace(
    data: bytes, rng: np.random.Generator, pattern: re.Pattern[bytes], by: Sequence[str]
) -> bytes:
    found = [item.span() for item in pattern.finditer(data)]
    if not found:
        return data
    start, end = found[int(rng.integers(len(found)))]
    return data[:start] + by[int(rng.integers(len(by)))].encode() + data[end:]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace(data, rng, TOKEN, NUMBERS)


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace(data, rng, WORD, WORDS)


def _scaled(data: bytes, rng: np.random.Generator) -> bytes:
    """All numbers of one length class larger: an absurd scale in place of one absurd number."""
    factor = float(rng.choice([1e-9, 1e-3, 1e3, 1e9, 1e150, -1.0]))

    def larger(found: re.Match[bytes]) -> bytes:
        try:
            return repr(float(found[0]) * factor).encode()
        except ValueError:
            return found[0]

    return re.sub(rb"[-+]?\d+\.\d+(?:e[-+]?\d+)?", larger, data)


def _line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    line, how = lines[k], int(rng.integers(6))
    if how == 0:
        lines[k : k + 1] = []
    elif how == 1:
        lines[k:k] = [line]
    elif how == 2:
        lines[k:k] = [line] * int(rng.choice([100, 5000]))
    elif how == 3:
        other = int(rng.integers(len(lines)))
        lines[k], lines[other] = lines[other], line
    elif how == 4:
        lines[k] = line.replace(b",", b";")
    else:
        lines[k:k] = [LINES[int(rng.integers(len(LINES)))].encode()]
    return b"\n".join(lines)


def _many_lines(data: bytes, rng: np.random.Generator) -> bytes:
    filler = (b"\n", b"#\n", b",,,\n", b"1,2,3\n", b"0 0 0\n")[int(rng.integers(5))]
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    return b"\n".join(lines[:k]) + filler * 60_000 + b"\n".join(lines[k:])


def _line_ends(data: bytes, rng: np.random.Generator) -> bytes:
    return data.replace(
        b"\n", (b"\r\n", b"\r", b"\x0b", b"\xe2\x80\xa8", b"\x1c")[int(rng.integers(5))]
    )


def _many_keys(data: bytes, rng: np.random.Generator) -> bytes:
    """Thousands of keys in the first object, columns in the header, or tables."""
    n = int(rng.choice([1000, 20_000]))
    if data.lstrip().startswith(b"{"):
        extra = b",".join(b'"k%d": %d' % (k, k) for k in range(n))
        return data.replace(b"{", b"{" + extra + b"," + b'"k0": 1,', 1)
    first, _, rest = data.partition(b"\n")
    if b"," in first:
        return first + b"".join(b",c%d" % k for k in range(n)) + b"\n" + rest
    return data + b"\n" + b"".join(b"[[t%d]]\n" % k for k in range(n))


TEXT_MUTATIONS: Sequence[Callable[[bytes, np.random.Generator], bytes]] = (
    *(_number, _number, _number, _number, _word, _word, _scaled, _line, _line, _line),
    *(_many_lines, _line_ends, _many_keys),
)
BYTE_MUTATIONS: Sequence[Callable[[bytes, np.random.Generator], bytes]] = (
    *(_flip, _flip, _flip, _flip_head, _flip_head, _cut_end, _cut_out, _zero, _insert, _double),
    *(_field, _field, _field, _odd_whole),
)


def write_case(folder: Path, reader: Reader, number: int, seed: int) -> None:
    """Write the files of case ``number`` into an empty folder: the same for equal arguments."""
    rng = np.random.default_rng([seed, number])
    files = dict(reader.files[number % len(reader.files)])
    names = reader.mutable or tuple(files)
    chosen = names[int(rng.integers(len(names)))]
    is_text = reader.is_text and not chosen.endswith(".png")
    files[chosen] = mutated(files[chosen], rng, is_text=is_text)
    place = int(rng.integers(60))
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if place == 6 and len(files) == 1:
            path = path.with_name(f"na\udcefve\n{path.suffix}")
        if name != chosen or place >= 5:
            path.write_bytes(content)
        elif place == 0:
            path.mkdir()
        elif place == 1:
            os.mkfifo(path)
        elif place == 2:
            path.symlink_to(path)
        elif place == 3:
            path.symlink_to("/dev/zero")


# running ----------------------------------------------------------------------------------------


class _OverTimeError(BaseException):
    """The case took too long."""


def _over_time(*_: object) -> None:
    raise _OverTimeError


def _status(key: str) -> float:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return float(text.split(f"{key}:")[1].split()[0]) / 1024


def run_case(reader: Reader, folder: Path) -> dict[str, Any]:
    """Outcome of reading a case: what happened, where, seconds and megabytes."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before_mb, start = _status("VmRSS"), time.process_time()
    outcome, place = "accepted", ""
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    try:
        reader.read(folder)
    except ArmscanError as error:
        outcome = "refused"
        sentence = str(error).replace(str(folder), "")
        place = "long" if len(sentence) > LONG_SENTENCE else ""
    except _OverTimeError:
        outcome, place = "slow", _place(sys.exc_info()[2])
    except MemoryError:
        outcome, place = "large", _place(sys.exc_info()[2])
    except Exception as error:
        outcome, place = (
            "other",
            f"{type(error).__name__} {_place(error.__traceback__)} {error!s:.80}",
        )
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    seconds, megabytes = time.process_time() - start, _status("VmHWM") - before_mb
    if outcome in ("accepted", "refused") and megabytes > LIMIT_MB:
        outcome = "large"
    if outcome in ("accepted", "refused") and seconds > LIMIT_S:
        outcome = "slow"
    return {"outcome": outcome, "place": place, "seconds": seconds, "megabytes": megabytes}


def _place(trace: Any) -> str:
    steps = [step for step in traceback.extract_tb(trace) if "armscan" in step.filename]
    return f"{Path(steps[-1].filename).name}:{steps[-1].lineno}" if steps else "?"


def work(names: Sequence[str], first: int, n_cases: int, seed: int) -> None:
    """Run cases in this process and print one line of JSON for each."""
    signal.signal(signal.SIGPROF, _over_time)
    all_readers = readers()
    limit = int((_status("VmSize") + 1.5 * LIMIT_MB) * 2**20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)
    for name in names:
        reader = all_readers[name]
        for number in range(first, first + n_cases):
            with tempfile.TemporaryDirectory(prefix="mutated-") as folder:
                write_case(Path(folder), reader, number, seed)
                print(json.dumps({"begun": [name, number]}), flush=True)
                found = run_case(reader, Path(folder))
                print(json.dumps({"reader": name, "case": number, **found}), flush=True)


def run(name: str, first: int, n_cases: int, seed: int) -> list[dict[str, Any]]:
    """Outcomes of cases of one reader; a process that dies or hangs is started again behind it."""
    outcomes: list[dict[str, Any]] = []
    while len(outcomes) < n_cases:
        begin = first + len(outcomes)
        left = n_cases - len(outcomes)
        command = [sys.executable, __file__, "--work", "--readers", name, "--seed", str(seed)]
        command += ["--first", str(begin), "--cases", str(left)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            found, death = _listen(cast(IO[bytes], process.stdout), left)
            process.kill()
        outcomes += found
        if len(found) < left:
            lost = {"reader": name, "case": first + len(outcomes), "outcome": death}
            outcomes.append({**lost, "place": "?", "seconds": SILENT_S, "megabytes": 0.0})
    return outcomes


def _listen(pipe: IO[bytes], n_cases: int) -> tuple[list[dict[str, Any]], str]:
    """Outcomes that a worker told, and how it ended before the last one."""
    found: list[dict[str, Any]] = []
    pending = b""
    patience = 120.0
    while len(found) < n_cases:
        ready, _, _ = select.select([pipe], [], [], patience)
        chunk = os.read(pipe.fileno(), 65536) if ready else b""
        if not chunk:
            return found, "died" if ready else "slow"
        *lines, pending = (pending + chunk).split(b"\n")
        parsed = [json.loads(line) for line in lines]
        found += [line for line in parsed if "outcome" in line]
        patience = SILENT_S
    return found, ""


KINDS = ("accepted", "refused", "other", "slow", "large", "died")


def main() -> None:
    """Run and tell."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--readers", nargs="*", help="names; all if left out")
    parser.add_argument("--cases", type=int, default=1500)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--keep", help="write the first case's files into this folder and stop")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    names = given.readers or list(readers())
    if given.keep:
        shutil.rmtree(given.keep, ignore_errors=True)
        write_case(Path(given.keep), readers()[names[0]], given.first, given.seed)
        return
    if given.work:
        work(names, given.first, given.cases, given.seed)
        return
    print("| reader | " + " | ".join(KINDS) + " | long sentence | slowest s | most MB |")
    print("|---" * (len(KINDS) + 4) + "|")
    total: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    example: dict[str, int] = {}
    for name in names:
        outcomes = run(name, given.first, given.cases, given.seed)
        counts = Counter(item["outcome"] for item in outcomes)
        total += counts
        n_long = sum(item["place"] == "long" for item in outcomes)
        slowest = max(item["seconds"] for item in outcomes)
        most = max(item["megabytes"] for item in outcomes)
        cells = " | ".join(str(counts[kind]) for kind in KINDS)
        print(f"| {name} | {cells} | {n_long} | {slowest:.2f} | {most:.0f} |", flush=True)
        for item in outcomes:
            if item["outcome"] not in ("accepted", "refused"):
                key = f"{name}: {item['outcome']} {item['place']}"
                faults[key] += 1
                example.setdefault(key, item["case"])
    print("sum: " + ", ".join(f"{total[kind]} {kind}" for kind in KINDS))
    for key, count in faults.most_common():
        print(f"{count} x {key} (case {example[key]})")
    if faults:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
