# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The loop closures that are judged, and which of them support or contradict one another."""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.truncated import LIMITS
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.judgement.consistency import Closures, squared_distances
from pose_graph_ros.core.judgement.floors import floored, FLOORS, forward
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain

# Squared Mahalanobis distance that 99 % of errors with three components are within.
GATE = float(LIMITS[3])
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


def claims(edges: Edges, floors: FloatArray = FLOORS) -> Closures:
    """
    Return closures from the earlier to the later node, with covariances to decide by.

    Parameters
    ----------
    floors : ndarray, shape (3,), least sigmas [m, m, rad]

    """
    own = floored(forward(edges), floors)
    covariance = np.asarray(
        np.linalg.inv(own.information + _LEAST_INFORMATION * np.eye(3)), dtype=np.float64)
    return Closures(own.i.copy(), own.j.copy(), own.mean.copy(), covariance)


def chances(covariance: FloatArray, extent: FloatArray) -> FloatArray:
    """
    Return the chances of random closures to pass gates, shape (M,).

    Parameters
    ----------
    covariance : ndarray, shape (M, 3, 3), of the errors that the gates are for
    extent : ndarray, shape (2,), how large the place is [m]

    """
    area = max(float(np.prod(extent)), 1.0)
    ellipse = np.pi * GATE * np.sqrt(np.linalg.det(covariance[:, :2, :2]))
    arc = np.sqrt(GATE * covariance[:, 2, 2]) / np.pi
    return np.asarray(np.minimum(ellipse / area, 1.0) * np.minimum(arc, 1.0))


