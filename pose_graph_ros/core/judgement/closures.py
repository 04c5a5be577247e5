# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures that are judged: how far from the estimate, and which of them agree with each other.

A closure is a measured pose z of a later node in an earlier one. Its error (3.48) is in the frame
of the measured pose, and so are all covariances here.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.truncated import LIMITS
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.compiled.jit import INTEGERS, kernel, MATRICES, NUMBERS, ROWS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.odometry_chain import composed, inverted, OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF

# Squared Mahalanobis distance that 99 % of errors with three components are within.
GATE = float(LIMITS[3])
# Least sigmas of closures to decide by [m, m, rad].
FLOORS = np.array(BELIEF.closure_floors)


class Closures(NamedTuple):
    i: IntArray  # nodes that they start from, shape (M,)
    j: IntArray  # nodes that they lead to, shape (M,)
    mean: FloatArray  # measured poses of j in i, shape (M, 3) [m, m, rad]
    noise: FloatArray  # covariances in the frames of the measured poses, shape (M, 3, 3)


def squared_distances(
    chain: OdometryChain, closures: Closures, first: IntArray, second: IntArray,
) -> FloatArray:
    """
    Return the squared Mahalanobis distances of pairs of closures, shape (P,).

    Closure a, from node i to node j, is predicted through closure b, from k to l, and the chains
    of odometry from i to k and from l to j (J. Mangelson et al., "Pairwise consistent measurement
    set maximization", ICRA 2018). With T_n the pose of node n by odometry,
    `T_i^-1 T_k z_b T_l^-1 T_j` is to be z_a. Edges that are in both chains are counted with their
    correlation. b may have been measured in the opposite direction: the shorter chains decide. The
    distance is infinite if a node is not chained by odometry.
    """
    first, second = (np.ascontiguousarray(rows, np.int64) for rows in (first, second))
    places = [chain.places(nodes[rows]) for rows in (first, second)
              for nodes in (closures.i, closures.j)]
    out = np.empty(len(first))
    _squared_distances(
        chain.poses, chain.sums, chain.travelled, *places, np.ascontiguousarray(closures.mean),
        np.ascontiguousarray(closures.noise), first, second, out)
    return out


@kernel
def _set_adjoint(out, a):  # type: ignore[no-untyped-def]
    c, s = math.cos(a[2]), math.sin(a[2])
    out[0, 0], out[0, 1], out[0, 2] = c, -s, a[1]
    out[1, 0], out[1, 1], out[1, 2] = s, c, -a[0]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@kernel
