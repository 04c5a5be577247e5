# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When the factors on the sigmas of sources of closures are learnt; see `residual_scale`."""

import numpy as np

from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.judgement.beliefs import Beliefs
from pose_graph_ros.core.judgement.closure_states import ClosureStates, STATES
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.residual_scale import agreement_scale, MOST, residual_scale
from pose_graph_ros.core.measurements import LoopClosure
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# A source is looked at again when this many times as many of its closures are believed as the
# last time, and this many more.
MORE, AND_MORE = 1.25, 5


class ScaleLearner:
    """
    Learns the factors on the sigmas of sources in the graph, but of those that are set.

    Parameters
    ----------
    smoother : IncrementalSmoother
    states : ClosureStates
    table : ClosureTable
    beliefs : Beliefs, which has the factors
    config : BackendConfig

    """

    def __init__(
        self, smoother: IncrementalSmoother, states: ClosureStates, table: ClosureTable,
        beliefs: Beliefs, config: BackendConfig,
    ) -> None:
        self._smoother, self._states, self._table = smoother, states, table
        self._beliefs, self._config = beliefs, config
        self._learnt_from: list[int] = []
        """Number of believed closures of each source when its factor was learnt."""

    def configure(self, config: BackendConfig) -> None:
        """Set the settings."""
        self._config = config

    def add_sources(self) -> None:
        """Give new sources a factor, 1 if none is set."""
        for name in self._states.sources[len(self._learnt_from):]:
            self._beliefs.scales.append(self._fixed(name) or 1.0)
            self._learnt_from.append(0)

    def begin(self) -> None:
        """Forget what was learnt."""
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

    def _fixed(self, source: str) -> float:
        """Return the factor that is set for a source, 0 if it is learnt."""
        return self._config.measurement_source(source, LoopClosure).sigma_scale

    def learn(self) -> bool:
        """Learn the factor of a source with many more closures; tell whether one has changed."""
        believed = np.flatnonzero(self._states.in_graph)
        for source, name in enumerate(self._states.sources):
            numbers = believed[self._states.source[believed] == source]
            if self._fixed(name) or len(numbers) < MORE * self._learnt_from[source] + AND_MORE:
                continue
            self._learnt_from[source] = len(numbers)
            scale, before = self._shown(source, numbers), self._beliefs.scales[source]
            if scale == before:
                continue
            self._beliefs.scales[source] = scale
            if not self._beliefs.apply({
                    k: STATES[self._states.state[k]] for k in numbers.tolist()}):
                self._beliefs.scales[source] = before
            return True
        return False

    def _shown(self, source: int, numbers: IntArray) -> float:
        """Return the factor that the believed closures of a source show."""
        states, graph = self._states, self._smoother.graph
        some = numbers[np.lexsort(states.stamps_ns[numbers].T)]
        some = some[np.linspace(0, len(some) - 1, min(len(some), MOST)).astype(np.int64)]
        edges = graph.edges_at(states.row[some])
        inside = states.in_graph & (states.source == source)
        return max(
            residual_scale(*self._smoother.edge_innovations(edges), edges.information,
                           self._beliefs.scales[source]),
            agreement_scale(self._table, some, inside, graph.edges_at(states.row[inside])))
