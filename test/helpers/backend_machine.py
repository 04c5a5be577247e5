# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Any history of the back end, against the dense solution of the graph that it has led to.

Whatever comes, in whatever order, and whatever is asked for: nothing is lost, all is answered or
counted, the estimate is the minimum once it has settled, and what is saved goes on as it was.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
import math
from pathlib import Path
import tempfile
import time
import traceback
from typing import Any

from dense_graph import chi2_of, DenseGraph
from hypothesis import HealthCheck, Phase, settings, strategies as st
from hypothesis.stateful import (
    initialize,
    invariant,
    precondition,
    rule,
    RuleBasedStateMachine,
    run_state_machine_as_test,
)
import numpy as np

from pose_graph_ros.core import config as cf, measurements as ms
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.io.graph_files import read_graph, SavedGraph, write_graph
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult

SECOND = 1_000_000_000
TICK = SECOND // 5  # between two samples of odometry [ns]
POISON = 12_345.0  # a coordinate that the solver fails with [m]
# What may be left of a step to the minimum once the estimate has settled, and after a full
# optimisation [sigma].
SETTLED, OPTIMIZED = 0.1, 1e-4
SAME_PATH = 1e-9  # [m, rad]
BAD = (math.nan, math.inf, -math.inf, 1e300, -1.0, 0.0)
FIXES = 'fix', 'earth', 'pose', 'compass'
seeds = st.integers(0, 2**32 - 1)
Source = tuple[str, Any]


class Picky(IncrementalSmoother):
    """Fails, and rolls back, where a constraint has a poisoned coordinate."""

    def update(self, update: GraphUpdate, *, fall_back: bool = True) -> UpdateResult:
        if np.any(update.factors.mean[:, 0] == POISON):
            # a node on which there is nothing
            update = update._replace(hidden=np.vstack((update.hidden, np.zeros(3))))
        return super().update(update, fall_back=fall_back)


