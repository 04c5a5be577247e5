# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Values come back from JSON to the bit."""

from collections.abc import Mapping
from dataclasses import dataclass
import json
from typing import Annotated, Any, NamedTuple

from hypothesis import given, strategies as st
import numpy as np
from saved_graphs import assert_same_value

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import Pose
from pose_graph_ros.core.saved_columns import (
    Column,
    decoded,
    encoded,
    Flags,
    Integers,
    Numbers,
    Rows3,
)

Pairs = Annotated[np.ndarray, Column(int, (2,))]


@dataclass(frozen=True)
class Inner:
    name: str
    used: bool
    pairs: Pairs
    matrix: tuple[Pose, Pose, Pose] | None


ROW = np.dtype([('id', 'i8'), ('x', 'f8', 3)])


@dataclass(frozen=True)
class Kept:
    table: Annotated[GrowingArray, Column(ROW)]


class Tuple(NamedTuple):
    count: int
    share: float | None


@dataclass(frozen=True)
class Outer:
    stamps: Integers
    flags: Flags
    numbers: Numbers
    rows: Rows3
    names: tuple[str, ...]
    inner: Mapping[str, Inner]
    both: Tuple


whole = st.integers(-2**63 + 1, 2**63 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
pose = st.tuples(finite, finite, finite)


def arrays(items: Any, dtype: Any, *shape: int) -> Any:
    return st.lists(items, max_size=4).map(
        lambda values: np.array(values, dtype=dtype).reshape(-1, *shape))


values = st.builds(
    Outer, arrays(whole, np.int64), arrays(st.booleans(), np.bool_), arrays(finite, np.float64),
    arrays(pose, np.float64, 3), st.lists(st.text(), max_size=3).map(tuple),
    st.dictionaries(st.text(), st.builds(
        Inner, st.text(), st.booleans(), arrays(st.tuples(whole, whole), np.int64, 2),
        st.none() | st.tuples(pose, pose, pose)), max_size=2),
    st.builds(Tuple, whole, st.none() | finite))


@given(values)
def test_any_value_comes_back_to_the_bit(value: Outer) -> None:
    text = json.dumps(encoded(value))
    again = decoded(Outer, json.loads(text))
    assert_same_value(again, value)
    assert json.dumps(encoded(again)) == text   # signs of zeros too


@given(arrays(st.tuples(whole, pose), ROW))
def test_a_table_of_records_comes_back_from_its_columns(rows: np.ndarray) -> None:
    value = Kept(GrowingArray.of(rows))
    plain = json.loads(json.dumps(encoded(value)))
    assert plain['table'] == {name: rows[name].tolist() for name in ('id', 'x')}
    assert_same_value(decoded(Kept, plain), value)
