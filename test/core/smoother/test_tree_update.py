# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Bayes tree is a factorisation of H; an update affects no more of it than necessary."""

from hypothesis import given, settings, strategies as st
import numpy as np
from slow_smoother import Clique, cliques, driven, information

from pose_graph_ros.core.graph import tables as tb

# Tolerance relative to the entries of H, if no clique frame has turned against its parent's.
ROUNDING = 1e-9

seeds = st.integers(0, 2**32 - 1)


def rows(nodes: list[int]) -> list[int]:
    return [3 * node + k for node in nodes for k in range(3)]


@given(seeds, st.integers(1, 25))
@settings(max_examples=30)
def test_each_node_is_eliminated_once_and_the_links_agree(seed: int, steps: int) -> None:
    graph = driven(seed, steps)[0].graph
    tree = cliques(graph)
    frontal = [node for clique in tree.values() for node in clique.frontal]
    assert sorted(frontal) == list(range(graph.n_nodes))
    for c, clique in tree.items():
        for node in clique.frontal:
            assert graph.memory['node_i'][node, tb.CLIQUE] == c
        for child in clique.children:
            assert tree[child].parent == c
        if clique.parent < 0:
            assert clique.separator == []
        else:
            above = tree[clique.parent]
            assert c in above.children
            assert set(clique.separator) <= set(above.frontal + above.separator)


@given(seeds, st.integers(1, 25))
@settings(max_examples=30)
def test_the_rows_of_all_cliques_are_a_root_of_the_information(seed: int, steps: int) -> None:
    graph = driven(seed, steps)[0].graph
    total = np.zeros((3 * graph.n_nodes,) * 2)
    for clique in cliques(graph).values():
        at = rows(clique.frontal + clique.separator)
        # a fixed node has rows of the identity, and its columns count for nothing
        R = clique.R[np.repeat(~graph.fixed[clique.frontal], 3)]
        total[np.ix_(at, at)] += R.T @ R
    free = np.flatnonzero(np.repeat(~graph.fixed, 3))
    H = information(graph)[np.ix_(free, free)]
    np.testing.assert_allclose(
        total[np.ix_(free, free)], H, atol=ROUNDING * np.max(np.abs(H), initial=1.0))


def below(tree: dict[int, Clique], c: int) -> list[int]:
    """Return the frontal nodes of a clique and of all below it."""
    return tree[c].frontal + [
        node for child in tree[c].children for node in below(tree, child)]


@given(seeds, st.integers(5, 25))
@settings(max_examples=20)
def test_update_matrices_are_schur_complements(seed: int, steps: int) -> None:
    graph = driven(seed, steps)[0].graph
    tree = cliques(graph)
    for c, clique in tree.items():
        inside, outside = below(tree, c), clique.separator
        H = information(graph, inside)
        i = [row for row in rows(inside) if not graph.fixed[row // 3]]
        o = rows(outside)
        expected = H[np.ix_(o, o)] - H[np.ix_(o, i)] @ np.linalg.solve(
            H[np.ix_(i, i)], H[np.ix_(i, o)])
        np.testing.assert_allclose(
            clique.update, expected, atol=ROUNDING * np.max(np.abs(H), initial=1.0))
