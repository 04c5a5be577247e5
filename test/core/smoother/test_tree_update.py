# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Bayes tree is a factorisation of H; an update affects no more of it than necessary."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from slow_smoother import Clique, cliques, EXACT, information, SlowGraph, world

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Tolerance relative to the entries of H, if no clique frame has turned against its parent's.
ROUNDING = 1e-9

seeds = st.integers(0, 2**32 - 1)


def driven(seed: int, steps: int, config: SmootherConfig = EXACT) -> IncrementalSmoother:
    """Return a smoother after random edits, including edits that fail."""
    smoother, slow, here = IncrementalSmoother(config), SlowGraph(), world(seed)
    updates = [GraphUpdate(hidden=np.array(here.truth), fix=[0])]
    for _ in range(steps):
        update = updates.pop() if len(updates) > 0 else here.mixture(slow)
        if smoother.update(update).status is not Status.FAILED:
            slow = slow.edited(update)
        del here.truth[len(slow.poses):]
    return smoother


def rows(nodes: list[int]) -> list[int]:
    return [3 * node + k for node in nodes for k in range(3)]


@given(seeds, st.integers(1, 25))
@settings(max_examples=30)
def test_each_node_is_eliminated_once_and_the_links_agree(seed: int, steps: int) -> None:
    graph = driven(seed, steps).graph
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
    graph = driven(seed, steps).graph
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
    graph = driven(seed, steps).graph
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


@given(seeds, st.integers(5, 40))
@settings(max_examples=20)
def test_cliques_are_amalgamated_up_to_a_limit(seed: int, steps: int) -> None:
    graph = driven(seed, steps).graph
    assert all(1 <= len(clique.frontal) <= 16 for clique in cliques(graph).values())


def chain(n: int, config: SmootherConfig = EXACT) -> IncrementalSmoother:
    smoother = IncrementalSmoother(config)
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    for k in range(1, n):
        smoother.update(link(k))
    return smoother


def link(k: int) -> GraphUpdate:
    return GraphUpdate(hidden=[[k, 0.0, 0.0]], edges=closure(k - 1, k, 1.0))


def closure(i: int, j: int, distance: float) -> Edges:
    return Edges([i], [j], [[distance, 0.0, 0.0]], [100.0 * np.eye(3)], [EdgeKind.ODOMETRY])


def test_the_newest_node_is_alone_in_the_root() -> None:
    smoother = chain(40)
    for update in (link(40), GraphUpdate(edges=closure(3, 40, 37.0)), link(41),
                   GraphUpdate(edges=closure(20, 41, 21.0))):
        smoother.update(update)
        newest = smoother.graph.n_nodes - 1
        roots = [clique for clique in cliques(smoother.graph).values() if clique.parent < 0]
        assert [clique.frontal for clique in roots] == [[newest]]


def test_a_step_along_a_chain_touches_its_end_alone() -> None:
    smoother = chain(300)
    before = cliques(smoother.graph)
    result = smoother.update(link(300))
    after = cliques(smoother.graph)
    assert result.eliminated <= 2
    changed = [c for c in after if c not in before or after[c].frontal != before[c].frontal]
    assert len(changed) <= 2


def test_a_closure_between_new_nodes_leaves_old_ones_alone() -> None:
    smoother = chain(300)
    result = smoother.update(GraphUpdate(edges=closure(290, 298, 8.0)))
    assert result.eliminated <= 20


def test_new_weights_do_not_change_the_tree() -> None:
    smoother = chain(60)
    smoother.update(GraphUpdate(edges=closure(5, 50, 45.0)))
    before = cliques(smoother.graph)
    smoother.update(GraphUpdate(weigh_edges={30: 0.5, 59: 2.0}))
    after = cliques(smoother.graph)
    assert list(before) == list(after)
    for c, clique in after.items():
        assert (clique.frontal, clique.separator) == (before[c].frontal, before[c].separator)


@given(seeds, st.integers(1, 25))
@settings(max_examples=20)
def test_the_scales_of_nodes_follow_their_constraints(seed: int, steps: int) -> None:
    smoother = driven(seed, steps)
    graph, columns = smoother.graph, [tb.SCALE_T, tb.SCALE_R]
    other = Graph()
    other.fill(graph.rows()._replace(poses=graph.poses))
    actual, expected = (
        each.memory['node_f'][:each.n_nodes, columns] for each in (graph, other))
    # squares, since they result from differences of large numbers
    np.testing.assert_allclose(actual**2, expected**2, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('n', [1, 2, 3, 12, 60])
def test_a_graph_in_many_parts_has_a_root_for_each(n: int) -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.zeros((n, 3)), fix=range(n)))
    tree = cliques(smoother.graph)
    assert [clique.parent for clique in tree.values()] == [-1] * n
    # an edge joins two of them
    if n > 1:
        smoother.update(GraphUpdate(edges=closure(0, n - 1, 1.0), free=[0]))
        assert sum(clique.parent < 0 for clique in cliques(smoother.graph).values()) == n - 1
