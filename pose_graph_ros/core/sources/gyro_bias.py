# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The bias of a gyroscope, as a chain of states in the graph.

Time is divided into bins; each bin with a rotation has one state [rad/s]. The bias is a random
walk: consecutive states are connected by `b_k - b_{k-1} = w, Var w = q^2 t`, with t the time
between the middles of their bins, and the first state has a prior. A rotation is an edge with
three ends: two hidden nodes, and the state of the bin in which the middle of its time lies. The
mean rate at rest is an observation of that state.

The bin of a rotation depends on the stamps of its nodes alone, and rotations come in the order of
the nodes, so the order of arrival does not matter.
"""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.gyro_config import GyroSource
from pose_graph_ros.core.odometry.turns import Turn
from pose_graph_ros.core.saved_columns import Integers, Pairs
from pose_graph_ros.core.sources.gauss_markov import Additions

# A time without rotations after which the sensor may have been switched off and on again [s].
SWITCHED_OFF = 60.0


@dataclass(frozen=True, slots=True)
class SavedGyroBias:
    """The states of the bias of one gyroscope that are in the graph."""

    width_ns: int
    """Unit of the numbers [ns]."""
    numbers: Integers
    """Increasing: the bin with number k begins at the stamp k `width_ns`."""
    ids: Integers
    """Id of each state in the graph."""
    edges: Pairs
    """Ids of the edges of its rotations, and of their states, shape (E, 2)."""


class GyroBias:
    """The bias of one gyroscope."""

    def __init__(self, source: GyroSource) -> None:
        self._source = source
        self._width_ns = round(source.bias_period * 1e9)
        self._begins_ns: list[int] = []
        """Stamp at which the bin of each state begins [ns]."""
        self._ids: list[int] = []
        self._n_before = 0

    @property
    def newest(self) -> int:
        """Id of the newest state; -1 before the first."""
        return self._ids[-1] if self._ids else -1

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._n_before = len(self._ids)

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        del self._begins_ns[self._n_before:], self._ids[self._n_before:]

    def add(self, turn: Turn, graph: Graph, additions: Additions) -> tuple[int, int]:
        """
        Return the ids of the edge that is added for a rotation, and of its state.

        Parameters
        ----------
        graph : Graph, gives the present estimate of the bias; it is not changed
        additions : Additions, receives the edge, a state if it is new, and what rest tells of it

        """
        begin_ns = turn.stamp_ns // self._width_ns * self._width_ns
        if not self._begins_ns or begin_ns > self._begins_ns[-1]:
            self._make_state(begin_ns, turn, graph, additions)
        # one that was set aside for long has the state of the bin before, if its own has none
        state = self._ids[max(bisect.bisect_right(self._begins_ns, turn.stamp_ns) - 1, 0)]
        if turn.rest_variance > 0.0:
            additions.add_observed(_observed(state, turn.rest_rate, turn.rest_variance))
        return additions.add_edge(turn_edge(turn, state)), state

    def _make_state(
        self, begin_ns: int, turn: Turn, graph: Graph, additions: Additions,
    ) -> None:
        source = self._source
        gap = (begin_ns - self._begins_ns[-1]) * 1e-9 if self._begins_ns else np.inf
        value, before = turn.rest_rate, self.newest
        if gap <= SWITCHED_OFF:
            known = int(graph.node_rows(np.array([before]))[0])
            # one of this update has no estimate yet
            value = float(graph.poses[known, 0] if known >= 0
                          else additions.biases[before - additions.first.node][0])
        state = additions.add_bias(value, dimension=1)
        self._begins_ns.append(begin_ns)
        self._ids.append(state)
        if gap <= SWITCHED_OFF:
            additions.add_edge(Edges(
                [state], [before], np.zeros((1, 3)),
                _information(source.sigma_bias_walk**2 * gap), [EdgeKind.BIAS],
                bias=np.array([(0.0, 0.0, 1.0, 0.0)])))
        else:
            additions.add_observed(_observed(state, 0.0, source.sigma_bias**2))

    def leaving(self, needed: IntArray) -> list[int]:
        """Return the states, by their ids, before the oldest one that is needed, or the newest."""
        oldest = int(np.min(needed, initial=self.newest))
        return self._ids[:bisect.bisect_left(self._ids, oldest)]

    def forget(self, nodes: set[int]) -> None:
        """Forget the states that have left the graph, by their ids."""
        kept = [k for k, state in enumerate(self._ids) if state not in nodes]
        self._begins_ns = [self._begins_ns[k] for k in kept]
        self._ids = [self._ids[k] for k in kept]

    def begin_ns(self, state: int) -> int | None:
        """Return when the bin of a state begins [ns], by its id; None for another source's."""
        at = bisect.bisect_left(self._ids, state)
        known = at < len(self._ids) and self._ids[at] == state
        return self._begins_ns[at] if known else None

    def saved(self, edges: IntArray) -> SavedGyroBias:
        """Return all states, with the edges of its rotations."""
        # a restored chain may have begun with bins of another width
        unit_ns = math.gcd(self._width_ns, *self._begins_ns)
        return SavedGyroBias(unit_ns, np.array(self._begins_ns, dtype=np.int64) // unit_ns,
                             np.array(self._ids, dtype=np.int64), edges)

    def restore(self, saved: SavedGyroBias) -> None:
        """Restore saved states; if bins have another width by now, the chain goes on with it."""
        self._begins_ns = (saved.numbers * saved.width_ns).tolist()
        self._ids = saved.ids.tolist()


