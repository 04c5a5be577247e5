# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which of the loop closures that have passed the gate are believed, and when one is tested again.

One is believed if a clique of closures that agree along the path supports it, or if a random one
of its source would hardly pass: q p is small against 1 - q, with p the chance to pass and q the
share of its source that is doubted. If p is large, only the record q of the source speaks for it:
it is believed weakly.

Closures are tested again whenever more or less is believed, with two exceptions. Those that
contradict one another could take turns in the graph for ever, so one that was thrown out a few
times waits for the next closure to come. And the iterations of an update diverge with some: these
wait until the graph has grown, twice as long after each failure, so that all failures together
take a time in proportion to the drive.
"""

from collections.abc import Iterable

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.judgement.closure_states import ClosureStates, OUT
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.verdicts import State

# How often a closure is thrown out before it waits for the next closure to come.
MOST_TURNS = 2
# After its first failure a closure waits until the graph has grown by this share, and by at least
# so many nodes; the wait doubles so many times.
REST, LEAST_REST, MOST_DOUBLINGS = 0.02, 10, 6
_NEVER = -1


class Retests:
    """Of each closure, by number, what its next test waits for."""

    def __init__(self) -> None:
        self._round, self._turns, self._failures, self._resting = self._columns = tuple(
            GrowingArray((), np.int64) for _ in range(4))

    def append(self, count: int) -> None:
        """Append closures that were not tested yet."""
        for column, value in zip(self._columns, (_NEVER, 0, 0, 0), strict=True):
            column.append(np.full(count, value))

    def truncate(self, size: int) -> None:
        """Remove the newest closures again."""
        for column in self._columns:
            column.truncate(size)

    def select(self, kept: IntArray) -> None:
        """Keep some closures, by number."""
        for column in self._columns:
            column.select(kept)

    def due(self, now: int, next_node: int, *, failed: bool = True) -> BoolArray:
        """
        Return which closures may be tested, shape (M,).

        Parameters
        ----------
        now : int, a number that increases with what is believed
        next_node : int, next id of a node of the graph
        failed : bool, whether also those that have failed before

        """
        return np.asarray((self._round.values < now) & (self._turns.values < MOST_TURNS)
                          & ~self.resting(next_node) & (failed | (self._failures.values == 0)))

    def resting(self, next_node: int) -> BoolArray:
        """Return which closures wait for a node with an id from this on, shape (M,)."""
        return np.asarray(self._resting.values > next_node)

    def failures(self, numbers: IntArray) -> IntArray:
        """Return with how many updates some closures have failed."""
        return np.asarray(self._failures.values[numbers])

    def tested(self, numbers: IntArray | slice, now: int) -> None:
        """
        Note that closures were tested.

        Parameters
        ----------
        numbers : ndarray of int, or slice
        now : int, as in `due`

        """
        self._round.values[numbers] = now

    def again(self, numbers: Iterable[int] | slice) -> None:
        """Have closures tested, whatever was found before."""
        chosen = numbers if isinstance(numbers, slice) else [*numbers]
        self._round.values[chosen], self._resting.values[chosen] = _NEVER, 0

    def thrown_out(self, numbers: IntArray) -> None:
        """Note that closures were taken out of the graph as they do not fit any more."""
        self._turns.values[numbers] += 1

    def failed(self, numbers: Iterable[int], n_nodes: int, next_node: int) -> None:
        """
        Let closures rest, as the iterations diverge where their belief is changed.

        Parameters
        ----------
        numbers : iterable of int
        n_nodes : int, size of the graph
        next_node : int, next id of a node

        """
        chosen = [*numbers]
        doublings = np.minimum(self._failures.values[chosen], MOST_DOUBLINGS)
        self._failures.values[chosen] += 1
        self._round.values[chosen] = _NEVER
        self._resting.values[chosen] = next_node + np.maximum(
            (REST * n_nodes * 2.0**doublings).astype(np.int64), LEAST_REST)

    def begin_turns(self) -> None:
        """Let all closures in again that have taken turns, as another one has come."""
        self._turns.values[:] = 0


# A clique supports a closure if it has so many members, over so long a way [m].
CLIQUE, CLIQUE_TRAVEL = 3, 1.0
# Largest odds that a closure is wrong which is believed alone.
WRONG_ODDS = 0.02
# Chance of a random closure to pass, above which a lone one is only believed weakly.
WEAK = 0.02
# The same, below which several are believed at once, as none changes the gates of others much.
NARROW = 1e-3


class BeliefRule:
    """Chooses what is believed; it changes nothing."""

    def __init__(self, states: ClosureStates, table: ClosureTable, retests: Retests) -> None:
        self._states, self._table, self._retests = states, table, retests

    def choose(self, passed: IntArray, chance: FloatArray) -> dict[int, State]:
        """
        Return which closures that have passed are believed now.

        Of wide gates only one is, and of those that have failed before.

        Parameters
        ----------
        passed : ndarray of int, shape (M,)
        chance : ndarray, shape (M,)

        """
        chosen: dict[int, State] = {}
        failures = self._retests.failures(passed)
        for k in np.lexsort((chance, failures)).tolist():
            if (chance[k] > NARROW or failures[k] > 0) and len(chosen) > 0:
                break
            state = self._belief(int(passed[k]), float(chance[k]))
            if state.in_graph:
                chosen[int(passed[k])] = state
        return chosen

    def _belief(self, number: int, chance: float) -> State:
        """Return the state of a closure that has passed the gate."""
        good, bad = self._states.record(int(self._states.source[number]))
        alone = (bad + 1.0) * chance < WRONG_ODDS * (good + 1.0)
        if (alone and chance <= WEAK) or self.is_corroborated(
                number, self._states.decision != OUT):
            return State.BELIEVED
        return State.WEAKLY_BELIEVED if alone else State.WAITING

    def is_corroborated(self, number: int, usable: BoolArray) -> bool:
        """
        Tell whether a clique of closures that agree along the path supports one.

        Parameters
        ----------
        number : int
        usable : ndarray of bool, shape (M,), which closures may be in the clique

        """
        support = self._table.support(number, usable)
        return len(support.clique) >= CLIQUE and support.travel >= CLIQUE_TRAVEL
