# SPDX-License-Identifier: Apache-2.0
"""How kernels are loaded and kept; a user without a home and without rights can still measure."""

from __future__ import annotations

import importlib
import importlib.util
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.cli.run import VARIABLE, give_kernels_a_folder
from armscan.jobs.live.doctor import kernel_modules
from armscan.jobs.twin.demo import UNUSED, UNUSED_BY_ONE_LINE
from armscan.kernels import arrays
from armscan.kernels.arrays import load_kernels


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Nothing but the folder for temporary files may be written."""
    monkeypatch.delenv(VARIABLE, raising=False)
    (tmp_path / "home").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    (tmp_path / "kernels").write_text("no folder")
    place = tmp_path / "tmp"
    place.mkdir()
    return place


def test_a_folder_of_this_user_is_made_and_used_again(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    give_kernels_a_folder(bare.parent, bare)
    first = Path(os.environ[VARIABLE])
    assert first.parent == bare
    assert stat.S_IMODE(first.stat().st_mode) == 0o700
    monkeypatch.delenv(VARIABLE)
    give_kernels_a_folder(bare.parent, bare)
    assert Path(os.environ[VARIABLE]) == first


def test_a_folder_that_others_may_write_is_not_taken(bare: Path) -> None:
    """What it holds would be run."""
    give_kernels_a_folder(bare.parent, bare)
    first = Path(os.environ.pop(VARIABLE))
    first.chmod(0o777)
    give_kernels_a_folder(bare.parent, bare)
    assert Path(os.environ[VARIABLE]) != first


def test_numba_is_left_alone_where_it_finds_a_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    give_kernels_a_folder(tmp_path, tmp_path)
    assert VARIABLE not in os.environ
    assert not list(tmp_path.glob("armscan-kernels-*"))
    monkeypatch.setenv(VARIABLE, "mine")
    give_kernels_a_folder(tmp_path, tmp_path)
    assert os.environ[VARIABLE] == "mine"


@pytest.mark.parametrize("damage", ["nbc cut", "nbi cut", "nbi junk", "nbc empty"])
def test_a_damaged_cache_is_compiled_anew(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a killed process or a full disk leaves it."""
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))
    source = tmp_path / "kernel_of_a_test.py"
    source.write_text(
        "from __future__ import annotations\n"
        "from armscan.kernels.arrays import Floats, compiled\n\n\n"
        "@compiled()\ndef total(values: Floats) -> float:\n    return values.sum()\n"
    )

    def total() -> float:
        spec = importlib.util.spec_from_file_location("kernel_of_a_test", source)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return float(module.total(np.array([1.0, 2.0])))

    assert total() == 3.0
    end, how = damage.split()
    files = list(tmp_path.rglob(f"*.{end}"))
    assert files != []
    for path in files:
        content = path.read_bytes()
        path.write_bytes({"cut": content[:100], "junk": b"junk" * 40, "empty": b""}[how])
    assert total() == 3.0
    assert total() == 3.0, "the cache is whole again"


def test_two_processes_do_not_compile_the_same_kernel(tmp_path: Path) -> None:
    """Both start with an empty cache; what one compiles, the other waits for and takes."""
    program = (
        "from armscan.kernels import grids\n"
        "from armscan.kernels.arrays import COMPILED, load_kernels\n"
        "load_kernels()\n"
        "print(*COMPILED)"
    )
    environment = {**os.environ, VARIABLE: str(tmp_path)}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    first, second = (one.communicate()[0].split() for one in both)
    assert [one.returncode for one in both] == [0, 0]
    assert not set(first) & set(second)
    assert {"armscan.kernels.grids.add_to_cells", "armscan.kernels.grids.voxel_values"} <= {
        *first,
        *second,
    }
    again = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert again.stdout.split() == []


SOURCE = """
from __future__ import annotations
from armscan.kernels.arrays import Floats, compiled

@compiled()
def total(values: Floats) -> float:
    return values.sum()

@compiled()
def mean(values: Floats) -> float:
    return total(values) / values.size

@compiled()
def unused(values: Floats) -> float:
    return values[0]
"""


