# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What sources keep of measurements that have left the graph."""

from hypothesis import given, settings, strategies as st
import numpy as np
from test_gauss_markov import SECOND, TAU

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate, NextIds
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.core.sources.bias import (
    Additions,
    BiasChain,
    CorrelatedErrors,
    Process,
)
from pose_graph_ros.core.sources.error_estimate import left_behind, measured_path, PathOdometry
from pose_graph_ros.core.sources.error_likelihood import no_past
from pose_graph_ros.core.sources.settings import SOURCES

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
        np.testing.assert_allclose(
            cov, np.exp(-np.abs(bins[:, None] - bins) / TAU), atol=1e-9)
        assert chain.bias.nodes.tolist() == sorted(chain.bins, key=chain.bins.__getitem__)
    assert chain.bias.nodes[-1] not in chain.bias.leaving(None)


def drive(seed: int, n: int) -> tuple[Graph, np.ndarray, np.ndarray]:
    """Return a drive with positions at some nodes, their stamps and their ids."""
    rng, graph = np.random.default_rng(seed), Graph()
    root = rng.normal(size=(n - 1, 3, 3)) * (0.05, 0.03, 0.02)
    noise = root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(3)
    nodes = np.flatnonzero(rng.random(n) < 0.6)
    graph.apply(GraphUpdate(hidden=np.zeros((n, 3)), factors=Factors.joined([
        Factors(np.arange(n - 1), np.arange(1, n), rng.normal(size=(n - 1, 3)),
                np.linalg.inv(noise), np.full(n - 1, FactorKind.ODOMETRY)),
        Factors.on(
            nodes, rng.normal(size=(len(nodes), 3)) * (1.0, 1.0, 0.0),
            rng.normal(size=(len(nodes), 3)) * (9.0, 9.0, 0.0),
            np.tile(np.diag((1.0, 1.0, 0.0)), (len(nodes), 1, 1)),
            np.full(len(nodes), FactorKind.POSITION))])))
    return graph, nodes * SECOND, n - 1 + np.arange(len(nodes))


ODOMETRY = PathOdometry(np.arange(100), SECOND * np.arange(100), AS_CLAIMED, AS_CLAIMED)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_the_measured_path_goes_on_before_the_window(seed: int) -> None:
    n = 30
    graph, stamps_ns, ids = drive(seed, n)
    whole, past = to_the_end(measured_path(graph, ODOMETRY, stamps_ns, ids)), None
    for first in (0, 4, 5, 17):
        begin = int(graph.node_ids[0])
        gone = np.flatnonzero((stamps_ns >= begin * SECOND) & (stamps_ns < first * SECOND))
        past = left_behind(
            graph, ODOMETRY, stamps_ns[gone], ids[gone], past=past, node=first)
        graph.begin()
        graph.apply(GraphUpdate(remove_nodes=tuple(range(begin, first))))
        graph.commit()
        again = to_the_end(measured_path(graph, ODOMETRY, stamps_ns, ids, past))
        for each in (whole, again):
            each.motion[:, 2] = se2.wrap(each.motion[:, 2])
        for one, other in zip(whole, again, strict=True):
            np.testing.assert_allclose(one[1:], other[1:], atol=1e-9)
    assert past is not None
    # two motions are one, with the noise of both
    if len(past.stamps_ns) > 0:
        rough, n_kept = past.thinned(), len(past.stamps_ns) % 2 + len(past.stamps_ns) // 2
        assert len(rough.stamps_ns) == n_kept == len(rough.motion) - 1
        ends = []
        for each in (past, rough):
            pose = np.zeros(3)
            for motion in each.motion[1 if each is past else 0:]:
                pose = se2.compose(pose, motion)
            ends.append(pose)
        first_motion = past.motion[0]
        np.testing.assert_allclose(
            se2.compose(first_motion, ends[0]), ends[1], atol=1e-9)


def test_the_past_is_bounded() -> None:
    path = no_past(0)
    graph, stamps_ns, ids = drive(1, 12)
    part = to_the_end(measured_path(graph, ODOMETRY, stamps_ns, ids))
    grown = part._replace(motion=np.zeros((len(ids) + 1, 3)),
                          noise=np.tile(np.eye(3), (len(ids) + 1, 1, 1)),
                          way=np.tile((1.0, 0.0, 1.0), (len(ids) + 1, 1)),
                          lever=np.zeros((len(ids) + 1, 3)))
    for k in range(600):
        path = path.extended(stamps_ns + k * 100 * SECOND, grown, 0)
        assert len(path.stamps_ns) <= 2 * SOURCES.kept_positions
    assert np.all(np.diff(path.stamps_ns) > 0)
    assert path.stamps_ns[-1] == stamps_ns[-1] + 599 * 100 * SECOND
