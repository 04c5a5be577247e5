# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses are associated as a search through all of them does it."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.exceptions import TrajectoryError
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.trajectories.association import associate, nearest
from pose_graph_ros.core.trajectories.sequence import in_order, Key, PoseSequence

stamps = st.sets(st.integers(0, 300), min_size=1, max_size=30).map(
    lambda found: np.array(sorted(found)))


def sequence(keys: list[int], shift: float = 0.0, key: Key = Key.STAMP) -> PoseSequence:
    found = np.array(keys, dtype=np.int64)
    return PoseSequence(Trajectory(found, np.column_stack(
        (found + shift, 2.0 * found, 0.001 * found))), key)


@settings(max_examples=100)
@given(fewer=stamps, more=stamps, limit=st.integers(0, 20))
def test_the_nearest_is_the_first_of_the_nearest(
    fewer: np.ndarray, more: np.ndarray, limit: int,
) -> None:
    slow = []
    for i, stamp in enumerate(fewer):
        differences = np.abs(more - stamp)
        if np.min(differences) <= limit:
            slow.append((i, int(np.argmin(differences))))
    assert list(zip(*(each.tolist() for each in nearest(fewer, more, limit)), strict=True)) == slow


def test_the_trajectory_with_fewer_poses_is_looked_up() -> None:
    few, many = sequence([0, 100, 200]), sequence([0, 99, 101, 150, 203], 0.5)
    for reference, estimate in ((few, many), (many, few)):
        found = associate(reference, estimate, max_difference_ns=3)
        assert found.reference[:, 1].tolist() == (
            [0, 200, 400] if reference is few else [0, 198, 406])
        assert found.estimate[:, 1].tolist() == (
            [0, 200, 400] if estimate is few else [0, 198, 406])
    assert len(associate(few, many, max_difference_ns=0)) == 1


def test_the_offset_is_added_to_the_estimate() -> None:
    found = associate(sequence([10, 20, 30]), sequence([0, 10, 20]), 0, 10)
    assert found.reference[:, 0].tolist() == [10, 20, 30]
    assert found.estimate[:, 0].tolist() == [0, 10, 20]
    assert found.keys.tolist() == [10, 20, 30]


def test_the_trajectory_with_more_poses_is_interpolated() -> None:
    few, many = sequence([1, 100, 203]), sequence([0, 99, 103, 150, 201], 0.5)
    found = associate(few, many, 2, interpolate=True)
    np.testing.assert_allclose(found.estimate[:, 0], [1.5, 100.5, 201.5])
    np.testing.assert_allclose(found.reference[:, 0], [1.0, 100.0, 203.0])
    found = associate(many, few, 2, interpolate=True)
    np.testing.assert_allclose(found.reference[:, 0], [1.5, 100.5, 201.5])
    np.testing.assert_allclose(found.estimate[:, 0], [1.0, 100.0, 203.0])
    later = associate(few, many, 2, 1, interpolate=True)
    np.testing.assert_allclose(later.estimate[:, 0], [0.5, 99.5, 201.5])


def test_ids_are_equal_and_poses_without_any_in_order() -> None:
    found = associate(sequence([3, 5, 9], key=Key.ID), sequence([1, 5, 9], key=Key.ID))
    assert found.keys.tolist() == [5, 9]
    by_index = sequence([0, 1, 2], key=Key.INDEX)
    found = associate(sequence([3, 5, 9], key=Key.ID), by_index)
    assert found.keys.tolist() == [0, 1, 2]
    assert found.key is Key.INDEX
    assert found.reference[:, 0].tolist() == [3, 5, 9]


@pytest.mark.parametrize(('reference', 'estimate', 'words'), [
    (sequence([0, 10**9]), sequence([5 * 10**8]), 'nearest two differ by 0.5 s'),
    (sequence([0]), sequence([10**12]), 'they cover 0.000 to 0.000 s and 1000.000 to'),
    (sequence([]), sequence([1]), 'no poses'),
    (sequence([0, 1], key=Key.ID), sequence([2], key=Key.ID), 'same id'),
    (sequence([0, 1], key=Key.INDEX), sequence([2]), 'have 2 and 1 poses'),
])
def test_it_says_why_nothing_belongs_together(
    reference: PoseSequence, estimate: PoseSequence, words: str,
) -> None:
    with pytest.raises(TrajectoryError, match=words):
        associate(reference, estimate)


def test_poses_come_in_order_and_each_stamp_once() -> None:
    poses = np.arange(12.0).reshape(4, 3)
    covariances = np.arange(4.0)[:, None, None] * np.eye(3)
    found = in_order(np.array([5, 3, 5, 1]), poses, Key.STAMP, covariances)
    assert found.keys.tolist() == [1, 3, 5]
    assert found.poses[:, 0].tolist() == [9.0, 3.0, 0.0]
    assert found.covariances is not None
    assert found.covariances[:, 0, 0].tolist() == [3.0, 1.0, 0.0]
    assert found.dropped == 1
    with pytest.raises(ValueError, match='covariances'):
        PoseSequence(found.path, covariances=covariances)
