# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the newest estimate to the newest odometry."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, NodePolicy, NoiseFrom, OdometrySource
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample
from pose_graph_ros.core.odometry.motion import Motion, NO_MOTION, odometry_covariance
from pose_graph_ros.core.odometry.odometry_errors import OdometryErrors
from pose_graph_ros.core.prediction import predict

SECOND = 1_000_000_000


def odometry(k: int) -> FloatArray:
    return np.array([0.3 * k, 0.0, 0.0])


def sample(k: int) -> OdometrySample:
    return OdometrySample(SECOND + k * SECOND // 5, odometry(k))


@pytest.fixture
def backend() -> PoseGraphBackend:
    backend = PoseGraphBackend()
    for k in range(20):
        backend.add_odometry(sample(k))
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
    now = predict(estimate, sample(19))
    np.testing.assert_allclose(now.T_map_base, estimate.T_map_base, atol=1e-12)
    np.testing.assert_allclose(now.covariance, estimate.covariance, atol=1e-15)


@pytest.mark.parametrize('odom', [
    OdometrySource(covariance_scale=9.0), OdometrySource(sigma_scale=3.0),
    OdometrySource(noise_from=NoiseFrom.TWIST),
    OdometrySource(noise_from=NoiseFrom.TWIST, covariance_scale=0.25, sigma_scale=0.5),
], ids=['scale', 'sigma_scale', 'twist', 'all'])
def test_what_is_added_is_what_an_edge_of_odometry_has(odom: OdometrySource) -> None:
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': odom}, nodes=NodePolicy(minimum_travel_distance=0.9)))
    twist = np.array([0.02, 0.03, 0.01])
    for k in range(8):
        backend.add_odometry(replace(sample(k), twist_variance=twist))
        backend.update()
    backend.optimize()
    before = estimate_of(backend)
    backend.add_odometry(replace(sample(11), twist_variance=twist))
    backend.optimize()
    after, edge = estimate_of(backend), backend.graph.edges
    predicted = predict(before, replace(sample(11), twist_variance=twist))
    # but for the floors of one edge, which are scaled as well
    np.testing.assert_allclose(predicted.covariance, after.covariance, atol=5e-5)
    noise = np.linalg.inv(edge.weighted_information[-1])
    # the edge began at the node before
    assert noise[0, 0] > 0.5 * (predicted.covariance - before.covariance)[0, 0]


def test_later_odometry_is_appended_as_the_next_estimate_would(
    backend: PoseGraphBackend,
) -> None:
    estimate = estimate_of(backend)
    ahead = predict(estimate, sample(22))
    np.testing.assert_allclose(
        ahead.T_map_base, se2.compose(estimate.T_map_odom, odometry(22)), atol=1e-12)
    # more uncertain than if the odometry in between had no noise
    increment = se2.between(odometry(19), odometry(22))
    carried = covariance.propagated(
        estimate.T_map_base, estimate.covariance, increment, np.zeros((3, 3)))
    assert np.all(np.linalg.eigvalsh(ahead.covariance - carried) > 0.0)
    for k in range(20, 23):
        backend.add_odometry(sample(k))
    then = estimate_of(backend)
    np.testing.assert_allclose(ahead.T_map_base, then.T_map_base, atol=1e-12)
    # the estimate's own covariance holds the floor of one increment more, at the most
    floor = odometry_covariance(estimate.odometry.noise, NO_MOTION)
    difference = then.covariance - ahead.covariance
    assert np.abs(difference[:2, :2]).max() <= 2.0 * floor[0, 0]


coordinates = st.floats(-1e3, 1e3)
poses = st.tuples(coordinates, coordinates, st.floats(-np.pi, np.pi)).map(np.array)
ESTIMATE: list[Estimate] = []


SOURCES = st.builds(
    OdometrySource, noise_from=st.sampled_from(NoiseFrom),
    covariance_scale=st.floats(0.01, 100.0), sigma_scale=st.just(0.0))


ERRORS = st.builds(
    OdometryErrors, st.floats(0.01, 100.0), st.floats(0.01, 100.0), st.floats(-0.1, 0.1),
    st.floats(-0.1, 0.1))


@given(poses, poses, poses, st.integers(0, 2**32 - 1), st.booleans(), SOURCES,
       ERRORS, st.booleans())
def test_plain_numbers_say_what_matrices_say(  # noqa: PLR0917
    T_map_base: FloatArray, T_odom_base: FloatArray, now: FloatArray, seed: int, near: bool,
    source: OdometrySource, errors: OdometryErrors, has_twist: bool,
) -> None:
    if not ESTIMATE:
        backend = PoseGraphBackend()
        backend.add_odometry(sample(0))
        backend.finish()
        ESTIMATE.append(estimate_of(backend))
    if near:
        now = T_odom_base + 1e-3 * now / 1e3
    rng = np.random.default_rng(seed)
    root, twist = rng.normal(0.0, 1.0, (3, 3)), rng.uniform(0.01, 1.0, 3)
    estimate = replace(
        ESTIMATE[0], T_map_base=T_map_base, T_odom_base=T_odom_base, covariance=root @ root.T,
        odometry=source, odometry_errors=errors)
    prediction = predict(estimate, OdometrySample(
        estimate.stamp_ns + SECOND // 10, now, twist_variance=twist if has_twist else None))
    increment = se2.between(T_odom_base, now)
    step, turn = float(np.hypot(*increment[:2])), abs(float(increment[2]))
    by_twist = source.noise_from is NoiseFrom.TWIST and has_twist
    motion = Motion(increment, step, turn)
    if by_twist:
        rests = step < 0.01 and turn < 0.01
        motion = Motion(increment, 0.0, 0.0, twist * (0.0 if rests else 0.1))
    claimed = source.covariance_scale * odometry_covariance(source.noise, motion, floor=False)
    seconds = np.array((0.1,))
    increment = errors.motions(increment[None], seconds)[0]
    expected = covariance.propagated(
        T_map_base, estimate.covariance, increment, errors.covariances(claimed[None])[0])
    pose = se2.compose(T_map_base, increment)
    np.testing.assert_allclose(prediction.T_map_base[:2], pose[:2], rtol=0.0, atol=1e-10)
    assert abs(se2.wrap(prediction.T_map_base[2] - pose[2])) < 1e-12
    np.testing.assert_allclose(
        prediction.covariance, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
    np.testing.assert_array_equal(prediction.covariance, prediction.covariance.T)
