# SPDX-License-Identifier: Apache-2.0
"""Array types, records that own arrays, and the axis-aligned box."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self, TypeAlias, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armscan.errors import InputError, OptionError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
ImageArray: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
RowChoice: TypeAlias = BoolArray | IntArray | slice
Shape: TypeAlias = tuple[int | str | None, ...]
"""An axis of a given length, of a length with a name (the same within a record), or of any."""

ROWS = "N"
"""Name of the axis that counts the rows of a `RowRecord`."""


def frozen_floats(
    values: ArrayLike,
    shape: Shape,
    name: str,
    *,
    allow_nan: bool = False,
) -> FloatArray:
    """Return a read-only float64 array of ``values`` after checking shape and finiteness.

    It is a copy, unless ``values`` owns its memory and is read-only already.

    Parameters
    ----------
    values
        Anything that numpy turns into an array.
    shape
        Expected shape.
    name
        The name that an error message shows, with frame and unit.
    allow_nan
        Accept NaN (a gap).

    Raises
    ------
    InputError
        If the shape differs or a value is not finite.
    """
    array: FloatArray = _Column(shape, _FLOAT, allow_nan).owned(values, name, {})
    return array


_FLOAT = np.dtype(np.float64)


def _frozen(values: ArrayLike, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The values themselves if they are read-only and own their memory, else a copy."""
    if isinstance(values, np.ndarray) and values.dtype == dtype:
        flags = values.flags
        if flags.c_contiguous and flags.owndata and not flags.writeable:
            return values
    array = np.array(values, dtype=dtype, order="C")
    array.setflags(write=False)
    return array


Array = TypeVar("Array", bound=NDArray[Any])


def given_away(array: Array) -> Array:
    """A new array, which a record then takes without a copy; a view stays as it is."""
    if array.flags.owndata:
        array.setflags(write=False)
    return array


def _check_shape(actual: tuple[int, ...], shape: Shape, name: str, lengths: dict[str, int]) -> None:
    """``lengths``: Of the axes named so far, to which those of this array are added."""
    if len(actual) == len(shape):
        for axis, length in zip(shape, actual, strict=True):
            if axis is None:
                continue
            if (lengths.setdefault(axis, length) if isinstance(axis, str) else axis) != length:
                break
        else:
            return
    for axis, length in zip(shape, actual, strict=False):
        if isinstance(axis, str):
            lengths.setdefault(axis, length)
    named = (lengths.get(axis, axis) if isinstance(axis, str) else axis for axis in shape)
    wanted = "(" + ", ".join("N" if axis is None else str(axis) for axis in named) + ")"
    raise InputError(f"{name} has shape {actual}, expected {wanted}")


def _check_finite(
    array: FloatArray, name: str, *, allow_nan: bool = False, allow_infinite: bool = False
) -> None:
    if np.isfinite(array).all():
        return
    bad = ~np.isfinite(array)
    if allow_nan or allow_infinite:
        bad = np.isinf(array) if allow_nan else np.isnan(array)
    if bad.any():
        n = int(bad.sum())
        raise InputError(
            f"{name} holds {n} value{'s that are' if n > 1 else ' that is'} not finite",
            remedy="remove or mask these entries",
        )


def extents(points: FloatArray) -> FloatArray:
    """(2, D) lowest and highest coordinates of points (N, D); of short rows numpy is slow at it."""
    columns = np.ascontiguousarray(points.T)
    return np.stack([columns.min(axis=1), columns.max(axis=1)])


def row_lengths(rows: FloatArray) -> FloatArray:
    """(N,) lengths of rows (N, D), as ``norm(axis=1)``, which takes six times as long of three."""
    squares = np.zeros(len(rows))
    for column in rows.T:
        squares = squares + column * column
    return np.asarray(np.sqrt(squares))


