# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When the factors on the sigmas of sources of closures are learnt; see `residual_scale`."""

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.judgement.beliefs import Beliefs
from pose_graph_ros.core.judgement.closure_states import ClosureStates, STATES
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.residual_scale import (
    agreement_scale,
    MOST,
    places,
    residual_scale,
    ROUNDS,
    ScaleLeft,
    together,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# A source is looked at again when so many more of its closures are believed than the last time: a
# share of those in the graph, and this number.
MORE, AND_MORE = 0.25, 5
# Largest number of closures that are looked at at the end.
MOST_AT_END = 1000


class ScaleLearner:
    """
    Learns the factors on the sigmas of sources in the graph.

    Parameters
    ----------
    beliefs : Beliefs, which has the factors

    """

    def __init__(
        self, smoother: IncrementalSmoother, states: ClosureStates, table: ClosureTable,
        beliefs: Beliefs,
    ) -> None:
        self._smoother, self._states, self._table = smoother, states, table
        self._beliefs = beliefs
        self._learnt_from: list[int] = []
        """Number of believed closures of each source when its factor was learnt."""

    def add_sources(self) -> None:
        """Give new sources the factor that closures have shown that have left, or 1."""
        for source in range(len(self._learnt_from), len(self._states.sources)):
            if source == len(self._beliefs.scales_left):
                self._beliefs.scales_left.append(ScaleLeft())
            self._beliefs.scales.append(
                together(1.0, 0.0, self._beliefs.scales_left[source]))
            self._learnt_from.append(0)

    def begin(self) -> None:
        """Forget what was learnt from closures that are in the graph."""
        self._beliefs.scales.clear()
        self._learnt_from.clear()
        self.add_sources()

    def state(self) -> tuple[list[float], list[int]]:
        """Return the factors, and what they were learnt from."""
        return [*self._beliefs.scales], [*self._learnt_from]

    def set_state(self, scales: list[float], learnt_from: list[int]) -> None:
        """
        Set what `state` has returned.

        Parameters
        ----------
        scales : list of float
        learnt_from : list of int

        """
        self._beliefs.scales[:], self._learnt_from[:] = scales, learnt_from

    def learn(self) -> bool:
        """Learn the factor of a source with many more closures; tell whether one has changed."""
        for source in range(len(self._states.sources)):
            n_believed, before = int(np.sum(self._of(source))), self._learnt_from[source]
            n = n_believed + self._beliefs.scales_left[source].n
            if n_believed >= AND_MORE and n - before >= (
                    MORE * min(n_believed, before) + AND_MORE):
                self._learnt_from[source] = n
                if self._learn(source):
                    return True
        return False

    def learn_all(self) -> None:
        """
        Learn all factors from 1, which they are to be.

        Residuals are those with the present factor, so a source is looked at until it shows none
        that is larger.
        """
        for source in range(len(self._states.sources)):
            n_believed = int(np.sum(self._of(source)))
            self._learnt_from[source] = n_believed + self._beliefs.scales_left[source].n
            if n_believed >= AND_MORE:
                for _ in range(ROUNDS):
                    if not self._learn(source, larger=True):
                        break

    def _of(self, source: int) -> BoolArray:
        """Tell which closures of a source are believed, shape (M,)."""
        return np.asarray(self._states.in_graph & (self._states.source == source))

    def _learn(self, source: int, *, larger: bool = False) -> bool:
        """Learn the factor of a source, if it is a `larger` one; tell whether it has changed."""
        before = self._beliefs.scales[source]
        numbers = np.flatnonzero(self._of(source))
        scale = self._shown(source, numbers, MOST_AT_END if larger else MOST)
        if scale == before or (larger and scale < before):
            return False
        self._beliefs.scales[source] = scale
        if self._beliefs.apply({k: STATES[self._states.state[k]] for k in numbers.tolist()}):
            self._table.forget_spread()
            return True
        self._beliefs.scales[source] = before
        return not larger

    def _shown(self, source: int, numbers: IntArray, most: int) -> float:
        """Return the factor that the believed closures of a source show."""
        states, graph = self._states, self._smoother.graph
        some, group = self._sample(numbers, most)
        edges, inside = graph.edges_at(states.edge[some]), self._of(source)
        return together(max(
            residual_scale(*self._smoother.edge_innovations(edges), edges.information, group,
                           self._beliefs.scales[source]),
            agreement_scale(self._table, some, inside, graph.edges_at(states.edge[inside]))),
            float(len(some)), self._beliefs.scales_left[source])

    def _sample(self, numbers: IntArray, most: int) -> tuple[IntArray, IntArray]:
        """Return at most so many closures, from all along the path, and the group of each."""
        group = places(self._table, self._smoother.graph.edges_at(self._states.edge[numbers]))
        n_groups = int(group.max()) + 1
        n_chosen = min(max(n_groups * most // len(numbers), 1), n_groups)
        chosen = np.linspace(0, n_groups - 1, n_chosen).astype(np.int64)
        some = np.flatnonzero(np.isin(group, chosen))
        # by their stamps, as numbers depend on the order of arrival
        some = some[np.lexsort((*self._states.stamps_ns[numbers[some]].T, group[some]))][:most]
        _, of_each = np.unique(group[some], return_inverse=True)
        return numbers[some], of_each.ravel()
