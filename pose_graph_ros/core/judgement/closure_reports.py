# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is told of loop closures: verdicts with their reasons, totals, and how they are drawn."""

from collections.abc import Sequence
import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.closure_states import (
    AUTO,
    ClosureStates,
    DECISIONS,
    DOUBTED,
    STATES,
    USED,
    WAITING,
)
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.texts import ODOMETRY
from pose_graph_ros.core.judgement.verdicts import (
    Judged,
    listed,
    MOST_NAMED,
    SourceVerdicts,
    State,
    Verdict,
)

WEAK, BELIEVED = STATES.index(State.WEAKLY_BELIEVED), STATES.index(State.BELIEVED)


class ClosureReports:
    """Tells what is decided on closures, and why."""

    def __init__(self, states: ClosureStates, table: ClosureTable) -> None:
        self._states, self._table = states, table
        self._reasons: dict[int, tuple[int, list[int], list[int]]] = {}
        """By number: how many are around, those that agree, and those that do not."""

    def forget(self) -> None:
        """Forget all reasons, as closures were removed."""
        self._reasons.clear()

    def verdicts(self, graph: Graph, most_believed: int | None) -> list[Verdict]:
        """
        Return the verdicts that are listed; see `verdicts.listed`.

        Parameters
        ----------
        most_believed : int or None

        """
        states = self._states
        return self.of(graph, listed(
            states.source, states.state == BELIEVED, states.decision != AUTO,
            most_believed).tolist())

    def of(self, graph: Graph, numbers: Sequence[int]) -> list[Verdict]:
        """
        Return the verdicts on some closures.

        Parameters
        ----------
        numbers : sequence of int

        """
        edges = graph.edges_at(self._states.edge[list(numbers)])
        return [self._verdict(number, residual) for number, residual in zip(
            numbers, graph.edge_errors(edges), strict=True)]

    def _verdict(self, number: int, residual: FloatArray) -> Verdict:
        states = self._states
        agree, against = self._neighbours(number)
        contradicted = [states.name(other) for other in against if USED[states.state[other]]]
        if states.distance[number] > GATE:
            contradicted.insert(0, ODOMETRY)
        stamp, reference = states.stamps_ns[number].tolist()
        return Verdict(
            id=states.name(number), kind=Judged.LOOP_CLOSURE,
            source=states.sources[states.source[number]], stamp_ns=stamp,
            reference_ns=reference, state=STATES[states.state[number]],
            since_ns=int(states.since_ns[number]), decision=DECISIONS[states.decision[number]],
            residual=residual, distance=math.sqrt(states.distance[number]),
            supported_by=tuple(states.name(other) for other in agree[:MOST_NAMED]),
            contradicted_by=tuple(contradicted[:MOST_NAMED]), edge=True,
            number=int(states.edge[number]))

    def _neighbours(self, number: int) -> tuple[list[int], list[int]]:
        """Return which closures agree with one and which do not; kept until there are more."""
        crowd = self._table.crowd(number)
        kept = self._reasons.get(number)
        if kept is None or kept[0] != crowd:
            agree, against = self._table.neighbours(number)
            kept = self._reasons[number] = crowd, agree.tolist(), against.tolist()
        return kept[1:]

    def totals(self, scales: Sequence[float]) -> dict[str, SourceVerdicts]:
        """Return what is believed of each source, given the factors on their sigmas."""
        totals = {}
        for k, source in enumerate(self._states.sources):
            own = self._states.source == k
            n_left, n_unused = self._states.n_left(k)
            counts = np.bincount(self._states.state[own], minlength=len(STATES))
            # wrong closures among right ones are what place recognition is like
            totals[source] = SourceVerdicts(
                dict(zip(STATES, counts.tolist(), strict=True)), scales[k], doubting=False,
                n_forgotten=int(np.count_nonzero(self._states.forgotten[own])),
                n_left=n_left, n_left_unused=n_unused)
        return totals

    def drawn_ids(self) -> list[IntArray]:
        """Return the ids of edges that are believed weakly, wait, and are doubted."""
        edge, state = self._states.edge, self._states.state
        return [edge[state == each] for each in (WEAK, WAITING, DOUBTED)]
