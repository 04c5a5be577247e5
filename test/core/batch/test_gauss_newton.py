# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a batch iteration against dense matrices: steps, chi2."""

from functools import partial

from hypothesis import assume, given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import dense_system, free_part, random_graph

from pose_graph_ros.core.batch import gauss_newton, optimizer
from pose_graph_ros.core.batch.levenberg_marquardt import secant_step
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# Relative error of a step, for a condition number of H of some 1e4.
ROUNDING = 1e-9

seeds = st.integers(0, 2**32 - 1)


def weighted_graph(seed: int, n_nodes: int = 12) -> Graph:
    """Return a graph with various weights, also zero, all parts of which are determined."""
    rng = np.random.default_rng(seed)
    n_biases = int(rng.integers(0, 4))
    graph = random_graph(
        seed, n_nodes, 2 * n_nodes, 6, fix=(int(rng.integers(n_nodes)),), n_biases=n_biases)
    is_edge = graph.factors.j >= 0
    first, second, *_ = observed = np.flatnonzero(~is_edge).tolist()
    loose = range(n_nodes - 1, first - 1 if n_biases > 0 else first)
    weights = {int(e): float(rng.choice([0.0, 0.3, 2.5])) for e in loose}
    weights |= {e: float(rng.choice([0.3, 2.5])) for e in range(loose.stop, graph.n_factors)
                if e not in observed}
    graph.apply(GraphUpdate(weigh={**weights, first: 0.0, second: 0.5}))
    return graph


def full_step(graph: Graph, damping: float = 0.0) -> FloatArray:
    """Make a step; return the solution of the free nodes, in the order of H."""
    head = graph.memory.head
    assert gauss_newton.eliminate(head, damping, False)
    found = gauss_newton.step(head, np.zeros((graph.n_nodes, 3)), False)
    length = gauss_newton.move(head, found)
    step = graph.node_records['delta']
    assert length == np.max(np.abs(step))
    np.testing.assert_array_equal(step[graph.fixed], 0.0)
    return step[~graph.fixed].ravel()


@given(seeds, st.just(0.0) | st.floats(1e-4, 1e4))
@settings(max_examples=80)
def test_a_step_is_that_of_dense_matrices(seed: int, damping: float) -> None:
    graph = weighted_graph(seed)
    H, b = free_part(graph, *dense_system(graph))
    assume(np.linalg.cond(H) < 1e12)
    rows = graph.node_records[~graph.fixed]
    scale = np.stack((rows['scale_t'], rows['scale_t'], rows['scale_r']), axis=1).ravel()**2
    expected = -np.linalg.solve(H + damping * np.diag(scale), b)
    optimizer.plant(graph, symbolic.analyse(graph.memory.head))
    for _ in range(2):  # again over the same cliques
        poses = graph.poses.copy()
        np.testing.assert_allclose(
            full_step(graph, damping), expected, rtol=ROUNDING,
            atol=ROUNDING * np.max(np.abs(expected)))
        gauss_newton.put_poses(graph.memory.head, poses)


@given(seeds)
@settings(max_examples=50)
def test_a_chord_step_has_the_old_matrix_and_the_new_gradient(seed: int) -> None:
    graph = weighted_graph(seed)
    H, _ = free_part(graph, *dense_system(graph))
    assume(np.linalg.cond(H) < 1e12)
    optimizer.plant(graph, symbolic.analyse(graph.memory.head))
    full_step(graph)
    head, right = graph.memory.head, np.empty((graph.n_nodes, 3))
    for _ in range(2):
        before = graph.poses.copy()
        gauss_newton.evaluate(head, right)
        expected = -np.linalg.solve(H, free_part(graph, *dense_system(graph))[1])
        length = gauss_newton.move(head, gauss_newton.step(head, right, True))
        size = np.max(np.abs(expected))
        assert length == pytest.approx(size, rel=ROUNDING)
        step = (graph.poses - before)[~graph.fixed]
        turns = np.round((step - expected.reshape(-1, 3))[:, 2] / (2.0 * np.pi))
        step[:, 2] -= 2.0 * np.pi * turns
        np.testing.assert_allclose(step.ravel(), expected, rtol=ROUNDING, atol=ROUNDING * size)
        np.testing.assert_array_equal(graph.poses[graph.fixed], before[graph.fixed])


@given(seeds, st.floats(0.3, 10.0))
def test_a_step_is_corrected_by_what_the_gradient_has_changed_by_in_the_last_one(
    seed: int, factor: float,
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    kept = root @ root.T + np.eye(6)
    right = rng.normal(size=6)
    first = secant_step(partial(np.linalg.solve, kept), right, None)
    np.testing.assert_allclose(kept @ first, right, atol=1e-9)
    # the true matrix is the one that is kept, times a factor
    after = right - factor * kept @ first
    second = secant_step(partial(np.linalg.solve, kept), after, (first, right))
    np.testing.assert_allclose(factor * kept @ second, after, atol=1e-9)


@given(seeds)
def test_chi2_and_its_gradient_are_those_of_the_constraints(seed: int) -> None:
    graph = weighted_graph(seed)
    right = np.empty((graph.n_nodes, 3))
    chi2, rounding = gauss_newton.evaluate(graph.memory.head, right)
    assert chi2 == pytest.approx(graph.energies().chi2, rel=1e-12)
    assert 0.0 < rounding < 1e-10 * chi2
    b = free_part(graph, *dense_system(graph))[1]
    np.testing.assert_allclose(
        right[~graph.fixed].ravel(), -b, rtol=ROUNDING, atol=ROUNDING * np.max(np.abs(b)))


def test_the_rounding_error_of_chi2_grows_with_the_distance_from_the_origin() -> None:
    graph = random_graph(seed=2, fix=(0,))
    right = np.empty((graph.n_nodes, 3))
    near = gauss_newton.evaluate(graph.memory.head, right)[1]
    graph.set_poses(graph.poses + np.array([5e6, 0.0, 0.0]))
    assert gauss_newton.evaluate(graph.memory.head, right)[1] > 1e3 * near
