# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics and NEES of errors that can be told by hand, and of drawn ones."""

import numpy as np
import pytest

from pose_graph_ros.core.exceptions import TrajectoryError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.trajectories.comparison import Alignment, compare, Options
from pose_graph_ros.core.trajectories.sequence import PoseSequence
from pose_graph_ros.core.trajectories.statistics import (
    consistency,
    normalized_squares,
    summarize,
    usable,
)

N = 4000


def drawn(scale: float = 1.0) -> tuple[PoseSequence, PoseSequence]:
    """Return a truth, and an estimate with errors drawn from its covariances, times a scale."""
    rng = np.random.default_rng(1)
    truth = np.cumsum(rng.normal(size=(N, 3)), axis=0)
    factors = rng.normal(size=(N, 3, 3)) * 0.1 + 0.2 * np.eye(3)
    errors = np.einsum('nij,nj->ni', factors, scale * rng.normal(size=(N, 3)))
    stamps = np.arange(N) * 10**9
    return (PoseSequence(Trajectory(stamps, se2.wrapped(truth))), PoseSequence(
        Trajectory(stamps, se2.wrapped(truth + errors)),
        covariances=factors @ np.swapaxes(factors, 1, 2)))


def test_statistics_of_known_errors() -> None:
    row = summarize(np.array([3.0, 0.0, 4.0, np.nan, 1.0, 2.0]))
    assert row is not None
    assert (row.mean, row.median, row.min, row.max, row.sse, row.count) == (2, 2, 0, 4, 30, 5)
    assert row.rmse == pytest.approx(np.sqrt(6.0))
    assert row.std == pytest.approx(np.sqrt(2.0))
    assert summarize(np.array([np.nan])) is None


def test_the_nees_of_drawn_errors_is_in_its_interval() -> None:
    result = compare(*drawn()).consistency()
    for name, dimension in (('position', 2), ('pose', 3)):
        found = result[name]
        assert found is not None
        assert found.interval[0] < found.mean < found.interval[1]
        assert found.interval[0] < found.expected == dimension < found.interval[1]
        assert found.within == pytest.approx(0.95, abs=0.015)
        assert found.count == N
    wrong = compare(*drawn(1.5)).consistency()['pose']
    assert wrong is not None
    assert wrong.mean == pytest.approx(3.0 * 1.5**2, rel=0.1)
    assert wrong.mean > wrong.interval[1]


def test_covariances_are_moved_with_the_estimate() -> None:
    truth, estimate = drawn()
    pose, scale = np.array([3.0, -2.0, 2.5]), 1.7
    poses = se2.compose(pose, estimate.poses) * (scale, scale, 1.0)
    axes = np.diag([scale, scale, 1.0])
    axes[:2, :2] = scale * se2.rotation(pose[2])
    assert estimate.covariances is not None
    moved = PoseSequence(Trajectory(estimate.keys, poses),
                         covariances=axes @ estimate.covariances @ axes.T)
    options = Options(Alignment.SIM2)
    for name, found in compare(truth, moved, options).consistency().items():
        expected = compare(truth, estimate, options).consistency()[name]
        assert found is not None
        assert expected is not None
        assert found.mean == pytest.approx(expected.mean, rel=1e-6)
    assert compare(truth, moved, options).alignment.scale == pytest.approx(1.0 / scale, rel=1e-3)


def test_covariances_that_are_none_are_left_out() -> None:
    good = np.diag([4.0, 1.0, 0.25])
    bad = [np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([1.0, -1.0, 1.0]),
           np.ones((3, 3)), np.diag([np.inf, 1.0, 1.0])]
    matrices = np.array([good, *bad])
    assert usable(matrices).tolist() == [True] + [False] * len(bad)
    squares = normalized_squares(np.tile([2.0, 1.0, 0.5], (len(matrices), 1)), matrices)
    assert squares[0] == pytest.approx(3.0)
    found = consistency(squares, 3)
    assert found is not None
    assert (found.count, found.mean) == (1, pytest.approx(3.0))
    assert consistency(squares[1:], 3) is None


def test_headings_that_are_not_known_have_no_errors() -> None:
    truth, estimate = drawn()
    bare = PoseSequence(Trajectory(truth.keys, truth.poses * (1.0, 1.0, np.nan)))
    result = compare(bare, estimate, Options(Alignment.SE2))
    rows = result.statistics()
    assert rows['ate'] is not None
    assert [rows[name] for name in ('ate_heading', 'rpe', 'rpe_heading')] == [None] * 3
    assert result.consistency()['position'] is not None
    assert result.consistency()['pose'] is None


def test_positions_must_be_finite() -> None:
    truth, estimate = drawn()
    for factor in (np.inf, np.nan, 1e200):
        with pytest.raises(TrajectoryError, match='not finite, or beyond'):
            compare(PoseSequence(Trajectory(truth.keys, truth.poses * factor)), estimate)
