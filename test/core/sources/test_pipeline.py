# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sources with high rates, or without an alignment, do not fill the memory."""

import numpy as np
import pytest

from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, MeasurementSource
from pose_graph_ros.core.measurements import HeadingOnly, OdometrySample, Position
from pose_graph_ros.core.sources import pipeline

SECOND = 1_000_000_000


def test_a_source_can_be_thinned_by_stamps() -> None:
    backend = PoseGraphBackend(BackendConfig(
        measurements={'imu': MeasurementSource(minimum_period=0.5)}))
    for k in range(1, 1001):
        stamp = k * SECOND // 100
        backend.add_odometry(OdometrySample(stamp, np.array((0.01 * k, 0.0, 0.0))))
        backend.add_measurement(HeadingOnly(stamp, 0.0, 0.01), 'imu')
    backend.add_measurement(Position(9 * SECOND, np.array((9.0, 0.0)), np.eye(2), np.zeros(2)),
                            'fix')
    assert backend.counts['imu', 'thinned'] == 1000 - 20
    backend.optimize()
    assert backend.counts['imu', 'accepted'] == 20
    estimate = backend.estimate()
    assert estimate is not None
    assert estimate.alignment is AlignmentState.ALIGNED
    assert estimate.n_observed == 21


def test_while_unaligned_the_oldest_positions_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, 'MOST_UNALIGNED', 50)
    backend, rng = PoseGraphBackend(), np.random.default_rng(0)

    def drive(seconds: range, speed: float, x: float) -> float:
        for k in seconds:
            for tenth in range(10):
                stamp = k * SECOND + tenth * SECOND // 10
                x += 0.1 * speed
                backend.add_odometry(OdometrySample(stamp, np.array((x, 0.0, 0.0))))
                backend.add_measurement(Position(
                    stamp, np.array((0.0, x)) + rng.normal(0.0, 0.1, 2), 0.01 * np.eye(2),
                    np.zeros(2)), 'fix')
            backend.update()
        return x

    x = drive(range(1, 60), 0.0, 0.0)
    estimate = backend.estimate()
    assert estimate is not None
    assert estimate.alignment is AlignmentState.UNALIGNED
    assert backend.counts['fix', 'dropped_unaligned'] > 500
    drive(range(60, 70), 1.0, x)
    estimate = backend.estimate()
    assert estimate is not None
    assert estimate.alignment is AlignmentState.ALIGNED
    assert abs(estimate.T_map_base[2] - np.pi / 2.0) < 0.1
