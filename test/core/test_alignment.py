# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The angle between odometry and map from positions, and how well it is known."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.optimize import least_squares

from pose_graph_ros.core import se2
from pose_graph_ros.core.alignment import align
from pose_graph_ros.core.config import AlignmentPolicy
from pose_graph_ros.core.se2 import FloatArray

# Weighted sums of squares of some 100 m.
EXACT = 1e-9

POLICY = AlignmentPolicy(sigma_heading=0.15, minimum_baseline=5.0, baseline_in_sigmas=5.0)

seeds = st.integers(0, 2**32 - 1)


def positions(seed: int, n: int = 12) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions, a pose of the odometry frame in the map, and variances."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(-30.0, 30.0, (n, 2)),
            np.array([*rng.uniform(-500.0, 500.0, 2), rng.uniform(-np.pi, np.pi)]),
            rng.uniform(0.1, 4.0, n))


@given(seeds)
def test_without_noise_the_pose_is_found_at_any_angle(seed: int) -> None:
    odometry, T_map_odom, variance = positions(seed)
    found = align(odometry, se2.transform(T_map_odom, odometry), variance)
    np.testing.assert_allclose(found.T_map_odom[:2], T_map_odom[:2], atol=EXACT)
    assert abs(se2.wrap(found.T_map_odom[2] - T_map_odom[2])) < EXACT
    assert found.scale == pytest.approx(1.0, abs=EXACT)
    assert found.baseline == pytest.approx(np.hypot(*np.ptp(odometry, axis=0)))
    assert found.sigma_position == pytest.approx(np.sqrt(1.0 / np.mean(1.0 / variance)))


@pytest.mark.parametrize('seed', range(5))
def test_with_noise_it_is_the_weighted_least_squares_solution(seed: int) -> None:
    odometry, T_map_odom, variance = positions(seed)
    noise = np.random.default_rng(seed).standard_normal((12, 2)) * np.sqrt(variance)[:, None]
    observed = se2.transform(T_map_odom, odometry) + noise

    def errors(x: FloatArray) -> FloatArray:
        return ((se2.transform(x, odometry) - observed) / np.sqrt(variance)[:, None]).ravel()

    expected = least_squares(errors, T_map_odom, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    found = align(odometry, observed, variance)
    np.testing.assert_allclose(found.T_map_odom[:2], expected.x[:2], atol=1e-6)
    assert abs(se2.wrap(found.T_map_odom[2] - expected.x[2])) < 1e-8
    # the claimed sigma is that of the least-squares problem
    covariance = np.linalg.inv(expected.jac.T @ expected.jac)
    assert found.sigma_heading == pytest.approx(np.sqrt(covariance[2, 2]), rel=0.05)


def test_the_claimed_uncertainty_is_that_of_samples() -> None:
    odometry, T_map_odom, variance = positions(seed=7)
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(4000):
        noise = rng.standard_normal((12, 2)) * np.sqrt(variance)[:, None]
        found = align(odometry, se2.transform(T_map_odom, odometry) + noise, variance)
        errors.append(float(se2.wrap(found.T_map_odom[2] - T_map_odom[2])))
    # 4000 draws: 1.1 % one sigma
    assert np.std(errors) == pytest.approx(found.sigma_heading, rel=0.05)
    assert abs(np.mean(errors)) < 4.0 * found.sigma_heading / np.sqrt(4000)


def test_a_single_place_tells_no_angle() -> None:
    for n in (1, 5):
        found = align(np.ones((n, 2)), np.full((n, 2), 7.0), np.ones(n))
        assert np.isinf(found.sigma_heading)
        assert found.baseline == 0.0
        assert found.scale == 0.0
        assert not found.certain(POLICY)
        np.testing.assert_allclose(
            se2.transform(found.T_map_odom, np.ones(2)), [7.0, 7.0], atol=EXACT)


def line(length: float, scale: float = 1.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    odometry = np.column_stack((np.linspace(0.0, length, 50), np.zeros(50)))
    return odometry, scale * odometry, np.full(50, 0.01)


@pytest.mark.parametrize(('arguments', 'policy', 'certain'), [
    (line(10.0), POLICY, True),
    (line(4.0), POLICY, False),
    (line(4.0), replace(POLICY, minimum_baseline=3.0), True),
    (line(10.0), replace(POLICY, sigma_heading=1e-4), False),
    (line(10.0), replace(POLICY, baseline_in_sigmas=200.0), False),
    (line(10.0, 2.5), POLICY, False),     # wheels that spin less than the map moves
    (line(10.0, 0.3), POLICY, False),
    (line(10.0, 0.7), POLICY, True),
], ids=['good', 'short', 'short_allowed', 'strict', 'many_sigmas', 'longer', 'shorter', 'slip'])
def test_certainty_takes_a_baseline_a_sigma_and_a_scale(
    arguments: tuple, policy: AlignmentPolicy, *, certain: bool,
) -> None:
    assert align(*arguments).certain(policy) == certain
