# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a batch iteration against dense and sparse matrices: cliques, steps, chi2."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_edges, random_graph, random_observed, random_poses
import scipy.sparse.csgraph
from sparse_system import Factorization, LinearSystem

from pose_graph_ros.core import fronts, gauss_newton, symbolic, tables as tb, vectors
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.jit import kernel
from pose_graph_ros.core.se2 import FloatArray

# Of a step, where H has a condition number of some 1e4.
ROUNDING = 1e-9

seeds = st.integers(0, 2**32 - 1)


def weighted_graph(seed: int, n_nodes: int = 12) -> Graph:
    """Return a graph with weights of all kinds, none of which loosens a part of it."""
    rng = np.random.default_rng(seed)
    n_biases = int(rng.integers(0, 4))
    graph = random_graph(
        seed, n_nodes, 2 * n_nodes, 6, fix=(int(rng.integers(n_nodes)),), n_biases=n_biases)
    loose = range(n_nodes - 1, graph.n_edges - 4 * n_biases)
    weights = {int(e): float(rng.choice([0.0, 0.3, 2.5])) for e in loose}
    weights |= {e: float(rng.choice([0.3, 2.5])) for e in range(loose.stop, graph.n_edges)}
    graph.apply(GraphUpdate(weigh_edges=weights, weigh_observed={0: 0.0, 1: 0.5}))
    return graph


def planted(graph: Graph) -> symbolic.Cliques:
    memory = graph.memory
    cliques, need_f, need_i, largest = symbolic.analyse(memory.head)
    memory.ensure('pool_f', need_f)
    memory.ensure('pool_i', need_i)
    memory.ensure('work_f', largest)
    symbolic.plant(memory.head, cliques)
    return cliques


def full_step(graph: Graph, damping: float = 0.0) -> FloatArray:
    """Take a step; return what it added to the poses, in the rows of H."""
    head = graph.memory.head
    gauss_newton.linearize(head)
    assert gauss_newton.eliminate(head, damping)
    length = gauss_newton.gauss_newton_step(head)
    step = graph.memory['node_f'][:graph.n_nodes, tb.DELTA:tb.DELTA + 3]
    assert length == np.max(np.abs(step))
    np.testing.assert_array_equal(step[graph.fixed], 0.0)
    return step[~graph.fixed].ravel()


# --- the cliques --------------------------------------------------------------------------------

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
    for k, nodes in enumerate(lists):
        separator = nodes[len(frontal[k]):]
        places = [position[node] for node in separator]
        assert places == sorted(places)
        parent = cliques.parent[k]
        assert (parent < 0) == (separator == [])
        if parent >= 0:
            assert parent > k
            assert set(separator) <= set(lists[parent])
            # each subtree lies in one piece: what comes between is below the same parent
            below = k + 1
            while below != parent:
                below = cliques.parent[below]
                assert 0 <= below <= parent
    clique_of = {node: k for k, nodes in enumerate(frontal) for node in nodes}
    for i, j in zip(graph.edges.i, graph.edges.j, strict=True):
        first = min(clique_of[i], clique_of[j])
        assert {i, j} <= set(lists[first])


@pytest.mark.parametrize('n_biases', [0, 5])
def test_the_newest_pose_is_alone_in_its_clique(n_biases: int) -> None:
    graph = random_graph(seed=1, n_nodes=30, n_edges=60, n_biases=n_biases)
    cliques = symbolic.analyse(graph.memory.head).cliques
    assert cliques.nodes[-1] == graph.newest_pose == 29
    assert cliques.n_frontal[-1] == 1


@given(seeds)
def test_loose_parts_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 15
    graph = Graph()
    graph.apply(GraphUpdate(hidden=random_poses(rng, n)))
    i = rng.integers(0, n, 14)
    j = (i + rng.integers(1, n, 14)) % n
    graph.apply(GraphUpdate(
        edges=random_edges(rng, i.tolist(), j.tolist()),
        observed=random_observed(rng, rng.integers(0, n, 3).tolist()),
        fix=[int(rng.integers(n))]))
    graph.apply(GraphUpdate(remove_edges=[0, 3], remove_observed=[1]))
    edges, observed = graph.edges, graph.observed
    matrix = scipy.sparse.coo_array((edges.weight, (edges.i, edges.j)), shape=(n, n)).tocsr()
    matrix.eliminate_zeros()
    _, part = scipy.sparse.csgraph.connected_components(matrix, directed=False)
    held = set(part[graph.fixed]) | set(part[observed.node[observed.weight > 0.0]])
    loose = [node for node in range(n) if part[node] not in held]
    expected = (loose[0] if len(loose) > 0 else -1, len(loose))
    assert symbolic.loose_part(graph.memory.head) == expected


# --- steps --------------------------------------------------------------------------------------

@given(seeds)
@settings(max_examples=50)
def test_a_step_is_that_of_sparse_matrices(seed: int) -> None:
    graph = weighted_graph(seed)
    H, b = LinearSystem(graph).assemble(graph.poses)
    expected = -Factorization(H).solve(b)
    planted(graph)
    for _ in range(2):  # again over the same cliques
        poses = graph.poses.copy()
        np.testing.assert_allclose(
            full_step(graph), expected, rtol=ROUNDING, atol=ROUNDING * np.max(np.abs(expected)))
        gauss_newton.put_poses(graph.memory.head, poses)


