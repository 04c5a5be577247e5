# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which fixes are believed in a drive of a real robot, where the recording is there."""


import numpy as np
from public_data import needs, PUBLIC
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import OdometrySample, Position

SECOND = 1_000_000_000
PLAZA = PUBLIC / 'robot/plaza2'


def read(name: str) -> Trajectory:
    rows = np.genfromtxt(PLAZA / name, delimiter=',', skip_header=1)
    stamps = np.round(rows[:, 0] * 1e9).astype(np.int64)
    new = np.append(True, np.diff(stamps) > 0)
    return Trajectory(stamps[new], rows[new, 1:4])


@needs('robot/plaza2')
@pytest.mark.parametrize('seed', [25, 47, 50, 1, 2, 4])
def test_a_mower_doubts_all_fixes_aside_after_an_outage_and_no_others(seed: int) -> None:
    odometry, truth = read('odom.csv'), read('gt.csv')
    begin, end = odometry.stamps_ns[[0, -1]]
    first = max(begin, truth.stamps_ns[0]) + SECOND
    stamps = np.arange(first, min(end, truth.stamps_ns[-1]), SECOND)
    fixes = truth.at(stamps)[:, :2] + np.random.default_rng(seed).normal(
        0.0, 1.0, (len(stamps), 2))
    since = (stamps - begin) - (end - begin) / 4.0
    sent = (since < 0.0) | (since >= 60.0 * SECOND)
    wrong = (since >= 60.0 * SECOND) & (since < 90.0 * SECOND)
    angle = np.random.default_rng(1000 + seed).uniform(-np.pi, np.pi)
    fixes[wrong] += 40.0 * np.array((np.cos(angle), np.sin(angle)))

    backend = PoseGraphBackend()
    events: list[OdometrySample | Position] = [
        OdometrySample(*each) for each in zip(
            odometry.stamps_ns.tolist(), odometry.poses, strict=True)]
    events += [Position(stamp, fix, np.eye(2), np.zeros(2)) for stamp, fix in zip(
        stamps[sent].tolist(), fixes[sent], strict=True)]
    for event in sorted(events, key=lambda each: each.stamp_ns):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, 'fix')
            backend.update()
    backend.optimize()
    assert {verdict.stamp_ns for verdict in backend.verdicts()
            if verdict.state is State.DOUBTED} == {*stamps[wrong].tolist()}
    estimate = backend.estimate()
    assert estimate is not None
    known = estimate.path.stamps_ns <= truth.stamps_ns[-1]
    error = estimate.path.poses[known] - truth.at(
        np.maximum(estimate.path.stamps_ns[known], truth.stamps_ns[0]))
    assert np.sqrt(np.mean(np.sum(error[:, :2]**2, axis=1))) < 0.6
