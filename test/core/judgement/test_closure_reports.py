# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is told of closures: quick ways against slow ones, and decisions of a person."""

from dataclasses import replace
import math

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, LOOP_CLOSURES, Loss, Robust
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement import closures
from pose_graph_ros.core.judgement.closures import Closures, ClosureTable
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import Decision, WAITING
from pose_graph_ros.core.measurements import AnswerStatus, LoopClosure, OdometrySample
from pose_graph_ros.core.sources.queued import Queued

UNSEEN = Factors.joined([])  # what a record does not look at

SECOND = 10**9
LAP = 60  # duration of a round [s]


def true_pose(seconds: float) -> np.ndarray:
    """A circle of 20 m radius."""
    angle = 2.0 * math.pi * seconds / LAP
    return se2.wrapped(np.array([20.0 * math.sin(angle), 20.0 * (1.0 - math.cos(angle)), angle]))


def driven(*wrong: float, last: int = LAP + 20) -> PoseGraphBackend:
    """Return an engine after a round and a bit, with closures that are wrong by so much [m]."""
    backend = PoseGraphBackend()
    for second in range(1, last + 1):
        backend.add_odometry(OdometrySample(second * SECOND, true_pose(second)))
    backend.finish()
    backend.update()
    for number, error in enumerate(wrong):
        at = LAP + 2 + number
        z = se2.between(true_pose(at - LAP), true_pose(at)) + np.array((0.0, error, 0.0))
        backend.add_measurement(LoopClosure(
            at * SECOND, z, np.diag((0.01, 0.01, 0.0025)), (at - LAP) * SECOND), 'loop')
        backend.update()
        while not backend.refine().finished:
            pass
    return backend


def states(backend: PoseGraphBackend) -> list[bool]:
    return [verdict.state.in_graph for verdict in backend.verdicts()]


def settle(backend: PoseGraphBackend) -> None:
    backend.update()
    while not backend.refine().finished:
        pass


