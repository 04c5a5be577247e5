# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors and Jacobians against g2o's definition."""

from hypothesis import given, strategies as st
import jacobians
import numpy as np
import pytest
from random_graphs import (
    random_edges,
    random_observed,
    random_poses,
    slow_edge,
    slow_observed,
)

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors

# Tolerance for coordinates of about 10 m after three or four rotations, each rounded to 2e-15.
ROUNDING = 1e-13

N = 40
seeds = st.integers(0, 2**32 - 1)


def assert_same_error(error: FloatArray, expected: FloatArray) -> None:
    np.testing.assert_allclose(error[:2], expected[:2], atol=ROUNDING)
    assert abs(se2.wrap(error[2] - expected[2])) < ROUNDING


@given(seeds)
def test_errors_are_those_of_g2o(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, 2 * N)
    edges = random_edges(rng, list(range(N)), list(range(N, 2 * N)))
    observed = random_observed(rng, list(range(N)))
    of_edges = jacobians.linearize_edges(poses, edges)
    of_observed = jacobians.linearize_observed(poses, observed)
    for k in range(N):
        slow, A, B = slow_edge(poses[k], poses[N + k], edges.mean[k])
        assert_same_error(of_edges[0][k], slow)
        np.testing.assert_allclose((of_edges[1][k], of_edges[2][k]), (A, B), atol=ROUNDING)
        slow, J = slow_observed(poses[k], observed.offset[k], observed.mean[k])
        assert_same_error(of_observed[0][k], slow)
        np.testing.assert_allclose(of_observed[1][k], J, atol=ROUNDING)


def test_angles_are_wrapped_once_and_at_the_end() -> None:
    # th_j - th_i = -2 pi + 0.2 and z = 0.3: wrapping only a part would leave 2 pi in the error
    poses = np.array([[0.0, 0.0, np.pi - 0.1], [0.0, 0.0, -np.pi + 0.1]])
    edges = Factors([0], [1], [[0.0, 0.0, 0.3]], [np.eye(3)], [FactorKind.ODOMETRY])
    assert factors.errors(poses, edges)[0, 2] == pytest.approx(-0.1, abs=ROUNDING)
    observed = Factors.on([1], [[0.0, 0.0, -0.3]], [[0.0, 0.0, np.pi - 0.1]], [np.eye(3)],
                             [FactorKind.GLOBAL_POSE])
    assert factors.errors(poses, observed)[0, 2] == pytest.approx(
        -0.1, abs=ROUNDING)
