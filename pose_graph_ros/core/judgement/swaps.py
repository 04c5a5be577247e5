# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Another set of believed closures, tried on a copy of the graph.

Closures that agree with one another and not with the graph may be right, and others that came
before them wrong. The copy is optimised with a clique of them forced in. Then all closures are
chosen anew by their residuals, with a limit that narrows. Sets are compared by the truncated cost

    chi2 of all that is not judged + sum over the judged closures of min(r^2, limit)

with r^2 by the floored covariances, which closures have in the copy. `SetSearch` says when, and
with which closures.
"""

from collections.abc import Generator
from dataclasses import dataclass
import math

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Parts, Status
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.error_functions import energies
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.consistency import Closures
from pose_graph_ros.core.judgement.copies import copied_rows, in_rows
from pose_graph_ros.core.solver_config import SolverConfig

_CONFIG = SolverConfig(max_iterations=20, step_tolerance=1e-3)
# Factors on the limit of r^2 in successive rounds; in the first ones the clique stays in.
NARROWING, FORCED_ROUNDS = (16.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0), 3
# By how much the truncated cost must fall.
GAIN = GATE


@dataclass(frozen=True, slots=True)
class Found:
    """A better set."""

    inside: BoolArray
    """Which closures are in it, shape (M,)."""
    nodes: IntArray
    """Ids of the hidden nodes of the copy, shape (N,)."""
    poses: FloatArray
    """Their poses, shape (N, 3)."""


class Swap:
    """
    A trial: at each step the copy is filled, or an iteration of its optimisations is done.

    In the copy nodes and edges are numbered by row.

    Parameters
    ----------
    closures : Closures, M judged ones, with floored covariances
    ids : ndarray of int, shape (M,), of their edges
    inside, free : ndarray of bool, shape (M,), which are believed, and which may change

    """

    def __init__(
        self, graph: Graph, closures: Closures, ids: IntArray, inside: BoolArray,
        free: BoolArray,
    ) -> None:
        self.ids, self.before, self.free = ids, inside, free
        self.nodes = graph.node_ids.copy()
        """Ids of the nodes of the copy."""
        self.closures = Edges(
            closures.i, closures.j, closures.mean, np.linalg.inv(closures.noise),
            graph.edges_at(ids).kind, np.ones(len(ids)))
        """With ids for ends."""
        self._rows, self._edges = graph.edge_rows(ids), in_rows(graph, self.closures)
        copied = copied_rows(graph)
        write(copied.edges, self._rows, self._edges, inside)
        self._graph = Graph()
        self._parts = self._first(copied)
        self._n_steps, self.cost = 0, np.inf
        self._inside = inside.copy()
        self.found: Found | None = None

    def _first(self, rows: GraphRows) -> Parts:
        """Fill the copy and optimise it with the present set."""
        self._graph.fill(rows)
        yield
        return (yield from optimizer.in_parts(self._graph, _CONFIG))

    def step(self, clique: IntArray) -> bool:
        """Do an iteration; tell whether the trial goes on. `found` is its result."""
        try:
            next(self._parts)
        except StopIteration as end:
            self._parts = optimizer.in_parts(self._graph, _CONFIG)
            return end.value.status is not Status.FAILED and self._goes_on(clique)
        return True

    def _goes_on(self, clique: IntArray) -> bool:
        """Compare the set that was optimised, and choose the next one; tell if there is any."""
        residual = residuals(self._graph, self._edges)
        if self._n_steps == 0:
            self.cost = self.truncated(self._graph, self._rows, residual)
            self._choose(self.before, clique)
            self._n_steps = 1
            return True
        if self._n_steps > len(NARROWING):
            return False
        limit = GATE * NARROWING[self._n_steps - 1]
        settled = limit <= GATE
        if settled and self.truncated(self._graph, self._rows, residual) < self.cost - GAIN:
            self.found = Found(self._inside.copy(), self.nodes, self._graph.poses.copy())
            self.cost = self.truncated(self._graph, self._rows, residual)
        self._n_steps += 1
        before = self._inside
        self._choose(residual < limit,
                     clique if self._n_steps <= FORCED_ROUNDS else clique[:0])
        return not (settled and np.array_equal(before, self._inside))

    def _choose(self, wanted: BoolArray, forced: IntArray) -> None:
        before = self._inside
        self._inside = np.where(self.free, wanted, self.before)
        self._inside[forced] = True
        changed = np.flatnonzero(self._inside != before)
        self._graph.apply(GraphUpdate(weigh_edges=dict(zip(
            self._rows[changed].tolist(), self._inside[changed].astype(float).tolist(),
            strict=True))))

    def truncated(self, graph: Graph, rows: IntArray, residual: FloatArray) -> float:
        """
        Return the truncated cost of a copy.

        Parameters
        ----------
        rows : ndarray of int, shape (M,), of the closures in it
        residual : ndarray, shape (M,), of `residuals`

        """
        others = np.ones(graph.n_edges, dtype=bool)
        others[rows] = False
        all_energies = graph.energies()
        chi2 = float(np.sum(all_energies.edges[others]) + np.sum(all_energies.observed))
        return chi2 + float(np.sum(np.minimum(residual[self.free], GATE))) + float(
            np.sum(residual[~self.free & self.before]))


def residuals(graph: Graph, edges: Edges) -> FloatArray:
    """
    Return r^2 of closures in a copy, shape (M,).

    Parameters
    ----------
    edges : Edges, M of them

    """
    return energies(graph.edge_errors(edges), edges.information)


def write(edges: Edges, rows: IntArray, closures: Edges, inside: BoolArray) -> None:
    """
    Write closures over those of a copy, with weight 1 or 0.

    Parameters
    ----------
    edges : Edges, all of the copy; they are changed
    rows : ndarray of int, shape (M,), of the closures
    closures : Edges, M of them
    inside : ndarray of bool, shape (M,), which of them are believed

    """
    columns = (*closures.columns[:5], inside.astype(np.float64))
    for column, values in zip(edges.columns, columns, strict=False):
        column[rows] = values


# Another set is tried when so many more closures speak for one than the last time, and half more.
MORE_CORROBORATED = 5
# Most closures from which the clique is grown that is forced in.
MOST_SEEDS = 50


class SetSearch:
    """Tries other sets, one bounded part at each call."""

    def __init__(self, states: ClosureStates, table: ClosureTable) -> None:
        self._states, self._table = states, table
        self._next = MORE_CORROBORATED
        self._parts: Generator[None, None, Found | None] | None = None
        """The trial that goes on."""
        self._began = 0
        self.found: Found | None = None
        """What the last part has ended with."""

    def work(self, graph: Graph, corroborated: BoolArray, now: int) -> bool:
        """
        Return whether there was anything to do.

        Goes on with a trial, or begins one if enough speaks against what is believed.

        Parameters
        ----------
        corroborated : ndarray of bool, shape (M,), which are supported by doubted ones
        now : int, a number that changes with what is believed, so that a trial is given up

        """
        self.found = None
        if self._parts is not None and self._began != now:
            self._parts = None
            return True
        if self._parts is None:
            against = np.flatnonzero(
                corroborated & ~self._states.in_graph & self._states.judged)
            if len(against) < self._next:
                return False
            self._next = max(len(against) + MORE_CORROBORATED, math.ceil(1.5 * len(against)))
            self._parts = self._trial(graph, self._states.edge[against[-MOST_SEEDS:]])
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
                    clique = states.edge[other] if len(other) > len(clique) else clique
            yield
        known = np.flatnonzero(~states.forgotten)
        edges = states.edge[known]
        clique = np.flatnonzero(np.isin(edges, clique))
        swap = Swap(graph, self._table.rows(known), edges, states.in_graph[known],
                    states.judged[known])
        while swap.step(clique):
            yield
        found = swap.found
        if found is None:
            return None
        # edges are in the order of their addition
        inside = np.zeros(len(states), dtype=bool)
        inside[states.numbers(edges)] = found.inside[np.isin(edges, states.edge)]
        return Found(inside, found.nodes, found.poses)
