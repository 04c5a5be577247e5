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
from dataclasses import dataclass
import math

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import GyroSource
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.odometry.gyro import Turn
from pose_graph_ros.core.saved_columns import Integers, Pairs
from pose_graph_ros.core.sources.gauss_markov import Additions, BiasChain, NO_TRANSITION
from pose_graph_ros.core.sources.settings import SOURCES


@dataclass(frozen=True, slots=True)
class SavedGyroBias:
    width_ns: int  # unit of the numbers [ns]
    numbers: Integers  # increasing: the bin with number k begins at the stamp k `width_ns`
    ids: Integers  # id of each state in the graph
    edges: Pairs  # ids of the edges of its rotations, and of their states, shape (E, 2)


class GyroBias(BiasChain):
    def __init__(self, source: GyroSource) -> None:
        super().__init__(round(source.bias_period * 1e9))
        self._source = source
        # ids of the edges of its rotations, and of the states that these have for an end
        self._edges = GrowingArray((2,), np.int64)
        self._n_settled = 0  # number of these before the update that was begun

    @property
    def newest(self) -> int:
        """Id of the newest state; -1 before the first."""
        return self.nodes[-1] if self.nodes else -1

    def begin(self) -> None:
        super().begin()
        self._n_settled = len(self._edges)

    def rollback(self) -> None:
        super().rollback()
        self._edges.truncate(self._n_settled)

    @property
    def edges(self) -> IntArray:
        """Ids of the edges of its rotations, increasing."""
        return np.asarray(self._edges.values[:, 0])

    def add(self, turn: Turn, graph: Graph, additions: Additions) -> None:
        """Add the edge of a rotation, and the state that it needs."""
        begin_ns = turn.stamp_ns // self._width_ns * self._width_ns
        if not self._begins_ns or begin_ns > self._begins_ns[-1]:
            self._make_state(begin_ns, turn, graph, additions)
        # one that was set aside for long has the state of the bin before, if its own has none
        state = self.nodes[max(bisect.bisect_right(self._begins_ns, turn.stamp_ns) - 1, 0)]
        if turn.rest_variance > 0.0:
            additions.add(_observed(state, turn.rest_rate, turn.rest_variance))
        self._edges.append_one((additions.add(turn_edge(turn, state)), state))

    def _make_state(
        self, begin_ns: int, turn: Turn, graph: Graph, additions: Additions,
    ) -> None:
        source = self._source
        gap = (begin_ns - self._begins_ns[-1]) * 1e-9 if self._begins_ns else np.inf
        value, before = turn.rest_rate, self.newest
        if gap <= SOURCES.switched_off:
            known = int(graph.node_rows(np.array([before]))[0])
            # one of this update has no estimate yet
            value = float(graph.poses[known, 0] if known >= 0
                          else additions.biases[before - additions.first.node][0])
        state = additions.add_bias(value, dimension=1)
        self._keep()
        for column, number in zip(
                self._columns, (begin_ns, state, NO_TRANSITION), strict=True):
            column.append(number)
        if gap <= SOURCES.switched_off:
            additions.add(Factors(
                [state], [before], np.zeros((1, 3)),
                _information(source.sigma_bias_walk**2 * gap), [FactorKind.BIAS],
                constants=np.array([(0.0, 0.0, 1.0, 0.0)])))
        else:
            additions.add(_observed(state, 0.0, source.sigma_bias**2))

    def leaving(self, factors: IntArray) -> list[int]:
        """Return the ids of the states that nothing needs once some factors have left."""
        needed = self._edges.values[~np.isin(self.edges, factors), 1]
        oldest = int(np.min(needed, initial=self.newest))
        return self.nodes[:bisect.bisect_left(self.nodes, oldest)]

    def forget_factors(self, factors: IntArray) -> None:
        """Forget factors that have left the graph, by their ids."""
        self._edges.select(np.flatnonzero(~np.isin(self.edges, factors)))

    def saved(self) -> SavedGyroBias:
        # a restored chain may have begun with bins of another width
        unit_ns = math.gcd(self._width_ns, *self._begins_ns)
        return SavedGyroBias(unit_ns, np.array(self._begins_ns, dtype=np.int64) // unit_ns,
                             np.array(self.nodes, dtype=np.int64), self._edges.values.copy())

    def restore(self, saved: SavedGyroBias) -> None:
        """Restore saved states; if bins have another width by now, the chain goes on with it."""
        self._fill([(saved.numbers * saved.width_ns).tolist(), saved.ids.tolist(),
                    len(saved.ids) * [NO_TRANSITION]])
        self._edges.append(saved.edges)
        self.begin()


def _information(variance: float) -> FloatArray:
    """Return the information of one row on a state, shape (1, 3, 3)."""
    information = np.zeros((1, 3, 3))
    information[0, 0, 0] = 1.0 / variance
    return information


def _observed(state: int, rate: float, variance: float) -> Factors:
    """Return the observation of a state: a rate [rad/s] and its variance."""
    return Factors.on([state], None, np.array([(rate, 0.0, 0.0)]), _information(variance),
                      [FactorKind.GLOBAL_POSE])


def turn_edge(turn: Turn, state: int) -> Factors:
    information = np.zeros((1, 3, 3))
    information[0, 2, 2] = 1.0 / turn.variance
    return Factors(
        [turn.i], [turn.j], np.array([(0.0, 0.0, turn.angle)]), information, [FactorKind.TURN],
        constants=np.array([(0.0, 0.0, 0.0, turn.seconds)]), k=[state])
