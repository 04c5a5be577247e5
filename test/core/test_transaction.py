# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A failed update leaves everything as it was, wherever it fails."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from random_graphs import snapshot
from saved_graphs import assert_same_value

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource, OdometrySource
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample, Position
from pose_graph_ros.core.smoother.results import UpdateResult

SECOND = 1_000_000_000
CONFIG = BackendConfig(
    odometry={'odom': OdometrySource(reorder_window=0.0)},
    measurements={
        'gnss': MeasurementSource(correlation_time=20.0, loss=Loss.HUBER),
        'fix': MeasurementSource(loss=Loss.HUBER)})


def drive(backend: PoseGraphBackend, start: int, end: int) -> None:
    """Drive along x at 1 m/s in a map turned by 90 degrees, with fixes and a closure."""
    for k in range(start, end):
        x = float(k)
        backend.add_odometry(OdometrySample((k + 1) * SECOND, np.array([x, 0.0, 0.0])))
        for source, sigma in (('gnss', 0.5), ('fix', 0.3)):
            backend.add_measurement(Position(
                (k + 1) * SECOND, np.array([0.1 * (k % 3), x]), sigma**2 * np.eye(2),
                np.zeros(2)), source)
    backend.add_measurement(LoopClosure(
        end * SECOND, np.array([2.0, 0.0, 0.0]), 0.01 * np.eye(3),
        reference_ns=(end - 2) * SECOND), 'loop_closure')


def state(backend: PoseGraphBackend) -> dict[str, Any]:
    """Return all that a failed update must leave alone."""
    return {
        'factors': backend._factors.saved(), 'losses': backend._reweighting.saved(),
        'alignment': backend._alignment.saved(), 'covariance': backend._newest_node_covariance}


def fails(*_: object, **__: object) -> Any:
    raise RuntimeError('broken on purpose')


def is_failed(_: GraphUpdate, **options: bool) -> UpdateResult:
    return UpdateResult(Status.FAILED, 'broken on purpose', 0, 0, 0, 0)


# The steps of an update, in their order.
STEPS: dict[str, tuple[Callable[[PoseGraphBackend], object], str]] = {
    'alignment': (lambda backend: backend._alignment, 'find'),
    'queue': (lambda backend: backend._pipeline, 'take_ready'),
    'build': (lambda backend: backend._factors, 'build'),
    'solve': (lambda backend: backend._smoother, 'update'),
}


@pytest.mark.parametrize('aligned', [False, True])
@pytest.mark.parametrize(
    ('step', 'failure'), [*((step, fails) for step in STEPS), ('solve', is_failed)])
def test_an_update_that_fails_at_any_step_changes_nothing(
    step: str, failure: Callable[..., Any], aligned: bool, monkeypatch: pytest.MonkeyPatch,
) -> None:
    backend = PoseGraphBackend(CONFIG)
    if aligned:
        drive(backend, 0, 8)
        assert backend.update().status is not Status.FAILED
    drive(backend, 8 if aligned else 0, 16)
    before, graph, estimate = state(backend), snapshot(backend.graph), backend.estimate()
    waiting = len(backend._pipeline.queue)
    owner, name = STEPS[step]
    with monkeypatch.context() as patch:
        patch.setattr(owner(backend), name, failure)
        report = backend.update()
    assert report.status is Status.FAILED
    assert 'broken on purpose' in report.reason
    assert_same_value(state(backend), before)
    assert snapshot(backend.graph) == graph
    np.testing.assert_array_equal(backend.estimate().path.poses, estimate.path.poses)
    # nothing is lost either
    assert len(backend._pipeline.queue) + backend.n_quarantined == waiting
    assert backend.optimize().status is Status.CONVERGED
    whole = PoseGraphBackend(CONFIG)
    drive(whole, 0, 8)
    drive(whole, 8, 16)
    whole.optimize()
    if not aligned:
        return
    np.testing.assert_allclose(
        backend.estimate().path.poses, whole.estimate().path.poses, atol=1e-6)


def test_a_graph_that_was_moved_is_moved_back(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = PoseGraphBackend(CONFIG)
    drive(backend, 0, 8)
    poses = backend.graph.poses.copy()
    with monkeypatch.context() as patch:
        patch.setattr(backend._factors, 'build', fails)
        assert backend.update().status is Status.FAILED
    np.testing.assert_array_equal(backend.graph.poses, poses)
    assert not backend._alignment.is_aligned
    assert backend.optimize().status is Status.CONVERGED
    assert backend._alignment.is_aligned


def test_what_was_committed_survives_a_later_solve_that_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    backend, updates = PoseGraphBackend(CONFIG), []
    original = backend._smoother.update

    def second_fails(update: GraphUpdate, **options: bool) -> UpdateResult:
        updates.append(update)
        return is_failed(update) if len(updates) == 2 else original(update, **options)

    drive(backend, 0, 8)
    with monkeypatch.context() as patch:
        # the new weights of robust losses are solved for after the commit
        patch.setattr(backend._smoother, 'update', second_fails)
        patch.setattr(backend._reweighting, 'changes', lambda _: ({}, {0: 0.5}))
        backend.update()
    assert len(updates) == 2
    bins = backend._factors.saved()['gnss'].bins
    assert bins is not None
    assert len(bins.numbers) == 8
    assert len(bins.numbers) == np.sum(backend.graph.is_bias)


def test_an_interrupt_is_rolled_back_and_goes_through(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = PoseGraphBackend(CONFIG)
    drive(backend, 0, 8)
    before, graph = state(backend), snapshot(backend.graph)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(backend._factors, 'build', interrupted)
        with pytest.raises(KeyboardInterrupt):
            backend.update()
    assert_same_value(state(backend), before)
    assert snapshot(backend.graph) == graph