def homogeneous(points: FloatArray) -> FloatArray:
    """Points (N, D) with a last coordinate of 1, (N, D + 1); of normalised (x, y) the rays."""
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def apply_homography(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Points (N, 2) mapped by a homography (3, 3)."""
    mapped = homogeneous(points) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


@dataclasses.dataclass(frozen=True, slots=True)
class _Column:
    """What an array field of a record holds; ``dtype`` None stands for a tuple."""

    shape: Shape
    dtype: np.dtype[Any] | None
    allow_nan: bool = False
    allow_infinite: bool = False

    def owned(self, value: Any, name: str, lengths: dict[str, int]) -> Any:
        """A value that was checked and that nobody can change; ``lengths`` of `_check_shape`."""
        if self.dtype is None:
            entries, (axis,) = tuple(value), self.shape
            length = len(entries)
            if (lengths.setdefault(axis, length) if isinstance(axis, str) else axis) != length:
                wanted = lengths[axis] if isinstance(axis, str) else axis
                raise InputError(f"{name} holds {length} entries, expected {wanted}")
            return entries
        array = _frozen(value, self.dtype)
        _check_shape(array.shape, self.shape, name, lengths)
        if self.dtype == _FLOAT and not (self.allow_nan and self.allow_infinite):
            _check_finite(array, name, allow_nan=self.allow_nan, allow_infinite=self.allow_infinite)
        return array


def floats(
    *shape: int | str | None,
    default: Any = dataclasses.MISSING,
    nan: bool = False,
    infinite: bool = False,
) -> Any:
    """Declare a float64 field of an `ArrayRecord`.

    As in ``points_mm: FloatArray = floats("N", 3)``.

    Parameters
    ----------
    *shape
        Length of each axis: a number, a name for a length that the record's fields share, or None
        for any. ``"N"`` counts the rows of a `RowRecord`.
    default
        Value where none is given, usually None; without it the field must be given.
    nan, infinite
        Accept NaN (a gap), infinity (no limit).
    """
    column = _Column(shape, np.dtype(np.float64), nan, infinite)
    return dataclasses.field(default=default, metadata={"column": column})


def ints(*shape: int | str | None, default: Any = dataclasses.MISSING) -> Any:
    """Declare an int64 field of an `ArrayRecord`; parameters as for `floats`."""
    column = _Column(shape, np.dtype(np.int64))
    return dataclasses.field(default=default, metadata={"column": column})


def bools(*shape: int | str | None, default: Any = dataclasses.MISSING) -> Any:
    """Declare a boolean field of an `ArrayRecord`; parameters as for `floats`."""
    column = _Column(shape, np.dtype(np.bool_))
    return dataclasses.field(default=default, metadata={"column": column})


def items(length: int | str = ROWS, *, default: Any = dataclasses.MISSING) -> Any:
    """Declare a field of an `ArrayRecord` that is a tuple with one entry a row."""
    return dataclasses.field(default=default, metadata={"column": _Column((length,), None)})


@dataclass_transform(
    frozen_default=True,
    eq_default=False,
    kw_only_default=True,
    field_specifiers=(dataclasses.field, floats, ints, bools, items),
)
class ArrayRecord:
    """Base of records that own arrays: subclasses are frozen dataclasses, built by keyword.

    Fields made with `floats`, `ints`, `bools` and `items` are checked and frozen when the record is
    built; axes of the same name must have the same length. A subclass that has more to check
    defines ``__post_init__`` and calls this one first. ``class Pose(ArrayRecord, kw_only=False)``
    may be built by position.

    Raises
    ------
    InputError
        If a shape differs or a value is not finite.
    """

    _columns: ClassVar[dict[str, _Column]] = {}
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls, *, kw_only: bool = True) -> None:
        super().__init_subclass__()
        dataclasses.dataclass(frozen=True, eq=False, kw_only=kw_only)(cls)
        cls._columns = {
            entry.name: entry.metadata["column"]
            for entry in dataclasses.fields(cls)
            if "column" in entry.metadata
        }

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for name, column in self._columns.items():
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, column.owned(value, name, lengths))

    def __setstate__(self, state: dict[str, Any]) -> None:
        # what was pickled or copied comes back writable
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)


class RowRecord(ArrayRecord):
    """An `ArrayRecord` of N rows: fields whose first axis is ``"N"`` hold one entry a row."""

    def __len__(self) -> int:
        """Count of rows."""
        for name, column in self._columns.items():
            if column.shape[0] == ROWS and (value := getattr(self, name)) is not None:
                return len(value)
        raise TypeError(f"{type(self).__name__} holds no field that counts rows")

    def select(self, rows: RowChoice) -> Self:
        """The rows of a mask (N,), of indices (M,) or of a slice; other fields stay."""
        # a record never changes, so that all of it is itself
        if (
            isinstance(rows, np.ndarray)
            and rows.dtype == np.bool_
            and len(rows) == len(self)
            and rows.all()
        ):
            return self
        chosen: dict[str, Any] = {}
        for name, column in self._columns.items():
            value = getattr(self, name)
            if column.shape[:1] != (ROWS,) or value is None:
                continue
            if column.dtype is None:
                chosen[name] = tuple(value[k] for k in np.arange(len(value))[rows])
            else:
                chosen[name] = given_away(value[rows])
        return dataclasses.replace(self, **chosen)

    @classmethod
    def empty(cls, **others: Any) -> Self:
        """No rows; ``others`` are the fields that do not count rows."""
        rows: dict[str, Any] = {}
        for name, column in cls._columns.items():
            if column.shape[:1] == (ROWS,) and name not in others:
                shape = (0, *(n if isinstance(n, int) else 0 for n in column.shape[1:]))
                rows[name] = () if column.dtype is None else np.zeros(shape, column.dtype)
        return cls(**rows, **others)

    @classmethod
    def concat(cls, parts: Sequence[Self], **changes: Any) -> Self:
        """The rows of all ``parts``, in turn, with ``changes`` as for `dataclasses.replace`.

        Other fields that do not count rows must be the same in all parts.

        Raises
        ------
        InputError
            If there is no part, or a field differs.
        """
        if not parts:
            raise InputError(f"no {cls.__name__} to join")
        values: dict[str, Any] = {}
        for entry in dataclasses.fields(cls):
            if entry.name in changes or not entry.init:
                continue
            column = cls._columns.get(entry.name)
            is_of_rows = column is not None and column.shape[:1] == (ROWS,)
            # a part without rows cannot lack a column
            full = [part for part in parts if len(part)] or parts[:1]
            each = [getattr(part, entry.name) for part in (full if is_of_rows else parts)]
            is_missing = any(value is None for value in each)
            if column is None or column.shape[:1] != (ROWS,) or is_missing:
                if not all(_is_same(value, each[0]) for value in each[1:]):
                    raise InputError(f"{entry.name} differs between the {cls.__name__} to join")
                values[entry.name] = each[0]
            elif column.dtype is None:
                values[entry.name] = tuple(entry for value in each for entry in value)
            else:
                values[entry.name] = given_away(np.concatenate(each))
        return cls(**values, **changes)


def _is_same(value: Any, other: Any) -> bool:
    if value is other:
        return True
    if isinstance(value, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(value, other, equal_nan=True)
    return bool(value == other)


LIMIT_NAMES = ("xmin", "xmax", "ymin", "ymax", "zmin", "zmax")
BOX_REMEDY = f"give {','.join(LIMIT_NAMES)} in mm"


class Box(ArrayRecord, kw_only=False):
    """A box along the axes of some frame, from the corner ``low_mm`` (3,) to ``high_mm`` (3,).

    Raises
    ------
    OptionError
        If a lower limit is not below its upper one.
    """

    low_mm: FloatArray = floats(3)
    high_mm: FloatArray = floats(3)

    def __post_init__(self) -> None:
        super().__post_init__()
        for axis in np.flatnonzero(~(self.low_mm < self.high_mm)):
            low, high = LIMIT_NAMES[2 * axis], LIMIT_NAMES[2 * axis + 1]
            raise OptionError(
                f"{low} {self.low_mm[axis]:g} is not below {high} {self.high_mm[axis]:g}",
                remedy=BOX_REMEDY,
            )

    @staticmethod
    def from_limits(limits_mm: Sequence[float], where: str) -> Box:
        """The box of ``xmin, xmax, ymin, ymax, zmin, zmax``; ``where`` names their option.

        Raises
        ------
        OptionError
            If these are not six finite numbers, each lower limit below its upper one.
        """
        if len(limits_mm) != len(LIMIT_NAMES):
            fact = f"{len(limits_mm)} numbers where {len(LIMIT_NAMES)} are needed"
            raise OptionError(fact, where=where, remedy=BOX_REMEDY)
        for name, value in zip(LIMIT_NAMES, limits_mm, strict=True):
            if not np.isfinite(value):
                raise OptionError(f"{name} is {value:g}", where=where, remedy=BOX_REMEDY)
        try:
            return Box(np.asarray(limits_mm[0::2]), np.asarray(limits_mm[1::2]))
        except OptionError as error:
            raise OptionError(error.what, where=where, remedy=error.remedy) from error

    @staticmethod
    def parse(text: str, where: str) -> Box:
        """The box of six numbers with commas between them, as `from_limits`."""
        limits = []
        for word in text.split(","):
            try:
                limits.append(float(word))
            except ValueError as error:
                fact = f"'{word}' is no number"
                raise OptionError(fact, where=where, remedy=BOX_REMEDY) from error
        return Box.from_limits(limits, where)

    def __str__(self) -> str:
        """The limits as `parse` reads them."""
        pairs = zip(self.low_mm.tolist(), self.high_mm.tolist(), strict=True)
        return ",".join(f"{low!r},{high!r}" for low, high in pairs)

    def holds(self, points_mm: FloatArray) -> BoolArray:
        """(N,) True for those of (N, 3) points that lie inside or on the border."""
        columns = np.asarray(points_mm).T
        inside = [
            (column >= low) & (column <= high)
            for column, low, high in zip(columns, self.low_mm, self.high_mm, strict=True)
        ]
        return np.asarray(inside[0] & inside[1] & inside[2])
