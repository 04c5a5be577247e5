# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on fixes survives failures, another order of arrival and another error model."""

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, POSITIONS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.judgement.verdicts import Decision, State, Verdict
from pose_graph_ros.core.measurements import Measurement, OdometrySample, Position
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult

SECOND = 1_000_000_000
Event = OdometrySample | Measurement


def drive(
    seed: int, *, n: int = 150, tau: float = 20.0, wrong: float = 0.2, offset: bool = False,
) -> tuple[list[Event], set[int]]:
    """Return odometry and fixes of 1 m with correlated errors, and stamps of wrong ones."""
    rng = np.random.default_rng(seed)
    true, seen, events, bad = np.zeros(3), np.array((3.0, 1.0, 2.0)), [], set()
    error, kept = rng.standard_normal(2), np.exp(-1.0 / tau)
    for second in range(1, n + 1):
        step = np.array((1.0, 0.0, 0.15 * np.sin(0.2 * second)))
        slip = rng.standard_normal(3) * (0.05, 0.03, 0.01)
        true, seen = se2.compose(true, step), se2.compose(seen, se2.compose(step, slip))
        events.append(OdometrySample(second * SECOND, seen))
        error = kept * error + np.sqrt(1.0 - kept**2) * rng.standard_normal(2)
        where = true[:2] + np.sqrt(0.95) * error + np.sqrt(0.05) * rng.standard_normal(2)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        if offset and 60 <= second < 75:
            where += (30.0, -20.0)
            bad.add(second * SECOND)
        elif rng.random() < wrong and second > 5:
            where += 30.0 * np.array((np.cos(angle), np.sin(angle)))
            bad.add(second * SECOND)
        events.append(Position(second * SECOND, where, np.eye(2), np.zeros(2)))
    return events, bad


def feed(backend: PoseGraphBackend, events: list[Event], every: int = 8) -> None:
    for k, event in enumerate(events):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, 'fix')
        if k % every == every - 1:
            backend.update()


def late(events: list[Event], seed: int, delay: float = 60.0) -> list[Event]:
    """Return the events with fixes that come later, out of order."""
    random = np.random.default_rng(seed)
    when = [event.stamp_ns + (delay * SECOND * random.random() if isinstance(event, Position)
                              else 0.0) for event in events]
    return [events[k] for k in np.argsort(when, kind='stable')]


def path(backend: PoseGraphBackend) -> FloatArray:
    estimate = backend.estimate()
    assert estimate is not None
    return estimate.path.poses


def doubted(backend: PoseGraphBackend) -> set[int]:
    return {each.stamp_ns for each in backend.verdicts() if each.state is State.DOUBTED}


def _held(backend: PoseGraphBackend) -> Factors:
    """Return the factors that verdicts are on."""
    return backend.graph.factors_at([each.number for each in backend.verdicts()])


def used(backend: PoseGraphBackend, verdict: Verdict) -> bool:
    """Tell whether the row of a verdict has a weight."""
    return bool(backend.graph.weights[verdict.number] > 0.0)


def assert_weights_are_as_decided(backend: PoseGraphBackend) -> None:
    """Each measurement has a weight in the row that holds it, if it is believed, and no other."""
    constraints = backend._factors.sources['fix']
    held = constraints.held(np.arange(len(constraints)))
    rows = dict(zip(constraints.measured['stamp_ns'].tolist(), held.tolist(), strict=True))
    for verdict in backend.verdicts():
        assert verdict.number == rows[verdict.stamp_ns]
        assert used(backend, verdict) is verdict.state.in_graph
    added = constraints.measured['id']
    assert np.all(backend.graph.weights[added[added != held]] == 0.0)


@pytest.mark.parametrize('seed', [1, 2])
def test_the_end_does_not_depend_on_the_order_of_arrival(seed: int) -> None:
    events, bad = drive(seed, offset=True)
    backends = []
    for those, every in ((events, 8), (late(events, seed), 8), (late(events, seed + 1, 400.0), 3)):
        backends.append(PoseGraphBackend())
        feed(backends[-1], those, every)
        assert backends[-1].optimize().status is Status.CONVERGED
    assert bad <= doubted(backends[0])
    for other in backends[1:]:
        assert doubted(other) == doubted(backends[0])
        assert_allclose(path(other), path(backends[0]), atol=1e-9)


