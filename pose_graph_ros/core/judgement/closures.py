# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures that are judged: how far from the estimate, which of them agree, what is decided.

A closure is a measured pose z of a later node in an earlier one. Its error (3.48) is in the frame
of the measured pose, and so are all covariances here.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.truncated import LIMITS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement import verdicts as vd
from pose_graph_ros.core.judgement.judgements import Column, Judgements
from pose_graph_ros.core.judgement.odometry_chain import moved, OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF

# Squared Mahalanobis distance that 99 % of errors with three components are within.
GATE = float(LIMITS[3])
# Least sigmas of closures to decide by [m, m, rad].
FLOORS = np.array(BELIEF.closure_floors)
NEVER = -1  # round of the last test of one that was not tested
# Variance of a prediction that was not tested: anything may be right.
ANYTHING = 1e12


class Closures(NamedTuple):
    i: IntArray  # nodes that they start from, shape (M,)
    j: IntArray  # nodes that they lead to, shape (M,)
    mean: FloatArray  # measured poses of j in i, shape (M, 3) [m, m, rad]
    noise: FloatArray  # covariances in the frames of the measured poses, shape (M, 3, 3)

    def rows(self, chosen: IntArray | BoolArray) -> 'Closures':
        return Closures(self.i[chosen], self.j[chosen], self.mean[chosen], self.noise[chosen])


def squared_distances(chain: OdometryChain, a: Closures, b: Closures) -> FloatArray:
    """
    Return the squared Mahalanobis distances of pairs of closures, shape (P,).

    Closure a, from node i to node j, is predicted through closure b, from k to l, and the chains
    of odometry from i to k and from l to j (J. Mangelson et al., "Pairwise consistent measurement
    set maximization", ICRA 2018). With T_n the pose of node n by odometry,
    `T_i^-1 T_k z_b T_l^-1 T_j` is to be z_a. Both lead to the later node. Their starts are near
    one another, and so are their ends: what both chains have in common does not count. The
    distance is infinite if a node is not chained by odometry.
    """
    out = np.full(len(a.i), np.inf)
    known = np.all([chain.places(nodes) >= 0 for nodes in (a.i, a.j, b.i, b.j)], axis=0)
    a, b = a.rows(known), b.rows(known)
    before, noise_before = chain.between(a.i, b.i)
    after, noise_after = chain.between(b.j, a.j)
    behind = se2.compose(b.mean, after)
    error = se2.between(a.mean, se2.compose(before, behind))
    # in the frame at the end of the prediction, then in the axes of the error
    noise = noise_after + moved(b.noise, se2.inverse(after)) + moved(
        noise_before, se2.inverse(behind))
    out[known] = squares(error, a.noise + moved(noise, error * (0.0, 0.0, 1.0)))
    return out


def floored(edges: Factors, sigmas: FloatArray = FLOORS) -> Factors:
    """Return edges with the variances of their errors raised; what is not measured stays so."""
    information = edges.information
    most = np.max(np.abs(information), axis=(1, 2), initial=0.0)
    # it may be singular
    covariance = np.linalg.inv(information + 1e-12 * most[:, None, None] * np.eye(3))
    missing = np.maximum(sigmas**2 - np.einsum('mii->mi', covariance), 0.0)
    # (C + D)^-1 = I (1 + D I)^-1 with D the diagonal of what is missing
    softer = information @ np.linalg.inv(np.eye(3) + missing[:, :, None] * information)
    softer = 0.5 * (softer + softer.transpose(0, 2, 1))
    return edges.replaced(information=softer)


def forward(edges: Factors) -> Factors:
    """Return edges that all lead to the later node, in whichever direction each was measured."""
    back = np.flatnonzero((edges.i > edges.j) & (edges.kind <= FactorKind.LOOP_CLOSURE))
    if len(back) == 0:
        return edges
    i, j = edges.i.copy(), edges.j.copy()
    mean, information = edges.mean.copy(), edges.information.copy()
    i[back], j[back] = edges.j[back], edges.i[back]
    # the error of the inverse is the error, moved from the end to the start
    mean[back] = se2.inverse(edges.mean[back])
    adjoint = se2.adjoint(mean[back])
    information[back] = adjoint.transpose(0, 2, 1) @ information[back] @ adjoint
    return edges.replaced(i=i, j=j, mean=mean, information=information)


