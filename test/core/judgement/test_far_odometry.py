# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes after garbage that has put odometry far away, where its sums have lost their digits."""

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    OdometrySource,
    Robust,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import OdometrySample, Position

SECOND = 1_000_000_000


@pytest.mark.parametrize('seed', [14, 28])
def test_no_fix_is_lost_by_the_judge_once_garbage_has_ended(seed: int) -> None:
    rng, pose, reasons = np.random.default_rng(seed), np.zeros(3), []
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(maximum_speed=1e12)},
        measurements={'fix': MeasurementSource(robust=Robust.JUDGED, loss=Loss.HUBER)}))
    far = 10.0**rng.uniform(4.0, 8.5)
    T_map_odom = np.array([*rng.normal(0.0, far, 2), rng.uniform(-3.0, 3.0)])
    for k in range(120):
        pose = se2.compose(pose, np.array([0.5, 0.0, 0.05]))
        garbage = 30 < k < 45
        if garbage and rng.random() < 0.5:
            pose = se2.compose(pose, np.array([*rng.normal(0.0, far, 2), rng.normal()]))
        stamp_ns = SECOND + k * SECOND // 5
        backend.add_odometry(OdometrySample(stamp_ns, pose, far if garbage else 2.5))
        if k % 2 == 0:
            where = se2.compose(T_map_odom, pose)[:2] + rng.normal(0.0, 0.1, 2)
            noise = 0.01 * np.eye(2)
            if garbage:
                noise = np.diag(10.0**rng.uniform(-12.0, 8.0, 2))
            backend.add_measurement(Position(
                stamp_ns - SECOND // 20, where, noise, np.zeros(2)), 'fix')
        if k % 4 == 0:
            reasons.append(backend.update().reason)
            backend.estimate()
    assert not [reason for reason in reasons if 'Error' in reason]
    assert 'Error' not in backend.optimize().reason
