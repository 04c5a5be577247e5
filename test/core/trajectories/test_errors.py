# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors are those of matrices, pairs those of a search through all poses."""

from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from pose_graph_ros.core.exceptions import TrajectoryError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.trajectories.association import Association
from pose_graph_ros.core.trajectories.errors import (
    absolute_errors,
    choose_pairs,
    relative_errors,
    Unit,
)
from pose_graph_ros.core.trajectories.sequence import Key

paths = st.integers(1, 25).flatmap(
    lambda n: arrays(np.float64, (n, 3), elements=st.floats(-3.0, 3.0)))


def association(poses: np.ndarray, key: Key = Key.STAMP) -> Association:
    keys = np.arange(len(poses)) * 10**8
    return Association(keys, np.zeros_like(poses), poses, None, key)


def matrix(pose: np.ndarray) -> np.ndarray:
    result = np.eye(3)
    result[:2, :2], result[:2, 2] = se2.rotation(pose[2]), pose[:2]
    return result


@settings(max_examples=50)
@given(paths, paths)
def test_errors_are_those_of_matrices(reference: np.ndarray, estimate: np.ndarray) -> None:
    n = min(len(reference), len(estimate))
    reference, estimate = reference[:n], estimate[:n]
    for error, a, b in zip(absolute_errors(reference, estimate), reference, estimate, strict=True):
        between = np.linalg.inv(matrix(a)) @ matrix(b)
        assert np.hypot(*error[:2]) == pytest.approx(np.hypot(*between[:2, 2]), abs=1e-9)
        assert np.cos(error[2]) == pytest.approx(between[0, 0], abs=1e-9)
    i, j = np.arange(n - 1), np.arange(1, n)
    for k, error in enumerate(relative_errors(reference, estimate, i, j)):
        motions = [np.linalg.inv(matrix(path[k])) @ matrix(path[k + 1])
                   for path in (reference, estimate)]
        np.testing.assert_allclose(
            matrix(error), np.linalg.inv(motions[0]) @ motions[1], atol=1e-9)


def slow_pairs(progress: np.ndarray, delta: float, *, all_pairs: bool) -> list[tuple[int, int]]:
    pairs, n = [], len(progress)
    if all_pairs:
        for i in range(n - 1):
            differences = np.abs(progress[i + 1:] - progress[i] - delta)
            if np.min(differences) <= 0.1 * delta:
                pairs.append((i, i + 1 + int(np.argmin(differences))))
        return pairs
    i = 0
    for j in range(n):
        if progress[j] >= progress[i] + delta:
            pairs.append((i, j))
            i = j
    return pairs


@settings(max_examples=100)
@given(poses=paths, delta=st.floats(0.1, 5.0), all_pairs=st.booleans(),
       unit=st.sampled_from([Unit.METRES, Unit.SECONDS, Unit.RADIANS]))
def test_pairs_are_those_of_a_search(
    poses: np.ndarray, delta: float, unit: Unit, *, all_pairs: bool,
) -> None:
    steps = {Unit.METRES: np.hypot(*np.diff(poses[:, :2], axis=0).T),
             Unit.SECONDS: np.full(len(poses) - 1, 0.1),
             Unit.RADIANS: np.abs(se2.wrap(np.diff(poses[:, 2])))}[unit]
    progress = np.append(0.0, np.cumsum(steps))
    if unit is Unit.SECONDS:
        progress = np.arange(len(poses)) * 10**8 * 1e-9
    if unit is Unit.RADIANS and all_pairs:
        expected = [(i, j) for i in range(len(poses)) for j in range(i + 1, len(poses))
                    if abs(abs(se2.wrap(poses[j, 2] - poses[i, 2])) - delta) <= 0.1 * delta]
    else:
        expected = slow_pairs(progress, delta, all_pairs=all_pairs)
    found = choose_pairs(association(poses), delta, unit, all_pairs=all_pairs)
    assert list(zip(*(each.tolist() for each in found), strict=True)) == expected


def test_pairs_by_frames_may_overlap() -> None:
    found = association(np.zeros((7, 3)))
    for all_pairs, expected in ((False, [0, 3]), (True, [0, 1, 2, 3])):
        i, j = choose_pairs(found, 3.0, Unit.FRAMES, all_pairs=all_pairs)
        assert i.tolist() == expected
        assert (j - i).tolist() == [3] * len(i)
    assert len(choose_pairs(found, 7.0, Unit.FRAMES)[0]) == 0


def test_the_reference_can_say_how_long_a_motion_is() -> None:
    found = association(np.arange(6.0)[:, None] * (1.0, 0.0, 0.0))
    assert len(choose_pairs(found, 1.0, Unit.METRES)[0]) == 5
    assert len(choose_pairs(found, 1.0, Unit.METRES, of_reference=True)[0]) == 0


@pytest.mark.parametrize(('delta', 'unit', 'words'), [
    (0.0, Unit.METRES, 'above 0'), (np.inf, Unit.RADIANS, 'above 0'),
    (1.5, Unit.FRAMES, 'whole number of frames'), (1.0, Unit.SECONDS, 'need stamps')])
def test_a_length_that_is_none_is_refused(delta: float, unit: Unit, words: str) -> None:
    with pytest.raises(TrajectoryError, match=words):
        choose_pairs(association(np.zeros((3, 3)), Key.INDEX), delta, unit)