def test_verdicts_tell_origin_reason_and_error() -> None:
    backend = driven(0.0, 0.0, 0.0, 8.0)
    verdicts = backend.verdicts()
    assert [verdict.id for verdict in verdicts] == [f'loop/{k}' for k in range(4)]
    assert states(backend) == [True, True, True, False]
    assert [verdict.stamp_ns // SECOND for verdict in verdicts] == [62, 63, 64, 65]
    assert [verdict.reference_ns // SECOND for verdict in verdicts] == [2, 3, 4, 5]
    assert set(verdicts[0].supported_by) == {'loop/1', 'loop/2'}
    assert set(verdicts[3].contradicted_by) >= {'loop/0', 'loop/1', 'loop/2'}
    assert verdicts[3].distance > 4.0
    np.testing.assert_allclose(np.abs(verdicts[3].residual[1]), 8.0, atol=0.2)


def test_reasons_are_those_of_an_engine_that_keeps_none() -> None:
    backend = PoseGraphBackend()
    errors = (0.0, 8.0, 0.0, 0.1, 8.1, -7.0)
    backend = driven(*errors)
    asked_once = backend.verdicts()
    fresh = PoseGraphBackend.restored(None, backend.saved())
    for one, other in zip(asked_once, fresh.verdicts(), strict=True):
        assert (one.supported_by, one.contradicted_by, one.state) == (
            other.supported_by, other.contradicted_by, other.state)
        assert one.distance == pytest.approx(other.distance)
    # one that asks after each closure keeps reasons that grow old
    asking = driven(*errors[:2])
    asking.verdicts()
    for at, error in zip(range(LAP + 4, LAP + 8), errors[2:], strict=True):
        z = se2.between(true_pose(at - LAP), true_pose(at)) + np.array((0.0, error, 0.0))
        asking.add_measurement(LoopClosure(
            at * SECOND, z, np.diag((0.01, 0.01, 0.0025)), (at - LAP) * SECOND), 'loop')
        settle(asking)
        asking.verdicts()
    assert [(each.id, each.supported_by) for each in asking.verdicts()] == [
        (each.id, each.supported_by) for each in asked_once]


def test_a_person_overrules_and_takes_it_back() -> None:
    backend = driven(0.0, 0.0, 0.0, 8.0)
    backend.verdict_changes()
    answer = backend.decide('loop/3', Decision.IN)
    assert answer.status is AnswerStatus.ACCEPTED
    assert answer.detail.startswith('loop/3: Used')
    settle(backend)
    assert states(backend)[3]
    assert 'odometry' in backend.verdicts()[3].contradicted_by
    assert backend.decide('loop/1', Decision.OUT).status is AnswerStatus.ACCEPTED
    settle(backend)
    assert not states(backend)[1]
    backend.optimize()
    assert (states(backend)[1], states(backend)[3]) == (False, True)
    for name in ('loop/1', 'loop/3'):
        assert backend.decide(name, Decision.AUTO).status is AnswerStatus.ACCEPTED
    settle(backend)
    assert states(backend) == [True, True, True, False]
    assert all(each.decision is Decision.AUTO for each in backend.verdicts())
    changed = {change.id for change in backend.verdict_changes()}
    assert {'loop/1', 'loop/3'} <= changed
    assert backend.verdict_changes() == []


def test_a_false_one_that_was_forced_in_where_nothing_contradicts_it_goes_again() -> None:
    backend = driven(30.0)
    assert states(backend) == [False]
    backend.decide('loop/0', Decision.IN)
    settle(backend)
    assert states(backend) == [True]
    backend.decide('loop/0', Decision.AUTO)
    settle(backend)
    assert states(backend) == [False]


@pytest.mark.parametrize('name', ['loop/9', 'loop', 'loop/', 'loop/-1', 'other/0', ''])
def test_an_unknown_id_is_refused(name: str) -> None:
    answer = driven(0.0).decide(name, Decision.OUT)
    assert (answer.status, answer.reason) == (AnswerStatus.REJECTED, 'unknown_id')
    assert repr(name) in answer.detail


@pytest.mark.parametrize('robust', [Robust.LOSS, Robust.NONE])
def test_a_source_that_is_no_longer_judged_keeps_the_verdicts_so_far(robust: Robust) -> None:
    backend = driven(0.0, 8.0)
    before = states(backend)
    backend.configure(BackendConfig(measurements={'loop': replace(
        LOOP_CLOSURES, robust=robust, loss=Loss.HUBER)}))
    z = se2.between(true_pose(10), true_pose(LAP + 10)) + np.array((0.0, 3.0, 0.0))
    backend.add_measurement(LoopClosure(
        (LAP + 10) * SECOND, z, np.diag((0.01, 0.01, 0.0025)), 10 * SECOND), 'loop')
    settle(backend)
    assert len(backend.verdicts()) == len(before)
    assert backend.graph.factors.edges.weight[-1] > 0.0
    assert len(backend._reweighting) == (1 if robust is Robust.LOSS else 0)


def test_of_many_hopeless_closures_the_oldest_are_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(closures, 'BELIEF', BELIEF._replace(most_waiting=6))
    # each is so far off that none agrees with another one
    backend = driven(*(12.0 * (-1.0) ** k * (k + 2) for k in range(9)), 0.0, 0.0, 0.0, 0.0)
    total = backend.verdict_totals()['loop']
    assert total.n_forgotten == 6    # three by the seventh, three by the first right one
    assert sum(total.counts.values()) == 13
    assert states(backend) == 9 * [False] + 4 * [True]
    # whom a person decides on is judged again when that is taken back
    for decision in (Decision.OUT, Decision.AUTO):
        assert backend.decide('loop/1', decision).status is AnswerStatus.ACCEPTED
    settle(backend)
    assert backend.verdict_totals()['loop'].n_forgotten == 5
    backend.optimize()
    assert states(backend) == 9 * [False] + 4 * [True]


def test_a_decision_on_a_loaded_graph_is_since_its_newest_node() -> None:
    saved = driven(0.0, 8.0).saved()
    backend = PoseGraphBackend.restored(None, saved)
    backend.decide('loop/0', Decision.OUT)
    assert backend.verdicts()[0].since_ns == saved.nodes.stamps_ns[-1]


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_neighbours_are_those_of_a_comparison_of_all(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 60
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=np.column_stack((2.0 * np.arange(n), np.zeros((n, 2)))), fix=(0,),
        factors=Factors(np.arange(n - 1), np.arange(1, n), np.tile((2.0, 0.0, 0.0), (n - 1, 1)),
                        np.tile(np.eye(3), (n - 1, 1, 1)), [FactorKind.ODOMETRY] * (n - 1))))
    chain = OdometryChain()
    chain.extend(graph)
    table, ends = ClosureTable(chain), np.empty((0, 2), dtype=np.int64)
    for step in rng.choice(3, 8).tolist():
        if step == 0 or len(ends) < 2:
            new = np.sort(rng.integers(0, n, (int(rng.integers(1, 40)), 2)), axis=1)
            for k in range(len(new)):
                table.append(Queued('scan', UNSEEN, k, 0, number=k), 0, WAITING)
            table.measure(len(ends), Closures(
                new[:, 0], new[:, 1], np.zeros((len(new), 3)),
                np.tile(np.eye(3), (len(new), 1, 1))))
            ends = np.concatenate((ends, new))
        elif step == 1:
            ends = ends[:-1]
            table.truncate(len(ends))
        else:
            kept = np.flatnonzero(rng.random(len(ends)) < 0.8)
            table.select(kept)
            ends = ends[kept]
        usable = rng.random(len(ends)) < 0.7
        for number in rng.integers(0, len(ends), 3).tolist() if len(ends) > 0 else ():
            apart = np.max(2.0 * np.abs(ends - ends[number]), axis=1)
            others = [k for k in np.argsort(apart, kind='stable').tolist()
                      if k != number and usable[k] and apart[k] <= BELIEF.near]
            assert table.near(number, usable).tolist() == others[:BELIEF.most_compared]
