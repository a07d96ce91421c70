# SPDX-License-Identifier: Apache-2.0
"""Whether the installation is complete; and, for a question to somebody else, what it needs in one
file, without what is nobody else's business.
"""

from __future__ import annotations

import getpass
import importlib
import io
import json
import os
import pkgutil
import platform
import re
import tempfile
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from armscan import kernels
from armscan.devices.registry import DriverReport, survey_drivers
from armscan.devices.sources import driver_names
from armscan.errors import ArmscanError, OptionError
from armscan.report.quantity import Quantity, Summary, Table, fact
from armscan.storage.documents import content_hash
from armscan.storage.files import check_outputs, holds_files, is_folder, read_bytes, write_files
from armscan.storage.recording import is_recording, read_recording, recording_name
from armscan.storage.recordings.read_mcap import record_folder

NEEDED = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "typer",
    "rich",
    "jinja2",
    "matplotlib",
    "mcap",
    "mcap-protobuf-support",
    "foxglove-schemas-protobuf",
    "zstandard",
)
OPENCV_NAMES = (
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
)
OPTIONAL = {
    "mrcal": "a second opinion on camera calibrations",
    "scikit-image": "meshes",
    "pye57": "E57 clouds",
    "laspy": "LAS and LAZ clouds",
    "fast-simplification": "meshes of fewer triangles",
    "cadquery-ocp-novtk": "STEP files",
    "weasyprint": "reports as PDF",
    "viser": "the console",
}


def examine_installation(*, warm: bool = False) -> Summary:
    """Check packages, the compiler and the folder for temporary files; what is wrong is a warning.

    ``warm``: also compile all kernels, so that the first use does not wait.
    """
    problems: list[str] = []
    facts = [
        ("armscan", version("armscan")),
        ("Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
    ]
    packages = {name: _version_of(name) for name in NEEDED}
    for name, found in packages.items():
        facts.append((name, found or "not found"))
        if not found:
            problems.append(f"the package {name} is missing; install armscan again")
    for name, use in OPTIONAL.items():
        facts.append((name, _version_of(name) or f"not installed (optional: {use})"))
    facts.append(("drivers", ", ".join(driver_names()) or "none"))
    facts += [(f"devices by {one.name}", _state(one)) for one in survey_drivers()]
    writable = _temporary_folder_fact(problems)
    facts.append(("temporary files", writable))
    facts.append(("compiler", _compiler_fact(problems)))
    # they bring the compiler with them, for which a look at a file does not wait
    from armscan.kernels.arrays import COMPILED, kernel_folder
    from armscan.pipeline.progress import count_cores

    facts.append(("cores", f"{count_cores()} for this process, of {os.cpu_count() or 1}"))
    facts.append(("compiled kernels", kernel_folder()))
    compiled: dict[str, float] = {}
    if warm:
        facts.append(("kernels", _compile_kernels(problems)))
        compiled = {name.removeprefix("armscan."): t for name, t in sorted(COMPILED.items())}
    rows = tuple((name, f"{seconds:.2f}") for name, seconds in compiled.items())
    is_ready = not problems
    return Summary(
        title="armscan is ready." if is_ready else "armscan is not ready.",
        quantities=tuple(fact(*pair) for pair in facts),
        tables=(Table(("compiled", "s"), rows),) if rows else (),
        warnings=tuple(problems),
        extra={
            "kind": "doctor",
            "is_ready": is_ready,
            "found": dict(facts),
            "compiled_s": compiled,
        },
    )


def _state(driver: DriverReport) -> str:
    """What a driver of devices says of itself; none is needed to measure recordings."""
    if driver.problem:
        return f"not usable: {driver.problem}"
    return f"ready, {len(driver.found)} found" if driver.found else "ready"


def _version_of(name: str) -> str:
    for candidate in OPENCV_NAMES if name.startswith("opencv") else (name,):
        try:
            return version(candidate)
        except PackageNotFoundError:
            continue
    return ""


def _temporary_folder_fact(problems: list[str]) -> str:
    try:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "probe").write_bytes(b"armscan")
    except OSError as error:
        problems.append(f"no folder for temporary files can be written ({error.strerror})")
        return "not writable"
    return "writable"


def _compiler_fact(problems: list[str]) -> str:
    try:
        numba = importlib.import_module("numba")
        start = time.perf_counter()
        is_right = int(numba.njit("int64(int64)")(lambda n: 2 * n + 1)(20)) == 41
    except Exception as error:
        problems.append(f"numba cannot compile ({error}); install numba and llvmlite again")
        return "fails"
    if not is_right:
        problems.append("numba compiles wrong code; install numba and llvmlite again")
    return f"works ({time.perf_counter() - start:.1f} s for a first function)"


