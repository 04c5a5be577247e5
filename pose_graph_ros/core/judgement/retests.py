# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
When a loop closure is tested again.

That is so whenever more or less is believed, with two exceptions. Closures that contradict one
another could take turns in the graph for ever, so one that was thrown out a few times waits for
the next closure to come. And the iterations of an update diverge with some: these wait until the
graph has grown, twice as long after each failure, so that all failures together take a time in
proportion to the drive.
"""

from collections.abc import Iterable

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray

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
