# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Growing arrays against plain lists."""

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray

actions = st.one_of(
    st.tuples(st.just('append'), st.integers(0, 70)),
    st.tuples(st.just('append_one'), st.just(1)))


@given(st.lists(actions, max_size=30), st.sampled_from([(), (3,), (3, 3)]))
def test_a_growing_array_holds_what_a_list_would(
    history: list[tuple[str, int]], row_shape: tuple[int, ...],
) -> None:
    array, rows, number = GrowingArray(row_shape, np.float64), [], 0
    for action, size in history:
        new = [np.full(row_shape, number + k) for k in range(size)]
        number += size
        if action == 'append':
            array.append(np.array(new).reshape(-1, *row_shape))
            rows += new
        else:
            array.append_one(new[0])
            rows += new
        assert len(array) == len(rows)
        np.testing.assert_array_equal(array.values, np.array(rows).reshape(-1, *row_shape))


def test_rows_are_selected_and_others_follow() -> None:
    array = GrowingArray((2,), np.int64)
    array.append(np.arange(80).reshape(40, 2))
    array.select(np.array([7, 3]))
    array.append_one((0, 1))
    np.testing.assert_array_equal(array.values, [(14, 15), (6, 7), (0, 1)])
    array.select(np.empty(0, dtype=np.int64))
    array.append_one((8, 9))
    np.testing.assert_array_equal(array.values, [(8, 9)])
