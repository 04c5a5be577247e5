# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pose that somebody sets: the robot is there, and what came before stays as it was."""

import math

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, CovariancePolicy, MeasurementSource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import AnswerStatus, GlobalPose, OdometrySample, Position

SIGMA = np.diag((0.25, 0.25, 0.07))


def stamp(step: int) -> int:
    return (10 + step) * 100_000_000


def odometry(step: int) -> OdometrySample:
    return OdometrySample(stamp(step), np.array([0.2 * step, 0.0, 0.0]), 2.0)


def drive(backend: PoseGraphBackend, begin: int, end: int, T_map_odom: np.ndarray | None) -> None:
    """Drive along; tell the pose in the map every second."""
    for step in range(begin, end):
        backend.add_odometry(odometry(step))
        if T_map_odom is not None and step % 10 == 5:
            backend.add_measurement(GlobalPose(
                stamp(step), se2.compose(T_map_odom, odometry(step).pose), 0.01 * np.eye(3)),
                'global_pose')
        if step % 5 == 0:
            backend.update()


def test_a_map_that_nothing_was_measured_in_is_laid_where_the_pose_says() -> None:
    backend = PoseGraphBackend()
    drive(backend, 0, 100, None)
    pose = np.array([100.0, 50.0, 1.5])
    assert backend.set_pose(GlobalPose(stamp(99), pose, SIGMA), 'set_pose').reason == ''
    backend.update()
    drive(backend, 100, 150, None)
    assert backend.optimize().status is Status.CONVERGED
    estimate = backend.estimate()
    expected = se2.compose(pose, np.column_stack((
        0.2 * (estimate.path.stamps_ns - stamp(99)) * 1e-8, np.zeros((len(estimate.path), 2)))))
    np.testing.assert_allclose(estimate.path.poses, expected, atol=1e-6)


@pytest.mark.parametrize('ago', [0, 20])
def test_in_a_map_the_robot_is_put_elsewhere_and_the_past_stays(ago: int) -> None:
    backend = PoseGraphBackend()
    before = np.array([5.0, 1.0, 0.0])
    drive(backend, 0, 100, before)
    backend.update()
    past = backend.estimate().path
    pose = np.array([300.0, -50.0, 2.5])
    answer = backend.set_pose(GlobalPose(stamp(99 - ago), pose, SIGMA), 'set_pose')
    assert answer.status is AnswerStatus.ACCEPTED
    backend.update()
    now = se2.compose(pose, np.array([0.2 * ago, 0.0, 0.0]))
    estimate = backend.estimate()
    np.testing.assert_allclose(estimate.T_map_base, now, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)[:2]), 0.5, rtol=0.05)
    after = se2.compose(now, se2.inverse(odometry(99).pose))
    drive(backend, 100, 200, after)
    assert backend.optimize().status is Status.CONVERGED
    path = backend.estimate().path
    n = int(np.searchsorted(path.stamps_ns, stamp(98)))
    np.testing.assert_allclose(path.poses[:n], past.poses[:n], atol=1e-4)
    np.testing.assert_allclose(path.poses[-1], se2.compose(after, odometry(199).pose), atol=1e-3)
    assert math.isclose(backend.estimate().chi2, 0.0, abs_tol=1e-3)


def test_measurements_count_on_their_side_of_it() -> None:
    """A fix that comes late belongs to the place before, whenever it arrives."""
    backend = PoseGraphBackend()
    drive(backend, 0, 100, np.array([5.0, 1.0, 0.0]))
    backend.set_pose(GlobalPose(stamp(99), np.array([300.0, 0.0, 0.0]), SIGMA), 'set_pose')
    drive(backend, 100, 110, None)
    late = Position(stamp(95), np.array([5.0 + 19.0, 1.0]), 0.01 * np.eye(2), np.zeros(2))
    soon = Position(stamp(105), np.array([301.2, 0.0]), 0.01 * np.eye(2), np.zeros(2))
    for fix in (late, soon):
        assert backend.add_measurement(fix, 'fix').status is AnswerStatus.ACCEPTED
    backend.optimize()
    assert backend.estimate().chi2 < 1e-6


def test_without_odometry_it_is_refused() -> None:
    backend = PoseGraphBackend()
    answer = backend.set_pose(GlobalPose(1, np.zeros(3), SIGMA), 'set_pose')
    assert answer.reason == 'before_odometry'
    assert backend.counts['set_pose', 'before_odometry'] == 1


def test_a_pose_with_an_invalid_covariance_is_refused_and_changes_nothing() -> None:
    backend = PoseGraphBackend(BackendConfig(measurements={
        'set_pose': MeasurementSource(covariance=CovariancePolicy(repair=False))}))
    drive(backend, 0, 100, np.array([5.0, 1.0, 0.0]))
    backend.update()
    pose = GlobalPose(stamp(99), np.array([9.0, 0.0, 0.0]), -SIGMA)
    assert backend.set_pose(pose, 'set_pose').status is AnswerStatus.REJECTED
    expected = PoseGraphBackend()
    drive(expected, 0, 100, np.array([5.0, 1.0, 0.0]))
    expected.update()
    expected.finish()
    assert backend.counts['set_pose', 'accepted'] == 0
    assert len(backend.node_stamps_ns) == len(expected.node_stamps_ns)
    np.testing.assert_allclose(
        backend.estimate().path.poses, expected.estimate().path.poses, atol=1e-9)
