# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories: frozen, increasing, interpolated and never extrapolated."""

from dataclasses import FrozenInstanceError

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import random_poses

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory

ROUNDING = 1e-12
EPOCH = 1_767_225_600_000_000_001

stamp_lists = st.lists(st.integers(0, 10**9), min_size=1, max_size=9, unique=True).map(
    lambda stamps: [EPOCH + stamp for stamp in sorted(stamps)])


@given(stamp_lists, st.data())
def test_interpolation_is_that_of_a_slow_search(stamps: list[int], data: st.DataObject) -> None:
    poses = random_poses(np.random.default_rng(1), len(stamps))
    trajectory = Trajectory(stamps, poses)
    at = data.draw(st.lists(st.integers(stamps[0], stamps[-1]), min_size=1, max_size=5))
    found = trajectory.at(at)
    assert found.shape == (len(at), 3)
    for stamp, pose in zip(at, found, strict=True):
        k = max(k for k in range(len(stamps)) if stamps[k] <= stamp)
        expected = poses[k]
        if stamp > stamps[k]:
            fraction = (stamp - stamps[k]) / (stamps[k + 1] - stamps[k])
            expected = se2.interpolate(poses[k], poses[k + 1], fraction)
        np.testing.assert_allclose(pose[:2], expected[:2], atol=ROUNDING)
        assert abs(se2.wrap(pose[2] - expected[2])) < ROUNDING


def test_nothing_is_extrapolated() -> None:
    trajectory = Trajectory([10, 20], np.zeros((2, 3)))
    np.testing.assert_array_equal(
        trajectory.covers([9, 10, 20, 21]), [False, True, True, False])
    with pytest.raises(ValueError, match=r'2 of 3 .*\[10, 20\]'):
        trajectory.at([9, 15, 21])
    empty = Trajectory([], np.empty((0, 3)))
    assert not np.any(empty.covers([1, 2]))
    assert empty.at([]).shape == (0, 3)
    with pytest.raises(ValueError, match='nothing'):
        empty.at([5])


@pytest.mark.parametrize(('stamps', 'poses', 'message'), [
    ([1, 2], np.zeros((3, 3)), r'\(2,\) and \(3, 3\)'),
    ([1, 2], np.zeros((2, 2)), r'\(2, 2\)'),
    ([[1], [2]], np.zeros((2, 3)), r'\(2, 1\)'),
    ([1, 3, 3], np.zeros((3, 3)), '3 then 3 at index 1'),
    ([5, 4], np.zeros((2, 3)), '5 then 4 at index 0'),
])
def test_what_is_no_trajectory_is_refused(stamps: list, poses: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Trajectory(stamps, poses)


def test_a_trajectory_is_frozen_and_its_own() -> None:
    stamps, poses = np.array([1, 2]), np.zeros((2, 3))
    trajectory = Trajectory(stamps, poses)
    poses[0], stamps[0] = 7.0, 0
    np.testing.assert_array_equal(trajectory.poses, 0.0)
    assert trajectory.stamps_ns[0] == 1
    for array in (trajectory.poses, trajectory.stamps_ns):
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 1
    with pytest.raises(FrozenInstanceError):
        trajectory.poses = poses
    trajectory.at([1])[0] = 5.0     # what is interpolated belongs to the caller
    Trajectory([1], np.zeros((1, 3))).at([1])[0] = 5.0