def squares(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return squared Mahalanobis distances of errors, shape (M,)."""
    return np.einsum(
        'mi,mi->m', errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])


def as_edges(some: Closures) -> Factors:
    """Return closures as a table; its information is not that of the closures."""
    return Factors(some.i, some.j, some.mean, some.noise,
                   np.full(len(some.i), int(FactorKind.LOOP_CLOSURE)))


def claims(edges: Factors, floors: FloatArray = FLOORS) -> Closures:
    """Return closures from the earlier to the later node, with covariances to decide by."""
    own = floored(forward(edges), floors)
    # it may be singular: at least that of a sigma of 1 km
    covariance = np.asarray(np.linalg.inv(own.information + 1e-6 * np.eye(3)), dtype=np.float64)
    return Closures(own.i.copy(), own.j.copy(), own.mean.copy(), covariance)


def chances(covariance: FloatArray, extent: FloatArray) -> FloatArray:
    """
    Return the chances of random closures in a place of some extent [m] to pass gates, shape (M,).
    """
    area = max(float(np.prod(extent)), 1.0)
    ellipse = np.pi * GATE * np.sqrt(np.linalg.det(covariance[:, :2, :2]))
    arc = np.sqrt(GATE * covariance[:, 2, 2]) / np.pi
    return np.asarray(np.minimum(ellipse / area, 1.0) * np.minimum(arc, 1.0))


class ClosureTable(Judgements):
    KIND = vd.Judged.LOOP_CLOSURE
    i, j = Column(np.int64), Column(np.int64)   # as in `Closures`
    mean, noise = Column(np.float64, 3), Column(np.float64, 3, 3)
    spread = Column(np.float64, 3, 3)  # of the prediction when it was tested last
    travel = Column(np.float64, 2)  # way along the path to both ends [m]
    forgotten = Column(np.bool_)  # hopeless, and not judged again
    round = Column(np.int64, new=NEVER)  # of its last test
    resting = Column(np.int64)  # id of the node until which it is not tested

    def __init__(self, chain: OdometryChain) -> None:
        super().__init__()
        self.chain = chain
        # numbers by the way to the later end, and these ways; none after a change
        self._by_end: tuple[IntArray, FloatArray] | None = None

    @property
    def judged(self) -> BoolArray:
        """Whether they are judged: no person has decided on them, and they are not forgotten."""
        return (self.decision == vd.AUTO) & ~self.forgotten

    def rows(self, numbers: IntArray) -> Closures:
        rows = self.records[numbers]    # which copies no others
        return Closures(*(rows[name].copy() for name in Closures._fields))

    def measure(self, begin: int, some: Closures) -> None:
        """Note what those from a number on measure, between nodes of the chain."""
        for name, column in zip(Closures._fields, some, strict=True):
            self.records[name][begin:] = column
        self.spread[begin:] = ANYTHING * np.eye(3)
        for k, nodes in enumerate((some.i, some.j)):
            self.travel[begin:, k] = self.chain.travel(nodes)
        self._by_end = None

    def test_all_again(self) -> None:
        self.round[:], self.resting[:] = NEVER, 0
        self.spread[:] = ANYTHING * np.eye(3)

    def numbers(self, edges: IntArray) -> IntArray:
        """Return the numbers of those of some edges, given by their ids, that are closures."""
        return np.flatnonzero(np.isin(self.held, edges))

    def forget(self, source: int) -> None:
        """Forget closures of a source if too many are not believed, the oldest doubted first."""
        kept = np.flatnonzero((self.source == source) & ~self.in_graph & self.judged)
        if len(kept) <= BELIEF.most_waiting:
            return
        order = np.lexsort((self.stamps_ns[kept, 0], self.state[kept] != vd.DOUBTED))
        # some more than need be, as this is not to be done for each new one
        self.forgotten[kept[order[:len(kept) - 9 * BELIEF.most_waiting // 10]]] = True

    def totals(self) -> dict[str, vd.SourceVerdicts]:
        return {source: each._replace(n_forgotten=int(np.count_nonzero(
            self.forgotten[self.source == self.sources.index(source)])))
            for source, each in super().totals().items()}

    def near(self, number: int, usable: BoolArray) -> IntArray:
        """Return usable closures with both ends near those of one, at most `most_compared`."""
        travel = self.travel
        if self._by_end is None or len(self._by_end[0]) != len(self):
            order = np.argsort(travel[:, 1], kind='stable')
            self._by_end = order, travel[order, 1]
        order, ends = self._by_end
        start, end = travel[number].tolist()
        # the rest of the work does not grow with the number of closures
        first = np.searchsorted(ends, end - BELIEF.near, 'left')
        last = np.searchsorted(ends, end + BELIEF.near, 'right')
        around = np.sort(order[first:last])
        apart = np.maximum(np.abs(travel[around, 0] - start), np.abs(travel[around, 1] - end))
        close = (apart <= BELIEF.near) & usable[around] & (around != number)
        return around[close][np.argsort(apart[close], kind='stable')[:BELIEF.most_compared]]

    def agree(self, a: IntArray, b: IntArray) -> BoolArray:
        """Tell which pairs of closures agree with one another, shape (P,)."""
        return np.asarray(squared_distances(self.chain, self.rows(a), self.rows(b)) < GATE)

    def is_supported(self, number: int, usable: BoolArray) -> bool:
        """
        Tell whether a closure is in a clique of usable ones that agree, over some way.

        The clique is grown greedily, those that agree with most first.
        """
        members = np.append(number, self.near(number, usable))
        m = len(members)
        if m < BELIEF.clique:
            return False
        a, b = np.triu_indices(m, 1)
        pairs = np.zeros((m, m), dtype=bool)
        pairs[a, b] = pairs[b, a] = self.agree(members[a], members[b])
        clique = [0]
        for k in np.argsort(-np.sum(pairs[:, pairs[0]], axis=1), kind='stable').tolist():
            if np.all(pairs[k, clique]):
                clique.append(k)
        way = float(np.ptp(self.travel[members[clique], 1]))
        return len(clique) >= BELIEF.clique and way >= BELIEF.clique_travel

    def verdicts(self, graph: Graph, numbers: IntArray) -> list[vd.Verdict]:
        verdicts = []
        usable = ~self.forgotten
        near = [self.near(number, usable) for number in numbers.tolist()]
        sizes = np.array([len(each) for each in near], dtype=np.int64)
        others = np.concatenate([np.empty(0, np.int64), *near])
        agree = np.split(self.agree(np.repeat(numbers, sizes), others),
                         np.cumsum(sizes)[:-1]) if len(sizes) > 0 else []
        residuals = graph.errors(graph.factors_at(self.held[numbers]))
        for number, residual, around, agrees in zip(
                numbers.tolist(), residuals, near, agree, strict=True):
            contradicted = [self.name(other) for other in around[~agrees]
                            if vd.USED[self.state[other]]]
            if self.distance[number] > math.sqrt(GATE):
                contradicted.insert(0, vd.ODOMETRY)
            verdicts.append(self.verdict(number, residual, contradicted_by=contradicted,
                                         supported_by=around[agrees].tolist()))
        return verdicts
