# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each loop closure: columns, in the order of addition, and verdicts."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Annotated

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import ODOMETRY
from pose_graph_ros.core.judgement.verdicts import (
    Change,
    Column,
    Decision,
    Judged,
    Judgements,
    listed,
    MOST_NAMED,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.saved_columns import Choices, Integers, Numbers, Pairs, Triples
from pose_graph_ros.core.sources.source_constraints import NewConstraint

NEVER = -1  # round of the last test of one that was not tested
STATES, DECISIONS = tuple(State), tuple(Decision)
WAITING, WEAK, BELIEVED, DOUBTED = (STATES.index(state) for state in (
    State.WAITING, State.WEAKLY_BELIEVED, State.BELIEVED, State.DOUBTED))
AUTO, OUT = DECISIONS.index(Decision.AUTO), DECISIONS.index(Decision.OUT)
USED = np.array([state.in_graph for state in STATES])


@dataclass(frozen=True, slots=True)
class SavedClosures:
    sources: tuple[str, ...]
    scales: Numbers  # of each source, the factor on its sigmas
    rows: Integers  # ids of the edges
    source: Integers  # index into `sources`
    stamps_ns: Pairs  # of the closure and of its other end [ns]
    state: Annotated[IntArray, Choices(State)]
    since_ns: Integers
    decision: Annotated[IntArray, Choices(Decision)]
    distance: Numbers  # Mahalanobis distance when it was tested last, -1 if it was not [sigma]
    # those in their names; empty if they are counted from 0 in each source
    numbers: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    # of each source, how many have left the graph, how many of these used, and doubted
    left: Triples = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))


CLOSURE = np.dtype([
    ('edge', np.int64),  # id of its edge
    ('source', np.int64),  # index of its source
    ('number', np.int64),  # in its name
    ('stamps_ns', np.int64, (2,)),  # of the closure and of its other end
    ('state', np.int64),  # index of its state
    ('since_ns', np.int64),  # newest odometry when it came, or its use began or ended
    ('decision', np.int64),  # index of what a person has decided
    ('distance', np.float64),  # squared Mahalanobis, when it was tested last; nan if it was not
    ('forgotten', np.bool_),  # hopeless, and not judged again
    # whether a clique of closures outside of the graph supports it while it is doubted
    ('corroborated', np.bool_),
    # what its next test waits for, see `Retests`: round of the last one, times that it was thrown
    # out in turn, updates that have diverged with it, and the node until which it rests
    ('round', np.int64), ('turns', np.int64), ('failures', np.int64), ('resting', np.int64),
])


class ClosureStates(Judgements):
    edge, state, stamps_ns, since_ns = Column(), Column(), Column(), Column()
    decision, distance, forgotten, corroborated = Column(), Column(), Column(), Column()
    round, turns, failures, resting = Column(), Column(), Column(), Column()

    def __init__(self) -> None:
        super().__init__(CLOSURE, n_left=3)  # of these some were used, and some doubted

    @property
    def in_graph(self) -> BoolArray:
        return np.asarray(USED[self.state])

    @property
    def judged(self) -> BoolArray:
        """Whether they are judged: no person has decided on them, and they are not forgotten."""
        return (self.decision == AUTO) & ~self.forgotten

    def record(self, source: int) -> tuple[int, int]:
        """Return how many closures of a source, by its index, are or were used, and doubted."""
        own = self.state[self.source == source]
        _, n_used, n_doubted = self._left[source]
        return (n_used + int(np.count_nonzero(USED[own])),
                n_doubted + int(np.count_nonzero(own == DOUBTED)))

    def n_left(self, source: int) -> tuple[int, int]:
        """Return how many closures of a source have left the graph, and how many unused."""
        n, n_used, _ = self._left[source]
        return n, n - n_used

    def numbers(self, edges: IntArray) -> IntArray:
        """Return the numbers of those of some edges, given by their ids, that are closures."""
        return np.flatnonzero(np.isin(self.edge, edges))

    def select(self, kept: IntArray) -> None:
        """Keep some closures; all others have left the graph, and are only counted."""
        dropped = np.setdiff1d(np.arange(len(self)), kept)
        for number in dropped.tolist():
            left, state = self._left[self.source[number]], self.state[number]
            left[:] = left[0] + 1, left[1] + int(USED[state]), left[2] + int(state == DOUBTED)
        self._records.select(kept)

    def forget(self, source: int) -> IntArray:
        """Forget closures of a source if too many are not believed, hopeless ones first."""
        kept = np.flatnonzero((self.source == source) & ~self.in_graph & self.judged)
        if len(kept) <= BELIEF.most_waiting:
            return kept[:0]
        doubted = self.state[kept] == DOUBTED
        hopeless = doubted & ~self.corroborated[kept] & (
            self.distance[kept] > BELIEF.hopeless_closure * GATE)
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

    def append(self, new: Sequence[NewConstraint], now_ns: int) -> None:
        for one in new:
            source = self.index_of(one.source)
            self._records.append_one(np.array((
                one.number, source, self.next_number(source), (one.stamp_ns, one.reference_ns),
                WAITING, now_ns, AUTO, np.nan, False, False, NEVER, 0, 0, 0), dtype=CLOSURE))

    def drop(self, count: int) -> None:
        self._records.truncate(len(self) - count)

    def announce(self, number: int, before: int, now_ns: int) -> None:
        after = int(self.state[number])
        source, new = self.sources[self.source[number]], STATES[after]
        if before == after:
            return
        # one that has waited is as little used if it is doubted
        if before < 0 or new.in_graph != STATES[before].in_graph:
            self.since_ns[number] = now_ns
        if before >= 0 or not new.in_graph:
            self._changes.append(Change(
                self.name(number), Judged.LOOP_CLOSURE, source, int(self.stamps_ns[number, 0]),
                None if before < 0 else STATES[before], new))

    def saved(self, scales: Sequence[float]) -> SavedClosures:
        distance = np.sqrt(self.distance)
        return SavedClosures(
            tuple(self.sources), np.array(scales, dtype=np.float64), self.edge.copy(),
            self.source.copy(), self.stamps_ns.copy(), self.state.copy(), self.since_ns.copy(),
            self.decision.copy(), np.where(np.isnan(distance), -1.0, distance),
            self.records['number'].copy(), np.array(self._left, dtype=np.int64).reshape(-1, 3))

    def restore(self, saved: SavedClosures) -> None:
        distance = np.where(saved.distance < 0.0, np.nan, np.square(saved.distance))
        self.fill(saved.sources, saved.left, saved.numbers, {
            'edge': saved.rows, 'source': saved.source, 'stamps_ns': saved.stamps_ns,
            'state': saved.state, 'since_ns': saved.since_ns, 'decision': saved.decision,
            'distance': distance, 'round': NEVER})


class ClosureReports:
    """Tells what is decided on closures, and why."""

    def __init__(self, states: ClosureStates, table: ClosureTable) -> None:
        self._states, self._table = states, table
        # by number: how many are around, those that agree, and those that do not
        self._reasons: dict[int, tuple[int, list[int], list[int]]] = {}

    def forget(self) -> None:
        self._reasons.clear()

    def verdicts(self, graph: Graph, most_believed: int | None) -> list[Verdict]:
        states = self._states
        return self.of(graph, listed(
            states.source, states.state == BELIEVED, states.decision != AUTO,
            most_believed).tolist())

    def of(self, graph: Graph, numbers: Sequence[int]) -> list[Verdict]:
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
