# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One bad constraint keeps no others out: it is found, named and set aside alone."""

import math

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core import isolation
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.isolation import isolate
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample, Position
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import UpdateResult
from pose_graph_ros.core.sources.constraint_queue import Queue, QueuedEdge

SECOND = 1_000_000_000
# Mean of a constraint that the smoother of these tests cannot solve for [m].
POISON = 0.123456


class Picky(IncrementalSmoother):
    """A smoother that fails with some constraints while `picky`, and counts what it is asked."""

    picky, asked = True, 0

    def update(self, update: GraphUpdate, **options: bool) -> UpdateResult:
        self.asked += 1
        means = np.concatenate((update.edges.mean, update.observed.mean))
        if self.picky and np.any(means[:, 0] == POISON):
            return UpdateResult(Status.FAILED, 'broken on purpose', 0, 0, 0, 0)
        return super().update(update, **options)


def queue_of(numbers: range) -> Queue:
    return Queue([QueuedEdge(str(k), Edges()) for k in numbers], [])


def names(queue: Queue) -> list[int]:
    return [int(queued.source) for queued in queue.edges]


@given(st.integers(1, 200), st.data())
def test_all_but_the_bad_ones_are_added_once(n: int, data: st.DataObject) -> None:
    bad = data.draw(st.sets(st.integers(0, n - 1), min_size=1, max_size=n))
    added: list[int] = []
    attempts = []

    def attempt(part: Queue) -> str:
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
    assert len(attempts) <= min(most * len(bad), isolation.MOST_ATTEMPTS + 2)
    if len(bad) * most <= isolation.MOST_ATTEMPTS:
        assert (set(singled), len(untried)) == (bad, 0)


def driven(n_bad: int, smoother: Picky, *, aligned: bool = True) -> PoseGraphBackend:
    """Return an engine with fixes, poses and closures for the next update, some of them bad."""
    backend = PoseGraphBackend(smoother=smoother)
    rng = np.random.default_rng(2)
    for k in range(400):
        x = 0.1 * k
        backend.add_odometry(OdometrySample(SECOND + k * SECOND // 10, np.array([x, 0.0, 0.0])))
        if aligned and k == 20:
            backend.add_measurement(
                GlobalPose(2 * SECOND, np.array([1.0, 0.0, 0.0]), 0.01 * np.eye(3)), 'start')
            backend.update()
    wrong = set(rng.choice(np.arange(40, 360), n_bad, replace=False).tolist())
    for k in range(40, 360):
        x = 0.1 * k + 0.1 * rng.standard_normal()
        backend.add_measurement(Position(
            SECOND + k * SECOND // 10 + 1, np.array([POISON if k in wrong else x, 0.0]),
            0.01 * np.eye(2), np.zeros(2)), 'fix')
    backend.add_measurement(LoopClosure(
        31 * SECOND, np.array([10.0, 0.0, 0.0]), 0.01 * np.eye(3), reference_ns=21 * SECOND),
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
    # log2 of 321 constraints and a few; each success is followed by up to three reweightings
    assert smoother.asked - before <= 4 * 14
    for _ in range(3):
        backend.update()
    assert backend.graph.n_observed == 319 + aligned
    assert backend.estimate().alignment is AlignmentState.ALIGNED
    assert backend.n_quarantined == 1
    # it is tried again with the next full optimisation, and once it is good it gets in
    assert backend.optimize().status is Status.FAILED
    assert (backend.n_quarantined, backend.graph.n_observed) == (1, 319 + aligned)
    smoother.picky = False
    assert backend.optimize().status is Status.CONVERGED
    assert (backend.n_quarantined, backend.graph.n_observed) == (0, 320 + aligned)
    whole = driven(1, Picky(), aligned=aligned)
    whole._smoother.picky = False
    whole.optimize()
    np.testing.assert_allclose(
        backend.estimate().path.poses, whole.estimate().path.poses, atol=1e-6)


def test_many_bad_ones_are_set_aside_over_the_next_updates() -> None:
    smoother = Picky()
    backend = driven(20, smoother)
    quarantined = []
    while len(quarantined) < 20 and (not quarantined or quarantined[-1] < 20):
        before = smoother.asked
        backend.update()
        assert smoother.asked - before <= 4 * (isolation.MOST_ATTEMPTS + 4)
        quarantined.append(backend.n_quarantined)
    assert quarantined == sorted(set(quarantined))  # each update finds at least one
    backend.update()
    assert backend.graph.n_observed == 301
    assert all(name.startswith('fix at ') for name in backend.set_aside(3))


def test_a_stream_ends_with_all_good_ones_in_the_graph() -> None:
    backend = driven(20, Picky())
    assert backend.optimize().status is Status.FAILED
    assert (backend.n_quarantined, backend.graph.n_observed) == (20, 301)


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
    assert backend.n_quarantined == 321
    assert backend.optimize().status is Status.CONVERGED
    assert backend.graph.n_observed == 321
