# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What sources keep of measurements that have left the graph."""

from hypothesis import given, strategies as st
import numpy as np
from test_gauss_markov import SECOND, TAU

from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import NextIds
from pose_graph_ros.core.sources.bias import Additions, BiasChain, CorrelatedErrors, Process

PROCESS = Process.correlated(CorrelatedErrors(TAU, 1.0, 0.05))


class Chain:
    """A bias with the information of its states, of which the oldest can leave."""

    def __init__(self) -> None:
        self.bias, self.next = BiasChain(), NextIds(0, 0)
        self.bins: dict[int, int] = {}
        """Bin of each state."""
        self.edges: dict[int, tuple[int, int, float, float]] = {}
        self.priors: dict[int, int] = {}
        self.carried: int | None = None

    def add(self, seconds: set[int]) -> None:
        additions, known = Additions(self.next), {*self.bins.values()}
        self.bias = self.bias.with_bins(
            np.array([*seconds]) * SECOND, PROCESS, additions, np.zeros(3))
        new = range(self.next.node, self.next.node + len(additions.biases))
        self.bins.update(zip(new, sorted(seconds - known), strict=True))
        added = Factors.joined(additions.factors)
        for number, one in enumerate(map(added.rows, np.arange(len(added))[:, None]),
                                     self.next.factor):
            if one.j[0] < 0:
                self.priors[number] = int(one.i[0])
            else:
                self.edges[number] = (int(one.i[0]), int(one.j[0]), float(one.constants[0, 2]),
                                      float(one.information[0, 0, 0]))
        for number in additions.remove:
            del (self.edges if number in self.edges else self.priors)[number]
        self.next = NextIds(self.next.node + len(new), self.next.factor + len(added))

    def forget(self, oldest: int) -> None:
        """Let the states leave that nothing needs if there is a measurement in this bin."""
        gone = self.bias.leaving(oldest * SECOND)
        self.bias = self.bias.without(gone)
        self.bins = {node: second for node, second in self.bins.items() if node not in gone}
        if not {self.carried, *self.priors.values()} - {*gone, None}:
            # a stationary process: what is left of it begins with a variance of 1
            self.carried = int(self.bias.nodes[0])
        self.edges = {number: edge for number, edge in self.edges.items()
                      if edge[0] not in gone and edge[1] not in gone}
        self.priors = {number: node for number, node in self.priors.items() if node not in gone}

    def covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bins of the states, in order, and their covariance."""
        nodes = sorted(self.bins, key=self.bins.__getitem__)
        at = {node: k for k, node in enumerate(nodes)}
        information = np.zeros((len(nodes), len(nodes)))
        for node in [*self.priors.values(), *([] if self.carried is None else [self.carried])]:
            information[at[node], at[node]] += 1.0
        for i, j, phi, weight in self.edges.values():
            row = np.zeros(len(nodes))
            row[at[i]], row[at[j]] = -1.0, phi
            information += weight * np.outer(row, row)
        return np.array([self.bins[node] for node in nodes]), np.linalg.inv(information)


@given(st.lists(st.tuples(
    st.sets(st.integers(0, 40), min_size=1, max_size=4), st.integers(0, 40)), min_size=1,
    max_size=25))
def test_a_bias_of_which_old_states_have_left_stays_the_same_process(
    steps: list[tuple[set[int], int]],
) -> None:
    chain, end = Chain(), 0
    for seconds, oldest in steps:
        chain.add(seconds)
        end = max(end, oldest // 2)
        if oldest % 3 == 0:
            chain.forget(end)
        bins, cov = chain.covariance()
        np.testing.assert_allclose(cov, np.exp(-np.abs(bins[:, None] - bins) / TAU), atol=1e-9)
        assert chain.bias.nodes.tolist() == sorted(chain.bins, key=chain.bins.__getitem__)
    assert chain.bias.nodes[-1] not in chain.bias.leaving(None)

