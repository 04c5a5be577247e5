# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Linear starts: exact without noise, in any gauge, independent of the present poses."""

from collections.abc import Callable
from functools import partial

from hypothesis import assume, given, strategies as st
import numpy as np
import numpy.typing as npt
import pytest
from random_graphs import (
    consistent_graph,
    free_part,
    random_graph,
    random_observed,
    random_poses,
    slow_edge,
    slow_observed,
)

from pose_graph_ros.core.batch import linear_starts
from pose_graph_ros.core.batch.gauss_newton import solve_chordal
from pose_graph_ros.core.batch.linear_starts import joint
from pose_graph_ros.core.batch.optimizer import plant
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# Absolute error of two linear solves with condition numbers of some 1e3 [m, rad].
EXACT = 1e-11

TO_COMPLEX = np.array([1.0, 1j, 0.0])
ComplexArray = npt.NDArray[np.complex128]
Chordal = Callable[[Graph], FloatArray]

seeds = st.integers(0, 2**32 - 1)


def assert_poses_equal(poses: FloatArray, expected: FloatArray) -> None:
    np.testing.assert_allclose(poses[:, :2], expected[:, :2], atol=EXACT)
    np.testing.assert_allclose(se2.wrap(poses[:, 2] - expected[:, 2]), 0.0, atol=EXACT)


def compiled(graph: Graph) -> FloatArray:
    """Return the chordal start as the optimiser finds it, over the cliques of the graph."""
    plant(graph, symbolic.analyse(graph.memory.head))
    return linear_starts.chordal(graph, partial(solve_chordal, graph.memory))


either = pytest.mark.parametrize('chordal', [linear_starts.chordal, compiled])


def scattered(graph: Graph, rng: np.random.Generator) -> None:
    """Replace all poses but those of the fixed nodes by random ones."""
    poses = random_poses(rng, graph.n_nodes, 100.0)
    graph.set_poses(np.where(graph.fixed[:, None], graph.poses, poses))


def observe_exactly(graph: Graph, nodes: list[int], rng: np.random.Generator) -> None:
    """Add observed nodes with offsets that agree with the poses; the first is a position."""
    observed = random_observed(rng, nodes)
    mean = se2.compose(graph.poses[nodes], observed.offset)
    mean[::3, 2] = 0.0
    graph.apply(GraphUpdate(factors=Factors.on(
        observed.i, observed.offset, mean, observed.information, observed.kind)))


@either
@given(seeds, st.integers(0, 7))
def test_without_noise_it_is_exact_whichever_node_is_fixed(
    chordal: Chordal, seed: int, fixed: int,
) -> None:
    graph = consistent_graph(seed)
    truth = graph.poses.copy()
    graph.apply(GraphUpdate(free=(0,)))
    graph.apply(GraphUpdate(fix=(fixed,)))
    scattered(graph, np.random.default_rng(seed))
    start = chordal(graph)
    assert_poses_equal(start, truth)
    assert np.all((start[:, 2] >= -np.pi) & (start[:, 2] < np.pi))


