# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ids of nodes and constraints never change; rows do, when others leave."""

import numpy as np
import pytest
from random_graphs import random_graph

from pose_graph_ros.core.graph.error_functions import edge_errors, observed_errors
from pose_graph_ros.core.graph.graph import GraphUpdate


def test_ids_that_somebody_holds_stay_what_they_are() -> None:
    graph = random_graph(seed=2)
    held = graph.node_ids, graph.edge_ids, graph.observed_ids
    copies = [ids.copy() for ids in held]
    graph.apply(GraphUpdate(remove_nodes=[1, 3]))
    for ids, copy in zip(held, copies, strict=True):
        np.testing.assert_array_equal(ids, copy)


def test_poses_and_errors_are_found_by_id() -> None:
    graph = random_graph(seed=3, n_biases=2)
    assert np.array_equal(graph.poses_of([3, 1]), graph.poses[[3, 1]])
    assert np.array_equal(graph.poses_of(4), graph.poses[4])
    assert np.array_equal(graph.edge_errors(graph.edges_at([5, 2])),
                          edge_errors(graph.poses, graph.edges)[[5, 2]])
    assert np.array_equal(graph.observed_errors(graph.observed_at([1])),
                          observed_errors(graph.poses, graph.observed)[[1]])
    elsewhere = graph.poses + 0.5
    assert np.array_equal(graph.edge_errors(graph.edges, elsewhere),
                          edge_errors(elsewhere, graph.edges))


def test_what_is_not_in_the_graph_is_refused_by_its_id() -> None:
    graph = random_graph(seed=4)
    with pytest.raises(ValueError, match='hidden node 7 is not in the graph'):
        graph.poses_of([2, 7])
    with pytest.raises(ValueError, match='edge -1 is not in the graph'):
        graph.edges_at([-1])
    with pytest.raises(ValueError, match='observed node 99 is not in the graph'):
        graph.observed_at(99)
