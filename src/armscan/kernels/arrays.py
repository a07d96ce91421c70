# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled, and the array types by which they say what they read and write."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, cast

import numpy as np
from numba import njit, types
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

        def built(*, cache: bool) -> F:
            found: Any = njit(
                cache=cache,
                nogil=True,
                fastmath=freedoms,
                error_model=error_model,
                forceinline=is_inlined,
            )(kernel)
            if found is kernel:
                # compilation is switched off, as for a debugger
                return kernel
            start = time.perf_counter()
            with _alone(found):
                found.compile(signature)
            if found.stats.cache_misses or not cache:
                COMPILED[f"{kernel.__module__}.{kernel.__name__}"] = time.perf_counter() - start
            found.disable_compile()
            return cast(F, found)

        try:
            return built(cache=True)
        except Exception:
            # what a killed process or a full disk left of an earlier compilation
            return built(cache=_forgotten(njit(cache=True)(kernel)))

    return compile_kernel


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


def _forgotten(kernel: Any) -> bool:
    """Empty the cache of one kernel; False if its folder may not be written."""
    try:
        kernel._cache.flush()
    except OSError:
        return False
    return True


def kernel_folder() -> str:
    """Where compiled kernels are kept, in words."""

    def nothing() -> None:
        """Is never compiled."""

    try:
        found: Any = njit(cache=True)(nothing)
    except RuntimeError:
        return "in no folder: none can be written"
    return "not compiled" if found is nothing else str(found._cache.cache_path)
