# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When another set of believed closures is tried, and with which of them: see `swaps`."""

from collections.abc import Generator
import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.swaps import Found, Swap

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
