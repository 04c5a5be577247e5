# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each loop closure: columns, in the order in which closures were added."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.verdicts import Change, Decision, Judged, State
from pose_graph_ros.core.saved_columns import Choices, Integers, Numbers, Pairs, Triples
from pose_graph_ros.core.sources.constraint_queue import NewConstraint

STATES, DECISIONS = tuple(State), tuple(Decision)
WAITING, DOUBTED = STATES.index(State.WAITING), STATES.index(State.DOUBTED)
AUTO, OUT = DECISIONS.index(Decision.AUTO), DECISIONS.index(Decision.OUT)
USED = np.array([state.in_graph for state in STATES])
# Largest number of closures of a source that are not believed and judged again, and how many are
# left when there are more.
MOST_WAITING, LEFT = 20_000, 18_000
# Squared Mahalanobis distance from which on one that nobody supports is hopeless, in gates.
HOPELESS = 10.0
# Largest number of changes that are kept for the announcement.
MOST_CHANGES = 1000


@dataclass(frozen=True, slots=True)
class SavedClosures:
    """Saved state of the judgement of loop closures."""

    sources: tuple[str, ...]
    scales: Numbers
    """Of each source, the factor on its sigmas."""
    rows: Integers
    """Ids of the edges."""
    source: Integers
    """Index into `sources`."""
    stamps_ns: Pairs
    """Of the closure and of its other end [ns]."""
    state: Annotated[IntArray, Choices(State)]
    since_ns: Integers
    decision: Annotated[IntArray, Choices(Decision)]
    distance: Numbers
    """Mahalanobis distance when it was tested last, -1 if it was not [sigma]."""
    numbers: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Those in their names; empty if they are counted from 0 in each source."""
    left: Triples = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))
    """Of each source, how many have left the graph, how many of these used, and doubted."""


@dataclass(slots=True)
class Tally:
    """Closures of a source that have left the graph."""

    n: int = 0
    n_used: int = 0
    n_doubted: int = 0


class ClosureStates:
    """States of closures, with their origin."""

    def __init__(self) -> None:
        self.sources: list[str] = []
        self._edge, self._source, self._number, self._state, self._since_ns, self._decision = (
            GrowingArray((), np.int64) for _ in range(6))
        self._stamps_ns = GrowingArray((2,), np.int64)
        self._distance = GrowingArray((), np.float64)
        self._forgotten = GrowingArray((), np.bool_)
        self._gone: list[Tally] = []
        """Of each source, its closures that have left the graph."""
        self._columns = (
            self._edge, self._source, self._number, self._state, self._since_ns, self._decision,
            self._stamps_ns, self._distance, self._forgotten)
        self._changes: deque[Change] = deque(maxlen=MOST_CHANGES)

    def __len__(self) -> int:
        return len(self._edge)

    @property
    def edge(self) -> IntArray:
        """Ids of the edges, shape (M,)."""
        return self._edge.values

    @property
    def source(self) -> IntArray:
        """Indices of their sources."""
        return self._source.values

    @property
    def state(self) -> IntArray:
        """Indices of their states."""
        return self._state.values

    @property
    def stamps_ns(self) -> IntArray:
        """Stamps of the closures and of their other ends [ns], shape (M, 2)."""
        return self._stamps_ns.values

    @property
    def since_ns(self) -> IntArray:
        """Stamps of the newest odometry when they came, or their use began or ended [ns]."""
        return self._since_ns.values

    @property
    def decision(self) -> IntArray:
        """Indices of the decisions of a person."""
        return self._decision.values

    @property
    def distance(self) -> FloatArray:
        """Squared Mahalanobis distances when they were tested last; nan if they were not."""
        return self._distance.values

    @property
    def in_graph(self) -> BoolArray:
        """Whether they are in the graph with a weight above 0."""
        return np.asarray(USED[self.state])

    @property
    def forgotten(self) -> BoolArray:
        """Whether they are hopeless and not judged again."""
        return self._forgotten.values

    @property
    def judged(self) -> BoolArray:
        """Whether they are judged: no person has decided on them, and they are not forgotten."""
        return (self.decision == AUTO) & ~self.forgotten

    def record(self, source: int) -> tuple[int, int]:
        """Return how many closures of a source, by its index, are or were used, and doubted."""
        own = self.state[self.source == source]
        gone = self._gone[source]
        return (gone.n_used + int(np.count_nonzero(USED[own])),
                gone.n_doubted + int(np.count_nonzero(own == DOUBTED)))

    def n_left(self, source: int) -> tuple[int, int]:
        """Return how many closures of a source have left the graph, and how many unused."""
        gone = self._gone[source]
        return gone.n, gone.n - gone.n_used

    def numbers(self, edges: IntArray) -> IntArray:
        """Return the numbers of those of some edges, given by their ids, that are closures."""
        return np.flatnonzero(np.isin(self.edge, edges))

    def select(self, kept: IntArray) -> None:
        """Keep some closures; all others have left the graph, and are only counted."""
        dropped = np.setdiff1d(np.arange(len(self)), kept)
        for number in dropped.tolist():
            gone = self._gone[self.source[number]]
            gone.n += 1
            gone.n_used += int(USED[self.state[number]])
            gone.n_doubted += int(self.state[number] == DOUBTED)
        for column in self._columns:
            column.select(kept)

    def forget(self, source: int, supported: BoolArray) -> IntArray:
        """
        Return which closures of a source are forgotten now, if too many are not believed.

        The oldest hopeless ones leave first, then doubted ones, then those that wait.

        Parameters
        ----------
        source : int
        supported : ndarray of bool, shape (M,), which are not hopeless as others support them

        """
        kept = np.flatnonzero((self.source == source) & ~self.in_graph & self.judged)
        if len(kept) <= MOST_WAITING:
            return kept[:0]
        doubted = self.state[kept] == DOUBTED
        hopeless = doubted & ~supported[kept] & (self.distance[kept] > HOPELESS * GATE)
        order = np.lexsort((self.stamps_ns[kept, 0], ~doubted, ~hopeless))
        gone = np.sort(kept[order[:len(kept) - LEFT]])
        self.forgotten[gone] = True
        return gone

    def changes_to(self, inside: BoolArray) -> dict[int, State]:
        """Return the states of another set of believed ones, also of those that stay in it."""
        now = self.in_graph[:len(inside)]
        return {
            k: (STATES[self.state[k]] if now[k] else State.BELIEVED) if inside[k]
            else State.DOUBTED for k in np.flatnonzero(inside | now).tolist()}

    def name(self, number: int) -> str:
        """Return the id of a closure."""
        return f'{self.sources[self.source[number]]}/{self._number.values[number]}'

    def find(self, name: str) -> int:
        """Return the number of the closure with an id, -1 if there is none in the graph."""
        source, _, text = name.rpartition('/')
        if source not in self.sources or not text.isdecimal():
            return -1
        found = np.flatnonzero((self.source == self.sources.index(source))
                               & (self._number.values == int(text)))
        return int(found[0]) if len(found) > 0 else -1

    def has_left(self, name: str) -> bool:
        """Return whether the closure with an id was in the graph, and is no more."""
        source, _, text = name.rpartition('/')
        return (source in self.sources and text.isdecimal() and self.find(name) < 0
                and int(text) < self._next_number(self.sources.index(source)))

    def _next_number(self, source: int) -> int:
        return self._gone[source].n + int(np.count_nonzero(self.source == source))

    def _add_source(self, name: str) -> None:
        self.sources.append(name)
        self._gone.append(Tally())

    def append(self, new: Sequence[NewConstraint], now_ns: int) -> None:
        """Append closures that wait."""
        for one in new:
            if one.source not in self.sources:
                self._add_source(one.source)
            source = self.sources.index(one.source)
            self._number.append_one(self._next_number(source))
            self._edge.append_one(one.number)
            self._source.append_one(source)
            self._stamps_ns.append_one((one.stamp_ns, one.reference_ns))
            self._state.append_one(WAITING)
            self._since_ns.append_one(now_ns)
            self._decision.append_one(AUTO)
            self._distance.append_one(np.nan)
            self._forgotten.append_one(False)

    def drop(self, count: int) -> None:
        """Remove the newest closures again."""
        size = len(self) - count
        for column in self._columns:
            column.truncate(size)

    def announce(self, number: int, before: int, now_ns: int) -> None:
        """
        Note a change of the state of a closure.

        Parameters
        ----------
        number : int
        before : int, index of the state before; -1 for a new closure

        """
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

    def take_changes(self) -> list[Change]:
        """Return the changes since the last call."""
        changes = list(self._changes)
        self._changes.clear()
        return changes

    def state_of_all(self) -> tuple[IntArray, IntArray, FloatArray, list[Change]]:
        """Return copies of states, stamps, distances, and the changes to be announced."""
        return self.state.copy(), self.since_ns.copy(), self.distance.copy(), list(self._changes)

    def set_state_of_all(
        self, state: IntArray, since_ns: IntArray, distance: FloatArray, changes: list[Change],
    ) -> None:
        """
        Set what `state_of_all` has returned; there are as many closures.

        Parameters
        ----------
        state, since_ns : ndarray of int, shape (M,)
        distance : ndarray, shape (M,)

        """
        self.state[:], self.since_ns[:], self.distance[:] = state, since_ns, distance
        self._changes.clear()
        self._changes.extend(changes)

    def saved(self, scales: Sequence[float]) -> SavedClosures:
        """Return those that are in the graph, with the scales of the sources."""
        distance = np.sqrt(self.distance)
        left = [(gone.n, gone.n_used, gone.n_doubted) for gone in self._gone]
        return SavedClosures(
            tuple(self.sources), np.array(scales, dtype=np.float64), self.edge.copy(),
            self.source.copy(), self.stamps_ns.copy(), self.state.copy(), self.since_ns.copy(),
            self.decision.copy(), np.where(np.isnan(distance), -1.0, distance),
            self._number.values.copy(), np.array(left, dtype=np.int64).reshape(-1, 3))

    def restore(self, saved: SavedClosures) -> None:
        """Fill an empty table with saved columns."""
        for name in saved.sources:
            self._add_source(name)
        for gone, numbers in zip(self._gone, saved.left.tolist(), strict=False):
            gone.n, gone.n_used, gone.n_doubted = numbers
        for array, values in (
                (self._edge, saved.rows), (self._source, saved.source), (self._state, saved.state),
                (self._since_ns, saved.since_ns), (self._decision, saved.decision),
                (self._stamps_ns, saved.stamps_ns)):
            array.append(values)
        self._distance.append(np.where(
            saved.distance < 0.0, np.nan, np.square(saved.distance)))
        self._forgotten.append(np.zeros(len(saved.source), dtype=bool))
        order = np.zeros(len(saved.source), dtype=np.int64)
        for source in range(len(self.sources)):
            chosen = np.flatnonzero(saved.source == source)
            order[chosen] = np.arange(len(chosen))
        self._number.append(saved.numbers if len(saved.numbers) > 0 else order)
