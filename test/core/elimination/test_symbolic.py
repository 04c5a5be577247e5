# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cliques of a whole graph are in postorder and cover it; loose parts are found."""

from hypothesis import given, strategies as st
import numpy as np
from random_graphs import random_edges, random_poses

from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.elimination.symbolic import NEWEST_LAST, newest_last
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


@given(seeds, st.integers(1, 40), st.integers(0, 40))
def test_cliques_cover_the_graph_in_postorder(seed: int, n_nodes: int, extra: int) -> None:
    rng = np.random.default_rng(seed)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=random_poses(rng, n_nodes)))
    if n_nodes > 1:
        pairs = np.array([rng.choice(n_nodes, 2, replace=False) for _ in range(extra)])
        graph.apply(GraphUpdate(edges=random_edges(rng, *pairs.reshape(-1, 2).T.tolist())))
    cliques = symbolic.analyse(graph.memory.head).cliques
    bounds = [slice(a, b) for a, b in zip(cliques.first, cliques.first[1:], strict=False)]
    lists = [cliques.nodes[part].tolist() for part in bounds]
    frontal = [nodes[:k] for nodes, k in zip(lists, cliques.n_frontal, strict=True)]
    order = [node for nodes in frontal for node in nodes]
    assert sorted(order) == list(range(n_nodes))
    position = {node: k for k, node in enumerate(order)}
    near = [set[int]() for _ in order]
    for i, j in zip(graph.edges.i.tolist(), graph.edges.j.tolist(), strict=True):
        near[i].add(j)
        near[j].add(i)
    fill = {}
    for node in order:
        fill[node] = len(near[node])
        for other in near[node]:
            near[other] |= near[node] - {other}
            near[other].discard(node)
    for k, nodes in enumerate(lists):
        separator = nodes[len(frontal[k]):]
        places = [position[node] for node in separator]
        assert places == sorted(places)
        parent = cliques.parent[k]
        assert (parent < 0) == (separator == [])
        if parent >= 0:
            assert parent > k
            assert set(separator) <= set(lists[parent])
            # each subtree is contiguous: all cliques in between are below the same parent
            below = k + 1
            while below != parent:
                below = cliques.parent[below]
                assert 0 <= below <= parent
        # merged cliques store few explicit zeros
        blocks = sum(len(nodes) - 1 - m for m in range(len(frontal[k])))
        assert blocks - sum(fill[node] for node in frontal[k]) <= symbolic.RELAXED_ZEROS
    clique_of = {node: k for k, nodes in enumerate(frontal) for node in nodes}
    for i, j in zip(graph.edges.i, graph.edges.j, strict=True):
        first = min(clique_of[i], clique_of[j])
        assert {i, j} <= set(lists[first])