@either
@given(seeds)
def test_without_noise_it_is_exact_with_observed_nodes_and_offsets_alone(
    chordal: Chordal, seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    graph = consistent_graph(seed)
    truth = graph.poses.copy()
    graph.apply(GraphUpdate(free=(0,)))
    observe_exactly(graph, [5, 2, 7, 2], rng)
    scattered(graph, rng)
    assert_poses_equal(chordal(graph), truth)


def dense_solution(
    graph: Graph, known: ComplexArray, weight: FloatArray, unary_weight: FloatArray, *,
    factor: ComplexArray, shift: ComplexArray, target: ComplexArray,
) -> ComplexArray:
    """Minimise sum w |v_j - factor v_i - shift|^2 + sum w |v_node - target|^2."""
    m, rows = len(graph.factors.edges), len(graph.factors.edges) + len(graph.factors.observed)
    matrix, right = np.zeros((rows, graph.n_nodes), complex), np.zeros(rows, complex)
    for k, (i, j) in enumerate(zip(graph.factors.edges.i, graph.factors.edges.j, strict=True)):
        matrix[k, j] += np.sqrt(weight[k])
        matrix[k, i] -= np.sqrt(weight[k]) * factor[k]
        right[k] = np.sqrt(weight[k]) * shift[k]
    for k, node in enumerate(graph.factors.observed.i):
        matrix[m + k, node] = np.sqrt(unary_weight[k])
        right[m + k] = np.sqrt(unary_weight[k]) * target[k]
    v = known.copy()
    free = ~graph.fixed
    right -= matrix[:, graph.fixed] @ known[graph.fixed]
    v[free] = np.linalg.lstsq(matrix[:, free], right, rcond=None)[0]
    return v


def weighted_graph(seed: int, n_nodes: int, extra: int, fix: set[int]) -> Graph:
    graph = random_graph(seed, n_nodes, n_nodes - 1 + extra, 5, tuple(fix))
    graph.apply(GraphUpdate(weigh={0: 0.5, n_nodes - 1: 0.0, graph.n_factors - 4: 3.0}))
    return graph


def dense_headings(graph: Graph) -> ComplexArray:
    """Return u of all nodes; none are used if they nearly cancel each other out."""
    edges, observed = graph.factors.edges, graph.factors.observed
    u = dense_solution(
        graph, np.exp(1j * graph.poses[:, 2]),
        *(table.weighted_information[:, 2, 2] for table in (edges, observed)),
        factor=np.exp(1j * edges.mean[:, 2]), shift=np.zeros(len(edges), complex),
        target=np.exp(1j * (observed.mean[:, 2] - observed.offset[:, 2])))
    assume(np.min(np.abs(u)) > 1e-2)
    return u / np.abs(u)


sizes = st.integers(2, 25), st.integers(0, 30), st.sets(st.integers(0, 1), min_size=1)


@given(seeds, *sizes)
def test_it_solves_two_linear_problems(
    seed: int, n_nodes: int, extra: int, fix: set[int],
) -> None:
    graph = weighted_graph(seed, n_nodes, extra, fix)
    edges, observed, u = graph.factors.edges, graph.factors.observed, dense_headings(graph)
    t = dense_solution(
        graph, graph.poses @ TO_COMPLEX,
        *(0.5 * np.trace(table.weighted_information[:, :2, :2], axis1=1, axis2=2)
          for table in (edges, observed)), factor=np.ones(len(edges)),
        shift=u[edges.i] * (edges.mean @ TO_COMPLEX),
        target=observed.mean @ TO_COMPLEX - u[observed.i] * (observed.offset @ TO_COMPLEX))
    start = linear_starts.chordal(graph)
    np.testing.assert_allclose(np.exp(1j * start[:, 2]), u, atol=1e-7)
    np.testing.assert_allclose(start @ TO_COMPLEX, t, atol=1e-6)


@given(seeds, *sizes)
def test_over_the_cliques_the_second_one_has_the_jacobians_of_measured_positions(
    seed: int, n_nodes: int, extra: int, fix: set[int],
) -> None:
    graph = weighted_graph(seed, n_nodes, extra, fix)
    edges, observed = graph.factors.edges, graph.factors.observed
    poses = np.zeros((n_nodes, 3))
    poses[:, 2] = np.angle(dense_headings(graph))
    poses[graph.fixed] = graph.poses[graph.fixed]
    H, b = np.zeros((3 * n_nodes,) * 2), np.zeros(3 * n_nodes)

    def add(error: FloatArray, J: FloatArray, information: FloatArray) -> None:
        J = J.reshape(3, -1)
        H[:] += J.T @ information @ J
        b[:] += J.T @ information @ error

    for i, j, mean, information in zip(
            edges.i, edges.j, edges.mean, edges.weighted_information, strict=True):
        J = np.zeros((3, n_nodes, 3))
        _, J[:, i], J[:, j] = slow_edge(poses[i], se2.compose(poses[i], mean), mean)
        add(slow_edge(poses[i], poses[j], mean)[0], J, information)
    for i, offset, mean, information in zip(
            observed.i, observed.offset, observed.mean, observed.weighted_information,
            strict=True):
        J = np.zeros((3, n_nodes, 3))
        error, J[:, i] = slow_observed(poses[i], offset, mean)
        add(error, J, information)
    H, b = free_part(graph, H, b)
    assume(np.linalg.cond(H) < 1e8)
    poses[~graph.fixed] -= np.linalg.solve(H, b).reshape(-1, 3)
    start = compiled(graph)
    np.testing.assert_allclose(start[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(se2.wrap(start[:, 2] - poses[:, 2]), 0.0, atol=1e-7)


@either
def test_headings_that_cancel_are_an_error(chordal: Chordal) -> None:
    graph = Graph()
    graph.apply(GraphUpdate(hidden=np.zeros((1, 3)), factors=Factors.on(
        [0, 0], None, [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]], [np.eye(3)] * 2,
        [FactorKind.GLOBAL_POSE] * 2)))
    with pytest.raises(LinearSolveError, match='cancel'):
        chordal(graph)


@given(seeds, st.booleans())
def test_joint_and_unit_starts_are_exact_without_noise_from_positions_alone(
    seed: int, unit: bool,
) -> None:
    rng = np.random.default_rng(seed)
    graph = consistent_graph(seed)
    truth, n = graph.poses.copy(), graph.n_nodes
    information = rng.uniform(0.1, 10.0, (n, 1, 1)) * np.diag([1.0, 1.0, 0.0])
    offset = np.column_stack((rng.uniform(-1.0, 1.0, (n, 2)), np.zeros(n)))
    mean = np.column_stack((se2.transform(truth, offset[:, :2]), np.zeros(n)))
    graph.apply(GraphUpdate(
        factors=Factors.on(np.arange(n), offset, mean, information,
                               np.full(n, FactorKind.POSITION)),
        free=np.flatnonzero(graph.fixed).tolist()))
    graph.set_poses(random_poses(rng, n))
    assert_poses_equal(joint(graph, unit=unit), truth)


@either
def test_headings_alone_do_not_determine_positions(chordal: Chordal) -> None:
    graph = Graph()
    graph.apply(GraphUpdate(hidden=np.zeros((2, 3)), fix=(0,), factors=Factors(
        [0], [1], [[1.0, 0.0, 0.5]], [np.diag([0.0, 0.0, 1.0])], [FactorKind.LOOP_CLOSURE])))
    with pytest.raises(LinearSolveError, match='singular'):
        chordal(graph)
