# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The view of a graph against a slow evaluation of each row."""


from hypothesis import given, strategies as st
import numpy as np
from random_graphs import matrix, random_graph

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import graph_view
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_view import DrawnRows, Lines

seeds = st.integers(0, 2**32 - 1)
biases = st.integers(0, 4)
# Energies by the kernel and by NumPy differ by rounding.
SAME = {'rtol': 1e-9, 'atol': 1e-9}


def weighted(seed: int, n_biases: int) -> Graph:
    """Return a random graph; some of its edges are odometry, some rows have weights or are out."""
    graph = random_graph(seed, n_edges=10, n_observed=6, n_biases=n_biases)
    graph.apply(GraphUpdate(
        factors=Factors([0, 2], [1, 3], [[1.0, 0.0, 0.1]] * 2, [np.eye(3)] * 2,
                        [FactorKind.ODOMETRY] * 2),
        weigh={0: 0.25, 1: 0.0, 14: 0.5}, remove=(2,)))
    return graph


def slow_view(graph: Graph) -> dict[str, list[list[float]]]:
    """Evaluate each row: five numbers for each constraint, its ends [m] and its error [sigma]."""
    found: dict[str, list[list[float]]] = {
        'nodes': [], 'odometry': [], 'loop_closures': [], 'observed': []}
    poses, is_bias, factors = graph.poses, graph.is_bias, graph.factors
    energies = graph.energies().factors
    for k in range(graph.n_nodes):
        if not is_bias[k]:
            found['nodes'].append(poses[k, :2].tolist())
    for k in range(len(factors)):
        if factors.weight[k] == 0.0:
            continue
        start, information = poses[factors.i[k]], factors.information[k]
        sigmas = np.sqrt(energies[k] / factors.weight[k] / (np.diag(information) > 0.0).sum())
        if factors.j[k] >= 0 and factors.kind[k] != FactorKind.BIAS:
            name = 'odometry' if factors.kind[k] == FactorKind.ODOMETRY else 'loop_closures'
            found[name].append([*start[:2], *poses[factors.j[k], :2], sigmas])
        elif not is_bias[factors.i[k]] and information[0, 0] > 0.0:
            predicted = matrix(start) @ [*factors.constants[k, :2], 1.0]
            found['observed'].append([*predicted[:2], *factors.mean[k, :2], sigmas])
    return found


def rows(lines: Lines) -> FloatArray:
    return np.column_stack((lines.ends.reshape(-1, 4), lines.sigmas))


def in_any_order(table: FloatArray) -> FloatArray:
    return table[np.lexsort(np.round(table, 6).T)]


@given(seeds, biases)
def test_the_view_shows_each_row_once_and_no_bias(seed: int, n_biases: int) -> None:
    graph = weighted(seed, n_biases)
    view = graph_view.view(graph)
    assert view is not None
    expected = slow_view(graph)
    np.testing.assert_array_equal(view.nodes, expected.pop('nodes'))
    for name, wanted in expected.items():
        np.testing.assert_allclose(
            in_any_order(rows(getattr(view, name))),
            in_any_order(np.array(wanted).reshape(-1, 5)), **SAME)


def test_what_is_not_simply_believed_is_drawn_apart_though_its_weight_is_0() -> None:
    graph = random_graph(3, n_edges=10, n_observed=6, n_biases=0)
    edges = graph.factors
    closures = np.flatnonzero(edges.kind == FactorKind.LOOP_CLOSURE)[:3].tolist()
    positions = np.flatnonzero((edges.j < 0) & (edges.information[:, 0, 0] > 0.0))[:2].tolist()
    weak, waiting, doubted = closures
    whole = graph_view.view(graph)
    graph.apply(GraphUpdate(weigh=dict.fromkeys((waiting, doubted, *positions), 0.0)))
    view = graph_view.view(graph, DrawnRows([weak], [waiting], [doubted], unused=positions))
    assert whole is not None
    assert view is not None
    assert len(view.loop_closures.ends) == len(whole.loop_closures.ends) - 3
    assert len(view.observed.ends) == len(whole.observed.ends) - 2
    for lines, row in ((view.weak, weak), (view.waiting, waiting), (view.doubted, doubted)):
        ends = graph.poses[[edges.i[row], edges.j[row]], :2]
        np.testing.assert_array_equal(lines.ends, ends[None])
    np.testing.assert_array_equal(
        in_any_order(np.concatenate([rows(lines) for lines in (
            view.loop_closures, view.weak, view.waiting, view.doubted)])),
        in_any_order(rows(whole.loop_closures)))
    np.testing.assert_array_equal(
        in_any_order(np.concatenate((rows(view.observed), rows(view.unused)))),
        in_any_order(rows(whole.observed)))
