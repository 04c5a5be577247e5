# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each loop closure: columns, in the order in which closures were added."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.verdicts import Change, Decision, Judged, State
from pose_graph_ros.core.saved_columns import Choices, Integers, Numbers, Pairs
from pose_graph_ros.core.sources.factor_builder import NewConstraint

STATES, DECISIONS = tuple(State), tuple(Decision)
WAITING, DOUBTED = STATES.index(State.WAITING), STATES.index(State.DOUBTED)
AUTO, OUT = DECISIONS.index(Decision.AUTO), DECISIONS.index(Decision.OUT)
_IN_GRAPH = np.array([state.in_graph for state in STATES])
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
    """Rows of the edges in the graph."""
    source: Integers
    """Index into `sources`."""
    stamps_ns: Pairs
    """Of the closure and of its other end [ns]."""
    state: Annotated[IntArray, Choices(State)]
    since_ns: Integers
    decision: Annotated[IntArray, Choices(Decision)]
    distance: Numbers
    """Mahalanobis distance when it was tested last, -1 if it was not [sigma]."""


class ClosureStates:
    """States of closures, with their origin."""

    def __init__(self) -> None:
        self.sources: list[str] = []
        self._row, self._source, self._number, self._state, self._since_ns, self._decision = (
            GrowingArray((), np.int64) for _ in range(6))
        self._stamps_ns = GrowingArray((2,), np.int64)
        self._distance = GrowingArray((), np.float64)
        self._forgotten = GrowingArray((), np.bool_)
        self._changes: deque[Change] = deque(maxlen=MOST_CHANGES)

    def __len__(self) -> int:
        return len(self._row)

    @property
    def row(self) -> IntArray:
        """Rows of the edges in the graph, shape (M,)."""
        return self._row.values

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
        """Stamps of the newest odometry when the states changed last [ns]."""
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
        """Whether they have a weight above 0."""
        return _IN_GRAPH[self.state]

    def in_graph_at(self, number: int) -> bool:
        """Return whether one of them has a weight above 0."""
        return bool(_IN_GRAPH[self.state[number]])

    @property
    def forgotten(self) -> BoolArray:
        """Whether they are hopeless and not judged again."""
        return self._forgotten.values

    @property
    def judged(self) -> BoolArray:
        """Whether they are judged: no person has decided on them, and they are not forgotten."""
        return (self.decision == AUTO) & ~self.forgotten

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
        """Return the number of the closure with an id, -1 if there is none."""
        source, _, text = name.rpartition('/')
        if source not in self.sources or not text.isdecimal():
            return -1
        found = np.flatnonzero((self.source == self.sources.index(source))
                               & (self._number.values == int(text)))
        return int(found[0]) if len(found) > 0 else -1

    def append(self, new: Sequence[NewConstraint], now_ns: int) -> None:
        """
        Append closures that wait.

        Parameters
        ----------
        new : sequence of NewConstraint
        now_ns : int

        """
        for one in new:
            if one.source not in self.sources:
                self.sources.append(one.source)
            source = self.sources.index(one.source)
            self._number.append_one(int(np.count_nonzero(self.source == source)))
            self._row.append_one(one.row)
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
        for array in (self._row, self._source, self._number, self._state, self._since_ns,
                      self._decision, self._stamps_ns, self._distance, self._forgotten):
            array.truncate(size)

    def announce(self, number: int, before: int, now_ns: int) -> None:
        """
        Note a change of the state of a closure.

        Parameters
        ----------
        number : int
        before : int, index of the state before; -1 for a new closure
        now_ns : int

        """
        after = int(self.state[number])
        source, new = self.sources[self.source[number]], STATES[after]
        if before == after:
            return
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
        changes : list of Change

        """
        self.state[:], self.since_ns[:], self.distance[:] = state, since_ns, distance
        self._changes.clear()
        self._changes.extend(changes)

    def saved(self, scales: Sequence[float]) -> SavedClosures:
        """Return all columns, with the scales of the sources."""
        distance = np.sqrt(self.distance)
        return SavedClosures(
            tuple(self.sources), np.array(scales, dtype=np.float64), self.row.copy(),
            self.source.copy(), self.stamps_ns.copy(), self.state.copy(), self.since_ns.copy(),
            self.decision.copy(), np.where(np.isnan(distance), -1.0, distance))

    def restore(self, saved: SavedClosures) -> None:
        """Fill an empty table with saved columns."""
        self.sources = list(saved.sources)
        for array, values in (
                (self._row, saved.rows), (self._source, saved.source), (self._state, saved.state),
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
        self._number.append(order)