def imported(source: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of kernels, of which none is compiled."""
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(folder / "cache"))
    place = folder / "kernels_of_a_test.py"
    place.write_text(source)
    os.utime(place, (1, 1))
    spec = importlib.util.spec_from_file_location("kernels_of_a_test", place)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_kernel_is_loaded_when_it_is_first_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By Python, or by a kernel that is compiled; of other numbers it is refused at once."""
    module = imported(SOURCE, tmp_path, monkeypatch)
    kernels = (module.total, module.mean, module.unused)
    assert [len(one.overloads) for one in kernels] == [0, 0, 0]
    with pytest.raises(TypeError, match="total takes no"):
        module.total(np.zeros(3, np.float32))
    given = np.array([1.0, 2.0, 6.0])
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(module.mean, [given] * 8)) == [3.0] * 8
    given.setflags(write=False)
    assert module.mean(given) == 3.0
    assert [len(one.overloads) for one in kernels] == [1, 1, 0]
    with pytest.raises(TypeError):
        module.mean(np.zeros((2, 2)))
    for left in ("kernels_of_a_test", "kernels_of_a_test.unused"):
        assert load_kernels(without=(left,)) == {}
        assert len(module.unused.overloads) == 0
    assert load_kernels() == {}
    assert len(module.unused.overloads) == 1


def test_what_a_demo_leaves_uncompiled_is_there() -> None:
    for name in (*UNUSED, *UNUSED_BY_ONE_LINE):
        module, _, kernel = name.partition(".")
        found = importlib.import_module(f"armscan.kernels.{module}")
        assert not kernel or callable(getattr(found, kernel))


def test_a_kernel_that_fails_is_named_and_the_others_are_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = "@compiled()\ndef broken(values: Floats) -> float:\n    return values.no_such_thing\n"
    module = imported(SOURCE + broken, tmp_path, monkeypatch)
    try:
        assert list(load_kernels()) == ["kernels_of_a_test.broken"]
        assert len(module.mean.overloads) == 1
    finally:
        arrays._WAITING.pop("kernels_of_a_test.broken")


def test_a_kernel_is_compiled_anew_when_another_that_it_calls_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numba's own stamp is of the caller's file alone."""
    module = imported(SOURCE, tmp_path, monkeypatch)
    given = np.array([1.0, 2.0, 6.0])
    assert module.mean(given) == 3.0
    assert module.mean.stats.cache_misses
    warm = imported(SOURCE, tmp_path, monkeypatch)
    assert warm.mean(given) == 3.0
    assert warm.mean.stats.cache_hits and not warm.mean.stats.cache_misses
    stamp = arrays.source_stamp
    monkeypatch.setattr(arrays, "source_stamp", lambda path: (*stamp(path), ("other.py", 1, 1)))
    anew = imported(SOURCE, tmp_path, monkeypatch)
    assert anew.mean(given) == 3.0
    assert anew.mean.stats.cache_misses


def test_the_stamp_of_a_kernel_names_all_modules_that_it_uses() -> None:
    """What its module took from other modules of kernels, and what these took."""
    folder = Path(arrays.__file__).parent
    for name in kernel_modules():
        module = importlib.import_module(name)
        used = {
            own.py_func.__module__ for own in vars(module).values() if hasattr(own, "py_func")
        } - {name}
        stamped = {one for one, _, _ in arrays.source_stamp(Path(str(module.__file__)))}
        assert {each.rpartition(".")[2] + ".py" for each in used} <= stamped
        assert Path(str(module.__file__)).name in stamped
    placing = {one for one, _, _ in arrays.source_stamp(folder / "placing.py")}
    assert placing == {"arrays.py", "placing.py", "rays.py"}


def test_every_module_of_kernels_is_compiled_ahead() -> None:
    folder = Path(arrays.__file__).parent
    files = {
        ".".join(("armscan.kernels", *path.relative_to(folder).with_suffix("").parts))
        for path in folder.rglob("*.py")
    }
    wanted = {name for name in files if not name.endswith("__init__")}
    assert wanted <= set(kernel_modules())
    assert "armscan.kernels.stripe.columns" in wanted
