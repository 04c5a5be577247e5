# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is left of zero by rounding; the laws of marginalisation are in test_forgetting."""

import numpy as np

from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import Prior
from pose_graph_ros.core.marginalization.marginalize import (
    as_edge,
    as_observed,
    eliminate,
    standing_for,
)

# what nodes that told nothing of a pose leave there: not positive semidefinite
NOTHING = np.array([[8.7e-13, 6.1e-13, -1.12e-11], [6.1e-13, 1.6e-13, -5.3e-12],
                    [-1.12e-11, -5.3e-12, 1.2e-10]])


def test_an_observed_node_is_valid() -> None:
    smallest = np.linalg.eigvalsh(NOTHING)[0]
    assert smallest < -1e-14
    observed = as_observed(
        Prior(np.array([3]), np.zeros((1, 3)), NOTHING, np.zeros(3), 0.0, anchored=True))
    assert np.linalg.eigvalsh(observed.information[0])[0] > 1e-3 * smallest
    np.testing.assert_allclose(observed.information[0], NOTHING, atol=2e-12)


def test_an_edge_is_valid() -> None:
    information = np.block([[NOTHING, -NOTHING], [-NOTHING, NOTHING]])
    edge = as_edge(Prior(
        np.array([3, 4]), np.zeros((2, 3)), information, np.zeros(6), 0.0, anchored=False))
    assert np.linalg.eigvalsh(edge.information[0])[0] > -1e-16


def test_nothing_stands_for_a_prior_that_tells_of_a_bias_alone_but_for_rounding() -> None:
    graph, J = Graph(), np.array([[1e-23, -2.3e-23, 1.7e-24, 1.0, 0.0, 0.0]])
    graph.apply(GraphUpdate(hidden=np.zeros((1, 3)), biases=np.zeros((1, 3)), dimensions=[1]))
    graph.apply(GraphUpdate(priors=[Prior(
        np.arange(2), np.zeros((2, 3)), 1.37e4 * J.T @ J, np.zeros(6), 0.0, True)]))
    assert len(standing_for(graph.rows())) == 0


def test_nothing_is_eliminated_where_constraints_have_no_other_ends() -> None:
    none = np.zeros(0)
    assert eliminate(np.zeros((0, 0)), none, none.astype(np.int64), none) == 0.0
