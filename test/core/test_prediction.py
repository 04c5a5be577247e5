# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the newest estimate to the newest odometry."""

import numpy as np
import pytest

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample
from pose_graph_ros.core.motion import NO_MOTION
from pose_graph_ros.core.prediction import predict
from pose_graph_ros.core.se2 import FloatArray

SECOND = 1_000_000_000


def odometry(k: int) -> FloatArray:
    return np.array([0.3 * k, 0.0, 0.0])


@pytest.fixture
def backend() -> PoseGraphBackend:
    backend = PoseGraphBackend()
    for k in range(20):
        backend.add_odometry(OdometrySample(SECOND + k * SECOND // 5, odometry(k)))
    backend.add_measurement(
        GlobalPose(SECOND, np.array([5.0, 6.0, 1.0]), np.diag([0.01, 0.02, 0.001])), 'fix')
    backend.optimize()
    return backend


def estimate_of(backend: PoseGraphBackend) -> Estimate:
    estimate = backend.estimate()
    assert estimate is not None
    return estimate


def test_at_the_estimate_nothing_is_added(backend: PoseGraphBackend) -> None:
    estimate = estimate_of(backend)
    now = predict(estimate, odometry(19))
    np.testing.assert_allclose(now.T_map_base, estimate.T_map_base, atol=1e-12)
    np.testing.assert_allclose(now.covariance, estimate.covariance, atol=1e-15)


def test_later_odometry_is_appended_as_the_next_estimate_would(
    backend: PoseGraphBackend,
) -> None:
    estimate = estimate_of(backend)
    ahead = predict(estimate, odometry(22))
    np.testing.assert_allclose(
        ahead.T_map_base, se2.compose(estimate.T_map_odom, odometry(22)), atol=1e-12)
    # more uncertain than if the odometry in between had no noise
    increment = se2.between(odometry(19), odometry(22))
    carried = covariance.propagated(
        estimate.T_map_base, estimate.covariance, increment, np.zeros((3, 3)))
    assert np.all(np.linalg.eigvalsh(ahead.covariance - carried) > 0.0)
    for k in range(20, 23):
        backend.add_odometry(OdometrySample(SECOND + k * SECOND // 5, odometry(k)))
    then = estimate_of(backend)
    np.testing.assert_allclose(ahead.T_map_base, then.T_map_base, atol=1e-12)
    # the estimate's own covariance holds the floor of one increment more, at the most
    floor = covariance.odometry_covariance(estimate.noise, NO_MOTION)
    difference = then.covariance - ahead.covariance
    assert np.abs(difference[:2, :2]).max() <= 2.0 * floor[0, 0]
