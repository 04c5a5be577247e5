# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The loop closures that are judged, and which of them support or contradict one another."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.judgement import relative
from pose_graph_ros.core.judgement.chain import OdometryChain

# Squared Mahalanobis distance that 99 % of errors with three components are within.
GATE = 11.34
# Sigmas that covariances are raised to for decisions: front ends claim too much [m, m, rad].
FLOORS = (0.3, 0.3, 0.05)
# Closures are compared whose ends are within this of each other, along the path [m].
NEAR = 10.0
# Largest number of closures that one is compared with, and of a clique.
MOST_COMPARED, MOST_IN_CLIQUE = 40, 12
# Added to informations, which may be singular: a sigma of 1 km.
_LEAST_INFORMATION = 1e-6


class Support(NamedTuple):
    """What other closures say about one."""

    clique: IntArray
    """It and others, all of which agree with one another, by number."""
    travel: float
    """Distance that the robot has travelled between the first and the last of the clique [m]."""
    against: IntArray
    """Those that contradict it, by number."""


class Claims(NamedTuple):
    """Closures with their ends in the order of the path, and covariances for decisions."""

    first: IntArray
    """Nodes in which the others are measured, the earlier ones, shape (M,)."""
    second: IntArray
    mean: FloatArray
    """Poses of the second nodes in the first ones, shape (M, 3) [m, m, rad]."""
    covariance: FloatArray
    """In the frames at the ends of these, floored, shape (M, 3, 3)."""


def claims(edges: Edges) -> Claims:
    """Return closures for decisions: from the earlier to the later node, covariances floored."""
    covariance = np.asarray(
        np.linalg.inv(edges.information + _LEAST_INFORMATION * np.eye(3)), dtype=np.float64)
    diagonal = np.einsum('mii->mi', covariance)
    np.maximum(diagonal, np.square(FLOORS), out=diagonal)
    first, second, mean = edges.i.copy(), edges.j.copy(), edges.mean.copy()
    back = np.flatnonzero(first > second)
    first[back], second[back] = edges.j[back], edges.i[back]
    # the error at the end of z moves to its start
    turn = se2.adjoint(mean[back])
    covariance[back] = turn @ covariance[back] @ turn.transpose(0, 2, 1)
    mean[back] = se2.inverse(mean[back])
    return Claims(first, second, mean, covariance)


class ClosureTable:
    """Closures in the order of their addition, and where they are along the path."""

    def __init__(self, chain: OdometryChain) -> None:
        self._chain = chain
        self._nodes = GrowingArray((2,), np.int64)
        self._ends = GrowingArray((2,), np.int64)
        self._mean = GrowingArray((3,), np.float64)
        self._covariance = GrowingArray((3, 3), np.float64)
        self._cells: dict[tuple[int, int], list[int]] = defaultdict(list)
        """Numbers of the closures by the places of their ends along the path."""

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def claims(self) -> Claims:
        """All of them."""
        nodes = self._nodes.values
        return Claims(np.ascontiguousarray(nodes[:, 0]), np.ascontiguousarray(nodes[:, 1]),
                      self._mean.values, self._covariance.values)

    def claims_of(self, numbers: IntArray) -> Claims:
        """Return some of them."""
        nodes = self._nodes.values[numbers]
        return Claims(nodes[:, 0].copy(), nodes[:, 1].copy(), self._mean.values[numbers],
                      self._covariance.values[numbers])

    def append(self, new: Claims) -> None:
        """Append closures whose nodes are in the chain."""
        begin = len(self)
        nodes = np.column_stack((new.first, new.second))
        ends = self._chain.positions(nodes)
        self._nodes.append(nodes)
        self._ends.append(ends)
        self._mean.append(new.mean)
        self._covariance.append(new.covariance)
        for number, cell in enumerate(self._cell(ends), begin):
            self._cells[cell].append(number)

    def drop(self, count: int) -> None:
        """Remove the newest closures again."""
        for cell in self._cell(self._ends.values[len(self) - count:]):
            self._cells[cell].pop()
        for array in (self._nodes, self._ends, self._mean, self._covariance):
            array.truncate(len(array) - count)

    def _cell(self, ends: IntArray) -> list[tuple[int, int]]:
        cells = np.floor(self._chain.travel[ends] / NEAR).astype(np.int64)
        return list(map(tuple, cells.tolist()))

    def near(self, number: int) -> IntArray:
        """Return closures whose ends are both near those of one, at most `MOST_COMPARED`."""
        ends = self._ends.values
        (a, b), = self._cell(ends[number:number + 1])
        found = [other for i in (a - 1, a, a + 1) for j in (b - 1, b, b + 1)
                 for other in self._cells.get((i, j), ())[-2 * MOST_COMPARED:] if other != number]
        numbers = np.array(found, dtype=np.int64)
        travel = self._chain.travel
        apart = np.max(np.abs(travel[ends[numbers]] - travel[ends[number]]), axis=1, initial=0.0)
        close = apart <= NEAR
        order = np.argsort(apart[close], kind='stable')[:MOST_COMPARED]
        return numbers[close][order]

    def distances(self, these: IntArray, others: IntArray) -> FloatArray:
        """
        Return squared Mahalanobis distances between closures, shape (K,).

        Parameters
        ----------
        these, others : ndarray of int, shape (K,), pairs of numbers

        """
        out, ends = np.empty(len(these)), self._ends.values
        relative.pair_distances(
            self._chain.poses, self._chain.sums, np.ascontiguousarray(ends[:, 0]),
            np.ascontiguousarray(ends[:, 1]), self._mean.values, self._covariance.values,
            np.ascontiguousarray(these), np.ascontiguousarray(others), out)
        return out

    def support(self, number: int, usable: IntArray) -> Support:
        """
        Return a clique that a closure belongs to, grown greedily from the nearest ones.

        Parameters
        ----------
        number : int
        usable : ndarray of bool, shape (M,), which closures may be in a clique

        """
        near = self.near(number)
        near = near[usable[near]]
        distance = self.distances(np.full(len(near), number), near)
        agree, against = near[distance < GATE], near[distance >= GATE]
        m = len(agree)
        pairs = self.distances(np.repeat(agree, m), np.tile(agree, m)).reshape(m, m) < GATE
        # those that agree with most are taken first
        clique: list[int] = []
        for k in np.argsort(-np.sum(pairs, axis=1), kind='stable').tolist():
            if len(clique) + 1 < MOST_IN_CLIQUE and np.all(pairs[k, clique]):
                clique.append(k)
        members = np.append(agree[clique], number)
        travel = self._chain.travel[self._ends.values[members, 1]]
        return Support(members, float(np.ptp(travel)), against)