def _add_product(out, factor, a, m, b):  # type: ignore[no-untyped-def]
    """Add `factor A M B^T` to a matrix; all have the shape (3, 3)."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for n in range(3):
                    total += a[i, k] * m[k, n] * b[j, n]
            out[i, j] += factor * total


@kernel
def _sum_between(sums, low, high, out):  # type: ignore[no-untyped-def]
    """Write the sum of the covariances of the edges between two places, from the prefix sums."""
    k = 0
    for i in range(3):
        for j in range(i, 3):
            out[i, j] = out[j, i] = sums[high, k] - sums[low, k]
            k += 1


@kernel
def solved_form(m, e):  # type: ignore[no-untyped-def]
    """Return `e^T M^-1 e` for a positive definite matrix, shape (3, 3)."""
    l00 = math.sqrt(m[0, 0])
    l10, l20 = m[1, 0] / l00, m[2, 0] / l00
    l11 = math.sqrt(m[1, 1] - l10 * l10)
    l21 = (m[2, 1] - l20 * l10) / l11
    x = e[0] / l00
    y = (e[1] - l10 * x) / l11
    z = e[2] - l20 * x - l21 * y
    return x * x + y * y + z * z / (m[2, 2] - l20 * l20 - l21 * l21)


@kernel(signature=(
    ROWS, ROWS, NUMBERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS, ROWS, MATRICES, INTEGERS,
    INTEGERS, NUMBERS), allocates=True)
def _squared_distances(  # type: ignore[no-untyped-def]
    poses, sums, travel, start_a, end_a, start_b, end_b, mean, noise, first, second, out,
):
    work = np.empty((6, 3, 3))
    noise_b, adjoint = work[0], work[1]
    for p in range(len(out)):
        a, b = first[p], second[p]
        i, j, k, l = start_a[p], end_a[p], start_b[p], end_b[p]     # noqa: E741  as the formula
        if min(i, j, k, l) < 0:
            out[p] = np.inf
            continue
        z_a, z_b = (mean[a, 0], mean[a, 1], mean[a, 2]), (mean[b, 0], mean[b, 1], mean[b, 2])
        noise_b[:] = noise[b]
        straight = abs(travel[i] - travel[k]) + abs(travel[l] - travel[j])
        crossed = abs(travel[i] - travel[l]) + abs(travel[k] - travel[j])
        if crossed < (1.0 - 1e-9) * straight:  # more than by rounding
            k, l = l, k     # noqa: E741
            _set_adjoint(adjoint, z_b)
            noise_b[:] = 0.0
            _add_product(noise_b, 1.0, adjoint, noise[b], adjoint)
            z_b = inverted(z_b)
        out[p] = _squared_distance(poses, sums, (i, j, k, l), z_a, noise[a], z_b, work)


@kernel
def _squared_distance(  # type: ignore[no-untyped-def]
    poses, sums, places, z_a, noise_a, z_b, work,
):
    """Return the squared distance of a from its prediction through b, whose noise is in `work`."""
    noise_b, to_k, to_l, to_end, total, part = (
        work[0], work[1], work[2], work[3], work[4], work[5])
    i, j, k, l = places     # noqa: E741
    T_i, T_k = (poses[i, 0], poses[i, 1], poses[i, 2]), (poses[k, 0], poses[k, 1], poses[k, 2])
    T_l, T_j = (poses[l, 0], poses[l, 1], poses[l, 2]), (poses[j, 0], poses[j, 1], poses[j, 2])
    behind = composed(inverted(T_l), T_j)
    from_k = composed(T_k, composed(z_b, behind))
    predicted = composed(inverted(T_i), from_k)
    dx, dy = predicted[0] - z_a[0], predicted[1] - z_a[1]
    c, s = math.cos(z_a[2]), math.sin(z_a[2])
    error = (c * dx + s * dy, c * dy - s * dx, factors.wrap(predicted[2] - z_a[2]))
    # the noises of both chains and of b, in the frame at the end of the prediction
    _set_adjoint(to_k, inverted(from_k))
    _set_adjoint(to_end, inverted(behind))
    _set_adjoint(to_l, inverted(T_j))
    total[:] = 0.0
    _add_product(total, 1.0, to_end, noise_b, to_end)
    _sum_between(sums, min(i, k), max(i, k), part)
    _add_product(total, 1.0, to_k, part, to_k)
    _sum_between(sums, min(l, j), max(l, j), part)
    _add_product(total, 1.0, to_l, part, to_l)
    low, high = max(min(i, k), min(l, j)), min(max(i, k), max(l, j))
    if low < high:
        # edges in both chains; one of them may be run through backwards
        same = 1.0 if (i < k) == (l < j) else -1.0
        _sum_between(sums, low, high, part)
        _add_product(total, same, to_k, part, to_l)
        _add_product(total, same, to_l, part, to_k)
    # turned to the axes of the error
    turn = to_k
    _set_adjoint(turn, (0.0, 0.0, error[2]))
    for m in range(3):
        for n in range(3):
            part[m, n] = noise_a[m, n]
    _add_product(part, 1.0, turn, total, turn)
    return solved_form(part, error)


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


@kernel(signature=(ROWS, MATRICES, NUMBERS))
def distances(errors, covariances, out):  # type: ignore[no-untyped-def]
    """Write squared Mahalanobis distances of errors, shape (M, 3)."""
    for k in range(len(errors)):
        out[k] = solved_form(covariances[k], errors[k])


def as_edges(some: Closures) -> Factors:
    """Return closures as a table; its information is not that of the closures."""
    return Factors(some.i, some.j, some.mean, some.noise,
                 np.full(len(some.i), int(FactorKind.LOOP_CLOSURE)))


def errors_of(graph: Graph, some: Closures) -> FloatArray:
    """Return the errors of closures at the estimate of a graph, shape (M, 3) [m, m, rad]."""
    return graph.errors(as_edges(some))


def residuals(graph: Graph, some: Closures) -> FloatArray:
    """
    Return squared residuals at the estimate of a graph, by the floored covariances, shape (M,).
    """
    errors, out = errors_of(graph, some), np.empty(len(some.i))
    distances(errors, some.noise, out)
    return out


def are_above(graph: Graph, edges: IntArray, limit: float) -> BoolArray:
    """Tell which squared residuals of edges, by their own covariances, are above a limit."""
    rows, factors = graph.factor_rows(edges), graph.factor_records
    return np.asarray(factors['energy'][rows] > limit * factors['weight'][rows])


class Support(NamedTuple):
    clique: IntArray  # it and others, all of which agree with one another, by number
    # distance that the robot has travelled between the first and the last of the clique [m]
    travel: float


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


class ClosureTable:
    """
    Closures by their numbers, in the order of addition; forgotten ones are the neighbours of none.
    """

    def __init__(self, chain: OdometryChain) -> None:
        self.chain = chain
        self._i, self._j = (GrowingArray((), np.int64) for _ in range(2))
        self._mean = GrowingArray((3,), np.float64)
        self._noise = GrowingArray((3, 3), np.float64)
        self._travel = GrowingArray((2,), np.float64)  # of both ends
        # covariances of the predictions when they were tested; 0 if not known
        self._spread = GrowingArray((3, 3), np.float64)
        self._columns = (
            self._i, self._j, self._mean, self._noise, self._travel, self._spread)
        # numbers of the closures by the places of their ends along the path
        self._cells: dict[tuple[int, int], list[int]] = defaultdict(list)

    def __len__(self) -> int:
        return len(self._i)

    def rows(self, numbers: IntArray) -> Closures:
        return Closures(*(column.values[numbers] for column in self._columns[:4]))

    @property
    def spread(self) -> FloatArray:
        """Covariances of the predictions when they were tested, writeable; 0 if not known."""
        return self._spread.values

    def append(self, new: Closures) -> None:
        """Append closures between nodes of the chain."""
        begin = len(self)
        travel = np.column_stack((self.chain.travel(new.i), self.chain.travel(new.j)))
        for array, values in zip(self._columns, (
                *new, travel, np.zeros((len(travel), 3, 3))), strict=True):
            array.append(values)
        self.bring_back(range(begin, len(self)))

    def bring_back(self, numbers: Iterable[int]) -> None:
        """Make closures neighbours of others again."""
        for number in numbers:
            self._cells[self._cell(number)].append(number)

    def drop(self, count: int) -> None:
        size = len(self) - count
        self.forget(range(size, len(self)))
        for array in self._columns:
            array.truncate(size)

    def forget(self, numbers: Iterable[int]) -> None:
        """Forget closures that are not believed."""
        for number in numbers:
            cell = self._cell(number)
            self._cells[cell].remove(number)
            if len(self._cells[cell]) == 0:
                del self._cells[cell]

    def select(self, kept: IntArray) -> None:
        new = {number: k for k, number in enumerate(kept.tolist())}
        for cell, numbers in [*self._cells.items()]:
            numbers[:] = [new[number] for number in numbers if number in new]
            if len(numbers) == 0:
                del self._cells[cell]
        for array in self._columns:
            array.select(kept)

    def _cell(self, number: int) -> tuple[int, int]:
        a, b = np.floor(self._travel.values[number] / BELIEF.near).tolist()
        return int(a), int(b)

    def _cells_around(self, number: int) -> list[Sequence[int]]:
        a, b = self._cell(number)
        return [self._cells.get((i, j), ()) for i in (a - 1, a, a + 1) for j in (b - 1, b, b + 1)]

    def crowd(self, number: int) -> int:
        """Return how many closures are around one: more than `near`, but it grows with these."""
        return sum(map(len, self._cells_around(number)))

    def near(self, number: int) -> IntArray:
        """Return closures whose ends are both near those of one, at most `most_compared`."""
        found = [other for cell in self._cells_around(number)
                 for other in cell[-2 * BELIEF.most_compared:] if other != number]
        numbers = np.array(found, dtype=np.int64)
        if len(numbers) == 0:
            return numbers
        travel = self._travel.values[np.append(numbers, number)]
        apart = np.max(np.abs(travel[:-1] - travel[-1]), axis=1, initial=0.0)
        close = apart <= BELIEF.near
        order = np.argsort(apart[close], kind='stable')[:BELIEF.most_compared]
        return numbers[close][order]

    def neighbours(self, number: int) -> tuple[IntArray, IntArray]:
        """Return which closures near one agree with it, and which do not."""
        near = self.near(number)
        distance = self._distances(np.full(len(near), number), near)
        return near[distance < GATE], near[distance >= GATE]

    def support(self, number: int, usable: BoolArray) -> Support:
        """Return a clique that a closure belongs to, grown greedily from the nearest ones."""
        near = self.near(number)
        near = near[usable[near]]
        distance = self._distances(np.full(len(near), number), near)
        agree = near[distance < GATE]
        m = len(agree)
        pairs = self._distances(np.repeat(agree, m), np.tile(agree, m)).reshape(m, m) < GATE
        # those that agree with most are taken first
        clique: list[int] = []
        for k in np.argsort(-np.sum(pairs, axis=1), kind='stable').tolist():
            if len(clique) + 1 < BELIEF.most_in_clique and np.all(pairs[k, clique]):
                clique.append(k)
        members = np.append(agree[clique], number)
        return Support(members, float(np.ptp(self._travel.values[members, 1])))

    def _distances(self, a: IntArray, b: IntArray) -> FloatArray:
        every = Closures(*(column.values for column in self._columns[:4]))
        return squared_distances(self.chain, every, a, b)
