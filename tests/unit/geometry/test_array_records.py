# SPDX-License-Identifier: Apache-2.0
"""Records own their arrays: checked, frozen, counted, chosen from and joined."""

from __future__ import annotations

import pickle
from copy import deepcopy
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    bools,
    floats,
    ints,
    items,
)


class Cloud(RowRecord):
    """N points on a grid of K columns."""

    points_mm: FloatArray = floats("N", 3)
    ids: IntArray = ints("N")
    table: FloatArray = floats("K", "K", nan=True)
    is_good: BoolArray | None = bools("N", default=None)
    names: tuple[str, ...] = items(default=())
    source: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(np.unique(self.ids)) != len(self):
            raise InputError("an id occurs twice", where=self.source)


class Corner(ArrayRecord, kw_only=False):
    at_mm: FloatArray = floats(3)
    limit_mm: FloatArray = floats(2, infinite=True)


def cloud(n: int = 4, first: int = 0, source: str = "a") -> Cloud:
    return Cloud(
        points_mm=np.arange(3.0 * n).reshape(n, 3),
        ids=np.arange(first, first + n),
        table=np.eye(2),
        is_good=np.arange(n) > 0,
        names=tuple("abcdefgh"[:n]),
        source=source,
    )


def test_arrays_are_copied_frozen_and_of_their_type() -> None:
    points: NDArray[Any] = np.zeros((2, 3), dtype=np.float32)
    record = replace(cloud(2), points_mm=points)
    points[:] = 9.0
    assert record.points_mm.dtype == np.float64
    assert record.points_mm.max() == 0.0
    with pytest.raises(ValueError, match="read-only"):
        record.points_mm[0, 0] = 1.0
    with pytest.raises(FrozenInstanceError):
        record.source = "b"  # type: ignore[misc]


def test_an_array_that_nobody_can_change_is_not_copied() -> None:
    record = cloud()
    assert replace(record, source="b").points_mm is record.points_mm
    view = record.points_mm[1:]
    assert replace(cloud(3), points_mm=view).points_mm.base is None


def test_records_are_built_by_keyword_unless_they_say_otherwise() -> None:
    with pytest.raises(TypeError):
        Cloud(np.zeros((2, 3)))  # type: ignore[call-arg]
    assert Corner(np.ones(3), np.zeros(2)).at_mm.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("points_mm", np.zeros((4, 2))),
        ("points_mm", np.zeros(4)),
        ("points_mm", np.full((4, 3), np.nan)),
        ("ids", np.zeros(3)),
        ("table", np.zeros((2, 3))),
        ("table", np.full((2, 2), np.inf)),
        ("is_good", np.ones(5)),
        ("names", ("a",)),
    ],
)
def test_a_field_that_does_not_fit_is_named(field: str, value: object) -> None:
    with pytest.raises(InputError, match=field):
        replace(cloud(), **{field: value})  # type: ignore[arg-type]


def test_gaps_and_limits_are_allowed_where_the_field_says_so() -> None:
    assert np.isnan(replace(cloud(), table=np.full((3, 3), np.nan)).table).all()
    assert np.isinf(Corner(np.zeros(3), np.array([-np.inf, np.inf])).limit_mm).all()
    with pytest.raises(InputError, match="limit_mm"):
        Corner(np.zeros(3), np.array([np.nan, 1.0]))


@pytest.mark.parametrize(
    ("rows", "ids"),
    [
        (np.array([True, False, True, False]), [0, 2]),
        (np.array([3, 1]), [3, 1]),
        (slice(1, None), [1, 2, 3]),
        (np.zeros(4, dtype=np.bool_), []),
    ],
)
def test_rows_are_chosen_by_mask_index_or_slice(
    rows: BoolArray | IntArray | slice, ids: list[int]
) -> None:
    chosen = cloud().select(rows)
    assert chosen.ids.tolist() == ids
    assert chosen.points_mm[:, 0].tolist() == [3.0 * k for k in ids]
    assert chosen.names == tuple("abcd"[k] for k in ids)
    assert chosen.is_good is not None
    assert chosen.is_good.tolist() == [k > 0 for k in ids]
    assert len(chosen) == len(ids)
    assert chosen.table.tolist() == np.eye(2).tolist()


def test_records_are_joined_row_by_row() -> None:
    joined = Cloud.concat([cloud(2), cloud(3, first=2)])
    assert joined.ids.tolist() == [0, 1, 2, 3, 4]
    assert joined.names == ("a", "b", "a", "b", "c")
    assert joined.is_good is not None
    assert len(joined.is_good) == 5


def test_no_rows_at_all() -> None:
    none = Cloud.empty(table=np.eye(2), source="a")
    assert (len(none), none.points_mm.shape, none.names) == (0, (0, 3), ())
    assert Cloud.concat([none, cloud(2)]).ids.tolist() == [0, 1]


def test_what_differs_between_the_parts_must_be_given() -> None:
    parts = [cloud(2), cloud(2, first=2, source="b")]
    with pytest.raises(InputError, match="source differs"):
        Cloud.concat(parts)
    assert Cloud.concat(parts, source="a, b").source == "a, b"
    with pytest.raises(InputError, match="is_good differs"):
        Cloud.concat([cloud(2), replace(cloud(2, first=2), is_good=None)])
    with pytest.raises(InputError, match="no Cloud"):
        Cloud.concat([])


def test_a_records_own_check_runs_on_what_is_chosen_too() -> None:
    with pytest.raises(InputError, match="twice"):
        cloud().select(np.array([1, 1]))


def test_copies_and_pickled_records_are_read_only_too() -> None:
    for copied in (pickle.loads(pickle.dumps(cloud())), deepcopy(cloud())):
        assert isinstance(copied, Cloud)
        assert (copied.points_mm == cloud().points_mm).all() and copied.names == cloud().names
        for array in (copied.points_mm, copied.ids, copied.table, copied.is_good):
            assert array is not None and not array.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            copied.points_mm[0, 0] = np.nan


def test_chosen_rows_are_the_records_own() -> None:
    """A record takes new arrays without a copy, but not what is a part of another's memory."""
    whole = cloud(6)
    for part in (
        whole.select(np.array([4, 1])),
        whole.select(slice(1, 3)),
        whole.select(whole.ids > 2),
    ):
        assert part.points_mm.flags.owndata and not part.points_mm.flags.writeable
        assert not np.shares_memory(part.points_mm, whole.points_mm)
