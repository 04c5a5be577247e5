# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The four views of a small graph, against lists by hand and against H itself."""

from typing import Any

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import random_graph

from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import Prior
from pose_graph_ros.core.marginalization.marginalize import equations
from pose_graph_ros.offline.graph_views import (
    bayesian_network,
    factor_graph,
    factors,
    hidden,
    map_places,
    markov_random_field,
    pose_graph,
    Role,
    Sort,
    terms,
    time_slices,
    VIEWS,
)
from pose_graph_ros.offline.pattern import elimination_order, filled, pattern

seeds = st.integers(0, 2**31)


def small_graph() -> Graph:
    """Return x0 to x3 with a closure, a gyro with its bias 5, a landmark 6, and observed nodes."""
    graph, eye = Graph(), np.eye(3)
    kinds = [*[FactorKind.ODOMETRY] * 3, FactorKind.LOOP_CLOSURE, FactorKind.TURN,
             *[FactorKind.POINT] * 2]
    information = np.stack([eye] * 4 + [np.diag((0.0, 0.0, 1.0))] + [np.diag((1.0, 1.0, 0.0))] * 2)
    mean = np.zeros((7, 3))
    mean[:4, 0] = 1.0
    graph.apply(GraphUpdate(
        hidden=np.column_stack((np.arange(4.0), np.zeros((4, 2)))), biases=np.zeros((1, 3)),
        dimensions=[1], landmarks=np.array([[1.0, 2.0]]), fix=(0,)))
    graph.apply(GraphUpdate(
        factors=Factors.joined([
            Factors([0, 1, 2, 3, 1, 0, 2], [1, 2, 3, 0, 2, 5, 5], mean, information, kinds,
                    weight=np.ones(7), k=[-1, -1, -1, -1, 4, -1, -1],
                    constants=[[0.0] * 4] * 4 + [[0.0, 0.0, 0.0, 1.0]] + [[0.0] * 4] * 2),
            Factors.on([1, 2], mean=np.zeros((2, 3)), information=np.stack((eye, eye)),
                       kind=[FactorKind.GLOBAL_POSE] * 2, weight=[1.0, 0.0])])))
    return graph


def named(view: Any) -> list[tuple[str, str]]:
    """Return the names of the ends of all arcs, sorted; those without a direction are sorted."""
    pairs = [(view.nodes[i]['name'], view.nodes[j]['name'], arc['directed'])
             for i, j, arc in view.edges(data=True)]
    return sorted((i, j) if directed else (min(i, j), max(i, j)) for i, j, directed in pairs)


def roles(view: Any, role: Role) -> list[str]:
    return [data['name'] for _, data in view.nodes(data=True) if data['role'] is role]


SMALL = factor_graph(small_graph().rows())


def test_a_pose_graph_has_hidden_and_observed_nodes_and_directed_edges() -> None:
    view = pose_graph(SMALL)
    assert roles(view, Role.POSE) == ['x0', 'x1', 'x2', 'x3']
    assert roles(view, Role.BIAS) == ['b4']
    assert roles(view, Role.LANDMARK) == ['l5']
    assert roles(view, Role.OBSERVED) == ['z0', 'z1']
    assert named(view) == sorted([
        ('x0', 'x1'), ('x1', 'x2'), ('x2', 'x3'), ('x3', 'x0'), ('0', 'x1'), ('0', 'x2'),
        ('0', 'b4'), ('x0', 'l5'), ('x2', 'l5'), ('z0', 'x1'), ('z1', 'x2')])
    assert [view.nodes[node]['name'] for node in hidden(view) if view.nodes[node]['fixed']] == [
        'x0']
    assert [arc['sort'] for _, _, arc in view.edges(data=True) if not arc['used']] == [
        Sort.OBSERVED]
    assert view.graph['notes'] == ['Dashed: 1 constraint with weight 0.']


def test_a_factor_graph_has_a_factor_for_each_term() -> None:
    view = factors(SMALL)
    assert [(each.sort, len(each.nodes)) for each in terms(view)] == [
        *[(Sort.ODOMETRY, 2)] * 3, (Sort.LOOP_CLOSURE, 2), (Sort.TURN, 3),
        *[(Sort.LANDMARK, 2)] * 2, (Sort.OBSERVED, 1)]
    assert not any(arc['directed'] for _, _, arc in view.edges(data=True))
    assert view.number_of_edges() == 16
    assert view.graph['notes'] == ['1 constraint with weight 0 left out.']


def test_a_markov_random_field_has_a_line_for_each_pair() -> None:
    view = markov_random_field(SMALL)
    assert len(view) == len(hidden(view)) == 6
    assert named(view) == sorted([
        ('x0', 'x1'), ('x0', 'x3'), ('l5', 'x0'), ('x1', 'x2'), ('b4', 'x1'), ('x2', 'x3'),
        ('b4', 'x2'), ('l5', 'x2')])
    assert view.graph['notes'][0].startswith('1 term of a single node is not in the picture')


