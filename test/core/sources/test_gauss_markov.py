# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Correlated errors: the estimate is that of the full covariance."""

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    MeasurementSource,
    NodePolicy,
    OdometryNoise,
    OdometrySource,
)
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample, Position
from pose_graph_ros.core.sources.settings import SOURCES

SECOND = 1_000_000_000
TAU = float(SOURCES.bins)
"""Time constant for which a bin is one second [s]."""


def position(seconds: float, x: float = 0.0, y: float = 0.0, sigma: float = 1.0) -> Position:
    return Position(round(seconds * SECOND), np.array((x, y)), sigma**2 * np.eye(2), np.zeros(2))


STIFF = OdometrySource(
    noise=OdometryNoise(sigma_distance=0.05, sigma_lateral=0.05, sigma_heading_distance=1e-4,
                        sigma_heading_turn=1e-4, sigma_floor_position=1e-3,
                        sigma_floor_heading=1e-5), reorder_window=0.0)
"""With a known heading a straight drive is linear, and the expected estimate has a closed form."""


def run(measurements: list[Position], source: MeasurementSource) -> PoseGraphBackend:
    backend = PoseGraphBackend(BackendConfig(
        nodes=NodePolicy(minimum_travel_distance=0.9), odometry={'odom': STIFF},
        measurements={'fix': source}))
    for second in range(1, 41):
        backend.add_odometry(OdometrySample(second * SECOND, np.array((second - 1.0, 0.0, 0.0))))
    # the map frame is the odometry frame, whose heading is known
    backend.add_measurement(GlobalPose(
        SECOND, np.zeros(3), np.diag((100.0**2, 100.0**2, 1e-8))), 'start')
    for measurement in measurements:
        backend.add_measurement(measurement, 'fix')
    return backend


def generalised_least_squares(
    fixes: list[Position], n: int, correlation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and deviation of the x of each node from the full covariance."""
    noise, which = STIFF.noise, [round(fix.stamp_ns / SECOND) - 1 for fix in fixes]
    step = noise.sigma_distance**2 + noise.sigma_floor_position**2
    prior = 100.0**2 + step * np.minimum.outer(np.arange(n), np.arange(n))
    design = np.zeros((len(fixes), n))
    design[np.arange(len(fixes)), which] = 1.0
    seen = np.array([fix.position[0] for fix in fixes])
    expected = np.arange(n, dtype=float)
    gain = prior @ design.T @ np.linalg.inv(design @ prior @ design.T + correlation)
    return (expected + gain @ (seen - design @ expected),
            np.sqrt(np.diagonal(prior - gain @ design @ prior)))


def test_poses_and_sigma_are_those_of_the_full_covariance() -> None:
    rng = np.random.default_rng(2)
    sigma, share = 2.0, SOURCES.white_share
    fixes = [position(second, second - 1.0 + rng.normal(0.0, sigma), 0.0, sigma)
             for second in range(1, 41)]
    source = MeasurementSource(correlation_time=TAU)
    backend = run(fixes, source)
    backend.optimize()
    estimate = backend.estimate()
    assert estimate is not None
    gap = np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    # the fixes lie at the ends of bins, where the states of bins are least accurate
    correlation = sigma**2 * (np.exp(-gap / TAU) + share * np.eye(40))
    expected, deviation = generalised_least_squares(fixes, 40, correlation)
    np.testing.assert_allclose(estimate.path.poses[:, 0], expected, atol=0.02 * sigma)
    assert np.sqrt(estimate.covariance[0, 0]) == pytest.approx(deviation[-1], rel=0.02)
    alone = run(fixes, MeasurementSource())
    alone.optimize()
    white = alone.estimate()
    assert white is not None
    assert np.sqrt(white.covariance[0, 0]) < 0.4 * deviation[-1]
