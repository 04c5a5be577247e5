# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Values come back from JSON to the bit; others than the annotations say are refused by name."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum
import json
from typing import Annotated, Any, NamedTuple

from hypothesis import given, strategies as st
import numpy as np
import pytest
from saved_graphs import assert_same_value

from pose_graph_ros.core.io.json_values import annotations, decoded, encoded
from pose_graph_ros.core.saved_columns import (
    Choices,
    Flags,
    Integers,
    Matrix,
    Numbers,
    Pairs,
    Rows3,
)


@dataclass(frozen=True)
class Inner:
    name: str
    used: bool
    pairs: Pairs
    matrix: Matrix | None


class Size(Enum):
    SMALL = 'small'
    LARGE = 'large'


class Colour(IntEnum):
    GREEN = 4
    RED = 2


@dataclass(frozen=True)
class Chosen:
    sizes: Annotated[np.ndarray, Choices(Size)]
    colours: Annotated[np.ndarray, Choices(Colour)]


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
    again = decoded(Outer, json.loads(text), 'value')
    assert_same_value(again, value)
    assert json.dumps(encoded(again)) == text   # signs of zeros too


def good() -> dict[str, Any]:
    return {
        'stamps': [1, 2], 'flags': [True], 'numbers': [0.5, 1], 'rows': [[1.0, 2.0, 3.0]],
        'names': ['a'], 'inner': {'x': {
            'name': 'x', 'used': False, 'pairs': [[1, 2]], 'matrix': None}},
        'both': {'count': 3, 'share': 1}}


def test_integers_are_numbers_too_but_become_floats() -> None:
    value = decoded(Outer, good(), 'value')
    assert value.numbers.dtype == np.float64
    assert type(value.both.share) is float


@pytest.mark.parametrize(('place', 'plain', 'expected'), [
    (('stamps',), 1, 'stamps: expected a list, got 1'),
    (('stamps',), [1, 2.0], 'stamps: expected ints'),
    (('stamps',), ['1'], 'stamps: expected ints'),
    (('stamps',), [2**63], 'stamps: expected ints'),
    (('stamps',), [10**400], 'stamps: expected ints'),
    (('stamps',), [[1]], r'stamps: expected ints in rows of shape \(\)'),
    (('flags',), [1], 'flags: expected bools'),
    (('numbers',), [float('nan')], 'numbers: expected finite numbers'),
    (('numbers',), [1.0, float('inf')], 'numbers: expected finite numbers'),
    (('numbers',), [None], 'numbers: expected floats'),
    (('rows',), [[1.0, 2.0]], r'rows: expected floats in rows of shape \(3,\)'),
    (('rows',), [[1.0, 2.0, 3.0], [1.0]], 'rows: expected rows of equal length'),
    (('names',), 'abc', 'names: expected a list'),
    (('names',), [1], 'names: expected a value of kind str, got 1'),
    (('inner',), [], 'inner: expected an object'),
    (('inner', 'x'), None, r'inner\.x: expected an object'),
    (('inner', 'x', 'used'), 0, r'inner\.x\.used: expected a value of kind bool, got 0'),
    (('inner', 'x', 'matrix'), [[0.0] * 3] * 2, r'inner\.x\.matrix: expected 3 items'),
    (('inner', 'x', 'matrix'), [[0.0, 0.0]] * 3, r'inner\.x\.matrix: expected 3 items'),
    (('inner', 'x', 'more'), 1, r'inner\.x: expected the fields .*matrix.*name'),
    (('both', 'count'), True, r'both\.count: expected a value of kind int, got True'),
    (('both', 'count'), 1.0, r'both\.count: expected a value of kind int, got 1\.0'),
    (('both', 'count'), 2**63, r'both\.count: expected an integer of 64 bits'),
    (('both', 'share'), True, r'both\.share: expected a value of kind float'),
    (('both', 'share'), 10**400, r'both\.share: expected a finite number, got inf'),
    (('both', 'share'), 'x' * 100, r'both\.share: .* got .xxx.*\.\.\.$')])
def test_another_value_is_refused_with_its_place(
    place: tuple[str, ...], plain: Any, expected: str,
) -> None:
    value = inner = good()
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = plain
    with pytest.raises(ValueError, match=f'value.{expected}'):
        decoded(Outer, value, 'value')


@pytest.mark.parametrize('name', list(good()))
def test_no_field_may_be_missing(name: str) -> None:
    value = good()
    del value[name]
    with pytest.raises(ValueError, match=f'value: expected the fields .*{name}'):
        decoded(Outer, value, 'value')


def test_columns_without_rows_keep_their_shape_and_type() -> None:
    value = decoded(Outer, {**good(), 'rows': [], 'stamps': []}, '')
    assert (value.rows.shape, value.stamps.shape) == ((0, 3), (0,))
    assert (value.rows.dtype, value.stamps.dtype) == (np.float64, np.int64)


def test_annotations_keep_the_descriptions_of_columns() -> None:
    assert annotations(Outer)['rows'] == Rows3
    assert list(annotations(Tuple)) == ['count', 'share']


@given(arrays(st.integers(0, 1), np.int64), arrays(st.sampled_from([4, 2]), np.int64))
def test_members_of_enumerations_are_names(sizes: np.ndarray, colours: np.ndarray) -> None:
    value = Chosen(sizes, colours)
    plain = json.loads(json.dumps(encoded(value)))
    assert_same_value(decoded(Chosen, plain, ''), value)
    assert [plain['sizes']['names'][k] for k in plain['sizes']['of']] == [
        tuple(Size)[k].value for k in sizes]
    assert [plain['colours']['names'][k] for k in plain['colours']['of']] == [
        Colour(k).name.lower() for k in colours]


@pytest.mark.parametrize(('plain', 'expected'), [
    ([0], r"sizes: expected the fields \['names', 'of'\]"),
    ({'names': ['small']}, 'sizes: expected the fields'),
    ({'names': ['huge'], 'of': [0]}, "sizes: expected one of small, large, got 'huge'"),
    ({'names': [0], 'of': [0]}, 'sizes: expected a value of kind str'),
    ({'names': ['small'], 'of': [1]}, 'sizes: expected positions among 1 names'),
    ({'names': ['small'], 'of': [-1]}, 'sizes: expected positions among 1 names'),
    ({'names': ['small'], 'of': [0.0]}, 'sizes: expected ints')])
def test_a_name_of_no_member_is_refused(plain: Any, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        decoded(Chosen, {'sizes': plain, 'colours': {'names': [], 'of': []}}, '')
