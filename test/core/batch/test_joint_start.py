# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The joint start: exact without noise from positions alone."""

from hypothesis import given, strategies as st
import numpy as np
from random_graphs import consistent_graph, random_poses

from pose_graph_ros.core.batch.joint_start import joint
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphUpdate

# Absolute error of two linear solves with condition numbers of some 1e3 [m, rad].
EXACT = 1e-11


def assert_poses_equal(poses: FloatArray, expected: FloatArray) -> None:
    np.testing.assert_allclose(poses[:, :2], expected[:, :2], atol=EXACT)
    np.testing.assert_allclose(se2.wrap(poses[:, 2] - expected[:, 2]), 0.0, atol=EXACT)


@given(st.integers(0, 10_000))
def test_joint_is_exact_without_noise_from_positions_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = consistent_graph(seed, noise=0.0)
    expected = graph.poses.copy()
    information = np.zeros((graph.n_nodes, 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = rng.uniform(0.1, 10.0, graph.n_nodes)
    offset = np.column_stack((rng.uniform(-1.0, 1.0, (graph.n_nodes, 2)), np.zeros(graph.n_nodes)))
    mean = np.zeros((graph.n_nodes, 3))
    mean[:, :2] = se2.transform(expected, offset[:, :2])
    graph.apply(GraphUpdate(
        observed=ObservedNodes(np.arange(graph.n_nodes), offset, mean, information,
                               np.full(graph.n_nodes, ObservedKind.POSITION)),
        free=np.flatnonzero(graph.fixed).tolist()))
    graph.set_poses(random_poses(rng, graph.n_nodes))
    assert_poses_equal(joint(graph), expected)
