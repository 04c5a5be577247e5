# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The sparse H and b that other tests go by: against dense loops, the states of the source's
Figure 3.10, and the null space.
"""

from hypothesis import given, strategies as st
import numpy as np
import numpy.typing as npt
import pytest
from random_graphs import (
    dense_system,
    free_part,
    random_edges,
    random_graph,
    random_observed,
    random_poses,
)
from sparse_system import Factorization, LinearSystem

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# Sums of tens of products of some 1e4, each rounded at 1e-16.
ROUNDING = 1e-10
# Relative, of an inverse: the rounding times a condition number of some 1e5.
INVERSE_ROUNDING = 1e-9

seeds = st.integers(0, 2**32 - 1)


def blocks_that_are_not_zero(H: FloatArray) -> npt.NDArray[np.bool_]:
    n = len(H) // 3
    return np.any(H.reshape(n, 3, n, 3) != 0.0, axis=(1, 3))


@given(seeds, st.integers(2, 9), st.integers(0, 8), st.integers(1, 6),
       st.sets(st.integers(0, 8), max_size=3), st.integers(0, 3))
def test_h_and_b_are_those_of_dense_loops(  # noqa: PLR0917
    seed: int, n_nodes: int, extra: int, n_observed: int, fixed: set[int], n_biases: int,
) -> None:
    fix = tuple(node for node in fixed if node < n_nodes)
    graph = random_graph(seed, n_nodes, n_nodes - 1 + extra, n_observed, fix, n_biases)
    system = LinearSystem(graph)
    H, b = system.assemble(graph.poses)
    H_dense, b_dense = free_part(graph, *dense_system(graph))
    assert system.size == 3 * (n_nodes - len(fix) + n_biases) == H.shape[0]
    np.testing.assert_allclose(H.toarray(), H_dense, atol=ROUNDING)
    np.testing.assert_allclose(b, b_dense, atol=ROUNDING)
    np.testing.assert_array_equal(system.pattern(), blocks_that_are_not_zero(H_dense))


def test_a_step_moves_the_free_nodes_alone() -> None:
    graph = random_graph(seed=3, n_nodes=4, fix=(1,))
    step = np.arange(9.0)
    moved = LinearSystem(graph).moved(graph.poses, step) - graph.poses
    np.testing.assert_allclose(moved[[0, 2, 3]], step.reshape(3, 3), atol=1e-14)
    np.testing.assert_array_equal(moved[1], 0.0)


def test_a_graph_of_fixed_nodes_has_no_unknowns() -> None:
    graph = random_graph(seed=4, n_nodes=3, fix=(0, 1, 2))
    system = LinearSystem(graph)
    H, b = system.assemble(graph.poses)
    assert system.size == 0
    assert H.shape == (0, 0)
    assert b.shape == (0,)


# --- The null space of a graph that floats ---------------------------------------------------

def rigid_motion(poses: FloatArray) -> FloatArray:
    """Return what a small motion of the whole map does to all poses, shape (3N, 3)."""
    n = np.zeros((len(poses), 3, 3))
    n[:] = np.eye(3)
    n[:, 0, 2], n[:, 1, 2] = -poses[:, 1], poses[:, 0]
    return n.reshape(-1, 3)


@given(seeds)
def test_edges_tell_nothing_of_the_pose_of_the_whole(seed: int) -> None:
    graph = random_graph(seed, n_observed=0, fix=(0,))
    # dense, with all nodes: H N = 0 and b^T N = 0 at any error
    H, b = dense_system(graph)
    N = rigid_motion(graph.poses)
    np.testing.assert_allclose(H @ N, 0.0, atol=ROUNDING)
    np.testing.assert_allclose(b @ N, 0.0, atol=ROUNDING)
    # the null space is no larger: six of the 3N directions are told apart by a rank
    assert np.linalg.matrix_rank(H) == len(H) - 3
    # with node 0 fixed its column is left out, so H_ff N_f = -H_f0 N_0, and only the rows of
    # nodes that share an edge with node 0 feel that it is fixed
    H_free, b_free = LinearSystem(graph).assemble(graph.poses)
    np.testing.assert_allclose(H_free @ N[3:], -H[3:, :3] @ N[:3], atol=ROUNDING)
    np.testing.assert_allclose(b_free @ N[3:], -b[:3] @ N[:3], atol=ROUNDING)
    edges = graph.edges
    tied = set(edges.j[edges.i == 0].tolist()) | set(edges.i[edges.j == 0].tolist())
    felt = (H_free @ N[3:]).reshape(-1, 9)
    for node in range(1, graph.n_nodes):
        assert (np.max(np.abs(felt[node - 1])) > ROUNDING) == (node in tied)


# --- Anchors ---------------------------------------------------------------------------------

def test_a_graph_without_an_anchor_is_refused_and_a_node_of_it_named() -> None:
    graph = random_graph(seed=5, n_nodes=4, n_observed=0)
    with pytest.raises(LinearSolveError, match='hidden node 0 and 3 others'):
        LinearSystem(graph)


def test_a_loose_part_of_the_graph_is_named() -> None:
    rng = np.random.default_rng(6)
    graph = random_graph(seed=6, n_nodes=4, fix=(0,))
    graph.apply(GraphUpdate(hidden=random_poses(rng, 2), edges=random_edges(rng, [4], [5])))
    with pytest.raises(LinearSolveError, match='hidden node 4 and 1 others'):
        LinearSystem(graph)
    graph.apply(GraphUpdate(observed=random_observed(rng, [5])))
    assert LinearSystem(graph).size == 15


# --- Factorization ---------------------------------------------------------------------------

@given(seeds)
def test_the_factorization_solves_and_gives_every_covariance(seed: int) -> None:
    graph = random_graph(seed, fix=(3,))
    H, b = LinearSystem(graph).assemble(graph.poses)
    factorization = Factorization(H)
    inverse = np.linalg.inv(H.toarray())
    scale = np.max(np.abs(inverse))
    np.testing.assert_allclose(
        factorization.solve(b), np.linalg.solve(H.toarray(), b), rtol=INVERSE_ROUNDING,
        atol=INVERSE_ROUNDING * scale)
    for block in range(graph.n_nodes - 1):
        covariance = factorization.covariance(block)
        part = slice(3 * block, 3 * block + 3)
        np.testing.assert_allclose(
            covariance, inverse[part, part], rtol=0.0, atol=INVERSE_ROUNDING * scale)
        np.testing.assert_array_equal(covariance, covariance.T)


def test_a_heading_that_nothing_determines_is_refused_or_has_no_certainty() -> None:
    # one position holds a chain like a pin: H has a null vector, the turn around the pin; what
    # rounding leaves of its zero pivot may or may not pass for a number
    rng = np.random.default_rng(8)
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=random_poses(rng, 6), edges=random_edges(rng, [0, 1, 2, 3, 4], [1, 2, 3, 4, 5]),
        observed=random_observed(rng, [2]).rows(slice(0, 1))))
    H, b = LinearSystem(graph).assemble(graph.poses)
    assert np.linalg.matrix_rank(H.toarray(), hermitian=True) == len(b) - 1
    try:
        covariance = Factorization(H).covariance(5)
    except LinearSolveError:
        return
    assert abs(covariance[2, 2]) > 1e6      # [rad^2]