def test_a_dynamic_bayesian_network_has_controls_and_measurements() -> None:
    view = bayesian_network(SMALL)
    assert roles(view, Role.CONTROL) == ['u0', 'u1', 'u2']
    assert roles(view, Role.MEASUREMENT) == ['z0', 'z1', 'z2', 'z3', 'z4']
    assert named(view) == sorted([
        ('x0', 'x1'), ('u0', 'x1'), ('x1', 'x2'), ('u1', 'x2'), ('x2', 'x3'), ('u2', 'x3'),
        ('x3', 'z0'), ('x0', 'z0'), ('x1', 'z1'), ('x2', 'z1'), ('b4', 'z1'),
        ('x0', 'z2'), ('l5', 'z2'), ('x2', 'z3'), ('l5', 'z3'), ('x1', 'z4')])


def test_a_dense_prior_is_one_term_of_all_its_nodes() -> None:
    graph = small_graph()
    graph.apply(GraphUpdate(priors=[Prior(
        np.array([1, 2, 3]), graph.poses[1:4].copy(), np.eye(9), np.zeros(9), 0.0,
        anchored=True)]))
    whole = factor_graph(graph.rows())
    assert terms(whole)[-1] == (Sort.PRIOR, (1, 2, 3), True)
    assert ('x1', 'x3') in named(markov_random_field(whole))
    assert len(roles(pose_graph(whole), Role.JOINT)) == 2


def numeric_pattern(graph: Graph) -> np.ndarray:
    """Return which blocks of H of the free nodes are not zero."""
    H = equations(graph)[0]
    free = np.flatnonzero(~graph.fixed)
    blocks = H.reshape(graph.n_nodes, 3, graph.n_nodes, 3)
    return np.any(blocks != 0.0, axis=(1, 3))[np.ix_(free, free)]


@given(seeds)
def test_the_pattern_is_that_of_the_matrix_and_the_random_field_that_off_its_diagonal(
    seed: int,
) -> None:
    graph = random_graph(seed, fix=(0,), n_biases=2)
    whole = factor_graph(graph.rows())
    expected = numeric_pattern(graph)
    np.testing.assert_array_equal(pattern(whole).blocks, expected)
    pairs = np.zeros((graph.n_nodes, graph.n_nodes), dtype=bool)
    for i, j in markov_random_field(whole).edges():
        pairs[i, j] = True
    np.testing.assert_array_equal(pairs[1:, 1:], np.triu(expected, 1))


@given(seeds)
def test_the_fill_is_that_of_a_numeric_factor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    blocks = rng.random((n, n)) < 0.25
    blocks |= blocks.T | np.eye(n, dtype=bool)
    values = np.where(blocks, rng.uniform(0.5, 1.0, (n, n)), 0.0)
    factor = np.linalg.cholesky(values + values.T + 4.0 * n * np.eye(n)).T
    np.testing.assert_array_equal(filled(blocks), np.abs(factor) > 1e-12)


@given(seeds)
def test_the_elimination_takes_each_node_once(seed: int) -> None:
    graph = random_graph(seed, n_nodes=12, n_edges=20, fix=(3,))
    whole = factor_graph(graph.rows())
    order = elimination_order(whole)
    assert sorted(order) == list(range(12))
    found = pattern(whole, order)
    assert found.names == tuple(whole.nodes[row]['name'] for row in order if row != 3)
    assert not np.any(found.fill & found.blocks)
    assert not np.any(np.tril(found.fill))


@settings(max_examples=10, deadline=None)
@given(seeds, st.sampled_from(list(VIEWS)))
def test_every_vertex_has_a_place_and_poses_are_to_scale(seed: int, name: str) -> None:
    rng = np.random.default_rng(seed)
    graph = random_graph(seed, int(rng.integers(2, 8)), n_biases=int(rng.integers(0, 2)))
    view = VIEWS[name](factor_graph(graph.rows()))
    at = time_slices(view) if name == 'dbn' else map_places(view)[0]
    assert set(at) == set(view)
    assert np.all(np.isfinite(list(at.values())))
    poses = np.flatnonzero(graph.is_pose)
    if name == 'dbn':
        assert least_distance(np.array(list(at.values()))) > 0.5
    else:
        shown, true = (np.array([each[node] for node in poses.tolist()])
                       for each in (at, graph.poses[:, :2]))
        scale = np.ptp(shown[:, 0]) / np.ptp(true[:, 0])
        np.testing.assert_allclose(shown - shown[0], scale * (true - true[0]), atol=1e-9)


def least_distance(at: np.ndarray) -> float:
    apart = at[:, None] - at[None]
    return float(np.min(np.hypot(apart[..., 0], apart[..., 1]) + 1e9 * np.eye(len(at))))
