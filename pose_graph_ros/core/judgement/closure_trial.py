# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Beliefs that are tried on a copy of the graph, part by part, between the updates.

`ClosureTrial` tries changes with which the iterations of an update diverge, `SetSearch` whole
other sets. In a copy nodes and constraints are numbered by their rows; only its result has ids
again.
"""

from collections.abc import Collection, Generator, Mapping
from dataclasses import dataclass, replace
import math

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.error_functions import energies
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate, NextIds
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE, residuals
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.trial import Trial


class ClosureTrial:
    """
    One trial at a time, and the closures that have to wait for its end.

    The result is adopted if the beliefs fit there. Trials that follow one another, with no update
    between that could do without, have longer and longer pauses: also where nothing else succeeds
    any more, they take a time in proportion to the drive.
    """

    def __init__(self, smoother: IncrementalSmoother) -> None:
        self._smoother = smoother
        self._trial: Trial | None = None
        # the states that are tried, by the numbers of closures
        self.changes: dict[int, State] = {}
        self.weights: dict[int, float] = {}  # the weights that are tried, by the ids of edges
        self._is_set = False  # whether it is a whole set, whose residuals were compared already
        # numbers of closures that another update has diverged with meanwhile
        self.later: set[int] = set()
        # updates that have diverged, times `make_up`, less those that have not
        self._n_diverged = 0
        self._next_at = 0  # next id of a node from which on there may be another trial

    def begin(
        self, changes: Mapping[int, State], weights: Mapping[int, float],
        poses: FloatArray | None = None, observed: Mapping[int, float] | None = None,
    ) -> None:
        """
        Begin a trial, but during a pause; that of a whole set, with poses, does not wait for it.

        While another trial goes on, the closures are only noted for later. Changes are by the
        numbers of closures; weights of edges and of observed nodes by their ids.
        """
        if self._trial is not None:
            self.later.update(changes)
            return
        if poses is None and not self.may_solve():
            return
        self.changes, self.weights = dict(changes), dict(weights)
        self._is_set = poses is not None
        self._trial = self._smoother.trial(
            GraphUpdate(weigh_edges=self.weights, weigh_observed=observed or {}), poses)

    def may_solve(self) -> bool:
        """Tell whether all may be solved for now that an update has diverged, or in a pause."""
        most = BELIEF.make_up * (BELIEF.without_pause + BELIEF.pause_doublings)
        self._n_diverged = min(self._n_diverged + BELIEF.make_up, most)
        if self.is_pausing:
            return False
        graph = self._smoother.graph
        doublings = max(self._n_diverged // BELIEF.make_up - BELIEF.without_pause, 0)
        growth = math.ceil(BELIEF.pause * graph.n_nodes * 2**doublings)
        self._next_at = graph.next_ids.node + growth
        return True

    @property
    def is_due_or_pausing(self) -> bool:
        """Whether a copy is solved, or has to wait until the graph has grown."""
        return self._trial is not None or self.is_pausing

    @property
    def is_pausing(self) -> bool:
        """Whether the graph has to grow until the next trial, as too many updates diverge."""
        graph = self._smoother.graph
        return (self._n_diverged >= BELIEF.make_up * BELIEF.without_pause
                and graph.n_nodes > BELIEF.small and graph.next_ids.node < self._next_at)

    def was_not_needed(self) -> None:
        """Shorten the next pause, as an update has changed beliefs without a trial."""
        self._n_diverged = max(self._n_diverged - 1, 0)

    @property
    def keeps_others_out(self) -> bool:
        """Whether updates diverge as long as a trial goes on."""
        return len(self.later) > 0

    def work(self) -> bool:
        if self._trial is None:
            return False
        self._trial.work()
        return True

    @property
    def is_finished(self) -> bool:
        """Whether a trial has come to its end, and waits to be adopted or dropped."""
        return self._trial is not None and self._trial.result is not None

    @property
    def is_outdated(self) -> bool:
        """Whether the poses of the graph were set since, as an alignment with the map does."""
        return self._trial is not None and self._trial.is_outdated

    def misfits(self, table: ClosureTable) -> list[int]:
        """Return which of the closures that would be believed do not fit into the copy."""
        assert self._trial is not None
        assert self._trial.result is not None
        if self._is_set or self._trial.result.status is Status.FAILED:
            return []
        wanted = np.array(
            [k for k, state in self.changes.items() if state.in_graph], dtype=np.int64)
        fit = residuals(self._trial.graph, table.rows(wanted))
        return list(map(int, wanted[~(fit <= GATE)]))

    def adopt(self) -> bool:
        assert self._trial is not None
        return self._smoother.adopt(self._trial).status is not Status.FAILED

    def forget(self, edges: Collection[int], numbers: Collection[int]) -> None:
        """Try no longer what has left the graph."""
        self.weights = {edge: weight for edge, weight in self.weights.items()
                        if edge not in edges}
        self.changes = {k: state for k, state in self.changes.items() if k not in numbers}
        self.later -= {*numbers}

    def renumber(self, new: IntArray) -> None:
        """Follow closures that have other numbers now: `new`, shape (M,), by the old ones."""
        self.changes = {int(new[k]): state for k, state in self.changes.items()}
        self.later = {int(new[k]) for k in self.later}

    def end(self) -> None:
        self._trial, self.later = None, set()


def copied_rows(graph: Graph) -> GraphRows:
    """Return copies of all rows of a graph, with rows in place of ids."""
    rows = graph.rows()
    observed = rows.observed
    n_nodes, n_edges, n_observed = len(rows.poses), len(rows.edges), len(observed)
    return rows._replace(
        edges=rows.edges.renumbered(graph.node_rows), observed=ObservedNodes(
            graph.node_rows(observed.node), *observed.columns[1:]),
        node_ids=np.arange(n_nodes), edge_ids=np.arange(n_edges),
        observed_ids=np.arange(n_observed), next_ids=NextIds(n_nodes, n_edges, n_observed),
        priors=[replace(prior, nodes=graph.node_rows(prior.nodes)) for prior in rows.priors])


def losses_in_rows(graph: Graph, reweighting: Reweighting) -> Reweighting:
    """Return a copy of the losses of a graph, by row instead of by id."""
    edges, observed = reweighting.saved()
    copy = Reweighting()
    copy.restore(replace(edges, rows=graph.edge_rows(edges.rows)),
                 replace(observed, rows=graph.observed_rows(observed.rows)))
    return copy


@dataclass(frozen=True, slots=True)
class Found:
    inside: BoolArray  # which closures are in it, shape (M,)
    nodes: IntArray  # ids of the hidden nodes of the copy, shape (N,)
    poses: FloatArray  # their poses, shape (N, 3)


def better_set(
    graph: Graph, closures: Edges, ids: IntArray, inside: BoolArray, *, free: BoolArray,
    clique: IntArray,
) -> Generator[None, None, Found | None]:
    """
    Return a better set of closures than `inside`, if one is found by starting with a clique.

    Closures that agree with one another and not with the graph may be right, and others that came
    before them wrong. The copy is optimised with a clique of them forced in. Then all that are
    `free` are chosen anew by their residuals, with a limit that narrows. Sets are compared by the
    truncated cost: chi2 of all that is not judged, and min(r^2, limit) of each closure, with r^2
    by the floored covariances. Each step fills the copy or does one iteration.
    """
    rows, closures = graph.edge_rows(ids), closures.renumbered(graph.node_rows)
    others = np.ones(graph.n_edges, dtype=bool)
    others[rows] = False
    before, nodes, copied, copy = inside, graph.node_ids.copy(), copied_rows(graph), Graph()
    columns = (*closures.columns[:5], inside.astype(np.float64))
    for column, values in zip(copied.edges.columns, columns, strict=False):
        column[rows] = values
    copy.fill(copied)
    yield
    found, lowest, config = None, np.inf, SolverConfig(max_iterations=20, step_tolerance=1e-3)
    for n, factor in enumerate((np.inf, *BELIEF.narrowing)):
        result = yield from optimizer.in_parts(copy, config)
        if result.status is Status.FAILED:
            break
        residual = energies(copy.edge_errors(closures), closures.information)
        rest = copy.energies()
        cost = (float(np.sum(rest.edges[others]) + np.sum(rest.observed))
                + float(np.sum(np.minimum(residual[free], GATE)))
                + float(np.sum(residual[~free & before])))
        if n == 0:
            lowest = cost
        elif factor <= 1.0 and cost < lowest - GATE:
            found, lowest = Found(inside, nodes, copy.poses.copy()), cost
        chosen = np.where(free, before if n == 0 else residual < GATE * factor, before)
        if n < BELIEF.forced_rounds:
            chosen[clique] = True
        changed = np.flatnonzero(chosen != inside)
        if factor <= 1.0 and len(changed) == 0:
            break
        inside = chosen
        copy.apply(GraphUpdate(weigh_edges=dict(zip(
            rows[changed].tolist(), inside[changed].astype(float).tolist(), strict=True))))
        yield
    return found


class SetSearch:
    """Tries other sets, one bounded part at each call."""

    def __init__(self, states: ClosureStates, table: ClosureTable) -> None:
        self._states, self._table = states, table
        self._next = BELIEF.more_corroborated
        self._parts: Generator[None, None, Found | None] | None = None  # the trial that goes on
        self._began = 0
        self.found: Found | None = None  # what the last part has ended with

    def work(self, graph: Graph, now: int) -> bool:
        """Go on with a trial, or begin one if enough speaks for it; tell if there was any."""
        self.found = None
        if self._parts is not None and self._began != now:
            self._parts = None
            return True
        if self._parts is None:
            against = np.flatnonzero(
                self._states.corroborated & ~self._states.in_graph & self._states.judged)
            if len(against) < self._next:
                return False
            self._next = max(len(against) + BELIEF.more_corroborated,
                             math.ceil(1.5 * len(against)))
            self._parts = self._trial(graph, self._states.held[against[-BELIEF.most_seeds:]])
            self._began = now
        try:
            next(self._parts)
        except StopIteration as end:
            self._parts, self.found = None, end.value
        return True

    def _trial(self, graph: Graph, seeds: IntArray) -> Generator[None, None, Found | None]:
        """Return a better set, part by part; closures are ids of edges, as some may leave."""
        states, clique = self._states, seeds[:0]
        for edge in seeds.tolist():
            for number in states.numbers(np.array([edge])).tolist():
                if states.judged[number]:
                    other = self._table.support(number, ~states.in_graph & states.judged).clique
                    clique = states.held[other] if len(other) > len(clique) else clique
            yield
        known = np.flatnonzero(~states.forgotten)
        edges = states.held[known]
        clique = np.flatnonzero(np.isin(edges, clique))
        some = self._table.rows(known)
        closures = Edges(some.i, some.j, some.mean, np.linalg.inv(some.noise),
                         graph.edges_at(edges).kind, np.ones(len(known)))
        found = yield from better_set(
            graph, closures, edges, states.in_graph[known], free=states.judged[known],
            clique=clique)
        if found is None:
            return None
        # edges are in the order of their addition
        inside = np.zeros(len(states), dtype=bool)
        inside[states.numbers(edges)] = found.inside[np.isin(edges, states.held)]
        return Found(inside, found.nodes, found.poses)
