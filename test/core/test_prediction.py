# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the newest estimate to the newest odometry."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import NoiseFrom, OdometrySource
from pose_graph_ros.core.estimate import Estimate, predict
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample
from pose_graph_ros.core.odometry.motion import (
    Motion,
    NO_MOTION,
    odometry_covariance,
    OdometryErrors,
)

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


def test_later_odometry_is_appended_as_the_next_estimate_would(backend: PoseGraphBackend) -> None:
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
    motion, rests = Motion(increment, step, turn), step < 0.01 and turn < 0.01
    if by_twist:
        motion = Motion(increment, 0.0, 0.0, twist * (0.0 if rests else 0.1))
    claimed = source.covariance_scale * odometry_covariance(source.noise, motion, floor=False)
    seconds = np.array((0.0 if rests else 0.1,))
    increment = errors.motions(increment[None], seconds)[0]
    expected = covariance.propagated(
        T_map_base, estimate.covariance, increment, errors.covariances(claimed[None])[0])
    pose = se2.compose(T_map_base, increment)
    np.testing.assert_allclose(prediction.T_map_base[:2], pose[:2], rtol=0.0, atol=1e-10)
    assert abs(se2.wrap(prediction.T_map_base[2] - pose[2])) < 1e-12
    np.testing.assert_allclose(
        prediction.covariance, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
    np.testing.assert_array_equal(prediction.covariance, prediction.covariance.T)
