# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What odometry has passed corrects the newest pose at once, and the graph when it is settled."""

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource, Robust
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    Measurement,
    OdometrySample,
    Position,
)

BEGIN, LAST = 1_000_000_000, 600
JUDGED = MeasurementSource(robust=Robust.JUDGED, loss=Loss.HUBER)
TRUTH = np.zeros((LAST + 30, 3))
for k in range(1, len(TRUTH)):
    TRUTH[k] = se2.compose(TRUTH[k - 1], np.array([0.1, 0.0, 0.006]))
LEVER = np.array([0.4, 0.2])


def stamp(k: float) -> int:
    return BEGIN + round(k * 50_000_000)


def fix(k: float, off: tuple[float, float] = (0.0, 0.0)) -> Position:
    pose = se2.interpolate(TRUTH[int(k)], TRUTH[int(k) + 1], k - int(k))
    return Position(stamp(k), se2.transform(pose, LEVER) + off, np.eye(2), LEVER)


def driven(source: MeasurementSource) -> tuple[PoseGraphBackend, FloatArray]:
    """Return a back end with a fix each second, the last one settled, and the odometry."""
    rng, odometry = np.random.default_rng(5), TRUTH.copy()
    for k in range(1, len(TRUTH)):
        odometry[k] = se2.compose(odometry[k - 1], se2.between(
            TRUTH[k - 1], TRUTH[k]) + rng.normal(0.0, (0.01, 0.01, 0.003)))
    backend = PoseGraphBackend(BackendConfig(measurements=dict.fromkeys(
        ('fix', 'pose', 'compass'), source)))
    first = GlobalPose(stamp(1), TRUTH[1], 0.01 * np.eye(3))
    for source_name in ('pose', 'compass'):
        backend.add_measurement(first, source_name)
    for k in range(LAST + 1):
        backend.add_odometry(OdometrySample(stamp(k), odometry[k], 2.0))
        if k % 20 == 7 and k < LAST - 10:
            backend.add_measurement(fix(k, tuple(rng.normal(0.0, 1.0, 2))), 'fix')
        if k % 4 == 0:
            backend.update()
    backend.update()
    return backend, odometry


def newest(backend: PoseGraphBackend) -> Estimate:
    backend.update()
    estimate = backend.estimate(with_path=False)
    assert estimate is not None
    return estimate


SOURCES = {'white': JUDGED, 'correlated': MeasurementSource(correlation_time=20.0)}
MEASUREMENTS: dict[str, tuple[str, Measurement]] = {
    'position': ('fix', fix(LAST - 2.4, (1.5, -1.0))),
    'pose': ('pose', GlobalPose(stamp(LAST - 3), TRUTH[LAST - 3] + (0.5, 0.8, 0.05),
                                np.diag([0.5, 0.5, 0.02]))),
    'heading': ('compass', HeadingOnly(stamp(LAST - 3), TRUTH[LAST - 3, 2] + 0.05, 4e-4))}


@pytest.mark.parametrize('source', SOURCES)
@pytest.mark.parametrize('kind', MEASUREMENTS)
def test_it_corrects_the_newest_pose_as_the_graph_does_later(kind: str, source: str) -> None:
    backend, _ = driven(SOURCES[source])
    before = newest(backend)
    name, measurement = MEASUREMENTS[kind]
    backend.add_measurement(measurement, name)
    assert backend.n_waiting == 1
    at_once = newest(backend)
    backend.finish()
    assert backend.n_waiting == 0
    settled = newest(backend)
    assert settled.stamp_ns == at_once.stamp_ns == before.stamp_ns
    step, rest = (at_once.T_map_base - before.T_map_base, settled.T_map_base - at_once.T_map_base)
    assert np.linalg.norm(step) > 5e-3
    assert np.linalg.norm(rest) < 0.1 * np.linalg.norm(step)
    np.testing.assert_allclose(at_once.covariance, settled.covariance, rtol=0.0,
                               atol=0.02 * np.max(settled.covariance))
    np.testing.assert_allclose(
        se2.compose(at_once.T_map_odom, at_once.T_odom_base), at_once.T_map_base, atol=1e-9)


def test_what_contradicts_the_estimate_waits_unless_nothing_is_judged() -> None:
    for source, moves in ((JUDGED, False), (MeasurementSource(robust=Robust.NONE), True)):
        backend, _ = driven(source)
        before = newest(backend)
        backend.add_measurement(fix(LAST - 2, (40.0, 0.0)), 'fix')
        step = newest(backend).T_map_base - before.T_map_base
        assert (np.linalg.norm(step) > 1.0) == moves


def test_neither_what_odometry_has_not_reached_nor_the_first_of_a_source_is_used() -> None:
    backend, _ = driven(JUDGED)
    before = newest(backend)
    backend.add_measurement(fix(LAST + 2, (1.0, 1.0)), 'fix')
    backend.add_measurement(fix(LAST - 2, (1.0, 1.0)), 'another')
    np.testing.assert_array_equal(newest(backend).T_map_base, before.T_map_base)


def test_the_graph_is_the_same_whether_or_not_it_was_asked_for_an_estimate() -> None:
    ends = []
    for asks in (False, True):
        backend, odometry = driven(SOURCES['correlated'])
        for k in range(LAST + 1, len(TRUTH)):
            backend.add_odometry(OdometrySample(stamp(k), odometry[k], 2.0))
            backend.add_measurement(fix(k - 1.5, (0.5, 1.0)), 'fix')
            backend.update()
            if asks:
                newest(backend)
        backend.optimize()
        ends.append(backend.graph.poses.copy())
    np.testing.assert_array_equal(*ends)