def test_a_decision_of_a_person_is_kept_at_the_end() -> None:
    events, bad = drive(1)
    backend = PoseGraphBackend(BackendConfig(measurements={'fix': POSITIONS}))
    feed(backend, events)
    backend.update()
    backend._tuner.decide()
    wrong, right = (next(each.id for each in backend.verdicts() if (each.stamp_ns in bad) is which)
                    for which in (True, False))
    backend.decide(wrong, Decision.IN)
    backend.decide(right, Decision.OUT)
    backend._judge.finish(ExitStack())
    states = {each.id: each.state.in_graph for each in backend.verdicts()}
    assert states[wrong]
    assert not states[right]
    assert_weights_are_as_decided(backend)


def test_what_is_doubted_stays_doubted_when_the_error_model_changes() -> None:
    events, bad = drive(1)
    backend = PoseGraphBackend(BackendConfig(measurements={'fix': POSITIONS}))
    feed(backend, events)
    while not backend.refine().finished:
        pass
    assert backend._factors.errors_in_use('fix') is not None
    verdicts = backend.verdicts()
    assert np.all(_held(backend).j >= 0)
    assert len(doubted(backend) & bad) > 0.9 * len(bad)
    assert_weights_are_as_decided(backend)
    # what is forgiven gets a weight in the row that holds it, and so does the rest at the end
    name = next(each.id for each in verdicts if not each.state.in_graph)
    backend.decide(name, Decision.IN)
    assert used(backend, next(each for each in backend.verdicts() if each.id == name))
    assert_weights_are_as_decided(backend)
    backend.optimize()
    assert_weights_are_as_decided(backend)
    # and back to white errors
    backend._tuner._waiting['fix'] = None
    backend._tuner.finish_change()
    assert np.all(_held(backend).j < 0)
    assert_weights_are_as_decided(backend)


class Flaky(IncrementalSmoother):
    """A smoother that fails, and undoes the update, while `broken`."""

    broken = False

    def update(self, update: GraphUpdate, **options: bool) -> UpdateResult:
        if not self.broken:
            return super().update(update, **options)
        self.graph.begin()
        self.graph.apply(update)
        self.graph.rollback()
        return UpdateResult(Status.FAILED, 'broken on purpose', 0, 0, 0, 0)


def everything(backend: PoseGraphBackend) -> list[object]:
    judge = backend._judge.fixes
    return [judge.states.records.tobytes(), judge.loosened,
            [base.tolist() for base in backend._reweighting['base']],
            judge.bank.rows['id'].tolist(), judge._slips]


def test_a_failed_update_that_would_turn_a_decision_changes_nothing() -> None:
    # the first 15 fixes are off by the same vector: half a minute later they are thrown out
    events, _ = drive(3, n=90, wrong=0.1)
    events = [replace(event, position=event.position + np.array((40.0, 0.0)))
              if isinstance(event, Position) and event.stamp_ns <= 15 * SECOND else event
              for event in events]
    config = BackendConfig(measurements={'fix': replace(POSITIONS, correlation_time=0.0)})
    smoother = Flaky(config.smoother)
    backend, n_turned = PoseGraphBackend(config, smoother=smoother), 0
    judge = backend._judge.fixes
    for k, event in enumerate(events):
        feed(backend, [event])
        if k % 2 == 0:
            continue
        before, n = everything(backend), len(judge.states)
        smoother.broken = True
        change = backend._factors.build(backend._pipeline.queue, backend.graph)
        backend._judge.before(backend._factors.new, change, 0)
        n_turned += judge.states.records[:n].tobytes() != before[0]
        backend._judge.rollback()
        assert everything(backend) == before
        smoother.broken = False
        backend.update()
    assert n_turned >= 1
    assert {second * SECOND for second in range(1, 16)} <= doubted(backend)


def test_the_covariance_is_wide_while_nobody_can_tell_which_fixes_are_wrong() -> None:
    """Fixes are wrong from the start on; then they, or the later ones, may be those in a fault."""
    events, _ = drive(0, wrong=0.0, tau=1e-3, n=70)
    backend, sigmas = PoseGraphBackend(BackendConfig(measurements={'fix': POSITIONS})), {}
    for event in events:
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
            continue
        second = event.stamp_ns // SECOND
        aside = np.array((30.0, -20.0)) * (second <= 30)
        backend.add_measurement(replace(event, position=event.position + aside), 'fix')
        backend.update()
        while not backend.refine().finished:
            pass
        if (estimate := backend.estimate()) is None:
            continue
        error = np.hypot(*(estimate.T_map_base[:2] - event.position))
        sigmas[second] = float(np.sqrt(np.trace(estimate.covariance[:2, :2])))
        assert error < 8.0 * sigmas[second] or second <= 32
    assert sigmas[29] < 1.0         # nothing speaks against them yet
    assert 3.0 < sigmas[36] < sigmas[55]
