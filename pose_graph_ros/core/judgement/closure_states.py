# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each loop closure, in the order of addition, and why."""

from collections.abc import Sequence
import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.judgements import Column, Judgements
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import (
    AUTO,
    DOUBTED,
    Judged,
    ODOMETRY,
    SourceVerdicts,
    State,
    STATES,
    USED,
    Verdict,
    WAITING,
    WEAK,
)

NEVER = -1  # round of the last test of one that was not tested


class ClosureStates(Judgements):
    forgotten, corroborated = Column(), Column()
    round, turns, resting = Column(), Column(), Column()

    def __init__(self) -> None:
        super().__init__(
            Judged.LOOP_CLOSURE,
            forgotten=False,  # hopeless, and not judged again
            # whether a clique of closures outside of the graph supports it while it is doubted
            corroborated=False,
            # what its next test waits for, see `Retests`: round of the last one, times that it was
            # thrown out in turn, and the node until which it rests
            round=NEVER, turns=0, resting=0)

    @property
    def judged(self) -> BoolArray:
        """Whether they are judged: no person has decided on them, and they are not forgotten."""
        return (self.decision == AUTO) & ~self.forgotten

    def record(self, source: int) -> tuple[int, int]:
        """Return how many closures of a source, by its index, are or were used, and doubted."""
        counts = self.counts(source)
        return int(np.sum(counts[USED])), int(counts[DOUBTED])

    def numbers(self, edges: IntArray) -> IntArray:
        """Return the numbers of those of some edges, given by their ids, that are closures."""
        return np.flatnonzero(np.isin(self.held, edges))

    def forget(self, source: int) -> IntArray:
        """Forget closures of a source if too many are not believed, hopeless ones first."""
        kept = np.flatnonzero((self.source == source) & ~self.in_graph & self.judged)
        if len(kept) <= BELIEF.most_waiting:
            return kept[:0]
        doubted = self.state[kept] == DOUBTED
        hopeless = doubted & ~self.corroborated[kept] & (
            self.distance[kept]**2 > BELIEF.hopeless_closure * GATE)
        order = np.lexsort((self.stamps_ns[kept, 0], ~doubted, ~hopeless))
        gone = np.sort(kept[order[:len(kept) - BELIEF.left_waiting]])
        self.forgotten[gone] = True
        return gone

    def changes_to(self, inside: BoolArray) -> dict[int, State]:
        """Return the states of another set of believed ones, also of those that stay in it."""
        now = self.in_graph[:len(inside)]
        return {
            k: (STATES[self.state[k]] if now[k] else State.BELIEVED) if inside[k]
            else State.DOUBTED for k in np.flatnonzero(inside | now).tolist()}

    def totals(self, scales: Sequence[float] | None = None) -> dict[str, SourceVerdicts]:
        return {source: each._replace(n_forgotten=int(np.count_nonzero(
            self.forgotten[self.source == self.sources.index(source)])))
            for source, each in super().totals(scales).items()}

    def drawn_ids(self) -> list[IntArray]:
        """Return the ids of edges that are believed weakly, wait, and are doubted."""
        return [self.held[self.state == each] for each in (WEAK, WAITING, DOUBTED)]


class ClosureReports:
    """Tells what is decided on closures, and why."""

    def __init__(self, states: ClosureStates, table: ClosureTable) -> None:
        self._states, self._table = states, table
        # by number: how many are around, those that agree, and those that do not
        self._reasons: dict[int, tuple[int, list[int], list[int]]] = {}

    def forget(self) -> None:
        self._reasons.clear()

    def of(self, graph: Graph, numbers: Sequence[int]) -> list[Verdict]:
        states, verdicts = self._states, []
        edges = graph.factors_at(states.held[list(numbers)])
        for number, residual in zip(numbers, graph.errors(edges), strict=True):
            agree, against = self._neighbours(number)
            contradicted = [states.name(other) for other in against if USED[states.state[other]]]
            if states.distance[number] > math.sqrt(GATE):
                contradicted.insert(0, ODOMETRY)
            verdicts.append(states.verdict(
                number, residual, supported_by=agree, contradicted_by=contradicted))
        return verdicts

    def _neighbours(self, number: int) -> tuple[list[int], list[int]]:
        """Return which closures agree with one and which do not; kept until there are more."""
        crowd = self._table.crowd(number)
        kept = self._reasons.get(number)
        if kept is None or kept[0] != crowd:
            agree, against = self._table.neighbours(number)
            kept = self._reasons[number] = crowd, agree.tolist(), against.tolist()
        return kept[1:]
