# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What happens to measurements before they are in the graph: thinned, dropped, placed."""

import numpy as np
import pytest

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, CovariancePolicy, MeasurementSource
from pose_graph_ros.core.measurements import Fix, HeadingOnly, OdometrySample, Position
from pose_graph_ros.core.sources import pipeline
from pose_graph_ros.core.sources.settings import SOURCES

NOWHERE = 0.0, 0.0, 0.0
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
    monkeypatch.setattr(pipeline, 'SOURCES', SOURCES._replace(most_unaligned=50))
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


NAN = np.full((2, 2), np.nan)


@pytest.mark.parametrize(('stamp', 'covariance', 'settings', 'reason'), [
    (0.5, np.eye(2), {}, 'before_odometry'), (0.0, np.eye(2), {}, 'zero_stamp'),
    (1e12, np.eye(2), {}, 'no_stamp'),
    (5.0, NAN, {'covariance': CovariancePolicy(repair=False)}, 'covariance_not_finite'),
    (1000.0, np.eye(2), {}, 'pending'), (3.0, np.eye(2), {}, 'duplicate_stamp'),
    (3.1, np.eye(2), {'minimum_period': 0.5}, 'thinned')])
def test_a_fix_is_placed_when_it_is_attached_and_not_if_it_is_refused(
    stamp: float, covariance: np.ndarray, settings: dict[str, object], reason: str,
) -> None:
    backend = PoseGraphBackend(BackendConfig(measurements={'fix': MeasurementSource(**settings)}))
    asked: list[float] = []

    def fix(seconds: float, variances: np.ndarray) -> Fix:
        def place(*_: float) -> np.ndarray:
            asked.append(seconds)
            return np.array((seconds, 0.0))
        return Fix(round(seconds * SECOND), NOWHERE, place, variances, np.zeros(2))

    for k in range(1, 100):
        backend.add_odometry(OdometrySample(k * SECOND // 10 + SECOND, np.array((0.1 * k, 0, 0))))
    good = fix(3.0, np.eye(2)), fix(20.0, np.eye(2))
    for each in good:
        backend.add_measurement(each, 'fix')
    assert backend.add_measurement(fix(stamp, covariance), 'fix').reason == reason
    assert asked == [3.0]
    # the one that waits is placed once odometry has come to it
    for k in range(100, 200):
        backend.add_odometry(OdometrySample(k * SECOND // 10 + SECOND, np.array((0.1 * k, 0, 0))))
    assert asked == [3.0, 20.0]
    assert backend.optimize().status is not Status.FAILED
    assert len(backend.graph.factors.observed) == 2


def test_a_fix_too_far_from_the_datum_is_refused() -> None:
    backend = PoseGraphBackend()
    for k in range(1, 100):
        backend.add_odometry(OdometrySample(k * SECOND // 10, np.array((0.1 * k, 0, 0))))
    for place, reason in ((np.array((2e9, 0.0)), 'too_large'), (np.full(2, np.nan), 'not_finite')):
        fix = Fix(5 * SECOND, NOWHERE, lambda *_, place=place: place, np.eye(2), np.zeros(2))
        assert backend.add_measurement(fix, 'fix').reason == reason
