# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is solved on a copy of the graph, part by part, between the updates.

`SetSearch` looks for a set of closures that costs less, `ClosureTrial` solves the graph with it,
or with weights with which the iterations of an update diverge.
"""

from collections.abc import Mapping
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.batch.truncated import Choosing
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement import final
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.trial import Trial


class Found(NamedTuple):
    """A set of closures that costs less."""

    believed: IntArray  # ids of the edges in it
    edges: IntArray  # ids of all that it decides on
    nodes: IntArray  # ids of the hidden nodes, shape (N,)
    poses: FloatArray  # their poses, shape (N, 3)


class ClosureTrial:
    """
    The graph with other weights, solved as a copy: one at a time.

    The graph has to grow between two that are begun because an update diverges, so that all of
    them together take a time in proportion to the drive.
    """

    def __init__(self, smoother: IncrementalSmoother) -> None:
        self._smoother = smoother
        self._trial: Trial | None = None
        self.found: Found | None = None  # the set that is tried
        self.weights: dict[int, float] = {}  # the weights of its closures, by the ids of factors
        self._next_at = 0  # next id of a node from which on there may be another trial

    def begin(self, found: Found, weights: Mapping[int, float], poses: FloatArray) -> None:
        """Try a set of closures, unless a trial goes on."""
        if self._trial is None:
            self.found, self.weights = found, dict(weights)
            self._trial = self._smoother.trial(GraphUpdate(weigh=weights), poses)

    def solve_later(self, weights: Mapping[int, float]) -> None:
        """Solve for weights, by id, with which an update diverges, but during a pause."""
        if self.may_solve():
            self.found, self.weights = None, {}
            self._trial = self._smoother.trial(GraphUpdate(weigh=weights))

    def may_solve(self) -> bool:
        """Tell whether all may be solved for now that an update has diverged; else in a pause."""
        if self.is_due_or_pausing:
            return False
        graph = self._smoother.graph
        self._next_at = graph.next_ids.node + math.ceil(BELIEF.pause * graph.n_nodes)
        return True

    @property
    def is_due_or_pausing(self) -> bool:
        """Whether a copy is solved, or has to wait until the graph has grown."""
        graph = self._smoother.graph
        return self._trial is not None or (
            graph.n_nodes > BELIEF.small and graph.next_ids.node < self._next_at)

    def work(self) -> bool:
        if self._trial is None:
            return False
        self._trial.work()
        return True

    @property
    def is_finished(self) -> bool:
        """Whether a trial has come to its end, and waits to be adopted or dropped."""
        return self._trial is not None and self._trial.result is not None

    def adopt(self) -> bool:
        assert self._trial is not None
        return self._smoother.adopt(self._trial).status is not Status.FAILED

    def end(self) -> None:
        self._trial = None


class SetSearch:
    """
    Looks for a set of closures that costs less than the present one, part by part on a copy.

    It is begun while closures that agree with one another are kept out, or as an update diverges,
    but the graph has to grow by a share between two of them, so that all together take a time in
    proportion to the drive.
    """

    def __init__(self, states: ClosureStates) -> None:
        self._states = states
        self._parts: Choosing | None = None
        self._edges = self._nodes = np.empty(0, dtype=np.int64)  # ids of what it decides on
        self._next_at = 0  # next id of a node from which on there may be another one
        self._wanted = False

    def want(self) -> None:
        """Begin a search once the graph has grown enough since the last one."""
        self._wanted = True

    def _is_due(self, graph: Graph) -> bool:
        states = self._states
        against = states.corroborated & ~states.in_graph & states.judged
        if graph.next_ids.node < self._next_at or not (self._wanted or np.any(against)):
            return False
        self._next_at = graph.next_ids.node + math.ceil(BELIEF.search_again * graph.n_nodes)
        self._wanted = False
        return True

    def work(self, graph: Graph) -> tuple[bool, Found | None]:
        """Go on, or begin if there is a reason; tell if there was any, and what was found."""
        if self._parts is None:
            if not self._is_due(graph):
                return False, None
            states = self._states
            judged = np.flatnonzero(states.judged)
            self._edges, self._nodes = states.held[judged], graph.node_ids.copy()
            self._parts = final.decide(
                graph, self._edges, states.held[states.in_graph & ~states.judged],
                states.in_graph[judged])
        try:
            next(self._parts)
        except StopIteration as end:
            self._parts = None
            if end.value is not None:
                return True, Found(
                    self._edges[end.value.believed], self._edges, self._nodes, end.value.poses)
        return True, None
