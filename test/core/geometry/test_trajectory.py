# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories: frozen, interpolated and never extrapolated, aligned, and filled by odometry."""

from dataclasses import FrozenInstanceError

from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from random_graphs import random_poses

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import (
    fit_motion,
    interpolated,
    PathCorrection,
    Trajectory,
)

ROUNDING = 1e-12
coordinates = st.floats(-1e3, 1e3)
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
    np.testing.assert_array_equal(trajectory.covers([9, 10, 20, 21]), [False, True, True, False])
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


@settings(max_examples=50)
@given(
    source=st.integers(2, 20).flatmap(
        lambda n: arrays(np.float64, (n, 2), elements=coordinates)),
    pose=arrays(np.float64, 3, elements=coordinates))
def test_it_recovers_any_rigid_motion(source: np.ndarray, pose: np.ndarray) -> None:
    target = se2.transform(pose, source)
    fitted = fit_motion(source, target)
    np.testing.assert_allclose(se2.transform(fitted, source), target, atol=1e-6)
    if np.ptp(source, axis=0).max() > 1.0:
        np.testing.assert_allclose(se2.between(fitted, se2.wrapped(pose)), 0.0, atol=1e-6)


@settings(max_examples=30)
@given(
    source=arrays(np.float64, (6, 2), elements=coordinates),
    target=arrays(np.float64, (6, 2), elements=coordinates),
    other=arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)))
def test_no_other_rigid_motion_fits_better(
    source: np.ndarray, target: np.ndarray, other: np.ndarray,
) -> None:
    fitted = fit_motion(source, target)
    best = np.sum((se2.transform(fitted, source) - target) ** 2)
    moved = np.sum((se2.transform(fitted + other, source) - target) ** 2)
    assert best <= moved * (1.0 + 1e-9) + 1e-6


def test_it_needs_points_and_turns_nothing_by_a_single_one() -> None:
    np.testing.assert_allclose(
        fit_motion(np.array([[1.0, 2.0]]), np.array([[4.0, 6.0]])), [3.0, 4.0, 0.0])
    for source, target in ((np.zeros((0, 2)), np.zeros((0, 2))), (np.zeros((2, 2)), np.zeros(2))):
        with pytest.raises(ValueError, match='equally many points'):
            fit_motion(source, target)


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
    at_path = interpolated(path, [
        sample for stamp, each in zip(stamps.tolist(), odometry, strict=True)
        for sample in ((stamp, pose(each)), (stamp - 1, (9.0, 9.0, 9.0)))])   # late, and ignored
    np.testing.assert_allclose(at_path, odometry[nodes], rtol=0.0, atol=1e-15)
    correction = PathCorrection(path, at_path)
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
    found = interpolated(path, [(10, (0.0, 0.0, 0.0)), (20, (2.0, 0.0, 0.0))])
    np.testing.assert_allclose(found, [[np.nan] * 3, [1.0, 0.0, 0.0]])
