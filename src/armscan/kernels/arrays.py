# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled, and the array types by which they say what they read and write."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, cast

import numpy as np
from numba import njit, types
from numba.core.caching import NullCache
from numba.core.compiler_lock import global_compiler_lock
from numpy.typing import NDArray

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows has none
    fcntl = None  # type: ignore[assignment]

COMPILED: dict[str, float] = {}
"""Seconds that this process compiled each kernel for which the cache had nothing."""

Image: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.uint8]
Bytes: TypeAlias = NDArray[np.uint8]
Table: TypeAlias = NDArray[np.float64]
Floats: TypeAlias = NDArray[np.float64]
IntTable: TypeAlias = NDArray[np.int64]
Ints: TypeAlias = NDArray[np.int64]
ImageOut: TypeAlias = NDArray[np.float32]
Row: TypeAlias = NDArray[np.float32]
RowOut: TypeAlias = NDArray[np.float32]
BytesOut: TypeAlias = NDArray[np.uint8]
MapOut: TypeAlias = NDArray[np.int32]
TableOut: TypeAlias = NDArray[np.float64]
FloatsOut: TypeAlias = NDArray[np.float64]
IntsOut: TypeAlias = NDArray[np.int64]
Two: TypeAlias = tuple[float, float]
Three: TypeAlias = tuple[float, float, float]
Four: TypeAlias = tuple[float, float, float, float]

_TYPES: dict[str, Any] = {
    "Image": types.Array(types.float32, 2, "C", readonly=True),
    "Mask": types.Array(types.uint8, 2, "C", readonly=True),
    "Bytes": types.Array(types.uint8, 1, "C", readonly=True),
    "Table": types.Array(types.float64, 2, "C", readonly=True),
    "Floats": types.Array(types.float64, 1, "C", readonly=True),
    "IntTable": types.Array(types.int64, 2, "C", readonly=True),
    "Ints": types.Array(types.int64, 1, "C", readonly=True),
    "ImageOut": types.Array(types.float32, 2, "C"),
    "Row": types.Array(types.float32, 1, "C", readonly=True),
    "RowOut": types.Array(types.float32, 1, "C"),
    "BytesOut": types.Array(types.uint8, 1, "C"),
    "MapOut": types.Array(types.int32, 2, "C"),
    "TableOut": types.Array(types.float64, 2, "C"),
    "FloatsOut": types.Array(types.float64, 1, "C"),
    "IntsOut": types.Array(types.int64, 1, "C"),
    "np.float32": types.float32,
    "float": types.float64,
    "int": types.int64,
    "None": types.void,
    "bool": types.boolean,
    "tuple[int, int]": types.UniTuple(types.int64, 2),  # type: ignore[no-untyped-call]
    "Two": types.UniTuple(types.float64, 2),  # type: ignore[no-untyped-call]
    "Three": types.UniTuple(types.float64, 3),  # type: ignore[no-untyped-call]
    "Four": types.UniTuple(types.float64, 4),  # type: ignore[no-untyped-call]
}
"""Inputs are read-only, so that frozen records and writable arrays share one compiled version."""

F = TypeVar("F", bound=Callable[..., Any])

COLUMN = 0
"""A point at an integer column: its centre was sought down that column."""
ROW = 1
"""A point at an integer row: its centre was sought along that row."""


FUSED = frozenset({"contract", "reassoc", "arcp", "nsz"})
"""Freedoms of arithmetic that leave NaN and infinity what they are."""


def compiled(
    *,
    fastmath: bool | frozenset[str] = False,
    error_model: Literal["python", "numpy"] = "python",
    is_inlined: bool = False,
) -> Callable[[F], F]:
    """Compile a kernel for the types that its annotations name (the aliases of this module).

    Parameters
    ----------
    fastmath
        Sums may be taken in another order; or which freedoms there are.
    error_model
        ``numpy``: a division by zero gives infinity or NaN instead of an exception.
    is_inlined
        Becomes a part of the loops that call it, without which these are not vectorised.
    """
    freedoms = set(fastmath) if isinstance(fastmath, frozenset) else fastmath

    def compile_kernel(kernel: F) -> F:
        named = dict(kernel.__annotations__)
        signature = _TYPES[named.pop("return")](*(_TYPES[name] for name in named.values()))
        found: Any = njit(
            cache=True,
            nogil=True,
            fastmath=freedoms,
            error_model=error_model,
            forceinline=is_inlined,
        )(kernel)
        # the same if compilation is switched off, as for a debugger
        return kernel if found is kernel else cast(F, _on_first_use(found, signature))

    return compile_kernel