def _information(variance: float) -> FloatArray:
    """Return the information of one row on a state, shape (1, 3, 3)."""
    information = np.zeros((1, 3, 3))
    information[0, 0, 0] = 1.0 / variance
    return information


def _observed(state: int, rate: float, variance: float) -> ObservedNodes:
    """Return the observation of a state: a rate [rad/s] and its variance."""
    return ObservedNodes([state], None, np.array([(rate, 0.0, 0.0)]), _information(variance),
                         [ObservedKind.GLOBAL_POSE])


def turn_edge(turn: Turn, state: int) -> Edges:
    """
    Return the edge of a rotation.

    Parameters
    ----------
    state : int, id of the bias

    """
    information = np.zeros((1, 3, 3))
    information[0, 2, 2] = 1.0 / turn.variance
    return Edges(
        [turn.i], [turn.j], np.array([(0.0, 0.0, turn.angle)]), information, [EdgeKind.TURN],
        bias=np.array([(0.0, 0.0, 0.0, turn.seconds)]), k=[state])


class GyroBiases:
    """The biases of all gyroscopes."""

    def __init__(self, config: BackendConfig) -> None:
        self._config = config
        self._biases: dict[str, GyroBias] = {}
        self._edges: dict[str, GrowingArray] = {}
        """Ids of the edges of each source, and of the states that they have for an end."""
        self._new: list[tuple[str, int, int]] = []
        """Source, id and state of the edges that were added since `begin`."""

    @property
    def n_new(self) -> int:
        """Number of rotations that were added since `begin`."""
        return len(self._new)

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._new.clear()
        for bias in self._biases.values():
            bias.begin()

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        self._new.clear()
        for bias in self._biases.values():
            bias.rollback()

    def commit(self) -> None:
        """Record what was added since `begin`."""
        for source, edge, state in self._new:
            self._edges_of(source).append_one((edge, state))
        self.begin()

    def add(self, turns: Sequence[Turn], graph: Graph, additions: Additions) -> None:
        """
        Add the edges of some rotations to an update, each source's in the order of their stamps.

        Parameters
        ----------
        graph : Graph, it is not changed

        """
        for turn in sorted(turns, key=lambda turn: turn.stamp_ns):
            edge, state = self._bias(turn.source).add(turn, graph, additions)
            self._new.append((turn.source, edge, state))

    def _bias(self, source: str) -> GyroBias:
        return self._biases.setdefault(source, GyroBias(self._config.gyro(source)))

    def _edges_of(self, source: str) -> GrowingArray:
        return self._edges.setdefault(source, GrowingArray((2,), np.int64))

    def leaving(self, edges: IntArray) -> list[int]:
        """Return the ids of the states that nothing needs once some edges have left the graph."""
        leaving = []
        for source, bias in self._biases.items():
            ids, states = self._edges_of(source).values.T
            leaving += bias.leaving(states[~np.isin(ids, edges)])
        return leaving

    def forget(self, nodes: set[int], edges: IntArray) -> None:
        """
        Forget what has left the graph.

        Parameters
        ----------
        nodes : set of int, ids
        edges : ndarray of int, ids

        """
        for source, bias in self._biases.items():
            bias.forget(nodes)
            known = self._edges_of(source)
            known.select(np.flatnonzero(~np.isin(known.values[:, 0], edges)))

    def edges(self) -> dict[str, IntArray]:
        """Return the ids of the edges of each source."""
        return {source: edges.values[:, 0] for source, edges in self._edges.items()}

    def source_of(self, edge: int) -> str | None:
        """Return the source of an edge, by its id; None if it is not of a gyroscope."""
        for source, edges in self._edges.items():
            at = int(np.searchsorted(edges.values[:, 0], edge))
            if at < len(edges) and edges.values[at, 0] == edge:
                return source
        return None

    def begin_of(self, state: int) -> tuple[str, int] | None:
        """Return source and begin [ns] of the bin of a state, by its id; None for others."""
        for source, bias in self._biases.items():
            begin_ns = bias.begin_ns(state)
            if begin_ns is not None:
                return source, begin_ns
        return None

    def values(self, graph: Graph) -> dict[str, float]:
        """Return the newest estimate of the bias of each source [rad/s]."""
        states = {source: bias.newest for source, bias in self._biases.items()}
        rows = graph.node_rows(np.array(list(states.values()), dtype=np.int64))
        return {source: float(graph.poses[row, 0])
                for source, row in zip(states, rows.tolist(), strict=True) if row >= 0}

    def saved(self) -> dict[str, SavedGyroBias]:
        """Return the states of all sources."""
        return {source: bias.saved(self._edges_of(source).values.copy())
                for source, bias in self._biases.items()}

    def restore(self, source: str, saved: SavedGyroBias) -> None:
        """Restore the states of a source."""
        self._bias(source).restore(saved)
        self._edges_of(source).append(saved.edges)