@given(seeds, st.floats(1e-4, 1e4))
@settings(max_examples=50)
def test_a_damped_step_is_that_of_sparse_matrices(seed: int, damping: float) -> None:
    graph = weighted_graph(seed)
    H, b = LinearSystem(graph).assemble(graph.poses)
    rows = graph.memory['node_f'][:graph.n_nodes][~graph.fixed]
    scale = rows[:, [tb.STIFF_T, tb.STIFF_T, tb.STIFF_R]].ravel()**2
    expected = -np.linalg.solve(H.toarray() + damping * np.diag(scale), b)
    planted(graph)
    np.testing.assert_allclose(
        full_step(graph, damping), expected, rtol=ROUNDING,
        atol=ROUNDING * np.max(np.abs(expected)))


@given(seeds)
@settings(max_examples=50)
def test_a_chord_step_has_the_old_matrix_and_the_new_gradient(seed: int) -> None:
    graph = weighted_graph(seed)
    system = LinearSystem(graph)
    factorization = Factorization(system.assemble(graph.poses)[0])
    planted(graph)
    full_step(graph)
    head, right = graph.memory.head, np.empty((graph.n_nodes, 3))
    for _ in range(2):
        before = graph.poses.copy()
        gauss_newton.evaluate(head, right)
        expected = -factorization.solve(system.assemble(before)[1])
        length = gauss_newton.chord_step(head, right)
        size = np.max(np.abs(expected))
        assert length == pytest.approx(size, rel=ROUNDING)
        step = (graph.poses - before)[~graph.fixed]
        turns = np.round((step - expected.reshape(-1, 3))[:, 2] / (2.0 * np.pi))
        step[:, 2] -= 2.0 * np.pi * turns
        np.testing.assert_allclose(step.ravel(), expected, rtol=ROUNDING, atol=ROUNDING * size)
        np.testing.assert_array_equal(graph.poses[graph.fixed], before[graph.fixed])


@given(seeds)
def test_chi2_and_its_gradient_are_those_of_the_constraints(seed: int) -> None:
    graph = weighted_graph(seed)
    right = np.empty((graph.n_nodes, 3))
    chi2, rounding = gauss_newton.evaluate(graph.memory.head, right)
    assert chi2 == pytest.approx(graph.energies().chi2, rel=1e-12)
    assert 0.0 < rounding < 1e-10 * chi2
    b = LinearSystem(graph).assemble(graph.poses)[1]
    np.testing.assert_allclose(
        right[~graph.fixed].ravel(), -b, rtol=ROUNDING, atol=ROUNDING * np.max(np.abs(b)))


def test_what_rounding_makes_of_chi2_grows_with_the_distance_from_the_origin() -> None:
    graph = random_graph(seed=2, fix=(0,))
    right = np.empty((graph.n_nodes, 3))
    near = gauss_newton.evaluate(graph.memory.head, right)[1]
    graph.set_poses(graph.poses + np.array([5e6, 0.0, 0.0]))
    assert gauss_newton.evaluate(graph.memory.head, right)[1] > 1e3 * near


# --- vectors and fronts -------------------------------------------------------------------------

@kernel
def copied(source, target, n):
    vectors.copy(source, 1, target, 2, n)


@kernel
def added(source, target, n):
    vectors.add(source, 1, target, 2, n)


@pytest.mark.parametrize('n', range(10))
def test_vectors_write_the_numbers_they_are_to_and_no_others(n: int) -> None:
    source, start = np.arange(20.0) + 100.0, np.arange(20.0)
    target, expected = start.copy(), start.copy()
    copied(source, target, n)
    expected[2:2 + n] = source[1:1 + n]
    np.testing.assert_array_equal(target, expected)
    added(source, target, n)
    expected[2:2 + n] += source[1:1 + n]
    np.testing.assert_array_equal(target, expected)


@pytest.mark.parametrize(('rows', 'n'), [
    (3, 3), (3, 6), (6, 6), (6, 15), (9, 9), (9, 12), (12, 21), (15, 48), (18, 90)])
def test_a_front_is_factorised_as_a_dense_matrix_is(rows: int, n: int) -> None:
    rng = np.random.default_rng(rows * n)
    root = rng.standard_normal((n, n))
    matrix = np.column_stack((root @ root.T + np.eye(n), rng.standard_normal(n)))
    ld = fronts.padded(n)
    front = np.zeros((n, ld))
    front[:, :n], front[:, -1] = np.triu(matrix[:, :n]), matrix[:, n]
    flat = front.ravel()
    assert fronts.factorize(flat, rows, n, ld, np.zeros(rows)) == -1
    done = np.column_stack((flat.reshape(n, ld)[:, :n], flat.reshape(n, ld)[:, -1]))
    R = np.linalg.solve(np.linalg.cholesky(matrix[:rows, :rows]), matrix[:rows])
    np.testing.assert_allclose(1.0 / np.diag(done)[:rows], np.diag(R), rtol=1e-10)
    np.testing.assert_allclose(np.triu(done[:rows], 1), np.triu(R, 1), atol=1e-10)
    rest = matrix[rows:, rows:] - R[:, rows:n].T @ R[:, rows:]
    np.testing.assert_allclose(np.triu(done[rows:, rows:]), np.triu(rest), atol=1e-9)


@pytest.mark.parametrize('bad', range(12))
def test_a_bad_pivot_is_found_in_its_row(bad: int) -> None:
    ld = fronts.padded(12)
    front = np.zeros((12, ld))
    front[:, :12] = np.diag(np.arange(1.0, 13.0))
    front[bad, bad] = 1e-3
    assert fronts.factorize(front.ravel(), 12, 12, ld, np.full(12, 0.01)) == bad
    front[bad, bad] = np.nan
    assert fronts.factorize(front.ravel(), 12, 12, ld, np.full(12, 0.01)) == bad