class ClosureTable:
    """
    Closures in the order of their addition, and where they are along the path.

    Each has a number, its place in this order, which is all that is kept of forgotten ones.
    """

    def __init__(self, chain: OdometryChain) -> None:
        self.chain = chain
        self._slot = GrowingArray((), np.int64)
        """Of each number, its row in the arrays below; -1 if it is forgotten."""
        self._i, self._j = (GrowingArray((), np.int64) for _ in range(2))
        self._mean = GrowingArray((3,), np.float64)
        self._noise = GrowingArray((3, 3), np.float64)
        self._travel = GrowingArray((2,), np.float64)
        """Of both ends."""
        self._spread = GrowingArray((3, 3), np.float64)
        self._columns = (
            self._i, self._j, self._mean, self._noise, self._travel, self._spread)
        self._cells: dict[tuple[int, int], list[int]] = defaultdict(list)
        """Numbers of the closures by the places of their ends along the path."""

    def __len__(self) -> int:
        return len(self._slot)

    def rows(self, numbers: IntArray) -> Closures:
        """Return some of them, none of which is forgotten."""
        slots = self._slots(numbers)
        return Closures(*(column.values[slots] for column in self._columns[:4]))

    def _slots(self, numbers: IntArray) -> IntArray:
        slots: IntArray = self._slot.values[numbers]
        assert np.all(slots >= 0)
        return slots

    def spread(self, numbers: IntArray) -> FloatArray:
        """Return the covariances of the predictions when they were tested; 0 if not known."""
        return np.asarray(self._spread.values[self._slots(numbers)])

    def set_spread(self, numbers: IntArray, spread: FloatArray) -> None:
        """
        Set the covariances of their predictions.

        Parameters
        ----------
        numbers : ndarray of int, shape (M,)
        spread : ndarray, shape (M, 3, 3)

        """
        self._spread.values[self._slots(numbers)] = spread

    def forget_spread(self) -> None:
        """Take no covariance of a prediction as known any more."""
        self._spread.values[:] = 0.0

    def append(self, new: Closures) -> None:
        """Append closures between nodes of the chain."""
        begin = len(self)
        self._slot.append(np.full(len(new.i), -1))
        self.bring_back(np.arange(begin, len(self)), new)

    def bring_back(self, numbers: IntArray, closures: Closures) -> None:
        """
        Know closures again that were forgotten.

        Parameters
        ----------
        numbers : ndarray of int, shape (M,)
        closures : Closures, M of them, between nodes of the chain

        """
        travel = np.column_stack((self.chain.travel(closures.i), self.chain.travel(closures.j)))
        for number, cell in zip(numbers.tolist(), _cells(travel), strict=True):
            self._cells[cell].append(number)
        begin = len(self._i)
        for array, values in zip(self._columns, (
                *closures, travel, np.zeros((len(numbers), 3, 3))), strict=True):
            array.append(values)
        self._slot.values[numbers] = np.arange(begin, len(self._i))

    def drop(self, count: int) -> None:
        """Remove the newest closures again."""
        size = len(self._i) - count
        for cell in _cells(self._travel.values[size:]):
            self._cells[cell].pop()
        for array in self._columns:
            array.truncate(size)
        self._slot.truncate(len(self) - count)

    def forget(self, numbers: IntArray) -> None:
        """Forget closures that are not believed, and give their memory back."""
        travel = self._travel.values[self._slots(numbers)]
        for number, cell in zip(numbers.tolist(), _cells(travel), strict=True):
            self._cells[cell].remove(number)
            if len(self._cells[cell]) == 0:
                del self._cells[cell]
        slots = self._slot.values
        slots[numbers] = -1
        kept = np.flatnonzero(slots >= 0)
        for array in self._columns:
            array.select(slots[kept])
        slots[kept] = np.arange(len(kept))

    def select(self, kept: IntArray) -> None:
        """Keep some closures, by number; all others have been forgotten."""
        new = np.full(len(self), -1)
        new[kept] = np.arange(len(kept))
        for numbers in self._cells.values():
            numbers[:] = new[numbers].tolist()
        self._slot.select(kept)

    def _cells_around(self, number: int) -> list[Sequence[int]]:
        slot = int(self._slot.values[number])
        if slot < 0:
            return []
        (a, b), = _cells(self._travel.values[slot:slot + 1])
        return [self._cells.get((i, j), ()) for i in (a - 1, a, a + 1) for j in (b - 1, b, b + 1)]

    def crowd(self, number: int) -> int:
        """Return how many closures are around one: more than `near`, but it grows with these."""
        return sum(map(len, self._cells_around(number)))

    def near(self, number: int) -> IntArray:
        """Return closures whose ends are both near those of one, at most `MOST_COMPARED`."""
        found = [other for cell in self._cells_around(number)
                 for other in cell[-2 * MOST_COMPARED:] if other != number]
        numbers = np.array(found, dtype=np.int64)
        if len(numbers) == 0:
            return numbers
        travel = self._travel.values[self._slots(np.append(numbers, number))]
        apart = np.max(np.abs(travel[:-1] - travel[-1]), axis=1, initial=0.0)
        close = apart <= NEAR
        order = np.argsort(apart[close], kind='stable')[:MOST_COMPARED]
        return numbers[close][order]

    def neighbours(self, number: int) -> tuple[IntArray, IntArray]:
        """Return which closures near one agree with it, and which do not."""
        near = self.near(number)
        distance = self._distances(np.full(len(near), number), near)
        return near[distance < GATE], near[distance >= GATE]

    def support(self, number: int, usable: BoolArray) -> Support:
        """
        Return a clique that a closure belongs to, grown greedily from the nearest ones.

        Parameters
        ----------
        number : int
        usable : ndarray of bool, shape (M,), which closures may be in a clique

        """
        near = self.near(number)
        near = near[usable[near]]
        distance = self._distances(np.full(len(near), number), near)
        agree = near[distance < GATE]
        m = len(agree)
        pairs = self._distances(np.repeat(agree, m), np.tile(agree, m)).reshape(m, m) < GATE
        # those that agree with most are taken first
        clique: list[int] = []
        for k in np.argsort(-np.sum(pairs, axis=1), kind='stable').tolist():
            if len(clique) + 1 < MOST_IN_CLIQUE and np.all(pairs[k, clique]):
                clique.append(k)
        members = np.append(agree[clique], number)
        travel = self._travel.values[self._slots(members), 1]
        return Support(members, float(np.ptp(travel)))

    def _distances(self, a: IntArray, b: IntArray) -> FloatArray:
        """Return squared Mahalanobis distances between closures, by number."""
        every = Closures(*(column.values for column in self._columns[:4]))
        return squared_distances(self.chain, every, self._slot.values[a], self._slot.values[b])


def _cells(travel: FloatArray) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in np.floor(travel / NEAR).tolist()]
