# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fallback optimises a copy: from the poses before the update, without touching the graph."""

import numpy as np
import pytest
from random_graphs import consistent_graph, random_edges, random_poses, snapshot

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.batch_fallback import optimize_copy
from pose_graph_ros.core.solver_config import SolverConfig


@pytest.mark.parametrize('seed', range(4))
def test_the_copy_has_all_constraints_and_is_at_the_minimum(seed: int) -> None:
    graph, copy = consistent_graph(seed, noise=0.1), Graph()
    graph.apply(GraphUpdate(weigh_edges={1: 0.5}))
    before = snapshot(graph)
    assert optimize_copy(graph, copy)
    assert snapshot(graph) == before
    assert snapshot(copy)[1:] == before[1:]     # all but the poses
    assert copy.has_touched
    assert optimizer.optimize_from_linear_start(graph, SolverConfig()).status is Status.CONVERGED
    np.testing.assert_allclose(copy.poses[:, :2], graph.poses[:, :2], atol=1e-4)
    np.testing.assert_allclose(
        se2.wrap(copy.poses[:, 2] - graph.poses[:, 2]), 0.0, atol=1e-4)


def test_it_begins_at_the_poses_before_the_update_that_diverged() -> None:
    graph, copies = consistent_graph(5, noise=0.1), [Graph(), Graph()]
    assert optimize_copy(graph, copies[0])
    graph.begin()
    before = snapshot(graph)
    for node in range(1, graph.n_nodes):    # a step that led astray
        graph.apply(GraphUpdate(fix=(node,)))
        graph.apply(GraphUpdate(free=(node,)))
    graph.memory['node_f'][1:graph.n_nodes, :3] += 1e6
    assert snapshot(graph) != before
    assert optimize_copy(graph, copies[1])
    assert snapshot(copies[1]) == snapshot(copies[0])
    graph.rollback()
    assert snapshot(graph) == before


def test_a_graph_that_is_not_determined_is_said_to_have_no_solution() -> None:
    graph, rng = consistent_graph(1), np.random.default_rng(0)
    n = graph.n_nodes
    graph.apply(GraphUpdate(hidden=random_poses(rng, 2), edges=random_edges(rng, [n], [n + 1])))
    before = snapshot(graph)
    assert not optimize_copy(graph, Graph())
    assert snapshot(graph) == before
