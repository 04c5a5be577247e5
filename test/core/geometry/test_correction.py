# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses between those of a path: held to the definition, with matrices."""

import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.correction import OdometryAtPath, PathCorrection
from pose_graph_ros.core.geometry.trajectory import Trajectory


def pose(array: np.ndarray) -> tuple[float, float, float]:
    x, y, theta = array.tolist()
    return x, y, theta


def test_odometry_is_moved_by_the_interpolated_place_of_its_frame() -> None:
    rng = np.random.default_rng(0)
    stamps = 10**18 + np.arange(50) * 10**8
    odometry = se2.wrapped(np.cumsum(rng.normal(0.0, 0.05, (50, 3)), axis=0))
    nodes = np.array([0, 10, 25, 49])
    path = Trajectory(stamps[nodes], se2.wrapped(
        se2.compose(np.array([5.0, 3.0, 1.0]), odometry[nodes])
        + rng.normal(0.0, 0.01, (4, 3))))
    collected = OdometryAtPath(path)
    for stamp, each in zip(stamps.tolist(), odometry, strict=True):
        collected.add(stamp, pose(each))
        collected.add(stamp - 1, (9.0, 9.0, 9.0))   # late, and ignored
    np.testing.assert_array_equal(collected.poses, odometry[nodes])
    correction = PathCorrection(path, collected.poses)
    for k, stamp in enumerate(stamps.tolist()):
        n = min(np.searchsorted(nodes, k, side='right') - 1, 2)
        ends = [se2.compose(path.poses[m], se2.between(odometry[nodes[m]], odometry[k]))
                for m in (n, n + 1)]
        part = (k - nodes[n]) / (nodes[n + 1] - nodes[n])
        expected = se2.wrapped(ends[0] + part * se2.wrapped(ends[1] - ends[0]))
        found = correction.at(stamp, pose(odometry[k]))
        assert found is not None
        np.testing.assert_allclose(se2.wrapped(np.array(found) - expected), 0.0, atol=1e-12)
    assert correction.at(int(stamps[0]) - 1, (0.0, 0.0, 0.0)) is None
    assert correction.at(int(stamps[-1]) + 1, (0.0, 0.0, 0.0)) is None


def test_a_robot_that_stands_between_two_poses_stands() -> None:
    path = Trajectory(np.array([10, 110]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    correction = PathCorrection(path, np.array([[5.0, 5.0, 0.0], [6.0, 5.0, 0.0]]))
    for stamp in (20, 50, 100):
        assert correction.at(stamp, (5.5, 5.0, 0.0)) == pytest.approx((0.5, 0.0, 0.0))


@pytest.mark.parametrize('jump', [100.0, np.nan])
def test_where_odometry_jumps_or_is_unknown_the_path_is_interpolated(jump: float) -> None:
    path = Trajectory(np.array([10, 110]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    correction = PathCorrection(path, np.array([[0.0, 0.0, 0.0], [jump, 0.0, 0.0]]))
    assert correction.at(60, (50.0, 0.0, 0.0)) == pytest.approx((0.5, 0.0, 0.0))


def test_odometry_between_two_samples_is_interpolated() -> None:
    path = Trajectory(np.array([5, 15]), np.zeros((2, 3)))
    collected = OdometryAtPath(path)
    collected.add(10, (0.0, 0.0, 0.0))
    collected.add(20, (2.0, 0.0, 0.0))
    assert np.all(np.isnan(collected.poses[0]))
    np.testing.assert_allclose(collected.poses[1], [1.0, 0.0, 0.0])
