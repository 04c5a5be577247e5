# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the newest estimate to the newest odometry."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample
from pose_graph_ros.core.odometry.motion import Motion, NO_MOTION, odometry_covariance
from pose_graph_ros.core.prediction import predict

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
    floor = odometry_covariance(estimate.noise, NO_MOTION)
    difference = then.covariance - ahead.covariance
    assert np.abs(difference[:2, :2]).max() <= 2.0 * floor[0, 0]


coordinates = st.floats(-1e3, 1e3)
poses = st.tuples(coordinates, coordinates, st.floats(-np.pi, np.pi)).map(np.array)
ESTIMATE: list[Estimate] = []


@given(poses, poses, poses, st.integers(0, 2**32 - 1), st.booleans())
def test_plain_numbers_say_what_matrices_say(
    T_map_base: FloatArray, T_odom_base: FloatArray, now: FloatArray, seed: int, near: bool,
) -> None:
    if not ESTIMATE:
        backend = PoseGraphBackend()
        backend.add_odometry(OdometrySample(SECOND, odometry(0)))
        backend.finish()
        ESTIMATE.append(estimate_of(backend))
    if near:
        now = T_odom_base + 1e-3 * now / 1e3
    root = np.random.default_rng(seed).normal(0.0, 1.0, (3, 3))
    estimate = replace(
        ESTIMATE[0], T_map_base=T_map_base, T_odom_base=T_odom_base, covariance=root @ root.T)
    prediction = predict(estimate, now)
    increment = se2.between(T_odom_base, now)
    motion = Motion(increment, float(np.hypot(*increment[:2])), abs(float(increment[2])))
    expected = covariance.propagated(
        T_map_base, estimate.covariance, increment,
        odometry_covariance(estimate.noise, motion, floor=False))
    pose = se2.compose(T_map_base, increment)
    np.testing.assert_allclose(prediction.T_map_base[:2], pose[:2], rtol=0.0, atol=1e-10)
    assert abs(se2.wrap(prediction.T_map_base[2] - pose[2])) < 1e-12
    np.testing.assert_allclose(
        prediction.covariance, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
    np.testing.assert_array_equal(prediction.covariance, prediction.covariance.T)