def kernel_modules() -> tuple[str, ...]:
    """Names of all modules that hold compiled loops of measuring."""
    found = pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}.")
    return tuple(item.name for item in found)


def _compile_kernels(problems: list[str]) -> str:
    from armscan.kernels.arrays import COMPILED, load_kernels

    for name in kernel_modules():
        try:
            importlib.import_module(name)
        except Exception as error:
            problems.append(f"kernel module {name} cannot be imported ({error})")
    failures = load_kernels()
    problems += [f"kernel {name} does not compile ({error})" for name, error in failures.items()]
    seconds = sum(COMPILED.values())
    return f"{len(COMPILED)} compiled now ({seconds:.1f} s), the others kept from before"


SUFFIX = ".zip"
CUT_EXPOSURES = 40
"""Of a recording: half a second of one quick camera, or a calibration's postures."""
MOST_BYTES = 50_000_000
"""Of one file: what still goes with a message."""
README, VERSIONS = "README.txt", "versions.json"
NOTED = "absolute paths are cut to their last names; the user, the computer and secrets are masked"
QUOTED_PATH = re.compile(r"""(["'])((?:/|~/|[A-Za-z]:[\\/])[^"'\n]*)\1""")
BARE_PATH = re.compile(
    r"""(?<![\w/.~])(?:~?/(?!dev/)[\w.~][^\s"'<>|;,:*?()]*|[A-Za-z]:[\\/]+[^\s"'<>|;,*?()]*)"""
)
SECRET_NAME = r"(?:token|pass(?:w(?:or)?d|phrase)?|pwd|secret|api[_-]?key|credentials?)"
SECRET = re.compile(
    rf"""(?i)((?<![a-z]){SECRET_NAME}["']?\s*[=:]\s*|--{SECRET_NAME}\s+)"""
    r"""("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[^\s"'&,}]+)"""
)
HEADER = re.compile(r"(?i)((?:authorization|cookie)[\"']?\s*[:=]\s*[\"']?)[^\"'\n]+")
ADDRESS = re.compile(r"(?i)\b([a-z][a-z0-9+.-]*://)[^\s/@\"']*@")
FILE_ADDRESS = re.compile(r"(?i)\bfile://[^\s\"'<>]+")
SHARE = re.compile(r"(?<![\w:])\\\\[\w.$-]+\\[^\s\"'<>|;,*?()]*")
PLAIN_NAMES = {"root", "user", "admin", "localhost"}


def without_secrets(text: str) -> str:
    """Text whose absolute paths keep their last names alone, and that names no user and computer.

    Values behind ``token``, ``password`` and their like, headers of authorisation, and users of
    addresses are masked. Of a path with blanks that is not quoted, what follows the first stays.
    """
    text = HEADER.sub(r"\1***", text)
    text = SECRET.sub(_masked, text)
    text = ADDRESS.sub(r"\1***@", text)
    for path in (FILE_ADDRESS, SHARE):
        text = path.sub(lambda found: _last_name(found[0]), text)
    text = QUOTED_PATH.sub(lambda found: f"{found[1]}{_last_name(found[2])}{found[1]}", text)
    text = BARE_PATH.sub(lambda found: _last_name(found[0]), text)
    for name, mask in ((_user(), "USER"), (platform.node(), "COMPUTER")):
        if len(name) > 2 and name.lower() not in PLAIN_NAMES:
            text = re.sub(rf"(?<![\w-]){re.escape(name)}(?![\w-])", mask, text)
    return text


def _masked(found: re.Match[str]) -> str:
    quote = found[2][0] if found[2][0] in "\"'" else ""
    return f"{found[1]}{quote}***{quote}"


def _last_name(path: str) -> str:
    parts = [part for part in re.split(r"[\\/]+", path) if part]
    return f".../{parts[-1]}" if parts else path


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return ""


@dataclass
class _Bundle:
    """Files of the archive, and a line for each: what it is, and what of it is left out."""

    contents: dict[str, bytes] = field(default_factory=dict)
    lines: list[tuple[str, str, str]] = field(default_factory=list)

    def add(self, name: str, content: bytes, what: str, lacks: str = "") -> None:
        stem, dot, suffix = name.rpartition(".")
        number = 2
        while name in self.contents:
            name, number = f"{stem}-{number}{dot}{suffix}", number + 1
        self.contents[name] = content
        self.lines.append((name, what, lacks))

    def leave_out(self, path: Path, why: str) -> None:
        self.lines.append((path.name, "not inside", why))


