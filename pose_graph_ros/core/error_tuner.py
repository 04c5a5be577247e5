# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is learnt of the noise of odometry and of sources, and the change of the graph to it.

When there are enough new measurements in the map, the noise of all is learnt (`belief.learning`).
If other noise than that in use explains the measurements better, the judge decides anew with it,
and the graph follows: where the errors of a source are slow it gets a new bias, and all its
measurements get edges to it, the newest first; edges of odometry get other weights and are without
constant errors, all in one step, outside the timer if the graph is large. All else is done in
bounded steps. At the end of a stream the noise is that which all measurements show, whatever was
in use.
"""

from dataclasses import dataclass, field
from functools import partial
import math

import numpy as np

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.belief import learning
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.graph_update import Measured
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.judge import Judge
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, changed, OdometryErrors
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources import bias as bs
from pose_graph_ros.core.sources.factor_builder import FactorBuilder, SourceState
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.transaction import succeeds

# Number of measurements that a step moves, online and at the end of a stream.
PART, WHOLE = 100, 5000
_is_close = partial(math.isclose, rel_tol=1e-9, abs_tol=1e-12)
# Slow errors that differ by less than this factor are not changed online in the graph.
ALIKE = 1.5


@dataclass(slots=True)
class _Change:
    """A change of the error model of a source that is under way."""

    source: str
    errors: bs.CorrelatedErrors | None  # the new ones; None for white errors
    remaining: IntArray  # numbers of the measurements to be moved, the next ones last
    before: IntArray  # id of the edge that held each measurement at the beginning, or -1
    bias: bs.BiasChain = field(default_factory=bs.BiasChain)  # what is in the graph for it
    undoing: bool = False


class ErrorTuner:
    """Learns how noisy odometry and sources are, and has the graph treat them so."""

    def __init__(self, smoother: IncrementalSmoother, nodes: HiddenNodes, factors: FactorBuilder,
                 reweighting: Reweighting, judge: Judge) -> None:
        self._smoother, self._factors, self._reweighting = smoother, factors, reweighting
        self._nodes, self._judge = nodes, judge
        self._search: learning.Search | None = None
        self._in_use: learning.Point | None = None  # noise that the judge decides with
        self._odometry = AS_CLAIMED  # errors of odometry that were learnt
        self._next = BANK.first_learnt  # number of measurements at which it is learnt next
        # sources whose errors are to change, one after the other
        self._waiting: dict[str, bs.CorrelatedErrors | None] = {}
        self._change: _Change | None = None
        self.n_failures = 0  # number of changes that were undone because the solver failed
        self._failed: OdometryErrors | None = None  # of odometry, with which the solver failed

    def step(self, most_edges: float = math.inf) -> float:
        """
        Do a bounded part of the work that is due; return how far a node has moved [m].

        In a graph of more than `most_edges` the odometry is not changed.
        """
        graph = self._smoother.graph
        if graph.has_touched:
            return 0.0  # an update has failed
        wanted, ends = self._wanted(), graph.factor_records['ends'][:, 1]
        if self._change is not None or (
                wanted is not None and np.count_nonzero(ends >= 0) <= most_edges):
            before = graph.poses.copy()
            if self._change is not None:
                self._move(PART)
            elif wanted is not None:
                self._correct_odometry(wanted)
            moved = np.abs(graph.poses[:len(before)] - before)[graph.is_pose[:len(before)], :2]
            return float(np.max(moved, initial=0.0))
        fixes = self._judge.fixes
        if self._begin_next() or fixes.step():
            return 0.0
        if self._search is None and fixes.n_seen >= self._next:
            fixes.prepare()
            self._search = learning.search(
                fixes.bank, fixes.known(), newest=BANK.most_learnt,
                begins=() if self._in_use is None else (self._in_use,))
            self._next = fixes.n_seen + max(1, min(
                int((BANK.next_learnt - 1.0) * fixes.n_seen), BANK.most_learnt // 4))
        if self._search is not None:
            try:
                next(self._search)
            except StopIteration as end:
                self._search = None
                found: learning.Found = end.value
                self._use(found, found.instead_of(self._in_use), BANK.most_learnt)
        return 0.0

    @property
    def is_idle(self) -> bool:
        """Whether `step` has nothing to do."""
        fixes = self._judge.fixes
        return (self._change is None and self._search is None and len(self._waiting) == 0
                and self._wanted() is None and fixes.next_bank is None
                and fixes.n_seen < self._next)

    def _use(self, found: learning.Found, learnt: learning.Learnt,
             newest: int | None = None) -> None:
        """
        Use noise that was learnt, also for judging the newest measurements, or all.

        If not all, the graph follows only where it differs much.
        """
        fixes = self._judge.fixes
        fixes.bank.by_noise = found.spread(learnt)
        if newest is None or learnt.point != self._in_use:
            self._in_use = learnt.point
            fixes.adopt(learning.noise_at(learnt.point), newest)
        if newest is None or learnt.is_far_from(self._odometry):
            self._odometry = learnt.odometry()
        for source in self._factors.finding():
            before, number = self._factors.errors_in_use(source), fixes.source(source)
            errors = None if number is None else learnt.errors(number)
            # by more than the factor `ALIKE` in a number
            differs = before is None or errors is None or any(
                max(a, b) > ALIKE * min(a, b) for a, b in zip(before, errors, strict=True))
            if errors != before and (newest is None or differs):
                self._waiting[source] = errors

    def finish_change(self) -> None:
        """Do all that is left of changes that are under way."""
        while self._change is not None or self._begin_next():
            if not self._move(WHOLE):
                break
        wanted = self._wanted()
        if wanted is not None and not self._smoother.graph.has_touched:
            self._correct_odometry(wanted)

    def decide(self) -> None:
        """Use the noise that all measurements show if they are enough, at the end of a stream."""
        self.finish_change()
        self._search = None
        fixes = self._judge.fixes
        fixes.prepare()
        if np.count_nonzero(fixes.bank.rows['decides']) < BANK.first_learnt:
            return
        # what was in use depends on the order of arrival
        memory = self._smoother.graph.memory
        found = to_the_end(learning.search(fixes.bank, fixes.known()), memory.check)
        self._use(found, found.best)
        self.finish_change()

    def leaving(self, factors: IntArray) -> list[int]:
        """
        Return the ids of the biases that are to leave the graph with constraints.

        At least the newest bias of a source stays.
        """
        change = self._change
        others = {} if change is None else {change.source: change.bias}
        return self._factors.leaving_biases(factors, others, self._smoother.graph)

    def forget(self, nodes: IntArray, factors: IntArray) -> None:
        """Forget what has left the graph, by ids."""
        kept, change = self._factors.forget(nodes, factors), self._change
        if change is None:
            return
        change.bias = change.bias.without(nodes)
        numbers = kept[change.source]
        numbers = numbers[numbers < len(change.before)]
        change.remaining = np.flatnonzero(np.isin(numbers, change.remaining))
        change.before = change.before[numbers]

    def restored(self) -> None:
        """Follow the graph, which was loaded."""
        self._odometry = self._nodes.errors

    def _wanted(self) -> OdometryErrors | None:
        """Return the errors that the odometry in the graph is to have; None if it has them."""
        config, wanted = self._factors.config, self._odometry
        # constant errors are those of one odometry; states of the graph are what calibrates it
        calibrated = config.odometry_source(self._nodes.primary).calibrate
        if config.odometry_scale > 0.0:
            wanted = OdometryErrors.scaled(config.odometry_scale)
        elif self._nodes.n_primaries > 1 or calibrated:
            wanted = OdometryErrors(wanted.way, wanted.turn)
        # but for rounding, however well they are known
        known = all(map(_is_close, wanted[:4], self._nodes.errors[:4]))
        return None if known or wanted == self._failed else wanted

    def _correct_odometry(self, wanted: OdometryErrors) -> None:
        """Have all primary odometry in the graph know of the errors; all or nothing."""
        graph, before = self._smoother.graph, self._nodes.errors
        edges = graph.factors_at(ids := graph.factor_ids[self._primary_rows()])
        begin_ns, end_ns = (self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, ends)]
                            for ends in (edges.i, edges.j))
        measured = Measured(ids, *changed(
            edges.mean, edges.information,
            np.asarray((end_ns - begin_ns) * 1e-9, dtype=np.float64), before, wanted))
        if not succeeds(self._smoother, GraphUpdate(measure=[measured])):
            self.n_failures += 1
            self._failed = wanted
            return
        self._nodes.errors = wanted
        self._judge.correct_odometry(before, wanted)

    def _primary_rows(self) -> IntArray:
        """Return the rows of the edges that the hidden nodes were made with."""
        graph = self._smoother.graph
        factors = graph.factor_records
        primary = factors['kind'] == FactorKind.ODOMETRY
        others = np.concatenate([[], *self._factors.edges().values()]).astype(np.int64)
        primary[graph.factor_rows(others)] = False
        later = graph.node_ids[factors['ends'][:, 1]]
        primary &= ~np.isin(later, self._nodes.relocated_ids)
        return np.flatnonzero(primary)

    def _begin_next(self) -> bool:
        """Begin the change of a source that waits for it; return whether there was one."""
        for source in list(self._waiting):
            errors = self._waiting.pop(source)
            if errors != self._factors.errors_in_use(source):
                self._begin(source, errors)
                return True
        return False

    def _begin(self, source: str, errors: bs.CorrelatedErrors | None) -> None:
        """Begin to change the error model of a source."""
        constraints = self._factors.sources[source]
        self._change = _Change(
            source, errors, np.arange(len(constraints)), constraints.measured['held_by'].copy())

    def _move(self, most: int) -> bool:
        """Move some measurements to the new model; return False if that has failed for good."""
        change = self._change
        assert change is not None
        constraints = self._factors.sources[change.source]
        if not change.undoing:  # those that came meanwhile
            known = len(change.before)
            change.remaining = np.append(change.remaining, np.arange(known, len(constraints)))
            change.before = np.append(change.before, constraints.measured['held_by'][known:])
        some = change.remaining[-most:]
        if self._apply(change, constraints, some):
            change.remaining = change.remaining[:len(change.remaining) - len(some)]
            if len(change.remaining) == 0:
                if change.undoing:
                    self._factors.abandon(change.bias)
                else:
                    bias = None if change.errors is None else change.bias
                    self._factors.set_errors(change.source, change.errors, bias)
                self._change = None
            return True
        if change.undoing:
            return False    # tried again at the next step
        self.n_failures += 1
        held_by = constraints.measured['held_by'][:len(change.before)]
        moved = np.flatnonzero(held_by != change.before)
        change.undoing, change.remaining, change.errors = True, moved, None
        return True

    def _apply(self, change: _Change, constraints: SourceState, some: IntArray) -> bool:
        """Have others hold some measurements; return whether the solver succeeded."""
        graph, bias = self._smoother.graph, change.bias
        held = constraints.held(some)
        weights = graph.weights[graph.factor_rows(held)]
        additions, rows = bs.Additions(graph.next_ids), constraints.measured.values[some]
        new = change.before[some] if change.undoing else np.full(len(some), -1)
        wanted = dict.fromkeys(held.tolist(), 0.0)
        if change.errors is None:
            wanted |= dict(zip(np.where(new >= 0, new, rows['id']).tolist(), weights.tolist(),
                               strict=True))
        else:
            table = graph.factors_at(rows['id'])
            bias = bias.with_bins(
                rows['stamp_ns'], bs.Process.correlated(change.errors), additions, np.zeros(3))
            new = additions.add(Factors.joined([
                bs.held_by_bias(
                    Queued(change.source, table.rows(slice(k, k + 1)), int(row['stamp_ns']),
                           noise=row['noise']), bias, change.errors)
                for k, row in enumerate(rows)]).replaced(weight=weights))
        update = additions.update()._replace(weigh=wanted)
        if not succeeds(self._smoother, update):
            return False
        change.bias = bias
        constraints.measured['held_by'][some] = new
        after = constraints.held(some)
        self._judge.moved(held, after)
        for one, to in zip(held.tolist(), after.tolist(), strict=True):
            self._reweighting.move(one, to)
        return True
