# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An engine whose parts are captured between two primary odometries goes on as without."""

from collections.abc import Iterator

import numpy as np
from saved_graphs import assert_same_value, SECOND

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.io.graph_files import SavedGraph
from pose_graph_ros.core.measurements import (
    GlobalPose,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult

CONFIG = BackendConfig(
    odometry={name: OdometrySource(reorder_window=0.0) for name in ('wheels', 'visual')},
    measurements={'fix': MeasurementSource(loss=Loss.HUBER),
                  'gnss': MeasurementSource(correlation_time=10.0)})
STEP = np.array([0.4, 0.0, 0.03])
SILENT = range(60, 105)
"""Steps at which the wheels say nothing, for less than ten seconds: later they begin anew."""
BEGIN = 75
"""First step of another odometry, which takes over at once and has no sample at the last node."""


def events() -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """Return two odometries at 5 Hz that do not tick together, fixes, and a closure."""
    rng, pose = np.random.default_rng(2), np.zeros(3)
    for k in range(140):
        stamp = (k + 5) * SECOND // 5
        if k not in SILENT:
            yield 'wheels', OdometrySample(stamp, pose, 2.0)
        later = se2.compose(pose, 0.35 * STEP)
        if k >= BEGIN:
            yield 'visual', OdometrySample(
                stamp + 70_000_000, se2.compose(np.array([9.0, 1.0, -1.0]), later), 2.0)
        if k == 3:
            yield 'start', GlobalPose(stamp, pose, 0.01 * np.eye(3))
        if k % 4 == 2 and k not in range(SILENT.start, BEGIN):   # nothing waits for long
            yield ('fix', 'gnss')[k // 4 % 2], Position(
                stamp, pose[:2] + rng.normal(0.0, 0.3, 2), 0.09 * np.eye(2), np.zeros(2))
        if k in {50, 120}:
            yield 'scan', LoopClosure(stamp, np.array([4.0, 0.0, 0.3]), 0.01 * np.eye(3),
                                      reference_ns=stamp - 2 * SECOND)
        pose = se2.compose(pose, STEP)


EVENTS = list(events())


def feed(
    backend: PoseGraphBackend, some: list[tuple[str, OdometrySample | Measurement]],
) -> PoseGraphBackend:
    for source, event in some:
        if isinstance(event, OdometrySample):
            backend.add_odometry(event, source)
        else:
            backend.add_measurement(event, source)
            backend.update()
    return backend


def again(saved: SavedGraph) -> PoseGraphBackend:
    return PoseGraphBackend.restored(CONFIG, saved)


class Refusing(IncrementalSmoother):
    """A smoother that makes no nodes while it refuses to."""

    refuses = False

    def extend(self, *arguments: FloatArray) -> UpdateResult:
        if self.refuses:
            return UpdateResult(Status.FAILED, 'refused', 0, 0, 0, 0)
        return super().extend(*arguments)


def test_a_graph_that_is_saved_between_two_primary_odometries_goes_on_as_without() -> None:
    """The other one has no sample at the last node, and its first sample made no node either."""
    smoother = Refusing(CONFIG.smoother)
    backend = PoseGraphBackend(CONFIG, smoother=smoother)
    cut = next(k for k, (source, _) in enumerate(EVENTS, 1) if source == 'visual')
    feed(backend, EVENTS[:cut - 1])
    n = len(backend.node_stamps_ns)
    smoother.refuses = True
    feed(backend, EVENTS[cut - 1:cut])
    smoother.refuses = False
    assert backend.counts['solver', 'failed'] == 1
    assert len(backend.node_stamps_ns) == n
    saved = backend.saved()
    assert saved.n_left_out == 0
    assert [name for _, name in saved.nodes.leads] == ['wheels', 'visual']
    assert saved.nodes.bridge is not None
    restored = again(saved)
    assert_same_value(restored.saved().nodes, saved.nodes)
    for each in (backend, restored):
        feed(each, EVENTS[cut:]).optimize()
    assert len(backend.node_stamps_ns) > n
    np.testing.assert_array_equal(restored.node_stamps_ns, backend.node_stamps_ns)
    assert_same_value(restored.graph.factors.edges, backend.graph.factors.edges)
    np.testing.assert_allclose(
        restored.estimate().path.poses, backend.estimate().path.poses, atol=1e-9)
