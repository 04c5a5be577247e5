# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The quotient graph is that of the constraints; amalgamation keeps cliques whole and small."""

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import random_edges, random_poses

from pose_graph_ros.core.elimination.quotient_graph import (
    amalgamate,
    NEWEST_LAST,
    newest_last,
    structure,
)
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

seeds = st.integers(0, 2**32 - 1)
nodes = st.sets(st.integers(0, 10**6), min_size=1, max_size=30)


@given(nodes, st.randoms(use_true_random=False), st.booleans())
def test_the_newest_nodes_are_last_in_order_and_the_newest_pose_is_the_very_last(
    chosen: set[int], random: object, has_newest: bool,
) -> None:
    order = list(chosen)
    random.shuffle(order)
    newest = order[0] if has_newest else -1
    affected = np.array(order, dtype=np.int32)
    n_last = newest_last(affected, newest)
    assert sorted(affected.tolist()) == sorted(chosen)
    assert n_last == min(NEWEST_LAST, len(chosen))
    expected = sorted(chosen - {newest}) + [newest] * has_newest
    assert affected[len(order) - n_last:].tolist() == expected[len(order) - n_last:]


@given(seeds, st.integers(2, 20), st.integers(0, 40), st.data())
@settings(max_examples=60)
def test_before_any_clique_the_neighbours_are_those_of_the_edges(
    seed: int, n: int, extra: int, data: st.DataObject,
) -> None:
    rng = np.random.default_rng(seed)
    pairs = np.array([rng.choice(n, 2, replace=False) for _ in range(extra + 1)])
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=random_poses(rng, n), edges=random_edges(rng, *pairs.T.tolist())))
    graph.apply(GraphUpdate(remove_edges=(0,)))
    affected = np.array(sorted(data.draw(st.sets(
        st.integers(0, n - 1), min_size=1))), dtype=np.int32)
    orphans, start, adjacency = structure(
        graph.memory.head, *np.empty((2, 0), dtype=np.int32), affected)
    assert len(orphans) == 0
    used = {frozenset(pair) for pair in pairs[1:].tolist()}
    for k, node in enumerate(affected.tolist()):
        found = adjacency[start[k]:start[k + 1]].tolist()
        assert len(set(found)) == len(found)    # each neighbour once
        assert {int(affected[other]) for other in found} == {
            other for other in affected.tolist() if {node, other} in used}


@st.composite
def trees(draw: st.DrawFn) -> tuple[list[int], list[set[int]], list[int]]:
    """Return frontal counts, separators and parents of cliques as an elimination leaves them."""
    n = draw(st.integers(1, 12))
    frontal = draw(st.lists(st.integers(1, 4), min_size=n, max_size=n))
    ends = np.cumsum(frontal)
    separators: list[set[int]] = [set() for _ in range(n)]
    parents = [-1] * n
    for k in range(n - 1, -1, -1):
        parent = draw(st.integers(-1, n - 1))
        if parent <= k:
            continue
        own = set(range(int(ends[parent]) - frontal[parent], int(ends[parent])))
        below = draw(st.sets(st.sampled_from(sorted(own)), min_size=1))
        above = sorted(separators[parent])
        more = draw(st.sets(st.sampled_from(above))) if above else set()
        separators[k], parents[k] = below | more, parent
    return frontal, separators, parents


@given(trees(), st.integers(0, 12), st.integers(0, 30), st.integers(1, 12))
def test_merged_cliques_hold_all_blocks_and_few_zeros(
    tree: tuple[list[int], list[set[int]], list[int]], n_apart: int, most_zeros: int,
    most_frontal: int,
) -> None:
    frontal, separators, parents = tree
    n, ends = len(frontal), np.cumsum(frontal)
    offset = np.cumsum([0, *(f + len(s) for f, s in zip(frontal, separators, strict=True))])
    into, merged = amalgamate(
        n, np.array(frontal, np.int32), offset.astype(np.int32), np.array(parents, np.int32),
        n_apart, most_zeros, most_frontal)
    members: dict[int, list[int]] = {}
    for k, target in enumerate(into.tolist()):
        assert target >= k
        assert into[target] == target   # nothing is merged into what is merged itself
        assert (k < n_apart) == (target < n_apart)
        members.setdefault(target, []).append(k)
    # nothing is merged into the clique of the newest pose
    assert members[n - 1] == [n - 1]
    for target, group in members.items():
        own = [set(range(int(ends[k]) - frontal[k], int(ends[k]))) for k in group]
        assert merged[target] == sum(map(len, own))
        together = set().union(*own)
        if len(group) == 1:
            continue
        assert merged[target] <= most_frontal
        # all the blocks of the separators that are not in the group are those of the target's
        assert set().union(*(separators[k] for k in group)) - together == separators[target]
        blocks = sum(f * (f - 1) // 2 + f * len(separators[k])
                     for f, k in zip(map(len, own), group, strict=True))
        size = len(together)
        zeros = size * (size - 1) // 2 + size * len(separators[target]) - blocks
        assert zeros <= most_zeros
