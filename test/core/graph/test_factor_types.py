# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Every type of constraint against its formula: errors, gradients, fronts, optimum, covariances.

The formulas are written again here, one constraint at a time; derivatives are finite differences.
"""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import (
    matrix,
    random_information,
    slow_edge,
    slow_observed,
    slow_third,
    slow_to_bias,
)
from slow_smoother import EXACT

from pose_graph_ros.core.batch import gauss_newton, optimizer
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

N_POSES = 8
POINTS = np.array([[3.0, 2.0], [-2.0, 4.0], [5.0, -3.0]])
seeds = st.integers(0, 2**32 - 1)


def slow_error(poses: FloatArray, edges: Factors, e: int) -> FloatArray:
    """Return the error of one edge by its formula."""
    start, end = poses[edges.i[e]], poses[edges.j[e]]
    mean, bias, kind = edges.mean[e], edges.constants[e], edges.kind[e]
    inverse = np.linalg.inv(matrix(start))
    if kind == FactorKind.BIAS:
        return slow_to_bias(start, end, mean, bias)[0]
    if kind == FactorKind.TURN:
        drift = bias[3] * poses[edges.k[e], 0] if edges.k[e] >= 0 else 0.0
        turn = end[2] - start[2] - mean[2] + drift
        return np.array([0.0, 0.0, np.arctan2(np.sin(turn), np.cos(turn))])
    point = (inverse @ [*end[:2], 1.0])[:2]
    if kind == FactorKind.POINT:
        return np.array([*(point - mean[:2]), 0.0])
    if kind == FactorKind.RANGE:
        return np.array([np.hypot(*(point - bias[:2])) - mean[0], 0.0, 0.0])
    error = slow_edge(start, end, mean)[0]
    if edges.k[e] >= 0:
        error += slow_third(mean, bias[3]) @ poses[edges.k[e]]
        error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
    return error


def whitened(graph: Graph, values: FloatArray) -> FloatArray:
    """Return all errors, multiplied by roots of their information, at other values of nodes."""
    factors = graph.factors
    errors = [slow_error(values, factors, e) if factors.j[e] >= 0 else slow_observed(
        values[factors.i[e]], factors.offset[e], factors.mean[e])[0] for e in range(len(factors))]
    W = factors.weighted_information
    # the root of a singular matrix by its eigenvectors
    size, vectors = np.linalg.eigh(W)
    roots = np.sqrt(np.maximum(size, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
    return np.concatenate([root @ error for root, error in zip(roots, errors, strict=True)])


def jacobian(graph: Graph) -> FloatArray:
    """Return the derivatives of all whitened errors by all coordinates, by central differences."""
    values, step = graph.poses.copy(), 1e-6
    columns = []
    for k in range(values.size):
        there, back = values.copy(), values.copy()
        there.flat[k] += step
        back.flat[k] -= step
        columns.append((whitened(graph, there) - whitened(graph, back)) / (2.0 * step))
    return np.array(columns).T


def drive(rng: np.random.Generator, noise: float) -> list[GraphUpdate]:
    """
    Return a drive as updates: odometry, turns with a bias that walks, points and ranges.

    Nodes are 8 poses; the bias of dimension 1 and the landmarks come with the second, a second
    bias with the fifth. With the sixth one comes what odometry is calibrated by from there on.
    """
    truth = np.cumsum(np.column_stack((
        np.ones(N_POSES), rng.normal(0.0, 0.3, (N_POSES, 2)))), axis=0)
    biases, dt = (0.03, 0.05), 0.7
    sigmas, updates = np.array([0.1, 0.1, 0.05]), []
    bias, first_point = 2, 3
    for k in range(N_POSES):
        node = k if k < 2 else k + 4 + (k > 4) + (k > 5)
        update = GraphUpdate(hidden=se2.wrapped(truth[k:k + 1] + noise * rng.normal(size=3)))
        if k == 0:
            updates.append(update._replace(fix=[0], hidden=truth[:1]))
            names = [0]
            continue
        parts = []
        motion = se2.between(truth[k - 1], truth[k]) + noise * sigmas * rng.normal(size=3)
        calibrated = -1
        if k >= 5:
            calibrated = 11
            motion = motion * (0.9, 0.9, 1.0) + (0.0, 0.0, 0.1 * dt)
        parts.append(Factors([names[-1]], [node], [motion], [np.diag(sigmas**-2)],
                           [FactorKind.ODOMETRY], k=[calibrated],
                           constants=[[0.0, 0.0, 0.0, dt * (k >= 5)]]))
        if k == 5:
            update = update._replace(biases=np.array([[0.0, 0.01, 0.0]]), dimensions=[2])
            parts.append(Factors.on([calibrated], mean=np.zeros((1, 3)), kind=[
                FactorKind.POSITION], information=[np.diag((1e2, 1e2, 0.0))]))
        if k == 1:
            update = update._replace(biases=np.array([[0.01, 0.0, 0.0]]), dimensions=[1],
                                     landmarks=POINTS + noise * rng.normal(size=POINTS.shape))
            # a single range does not determine a landmark
            observed = Factors.on(
                [bias, first_point + 2], mean=[[biases[0], 0.0, 0.0], [*POINTS[2], 0.0]],
                information=[np.diag((1e4, 0.0, 0.0)), np.diag((1.0, 1.0, 0.0))],
                kind=[FactorKind.POSITION] * 2)
            parts.append(observed)
        if k == 4:
            update = update._replace(biases=np.array([[0.01, 0.0, 0.0]]), dimensions=[1])
            parts.append(Factors([node + 1], [bias], np.zeros((1, 3)), [np.diag((1e3, 0.0, 0.0))],
                               [FactorKind.BIAS], constants=[[0.0, 0.0, 1.0, 0.0]]))
            bias = node + 1
        turn = truth[k, 2] - truth[k - 1, 2] + dt * biases[k >= 4] + 0.01 * noise * rng.normal()
        parts.append(Factors([names[-1]], [node], [[0.0, 0.0, turn]], [np.diag((0.0, 0.0, 1e4))],
                           [FactorKind.TURN], constants=[[0.0, 0.0, 0.0, dt]], k=[bias]))
        names.append(node)
        for m, point in enumerate(POINTS):
            seen = (np.linalg.inv(matrix(truth[k])) @ [*point, 1.0])[:2]
            seen += 0.1 * noise * rng.normal(size=2)
            mean, information = np.zeros(3), np.zeros((3, 3))
            arm = np.zeros(4)
            if m < 2:
                mean[:2], information[:2, :2] = seen, random_information(rng, 1)[0, :2, :2]
                kind = FactorKind.POINT
            else:
                arm[:2] = 0.4, -0.2
                mean[0], information[0, 0], kind = np.hypot(*(seen - arm[:2])), 100.0, (
                    FactorKind.RANGE)
            parts.append(Factors([node], [first_point + m], [mean], [information], [kind],
                               constants=[arm]))
        updates.append(update._replace(factors=Factors.joined(parts)))
    return updates


def graph_of(updates: list[GraphUpdate]) -> Graph:
    graph = Graph()
    for update in updates:
        graph.apply(update)
    return graph


def is_free(graph: Graph) -> FloatArray:
    """Return which of all coordinates are estimated."""
    return (~graph.fixed[:, None] & (np.arange(3) < graph.dimension[:, None])).ravel()


@given(seeds)
@settings(max_examples=15)
def test_energies_and_gradients_are_those_of_the_formulas_far_from_the_minimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = graph_of(drive(rng, 1.0))
    moved = graph.poses + np.where(is_free(graph).reshape(-1, 3), rng.normal(
        size=graph.poses.shape), 0.0)
    graph.set_poses(moved)
    right = np.empty((graph.n_nodes, 3))
    chi2, _ = gauss_newton.evaluate(graph.memory.head, right)
    error = whitened(graph, graph.poses)
    assert chi2 == pytest.approx(error @ error)
    assert graph.energies().chi2 == pytest.approx(chi2)
    np.testing.assert_allclose(right.ravel(), -jacobian(graph).T @ error,
                               rtol=1e-5, atol=1e-4 * np.sqrt(chi2))


@given(seeds)
@settings(max_examples=10)
def test_the_smoother_ends_at_the_batch_optimum_with_its_covariances(seed: int) -> None:
    updates = drive(np.random.default_rng(seed), 0.3)
    smoother = IncrementalSmoother(EXACT)
    for update in updates:
        smoother.update(update)
    graph = graph_of(updates)
    optimizer.optimize(graph, SolverConfig())
    np.testing.assert_allclose(smoother.poses, graph.poses, atol=1e-6)
    J, free = jacobian(graph), is_free(graph)
    assert np.max(np.abs(J.T @ whitened(graph, graph.poses))[free]) < 1e-3
    assert np.all(graph.poses.ravel()[~free & np.repeat(~graph.fixed, 3)] == 0.0)
    expected = np.zeros((3 * graph.n_nodes,) * 2)
    expected[np.ix_(free, free)] = np.linalg.inv(J[:, free].T @ J[:, free])
    blocks = expected.reshape(-1, 3, graph.n_nodes, 3)
    for node, covariance in enumerate(smoother.covariances()):
        np.testing.assert_allclose(covariance, blocks[node, :, node], rtol=1e-3, atol=1e-7)
        np.testing.assert_allclose(
            smoother.covariance(node), blocks[node, :, node], rtol=1e-3, atol=1e-7)


@given(seeds, st.lists(st.tuples(seeds, st.sampled_from([0.0, 0.5, 2.0])), max_size=6))
@settings(max_examples=10)
def test_a_rollback_restores_and_nodes_leave_with_edges_of_three_ends(
    seed: int, weights: list[tuple[int, float]],
) -> None:
    graph = graph_of(drive(np.random.default_rng(seed), 0.3))
    whole = graph.rows()
    graph.begin()
    graph.apply(GraphUpdate(weigh={
        number % graph.n_factors: weight for number, weight in weights}, remove_nodes=[2]))
    graph.rollback()
    for column, before in zip(graph.factors.columns, whole.factors.columns, strict=True):
        np.testing.assert_array_equal(column, before)
    graph.begin()
    graph.apply(GraphUpdate(remove_nodes=[2]))
    graph.commit()
    factors = whole.factors
    left = factors.rows((factors.i != 2) & (factors.j != 2) & (factors.k != 2))
    for column, kept in zip(graph.factors.columns, left.columns, strict=True):
        np.testing.assert_array_equal(column, kept)
    copy = Graph()
    copy.fill(graph.rows())
    for name in ('node_kind', 'dimension', 'poses'):
        np.testing.assert_array_equal(getattr(copy, name), getattr(graph, name))


@pytest.mark.parametrize(('kind', 'change', 'message'), [
    (FactorKind.POINT, {'j': [1]}, r'kind POINT to have landmark'),
    (FactorKind.RANGE, {'j': [1]}, r'kind RANGE to have landmark'),
    (FactorKind.TURN, {'k': [1]}, r'Factors\.k: .*kind TURN to have bias'),
    (FactorKind.LOOP_CLOSURE, {'j': [1], 'k': [2]}, r'Factors\.k: .*to have none'),
    (FactorKind.ODOMETRY, {'j': [1], 'k': [2]}, r'Factors\.k: .*two coordinates'),
    (FactorKind.POINT, {'mean': [[1.0, 0.0, 1.0]]}, 'mean: expected 0 in rows'),
    (FactorKind.RANGE, {'information': [np.eye(3)]}, 'information: expected 0 in rows'),
    (FactorKind.TURN, {'k': [99]}, r'expected a hidden node in 0\.\.5'),
])
def test_what_a_kind_of_edge_does_not_have_is_refused(
    kind: FactorKind, change: dict[str, object], message: str,
) -> None:
    graph, factor = Graph(), FACTORS[kind]
    graph.apply(GraphUpdate(hidden=np.zeros((2, 3)), biases=np.zeros((1, 3)), dimensions=[1],
                            landmarks=POINTS))
    rows = np.isin(range(3), factor.rows)
    columns = {'i': [0], 'j': [3 if kind in {FactorKind.POINT, FactorKind.RANGE} else 1],
               'mean': [np.where(rows, 1.0, 0.0)], 'information': [np.diag(np.where(rows, 1, 0))],
               'kind': [kind]}
    before = len(graph.factors.edges)
    with pytest.raises(GraphUpdateError, match=message):
        graph.apply(GraphUpdate(factors=Factors(**{**columns, **change})))
    assert len(graph.factors.edges) == before
    graph.apply(GraphUpdate(factors=Factors(**columns)))
    assert len(graph.factors.edges) == before + 1
