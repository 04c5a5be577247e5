# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of a motion by odometry: that of samples, additive along the path, bounded."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.odometry.motion import (
    Motion,
    odometry_covariance,
)

NOISE = OdometryNoise()
NO_FLOORS = replace(NOISE, sigma_floor_position=1e-9, sigma_floor_heading=1e-9)
lengths = st.floats(0.0, 100.0)
angles = st.floats(-np.pi, np.pi)


@given(lengths, lengths, angles, lengths, lengths)
def test_covariances_are_symmetric_positive_and_have_a_bounded_heading(
    x: float, y: float, theta: float, more: float, turn: float,
) -> None:
    motion = Motion(np.array([x, y, theta]), float(np.hypot(x, y)) + more, abs(theta) + turn)
    cov = odometry_covariance(NOISE, motion)
    np.testing.assert_array_equal(cov, cov.T)
    assert np.linalg.eigvalsh(cov)[0] > 0.0
    assert cov[2, 2] <= UNKNOWN_HEADING_VARIANCE + NOISE.sigma_floor_heading**2


def test_the_covariance_is_that_of_samples_along_a_straight_path() -> None:
    noise, n, length = NO_FLOORS, 200, 20.0
    rng, step = np.random.default_rng(0), length / n
    wrong = rng.standard_normal((3, 5_000, n)) * np.sqrt(step)
    heading = np.cumsum(noise.sigma_heading_distance * wrong[2], axis=1)
    x = length + np.sum(noise.sigma_distance * wrong[0], axis=1)
    y = np.sum(noise.sigma_lateral * wrong[1] + step * heading, axis=1)
    # the true end seen from the measured one
    ends = se2.between(np.column_stack((x, y, heading[:, -1])), np.array([length, 0.0, 0.0]))
    expected = odometry_covariance(noise, Motion(np.array([length, 0.0, 0.0]), length, 0.0))
    root = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(ends.T) / root / root[:, None], expected / root / root[:, None], atol=0.05)


@given(lengths, lengths, st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), angles)
def test_more_path_and_more_turns_never_make_it_more_certain(
    distance: float, more: float, x: float, y: float, theta: float,
) -> None:
    less = odometry_covariance(NOISE, Motion(np.array([x, y, theta]), distance, 0.0))
    for longer in (Motion(np.array([x, y, theta]), distance + more, 0.0),
                   Motion(np.array([x, y, theta]), distance, more)):
        change = odometry_covariance(NOISE, longer) - less
        assert np.linalg.eigvalsh(change)[0] > -1e-9 * max(1.0, np.max(np.abs(less)))


def test_turning_the_motion_leaves_the_covariance_in_the_frame_at_its_end() -> None:
    """It depends on the chord seen from the end, so the start may be turned."""
    chord = np.array([3.0, 1.0])
    expected = odometry_covariance(NOISE, Motion(np.array([*chord, 0.0]), 4.0, 2.0))
    for theta in (0.3, -2.0, 3.0):
        turned = np.array([*(se2.rotation(theta) @ chord), theta])
        np.testing.assert_allclose(
            odometry_covariance(NOISE, Motion(turned, 4.0, 2.0)), expected, atol=1e-12)
