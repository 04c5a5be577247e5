# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Estimates of the errors of sources, and the change of the graph to new ones.

When a source with `correlation_time` of -1 has sent enough measurements, the statistics of its
errors are estimated (`sources.error_estimate`), and again whenever there are some more. If they
differ much from those in use, the source gets a new bias, and all its measurements get edges to
it, the newest first. Where odometry drifts more than it claims, its edges get a lower weight, all
in one step, outside the timer if the graph is large. All else is done in bounded steps.
At the end of a stream the statistics are those that all measurements show, whatever was in use.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
import math

import numpy as np

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.graph_update import Measured
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.judge import Judge
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import (
    AS_CLAIMED,
    changed,
    OdometryErrors,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources import error_estimate
from pose_graph_ros.core.sources.bias import (
    Additions,
    BiasChain,
    CorrelatedErrors,
    held_by_bias,
    Process,
)
from pose_graph_ros.core.sources.error_likelihood import PastPath
from pose_graph_ros.core.sources.factor_builder import FactorBuilder, SourceState
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.transaction import succeeds

# Number of measurements that a step moves, online and at the end of a stream.
PART, WHOLE = 100, 5000
# Estimates that differ by less than this factor from what is in use change nothing online.
SIMILAR = 1.9


@dataclass(slots=True)
class _Change:
    """A change of the error model of a source that is under way."""

    source: str
    errors: CorrelatedErrors | None  # the new ones; None for white errors
    remaining: IntArray  # numbers of the measurements to be moved, the next ones last
    before: IntArray  # id of the edge that held each measurement at the beginning, or -1
    bias: BiasChain = field(default_factory=BiasChain)  # what is in the graph for it
    undoing: bool = False


@dataclass(slots=True)
class _Search:
    """An estimate that is under way."""

    source: str
    steps: error_estimate.Search
    next_estimate: int  # number of measurements at which the next one is due


class ErrorTuner:
    """Finds out whether the errors of sources are correlated, and has the graph treat them so."""

    def __init__(
        self, smoother: IncrementalSmoother, nodes: HiddenNodes, factors: FactorBuilder,
        reweighting: Reweighting, judge: Judge,
    ) -> None:
        self._smoother, self._factors, self._reweighting = smoother, factors, reweighting
        self._nodes, self._judge = nodes, judge
        self._search: _Search | None = None
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
        ends = graph.factor_records['ends'][:, 1]
        if self._change is not None or (
                self._odometry_is_due() and np.count_nonzero(ends >= 0) <= most_edges):
            before = graph.poses.copy()
            if self._change is not None:
                self._move(PART)
            else:
                self._correct_odometry(self._wanted())
            moved = np.abs(graph.poses[:len(before)] - before)[graph.is_pose[:len(before)], :2]
            return float(np.max(moved, initial=0.0))
        if self._search is None:
            self._search = self._next_search()
        if self._search is not None:
            try:
                next(self._search.steps)
            except StopIteration as end:
                search, self._search = self._search, None
                constraints = self._factors.sources[search.source]
                constraints.next_estimate = search.next_estimate
                found: error_estimate.Estimate = end.value
                if _far(constraints.odometry, found):
                    constraints.odometry = found.odometry
                if _differ(self._factors.errors_in_use(search.source), found.errors):
                    self._begin(search.source, found.errors)
        return 0.0

    @property
    def is_idle(self) -> bool:
        """Whether `step` has nothing to do."""
        return (self._change is None and self._search is None and not self._odometry_is_due()
                and len(self._factors.due_for_estimate()) == 0)

    def finish_change(self) -> None:
        """Do all that is left of a change that is under way."""
        while self._change is not None and self._move(WHOLE):
            pass
        if self._odometry_is_due() and not self._smoother.graph.has_touched:
            self._correct_odometry(self._wanted())

    def decide(self) -> None:
        """Give all sources the errors that their measurements show; for the end of a stream."""
        self.finish_change()
        self._search = None
        sources = self._factors.finding()
        if len(sources) == 0:
            return
        # what was in use depends on the order of arrival
        self._correct_odometry(self._given or AS_CLAIMED)
        # moving the measurements of one source changes none of another one
        weights = self._judge.final_weights()
        for source in sources:
            constraints = self._factors.sources[source]
            found = to_the_end(self._steps(constraints, weights))
            if found.odometry.rate != 0.0:
                found = to_the_end(self._steps(constraints, weights, reference=found.odometry))
            constraints.next_estimate = max(
                constraints.next_estimate, _next_estimate(constraints))
            constraints.odometry = found.odometry
            if found.errors != self._factors.errors_in_use(source):
                self._begin(source, found.errors)
                self.finish_change()
        self.finish_change()

    def leaving(
        self, factors: IntArray, first: int,
    ) -> tuple[list[int], Mapping[str, PastPath]]:
        """
        Return the ids of the biases that are to leave the graph with constraints.

        With it comes what the measurements among these show of the errors of their sources, for
        `forget`; `first` is the pose that is the oldest one then. At least the newest bias of a
        source stays.
        """
        graph, past = self._smoother.graph, dict[str, PastPath]()
        for source in self._factors.finding():
            constraints = self._factors.sources[source]
            used = constraints.measured.values[
                constraints.leaving(factors) & constraints.are_used(graph)]
            past[source] = error_estimate.left_behind(
                graph, self._odometry(AS_CLAIMED), used['stamp_ns'], used['id'],
                past=constraints.past, node=first)
        change = self._change
        others = {} if change is None else {change.source: change.bias}
        return self._factors.leaving_biases(factors, others, graph), past

    @property
    def needed(self) -> list[int]:
        """Ids of the poses from which odometry leads to the measurements that are left."""
        every = (self._factors.sources[source].past for source in self._factors.finding())
        return [past.node for past in every if past is not None]

    def forget(
        self, nodes: IntArray, factors: IntArray, past: Mapping[str, PastPath],
    ) -> None:
        """Forget what has left the graph, by ids; keep what `leaving` has returned of it."""
        kept, change = self._factors.forget(nodes, factors), self._change
        for source, path in past.items():
            self._factors.sources[source].past = path
        if change is None:
            return
        change.bias = change.bias.without(nodes)
        numbers = kept[change.source]
        numbers = numbers[numbers < len(change.before)]
        change.remaining = np.flatnonzero(np.isin(numbers, change.remaining))
        change.before = change.before[numbers]

    def restored(self, *, knows_errors: bool) -> None:
        """
        Follow the graph, which was loaded.

        In files of older versions (not `knows_errors`) weights stand for the noise of odometry.
        """
        graph, rows = self._smoother.graph, self._primary_rows()
        # what a loss or the judge has changed has less weight
        weight = float(np.max(graph.weights[rows], initial=0.0))
        if knows_errors or weight in (0.0, 1.0):
            return
        ids, edges = graph.factor_ids[rows], graph.factors_at(graph.factor_ids[rows])
        graph.apply(GraphUpdate(
            measure=[Measured(ids, edges.mean, weight * edges.information)],
            weigh=dict(zip(ids.tolist(), (edges.weight / weight).tolist(), strict=True))))
        self._reweighting.scale_base_weights(ids, 1.0 / weight)
        self._nodes.errors = OdometryErrors.scaled(weight**-0.5)

    @property
    def _given(self) -> OdometryErrors | None:
        """Errors of odometry that are set by a person; None if they are to be found."""
        scale = self._factors.config.odometry_scale
        return OdometryErrors.scaled(scale) if scale > 0.0 else None

    def _wanted(self) -> OdometryErrors:
        """Return the errors of odometry that are given, or that most measurements show."""
        if self._given is not None:
            return self._given
        sources = [self._factors.sources[source] for source in self._factors.finding()]
        found = max(sources, key=lambda one: one.n_ever, default=None)
        if found is None:
            return AS_CLAIMED
        # constant errors are those of one odometry; states of the graph are what calibrates it
        calibrated = self._factors.config.odometry_source(self._nodes.primary).calibrate
        if self._nodes.n_primaries > 1 or calibrated:
            return found.odometry._replace(rate=0.0, scale=0.0)
        return found.odometry

    def _odometry_is_due(self) -> bool:
        """Tell whether the odometry in the graph is to have other errors."""
        wanted = self._wanted()
        return not wanted.is_close(self._nodes.errors) and wanted != self._failed

    def _correct_odometry(self, wanted: OdometryErrors) -> None:
        """Have all primary odometry in the graph know of the errors; all or nothing."""
        graph, before = self._smoother.graph, self._nodes.errors
        if wanted.is_close(before):
            return
        edges = graph.factors_at(ids := graph.factor_ids[self._primary_rows()])
        stamps_ns = (self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, ends)]
                     for ends in (edges.i, edges.j))
        begin_ns, end_ns = stamps_ns
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

    def _next_search(self) -> _Search | None:
        for source in self._factors.due_for_estimate():
            constraints = self._factors.sources[source]
            steps = self._steps(
                constraints, self._smoother.graph.weights,
                correlated=self._factors.errors_in_use(source) is not None,
                reference=self._nodes.errors)
            return _Search(source, steps, _next_estimate(constraints))
        return None

    def _steps(
        self, constraints: SourceState, weights: FloatArray, *,
        correlated: bool = False, reference: OdometryErrors = AS_CLAIMED,
    ) -> error_estimate.Search:
        """Search with the measurements of a source that have a weight, of those given by row."""
        graph = self._smoother.graph
        used = constraints.measured.values[constraints.are_used(graph, weights)]
        path = yield from error_estimate.measured_path(
            graph, self._odometry(reference), used['stamp_ns'], used['id'], constraints.past)
        return (yield from error_estimate.search(path, correlated=correlated))

    def _odometry(self, reference: OdometryErrors) -> error_estimate.PathOdometry:
        return error_estimate.PathOdometry(
            self._nodes.ids, self._nodes.stamps_ns, self._nodes.errors, reference)

    def _begin(self, source: str, errors: CorrelatedErrors | None) -> None:
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
        additions, rows = Additions(graph.next_ids), constraints.measured.values[some]
        new = change.before[some] if change.undoing else np.full(len(some), -1)
        wanted = dict.fromkeys(held.tolist(), 0.0)
        if change.errors is None:
            wanted |= dict(zip(np.where(new >= 0, new, rows['id']).tolist(), weights.tolist(),
                               strict=True))
        else:
            table = graph.factors_at(rows['id'])
            bias = bias.with_bins(
                rows['stamp_ns'], Process.correlated(change.errors), additions, np.zeros(3))
            new = additions.add(Factors.joined([
                held_by_bias(
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


def _next_estimate(constraints: SourceState) -> int:
    """Return at how many measurements of a source the estimate after the next one is due."""
    return constraints.n_gone + math.ceil(1.3 * len(constraints))


def _far(known: OdometryErrors, found: error_estimate.Estimate) -> bool:
    """Tell whether errors of odometry differ by more than what is known of them."""
    new = found.odometry
    return (any(max(one, other) > 1.5 * min(one, other)
                for one, other in zip(known[:2], new[:2], strict=True))
            or abs(new.rate - known.rate) > found.rate_sigma
            or abs(new.scale - known.scale) > found.scale_sigma)


def _differ(one: CorrelatedErrors | None, other: CorrelatedErrors | None) -> bool:
    """Tell whether two estimates differ by more than the factor `SIMILAR` in a number."""
    if one is None or other is None:
        return one is not other
    return any(max(a, b) > SIMILAR * min(a, b) for a, b in zip(one, other, strict=True))