def pack_bundle(
    output: Path, paths: Sequence[Path] = (), *, is_overwriting: bool = False
) -> Summary:
    """Pack versions, documents, logs and a cut of recordings into one archive ``.zip``.

    Raises
    ------
    OptionError
        If the name ends in something else.
    OutputError
        If the file exists or cannot be written; nothing is left then.
    """
    if output.suffix.lower() != SUFFIX:
        raise OptionError(
            f"the name ends in '{output.suffix}'", where="--bundle", remedy=f"end it in {SUFFIX}"
        )
    check_outputs((output,), is_overwriting=is_overwriting)
    found, bundle = examine_installation(), _Bundle()
    versions = json.dumps({**found.extra, "problems": list(found.warnings)}, indent=2)
    bundle.add(VERSIONS, without_secrets(versions).encode(), "versions, drivers and problems")
    for path in paths:
        try:
            _add_path(bundle, path)
        except ArmscanError as error:
            bundle.leave_out(path, without_secrets(error.what))
    content = _zipped(bundle)
    write_files({output: content}, is_overwriting=is_overwriting)
    left_out = [line for line in bundle.lines if line[1] == "not inside"]
    return Summary(
        title="Packed. Look at it before you send it.",
        quantities=(
            Quantity("files", "files inside", len(bundle.contents) + 1),
            Quantity("megabytes", "size", len(content) / 1e6, unit="MB"),
        ),
        tables=(Table(("file", "what it is", "left out"), tuple(bundle.lines), "", (1, 2)),),
        warnings=tuple(f"{name} is not inside: {why}" for name, _, why in left_out),
        written=(output,),
        extra={"kind": "bundle", "inside": [list(line) for line in bundle.lines]},
    )


def _add_path(bundle: _Bundle, path: Path) -> None:
    if is_recording(path):
        try:
            _add_recording(bundle, path)
        except ArmscanError as error:
            if is_folder(path) or not path.is_file():
                raise
            _add_unread(bundle, path, error)
        return
    if holds_files(path):
        bundle.leave_out(path, "a folder that is no recording: name the files that matter")
        return
    data = read_bytes(path)
    if len(data) > MOST_BYTES:
        bundle.leave_out(path, f"{len(data) / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f}")
        return
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        bundle.add(path.name, data, "as it is")
        return
    bundle.add(path.name, _cleaned(text).encode(), "text", NOTED)


def _cleaned(text: str) -> str:
    """A document stays one that can be read: its checksum is made anew."""
    cleaned = without_secrets(text)
    try:
        content = json.loads(cleaned)
        if isinstance(content, dict) and isinstance(content.get("sha256"), str):
            cleaned = cleaned.replace(content["sha256"], content_hash(content))
    except (ValueError, RecursionError):
        pass
    return cleaned


def _add_recording(bundle: _Bundle, path: Path) -> None:
    n_all = len(read_recording(path).rows)
    with tempfile.TemporaryDirectory(prefix="armscan-bundle-") as scratch:
        cut = Path(scratch) / "cut.mcap"
        record_folder(path, cut, most=CUT_EXPOSURES, edit=_edited)
        data = read_bytes(cut)
    if len(data) > MOST_BYTES:
        bundle.leave_out(path, f"{len(data) / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f}")
        return
    n_cut = min(n_all, CUT_EXPOSURES)
    lacks = f"{n_all - n_cut} later exposures; " if n_cut < n_all else ""
    what = f"recording, the first {n_cut} of {n_all} exposures; images and tables as recorded"
    bundle.add(f"{recording_name(path)}.mcap", data, what, f"{lacks}{NOTED} in its documents")


def _add_unread(bundle: _Bundle, path: Path, error: ArmscanError) -> None:
    """A recording that cannot be read, which the question may be about: its bytes."""
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES)
    except OSError as refused:
        bundle.leave_out(path, refused.strerror or "it cannot be read")
        return
    n_bytes = path.stat().st_size
    cut = f"all after its first {MOST_BYTES / 1e6:.0f} MB; " if n_bytes > len(data) else ""
    what = f"as it is: as a recording it cannot be read ({without_secrets(error.what)})"
    bundle.add(path.name, data, what, f"{cut}nothing in it is masked")


def _edited(document: bytes) -> bytes:
    try:
        return _cleaned(document.decode("utf-8")).encode()
    except UnicodeDecodeError:
        return document


def _zipped(bundle: _Bundle) -> bytes:
    said = [
        "Packed by `armscan doctor --bundle` for a question to somebody else.",
        "",
        f"No environment variable is inside, and in texts {NOTED}.",
        "Addresses of devices stay. Images, tables and binary files are as they were.",
        "",
        f"{README}: this list",
    ]
    said += [f"{name}: {what}" + (f" ({lacks})" if lacks else "") for name, what, lacks in
             bundle.lines]  # fmt: skip
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(README, "\n".join(said) + "\n")
        for name, content in bundle.contents.items():
            archive.writestr(name, content)
    return buffer.getvalue()