_WAITING: dict[str, Callable[[], Any]] = {}
"""What loads each kernel that was imported and is not loaded yet."""


def load_kernels(*, without: Collection[str] = ()) -> dict[str, Exception]:
    """Load, or compile, all kernels imported so far, for work that must not wait for them later.

    Modules and kernels (``chains.best_states``) of ``without`` are left, but what another kernel
    calls. Returns why a kernel failed, by its name; it fails again when it is called.
    """
    failures = {}
    for name, load in list(_WAITING.items()):
        module, kernel = name.split(".")[-2:]
        if module in without or f"{module}.{kernel}" in without:
            continue
        try:
            load()
        except Exception as error:
            failures[name] = error
    return failures


def _on_first_use(kernel: Any, signature: Any) -> Any:
    """The kernel, which is loaded when Python or a kernel that is compiled first asks for it.

    A command then waits for the kernels that it uses. From the start only the signature is known;
    numba asks by these two methods, and would else compile for the types of the first arguments.
    """
    name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
    template_of = kernel.get_call_template
    kept = getattr(kernel._cache, "_cache_file", None)
    if kept is not None:
        kept._source_stamp = source_stamp(Path(kernel.py_func.__code__.co_filename))

    def load() -> Any:
        # numba's lock first: who holds it may come to wait for the file's
        with global_compiler_lock:
            if not kernel.overloads:
                start = time.perf_counter()
                with _alone(kernel):
                    _compile(kernel, signature)
                if kernel.stats.cache_misses:
                    COMPILED[name] = time.perf_counter() - start
                kernel.disable_compile()
            _WAITING.pop(name, None)
            return kernel.overloads[signature.args].entry_point

    def first_call(*values: Any) -> Any:
        entry = load()
        for value, wanted in zip(values, signature.args, strict=True):
            if kernel.typingctx.can_convert(kernel.typeof_pyval(value), wanted) is None:
                raise TypeError(f"{name} takes no {kernel.typeof_pyval(value)} as {wanted}")
        return entry

    def call_template(types_: Any, named: Any) -> Any:
        load()
        return template_of(types_, named)

    kernel._compile_for_args, kernel.get_call_template = first_call, call_template
    _WAITING[name] = load
    return kernel


_IMPORTED = re.compile(r"^from armscan\.kernels\.([\w.]+) import", re.MULTILINE)


def source_stamp(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Name, time and size of each file that kernels of a module are made of.

    A kernel holds the code and the constants of those that it calls, and numba looks at its own
    file only: one that was compiled before another module changed would go on as before.
    """
    return tuple(
        (one.name, (told := one.stat()).st_mtime_ns, told.st_size)
        for one in sorted(_files_of(path))
    )


@cache
def _files_of(path: Path) -> frozenset[Path]:
    folder = Path(__file__).parent
    modules = _IMPORTED.findall(path.read_text("utf-8"))
    called = (folder.joinpath(*name.split(".")).with_suffix(".py") for name in modules)
    return frozenset({path}.union(*(_files_of(one) for one in called)))


def _compile(kernel: Any, signature: Any) -> None:
    try:
        kernel.compile(signature)
    except Exception:
        # what a killed process or a full disk left of an earlier compilation
        try:
            kernel._cache.flush()
        except OSError:
            kernel._cache = NullCache()
        kernel.compile(signature)


@contextmanager
def _alone(kernel: Any) -> Iterator[None]:
    """Wait while another process compiles the same kernel, to take it from the cache then.

    Where nothing can be locked, both compile.
    """
    handle = None
    if fcntl is not None:
        with suppress(OSError):
            folder = Path(kernel._cache.cache_path)
            folder.mkdir(parents=True, exist_ok=True)
            name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
            handle = os.open(folder / f".{name}.lock", os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def kernel_folder() -> str:
    """Where compiled kernels are kept, in words."""

    def nothing() -> None:
        """Is never compiled."""

    try:
        found: Any = njit(cache=True)(nothing)
    except RuntimeError:
        return "in no folder: none can be written"
    return "not compiled" if found is nothing else str(found._cache.cache_path)
