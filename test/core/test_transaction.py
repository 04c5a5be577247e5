# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A failed update leaves everything as it was; constraints that make it fail are set aside."""

from collections.abc import Callable
from copy import deepcopy
import math
from typing import Any

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import snapshot
from saved_graphs import assert_same_value

from pose_graph_ros.core import transaction
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource, OdometrySource
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample, Position
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.transaction import isolate

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
        'factors': backend._factors.saved(), 'losses': deepcopy(backend._reweighting),
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


# Mean of a constraint that the smoother of these tests cannot solve for [m].
POISON = 0.123456


class Picky(IncrementalSmoother):
    """A smoother that fails with some constraints while `picky`, and counts what it is asked."""

    picky, asked = True, 0

    def update(self, update: GraphUpdate, **options: bool) -> UpdateResult:
        self.asked += 1
        if self.picky and np.any(update.factors.mean[:, 0] == POISON):
            return UpdateResult(Status.FAILED, 'broken on purpose', 0, 0, 0, 0)
        return super().update(update, **options)


def queue_of(numbers: range) -> list[Queued]:
    return [Queued(str(k), Factors()) for k in numbers]


def names(queue: list[Queued]) -> list[int]:
    return [int(queued.source) for queued in queue]


@given(st.integers(1, 200), st.data())
def test_all_but_the_bad_ones_are_added_once(n: int, data: st.DataObject) -> None:
    bad = data.draw(st.sets(st.integers(0, n - 1), min_size=1, max_size=n))
    added: list[int] = []
    attempts = []

    def attempt(part: list[Queued]) -> str:
        attempts.append(len(part))
        if bad.isdisjoint(names(part)):
            added.extend(names(part))
            return ''
        return 'bad'

    found, untried = isolate(queue_of(range(n)), 'bad', attempt)
    singled = [number for one, _ in found for number in names(one)]
    assert sorted([*added, *singled, *names(untried)]) == list(range(n))
    assert bad.issuperset(singled)
    assert len(singled) > 0
    assert 0 not in attempts
    most = math.ceil(math.log2(n)) + 2
    assert len(attempts) <= min(most * len(bad), transaction.MOST_ATTEMPTS + 2)
    if len(bad) * most <= transaction.MOST_ATTEMPTS:
        assert (set(singled), len(untried)) == (bad, 0)


def driven(n_bad: int, smoother: Picky, *, aligned: bool = True) -> PoseGraphBackend:
    """Return an engine with fixes, poses and closures for the next update, some of them bad."""
    backend = PoseGraphBackend(smoother=smoother)
    rng = np.random.default_rng(2)
    for k in range(200):
        x = 0.1 * k
        backend.add_odometry(OdometrySample(SECOND + k * SECOND // 10, np.array([x, 0.0, 0.0])))
        if aligned and k == 20:
            backend.add_measurement(
                GlobalPose(2 * SECOND, np.array([1.0, 0.0, 0.0]), 0.01 * np.eye(3)), 'start')
            backend.update()
    wrong = set(rng.choice(np.arange(40, 160), n_bad, replace=False).tolist())
    for k in range(40, 160):
        x = 0.1 * k + 0.1 * rng.standard_normal()
        backend.add_measurement(Position(
            SECOND + k * SECOND // 10 + 1, np.array([POISON if k in wrong else x, 0.0]),
            0.01 * np.eye(2), np.zeros(2)), 'fix')
    backend.add_measurement(LoopClosure(
        18 * SECOND, np.array([10.0, 0.0, 0.0]), 0.01 * np.eye(3), reference_ns=8 * SECOND),
        'scan')
    return backend


@pytest.mark.parametrize('aligned', [True, False])
def test_one_bad_fix_of_many_is_set_aside_by_its_name(aligned: bool) -> None:
    smoother = Picky()
    backend = driven(1, smoother, aligned=aligned)
    before = smoother.asked
    report = backend.update()
    assert report.status is Status.FAILED
    assert backend.n_quarantined == 1
    (name,) = backend.set_aside(3)
    assert name.startswith('fix at ')
    assert report.reason == f'{name}: broken on purpose'
    assert backend.counts['solver', 'failed'] == 1
    # log2 of 121 constraints and a few; each success is followed by up to three reweightings
    assert smoother.asked - before <= 4 * 14
    for _ in range(3):
        backend.update()
    assert len(backend.graph.factors.observed) == 119 + aligned
    assert backend.estimate().alignment is AlignmentState.ALIGNED
    assert backend.n_quarantined == 1
    # it is tried again with the next full optimisation, and once it is good it gets in
    assert backend.optimize().status is Status.FAILED
    assert (backend.n_quarantined, len(backend.graph.factors.observed)) == (1, 119 + aligned)
    smoother.picky = False
    assert backend.optimize().status is Status.CONVERGED
    assert (backend.n_quarantined, len(backend.graph.factors.observed)) == (0, 120 + aligned)
    whole = driven(1, Picky(), aligned=aligned)
    whole._smoother.picky = False
    whole.optimize()
    np.testing.assert_allclose(
        backend.estimate().path.poses, whole.estimate().path.poses, atol=1e-6)


def test_a_stream_ends_with_all_good_ones_in_the_graph() -> None:
    backend = driven(20, Picky())
    assert backend.optimize().status is Status.FAILED
    assert (backend.n_quarantined, len(backend.graph.factors.observed)) == (20, 101)


def test_a_solver_that_always_fails_is_not_asked_for_each_constraint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    smoother = Picky()
    backend = driven(0, smoother)
    with monkeypatch.context() as patch:
        patch.setattr(IncrementalSmoother, 'update', lambda *_, **__: UpdateResult(
            Status.FAILED, 'out of order', 0, 0, 0, 0))
        before = smoother.asked
        assert backend.update().reason == 'out of order'
        assert smoother.asked == before + 2
    assert backend.n_quarantined == 121
    assert backend.optimize().status is Status.CONVERGED
    assert len(backend.graph.factors.observed) == 121