class Histories(RuleBasedStateMachine):
    """A robot that drives, what its sensors say of it, and what people do."""

    def __init__(self) -> None:
        super().__init__()
        self.rng = np.random.default_rng(0)
        self.truth = [np.zeros(3)]  # at each tick, the first one after a second
        self.odometry = [np.array((3.0, -2.0, 1.0))]
        self.late: list[Source] = []  # what has been measured and has not come yet
        self.came: list[Source] = []
        self.saved: SavedGraph | None = None
        self.since: list[Callable[[], Any]] = []  # what came since then
        self.config = BackendConfig()
        self.backend = PoseGraphBackend(self.config, Picky())
        self.begin_counting()

    @initialize(seed=seeds, limit=st.sampled_from(({}, {'nodes': 15}, {'seconds': 20.0})),
                prior=st.sampled_from(cf.WindowPrior), cell=st.sampled_from((0.0, 2.0)),
                robust=st.sampled_from(cf.Robust), calibrate=st.booleans(),
                correlation_time=st.sampled_from((0.0, cf.FOUND, 10.0)))
    def begin(self, *, seed: int, limit: dict[str, float], prior: cf.WindowPrior, cell: float,
              robust: cf.Robust, calibrate: bool, correlation_time: float) -> None:
        fixes = replace(cf.POSITIONS, robust=robust, correlation_time=correlation_time)
        self.config = BackendConfig(
            odometry={'odom': cf.OdometrySource(calibrate=calibrate)},
            window=cf.WindowConfig(prior=prior, **limit),  # type: ignore[arg-type]
            thinning=cf.ThinningConfig(cell=cell, newest=10),
            measurements={'fix': fixes, 'earth': fixes,
                          'closure': replace(cf.LOOP_CLOSURES, robust=robust)})
        self.backend = PoseGraphBackend(self.config, Picky())
        self.drive(seed, 60, 0.0, 0.2)

    # --- what comes

    @property
    def now(self) -> int:
        return self.stamp(len(self.truth) - 1)

    def stamp(self, tick: int) -> int:
        return SECOND + tick * TICK

    def begin_counting(self) -> None:
        """Begin to count what is given, and remember what there is already."""
        self.given: Counter[str] = Counter()
        self.held_before = {source: self.held(source) for source in FIXES}

    def give(self, source: str, what: Any) -> None:
        self.given[source] += 1
        self.came.append((source, what))
        self.since.append(lambda: self.give(source, what))
        add = (self.backend.add_odometry if isinstance(what, ms.OdometrySample)
               else self.backend.add_measurement)
        answer = add(what, source)
        assert (answer.reason == '') == (answer.status is ms.AnswerStatus.ACCEPTED)

    @rule(seed=seeds, n=st.integers(5, 100), mixed=st.sampled_from((0.0, 0.3)),
          measured=st.sampled_from((0.0, 0.1, 0.5)))
    def drive(self, seed: int, n: int, mixed: float, measured: float) -> None:
        """Drive on, with odometry that comes out of order, and measurements on the way."""
        rng = self.rng = np.random.default_rng(seed)
        turn, speed = rng.uniform(-0.3, 0.3), rng.choice((0.0, 0.3, 0.6))
        samples: list[ms.OdometrySample] = []
        for _ in range(n):
            moved = np.array((speed, 0.0, turn * (speed > 0.0)))
            self.truth.append(se2.compose(self.truth[-1], moved))
            slip = rng.normal(0.0, (0.02, 0.01, 0.005)) * (speed > 0.0)
            self.odometry.append(se2.compose(self.odometry[-1], moved + slip))
            samples.append(ms.OdometrySample(self.now, self.odometry[-1]))
        for k in range(len(samples) - 1):
            if rng.random() < mixed:
                samples[k], samples[k + 1] = samples[k + 1], samples[k]
        first = len(self.truth) - n
        for k, sample in enumerate(samples):
            self.give('odom', sample)
            if rng.random() < measured:
                self.give(*self.measurement(first + k, 0.0))
            if k % 20 == 19:
                self.backend.update()

    @rule(seed=seeds, n=st.integers(1, 20), wrong=st.sampled_from((0.0, 0.3)), late=st.booleans())
    def measure(self, seed: int, n: int, wrong: float, late: bool) -> None:
        """Measure at some of the newest ticks; what is late comes another time."""
        self.rng = np.random.default_rng(seed)
        for _ in range(n):
            tick = int(self.rng.integers(max(len(self.truth) - 100, 0), len(self.truth)))
            event = self.measurement(tick, off=15.0 * (self.rng.random() < wrong))
            if late:
                self.late.append(event)
            else:
                self.give(*event)

    def measurement(self, tick: int, off: float) -> Source:
        rng, true = self.rng, self.truth[tick]
        stamp = self.stamp(tick) + int(rng.integers(0, TICK))
        where = true[:2] + rng.normal(0.0, 0.3, 2) + off
        pose = np.append(where, true[2] + rng.normal(0.0, 0.03))
        cov, distance = np.diag((0.09, 0.09, 0.001)), float(np.hypot(*(true[:2] - (5.0, 9.0))))
        return (self.closure(tick, off), *(
            ('fix', ms.Position(stamp, where, cov[:2, :2], np.array(lever_arm)))
            for lever_arm in ((0.0, 0.0), (0.5, -0.2))),
            ('earth', ms.Fix(stamp, (0.0, 0.0, 0.0), lambda *_: where.copy(), cov[:2, :2],
                              np.zeros(2))),
            ('pose', ms.GlobalPose(stamp, pose, cov)),
            ('compass', ms.HeadingOnly(stamp, float(pose[2]), 0.01)),
            ('gyro', ms.YawRate(self.stamp(tick), float(rng.normal(0.05, 0.01)), 1e-4)),
            ('range', ms.Range(stamp, 'beacon', distance + off + float(rng.normal(0.0, 0.1)),
                               0.01, np.zeros(2))))[rng.integers(8)]

    def closure(self, tick: int, off: float) -> Source:
        other = int(self.rng.integers(0, len(self.truth)))
        seen = se2.between(self.truth[other], self.truth[tick]) + self.rng.normal(
            0.0, (0.05, 0.05, 0.01)) + (off, 0.0, 0.0)
        return 'closure', ms.LoopClosure(self.stamp(tick), seen, np.diag((
            0.01, 0.01, 4e-4)), reference_ns=self.stamp(other))

    @rule(seed=seeds, n=st.integers(1, 4), wrong=st.booleans())
    def close(self, seed: int, n: int, wrong: bool) -> None:
        self.rng = np.random.default_rng(seed)
        for _ in range(n):
            self.give(*self.closure(len(self.truth) - 1 - int(self.rng.integers(0, 5)),
                                    8.0 * wrong))

    @rule(seed=seeds)
    def break_one(self, seed: int) -> None:
        """Send a message with an odd number in one of its fields."""
        rng = self.rng = np.random.default_rng(seed)
        source, what = self.measurement(len(self.truth) - 1, 0.0)
        if rng.random() < 0.2:
            source, what = 'odom', ms.OdometrySample(self.now + 1, self.odometry[-1])
        name = str(rng.choice([each for each in type(what).__slots__ if each not in {
            'place', 'beacon', 'reference_node', 'twist', 'twist_variance'}]))
        value, bad = getattr(what, name), float(rng.choice(BAD))
        if isinstance(value, np.ndarray):
            value = value.copy()
            value[tuple(rng.integers(0, value.shape))] = bad
        elif isinstance(value, int):
            value = int(rng.choice((0, -1, -2**62, 2**62)))
        else:
            value = bad
        if name != 'lever_arm':     # which is no part of a message
            self.give(source, replace(what, **{name: value}))

    @rule(seed=seeds)
    def poison(self, seed: int) -> None:
        """Send what the solver fails with."""
        self.rng = np.random.default_rng(seed)
        self.give('pose', ms.GlobalPose(
            self.now - int(self.rng.integers(0, 5)) * TICK, np.array((POISON, 0.0, 0.0)),
            np.eye(3)))

    @rule(seed=seeds)
    def deliver(self, seed: int) -> None:
        """Let what is late come, in any order, and some of what came come again."""
        rng = np.random.default_rng(seed)
        again = [self.came[k] for k in rng.integers(0, len(self.came), 5)]
        events, self.late = [*self.late, *again], []
        for k in rng.permutation(len(events)).tolist():
            self.give(*events[k])

    # --- what is done

    @rule()
    def update(self) -> None:
        before = self.backend.graph.rows()
        report = self.backend.update()
        if report.status is Status.FAILED:
            assert self.backend.n_quarantined > 0
            assert report.reason != ''
            if report.new_constraints == 0 and len(before.priors) == 0:
                np.testing.assert_array_equal(
                    before.factor_ids, self.backend.graph.factor_ids[:len(before.factor_ids)])

    @rule(n=st.integers(1, 5), interrupted=st.booleans())
    def refine(self, n: int, interrupted: bool) -> None:
        for _ in range(n):
            if interrupted:
                self.backend.interrupt()
            self.backend.refine()

    @rule()
    def settle(self) -> None:
        """At rest the estimate is the minimum, as far as the smoother's accuracy goes."""
        backend = self.backend
        backend.update()
        for _ in range(2000):
            if backend.refine().finished:
                break
        else:
            raise AssertionError('it does not come to rest')
        if not backend.graph.has_touched:
            step = DenseGraph.of(backend.graph).step()
            assert np.max(np.abs(step), initial=0.0) < SETTLED

    @rule()
    def optimize(self) -> None:
        """After a full optimisation the estimate is the dense solution, with its covariance."""
        backend = self.backend
        report = backend.optimize()
        assert backend.n_quarantined < len(self.came)
        if report.status is not Status.CONVERGED or backend.graph.has_touched:
            return
        dense, graph = DenseGraph.of(backend.graph), backend.graph
        assert np.max(np.abs(dense.step()), initial=0.0) < OPTIMIZED
        row = int(graph.node_rows(graph.newest_pose))
        if not graph.fixed[row]:
            expected = dense.covariance_of(row)
            sigma = np.sqrt(np.diagonal(expected))
            np.testing.assert_allclose(
                backend._newest_node_covariance / sigma / sigma[:, None],
                expected / sigma / sigma[:, None], atol=1e-3)

    @rule(seed=seeds, decision=st.sampled_from(Decision))
    def decide(self, seed: int, decision: Decision) -> None:
        names = [each.id for each in self.backend.verdicts(20)] + ['no/0', 'fix/' + '9' * 5000]
        name = names[seed % len(names)]
        self.since.append(lambda: self.backend.decide(name, decision))
        answer = self.backend.decide(name, decision)
        assert (answer.status is ms.AnswerStatus.REJECTED) >= (name in names[-2:])

    @rule(seed=seeds)
    def set_pose(self, seed: int) -> None:
        """The robot is put elsewhere, or somebody says so."""
        pose = np.random.default_rng(seed).normal(0.0, 5.0, 3)
        self.since.append(lambda: self.set_to(pose))
        self.set_to(pose)

    def set_to(self, pose: FloatArray) -> None:
        self.backend.set_pose(ms.GlobalPose(self.now, pose, np.diag((0.1, 0.1, 0.01))), 'set')

    @rule(seed=seeds)
    def configure(self, seed: int) -> None:
        """Change settings that may change; what may not is refused, and nothing changes."""
        rng, before = np.random.default_rng(seed), self.config
        odom = before.odometry_source('odom')
        with suppress(ConfigError):
            self.backend.configure(replace(before, odometry={'odom': replace(
                odom, calibrate=not odom.calibrate)}))
            raise AssertionError('it has states for that in the graph')
        assert self.backend._config is before
        self.config = replace(
            before, nodes=cf.NodePolicy(minimum_travel_distance=rng.uniform(0.5, 2.0)),
            odometry={'odom': replace(odom, covariance_scale=rng.uniform(0.5, 2.0))},
            window=replace(before.window, nodes=int(rng.choice((0, 10, 40)))),
            thinning=replace(before.thinning, cell=float(rng.choice((0.0, 1.5)))))
        self.backend.configure(self.config)

    # --- what survives

    @rule()
    def save(self) -> None:
        """What is saved is read back, and goes on with the same path."""
        if self.backend.graph.n_nodes == 0:
            return
        saved, before = self.backend.saved(), self.backend.estimate()
        with tempfile.TemporaryDirectory() as folder:
            write_graph(saved, Path(folder, 'map'))
            self.saved = read_graph(Path(folder, 'map'))
        again = PoseGraphBackend.restored(self.config, self.saved)
        assert again.n_quarantined == self.backend.n_quarantined
        assert len(again._pipeline.queue) == len(self.backend._pipeline.queue)
        after = again.estimate()
        assert before is not None
        assert after is not None
        np.testing.assert_array_equal(before.path.stamps_ns[:-1], after.path.stamps_ns[:-1])
        difference = before.path.poses[:before.n_hidden] - after.path.poses[:before.n_hidden]
        difference[:, 2] = se2.wrap(difference[:, 2])
        assert np.max(np.abs(difference), initial=0.0) < SAME_PATH
        # what waits is not saved, and is sent again
        self.since = [lambda source=source, what=what: self.give(source, what)  # type: ignore[misc]
                      for _, source, what in self.backend._pipeline.waiting]

    def restore(self) -> None:
        assert self.saved is not None
        self.backend = PoseGraphBackend.restored(self.config, self.saved)
        self.backend._smoother.__class__ = Picky
        self.begin_counting()

    @precondition(lambda self: self.saved is not None)
    @rule()
    def undo(self) -> None:
        """Go back to what was saved; what came since comes no more."""
        self.restore()
        self.since = []

    @precondition(lambda self: self.saved is not None)
    @rule()
    def kill(self) -> None:
        """
        End the back end, and go on from what was saved and what came since.

        This is what a journal does, from its last checkpoint; its own reader belongs here.
        """
        stamps_ns = self.saved.nodes.stamps_ns  # type: ignore[union-attr]
        newest_ns = self.backend._nodes.newest_ns
        self.restore()
        again, self.since = self.since, []
        for repeat in again:
            repeat()
        self.backend.finish()
        self.backend.update()
        np.testing.assert_array_equal(self.backend.node_stamps_ns[:len(stamps_ns)], stamps_ns)
        assert self.backend._nodes.newest_ns == newest_ns

    # --- what always holds

    def held(self, source: str) -> int:
        """Return how many measurements of a source are in the graph, or wait to be added."""
        backend = self.backend
        state = backend._factors.sources.get(source)
        return (0 if state is None else state.n_ever + state.n_otherwise) + sum(
            each.source == source for each in (*backend._pipeline.queue, *backend._quarantine))

    @invariant()
    def nothing_is_lost(self) -> None:
        pipeline, counts = self.backend._pipeline, self.backend.counts
        waiting = Counter(each.source for each in pipeline.waiting)
        for source, given in self.given.items():
            refused = sum(n for key, n in counts.items()
                          if key[0] == source and key in pipeline.refusals)
            answered = counts[source, 'accepted'] + refused + waiting[source]
            # what was accepted may leave with its node before it is added
            left = counts[source, 'before_window'] + counts[source, 'dropped_unaligned']
            assert 0 <= answered - given <= left, (source, counts)
            if source in FIXES:
                added = self.held(source) - self.held_before[source]
                assert 0 <= counts[source, 'accepted'] - added <= left, (source, counts)

    @invariant()
    def the_graph_is_sound(self) -> None:
        backend, graph = self.backend, self.backend.graph
        estimate = backend.estimate()
        if estimate is None:
            return
        assert np.all(np.diff(backend.node_stamps_ns) > 0)
        assert np.all(np.diff(graph.node_ids) > 0)
        assert np.all(np.diff(graph.factor_ids) > 0)
        factors = graph.factors
        for ends in (factors.i, factors.j, factors.k):
            assert np.all(graph.node_rows(ends[ends >= 0]) >= 0)
        assert estimate.n_hidden == len(backend.node_stamps_ns) <= len(estimate.path)
        assert np.all(np.isfinite(estimate.path.poses))
        assert np.all(np.linalg.eigvalsh(estimate.covariance) > -1e-12)     # 0 if it is fixed
        chi2 = chi2_of(graph)
        assert abs(backend._smoother.chi2() - chi2) < 1e-7 * (1.0 + chi2)


SHORT = settings(max_examples=6, stateful_step_count=25, derandomize=True, deadline=None,
                 suppress_health_check=[*HealthCheck], phases=[Phase.generate])


def long_run(seconds: int) -> tuple[int, str | None]:
    """Run histories with other seeds; return their number and, if one fails, how it was."""
    begin, number = time.monotonic(), 0
    while time.monotonic() - begin < seconds:
        try:
            run_state_machine_as_test(Histories, settings=settings(
                SHORT, derandomize=False, max_examples=3, stateful_step_count=60, database=None,
                phases=[Phase.generate, Phase.shrink]))
        except Exception as error:  # whatever it is, it is a find
            return number, ''.join([*traceback.format_exception(error), *getattr(
                error, '__notes__', ())])
        number += 3
    return number, None
