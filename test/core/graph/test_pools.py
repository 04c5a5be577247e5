# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pools: sizes of blocks, triangles without gaps, and blocks that are used again."""

from itertools import pairwise

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.graph import pools, tables as tb
from pose_graph_ros.core.graph.graph import Graph


@pytest.mark.parametrize('n', [1, 2, 12, 64, 65, 66, 73, 1000, 12345, 10**7])
def test_blocks_are_large_enough_and_not_much_larger(n: int) -> None:
    size = pools.rounded(n)
    assert n <= size <= max(n, 1.125 * n + 1)
    assert pools.rounded(size) == size


def test_what_is_given_back_is_taken_again() -> None:
    head = Graph().memory.head
    taken = [pools.take_nodes(head, n) for n in (3, 5, 3, 1)]
    assert taken == [0, 3, 8, 11]
    pools.give_nodes(head, 0, 3)
    pools.give_nodes(head, 8, 3)
    assert [pools.take_nodes(head, 3) for _ in range(3)] == [8, 0, 12]


@given(st.integers(0, 12), st.integers(0, 12))
def test_rows_of_a_triangle_follow_each_other_without_gaps(rows: int, more: int) -> None:
    n = rows + more
    begin = 0
    for k in range(rows):
        assert pools.row_start(k, n) + k == begin   # column k is the first that is stored
        assert pools.row_start(k, n) + n == begin + n - k   # the right-hand side is the last
        begin += n - k + 1
        assert pools.triangle_size(k + 1, n) == begin
    assert pools.triangle_size(rows, n) == begin


@given(st.integers(0, 10), st.integers(0, 10))
def test_a_clique_holds_its_rows_of_r_and_the_triangle_of_its_separator(
    frontal: int, separator: int,
) -> None:
    f, s = 3 * frontal, 3 * separator
    upper = sum(f + s + 1 - k for k in range(f)) + sum(s + 1 - k for k in range(s))
    more = 3 * s + 1 if frontal == 0 else 0     # of a prior
    assert pools.n_values(frontal, separator) == upper + more


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 200)), min_size=1, max_size=60))
@settings(max_examples=60)
def test_blocks_in_use_never_overlap(steps: list[tuple[bool, int]]) -> None:
    graph = Graph()
    head, taken = graph.memory.head, dict[int, int]()
    graph.memory.ensure('pool_f', 20_000)
    for gives, n in steps:
        if gives and taken:
            at = sorted(taken)[n % len(taken)]
            pools.give_values(head, at, taken.pop(at))
        else:
            at = pools.take_values(head, n)
            assert at not in taken
            taken[at] = n
        used = sorted((at, at + pools.rounded(n)) for at, n in taken.items())
        assert all(end <= begin for (_, end), (begin, _) in pairwise(used))
        assert all(end <= head[tb.POOL_F_END] for _, end in used)


def test_a_pool_grows_only_if_no_block_of_that_size_is_free() -> None:
    graph = Graph()
    head = graph.memory.head
    graph.memory.ensure('pool_f', 1000)
    first = [pools.take_values(head, 70) for _ in range(4)]
    end = head[tb.POOL_F_END]
    for at in first:
        pools.give_values(head, at, 70)
    # any number of the same size class will do
    n = pools.rounded(70)
    assert sorted(pools.take_values(head, n) for _ in range(4)) == first
    assert head[tb.POOL_F_END] == end
    assert pools.take_values(head, 70) == end


def test_sizes_of_blocks_increase() -> None:
    assert np.all(np.diff(tb.SIZES) > 0)
