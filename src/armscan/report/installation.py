# SPDX-License-Identifier: Apache-2.0
"""Is everything there that armscan needs, and is it ready."""

from __future__ import annotations

import importlib
import pkgutil
import platform
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from armscan import kernels
from armscan.devices.registry import driver_names
from armscan.report.summary import Summary

NEEDED = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "pydantic",
    "typer",
    "rich",
    "jinja2",
    "matplotlib",
)
OPENCV_NAMES = (
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
)
OPTIONAL = {"mrcal": "a second opinion on camera calibrations"}


def examine_installation(*, warm: bool = False) -> Summary:
    """Check packages, the compiler and the folder for temporary files.

    Parameters
    ----------
    warm
        Also compile all kernels, so that the first use does not wait.

    Returns
    -------
    Summary
        Its warnings are what is wrong; none if all is well.
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
    writable = _temporary_folder_fact(problems)
    facts.append(("temporary files", writable))
    facts.append(("compiler", _compiler_fact(problems)))
    if warm:
        facts.append(("kernels", _compile_kernels(problems)))
    is_ready = not problems
    return Summary(
        title="armscan is ready." if is_ready else "armscan is not ready.",
        facts=tuple(facts),
        warnings=tuple(problems),
        data={"kind": "doctor", "is_ready": is_ready, "found": dict(facts)},
    )


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


def _compile_kernels(problems: list[str]) -> str:
    start = time.perf_counter()
    names = [item.name for item in pkgutil.iter_modules(kernels.__path__)]
    for name in names:
        try:
            importlib.import_module(f"{kernels.__name__}.{name}")
        except Exception as error:
            problems.append(f"kernel module {name} does not compile ({error})")
    return f"{len(names)} modules compiled in {time.perf_counter() - start:.1f} s"
