# SPDX-License-Identifier: Apache-2.0
"""Whether the installation is complete."""

from __future__ import annotations

import importlib
import os
import pkgutil
import platform
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from armscan import kernels
from armscan.devices.registry import DriverReport, survey_drivers
from armscan.devices.sources import driver_names
from armscan.report.quantity import Summary, Table, fact

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
}


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
    facts += [(f"devices by {one.name}", _state(one)) for one in survey_drivers()]
    writable = _temporary_folder_fact(problems)
    facts.append(("temporary files", writable))
    facts.append(("compiler", _compiler_fact(problems)))
    # they bring the compiler with them, for which a look at a file does not wait
    from armscan.kernels.arrays import COMPILED, kernel_folder
    from armscan.pipeline.measure import count_cores

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
