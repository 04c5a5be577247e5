# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The newest nodes are eliminated last."""

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.elimination.symbolic import NEWEST_LAST, newest_last

nodes = st.sets(st.integers(0, 10**6), min_size=1, max_size=30)


@given(nodes, st.randoms(use_true_random=False), st.booleans(), st.booleans())
def test_the_newest_are_last_in_order_then_a_fixed_node_and_the_newest_pose(
    chosen: set[int], random: object, has_newest: bool, has_fixed: bool,
) -> None:
    order = list(chosen)
    random.shuffle(order)
    newest, fixed = order[0] if has_newest else -1, order[-1] if has_fixed else -1
    affected = np.array(order, dtype=np.int32)
    n_last = newest_last(affected, newest, fixed)
    assert sorted(affected.tolist()) == sorted(chosen)
    assert n_last == min(NEWEST_LAST, len(chosen))
    last = [fixed] * (has_fixed and fixed != newest) + [newest] * has_newest
    expected = sorted(chosen - set(last)) + last
    assert affected[len(order) - n_last:].tolist() == expected[len(order) - n_last:]
