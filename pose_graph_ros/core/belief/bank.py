# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measurements in the map in the order of their stamps, and what the best hypothesis says of each.

A late one takes its place among the others, and the filters run again from there: what is decided
does not depend on the order of arrival.
"""

from copy import copy
from itertools import pairwise
import math
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.belief import hypotheses as hy
from pose_graph_ros.core.belief.filter import ERROR, NOISE, RATE, SCALE
from pose_graph_ros.core.belief.hypotheses import BRANCH, HYPOTHESIS
from pose_graph_ros.core.belief.rows import count, COUNTS, FOLLOWS, join_motions, MEASURED, Records
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.odometry.motion import OdometryErrors


class Odometry(NamedTuple):
    """The chain of odometry that measurements lie on, with the errors that it knows of."""

    nodes: IntArray  # ids, ascending, shape (N,)
    poses: FloatArray  # in the first one, shape (N, 3)
    sums: FloatArray  # upper triangles of the summed covariances up to them, shape (N, 6)
    known: IntArray  # ids of these and of other nodes, ascending, shape (M,)
    stamps_ns: IntArray  # of all known nodes, shape (M,)
    errors: OdometryErrors


class Spread(NamedTuple):
    """How far what may have happened, but is not believed, is from the best hypothesis."""

    pose: FloatArray  # by the best one, at the newest row, shape (3,) [m, m, rad]
    # what poses by which other sources are in a fault, and those by other noise, add to its own
    covariance: FloatArray


NO_SPREAD = Spread(np.zeros(3), np.zeros((3, 3)))


class Decided(NamedTuple):
    """What is decided on the rows from the first one whose decision has changed."""

    first: int
    choice: IntArray
    far: FloatArray  # from where they were expected [m]
    d2: FloatArray  # the same as squared Mahalanobis distances


class Bank:
    def __init__(self, noise: Records | None = None) -> None:
        self.noise = as_claimed() if noise is None else noise
        self._rows = GrowingArray((), MEASURED)
        self.done, self._traced, self._n = 0, 0, 0
        self._bank = np.zeros(BANK.hypotheses, HYPOTHESIS)
        self._begin_at({0: np.zeros(0, HYPOTHESIS)})
        self._first_node = -1  # node that the motion to the first row begins at, if it is known
        self.n_sources = 0
        self.spread = NO_SPREAD  # when it was last decided
        self.by_noise = NO_SPREAD.covariance  # the part of it by other noise, when it was learnt

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> Records:
        """Rows of measurements, by stamp, read-only."""
        return self._rows.read_only

    def begin_with(self, node: int, pose: FloatArray, covariance: FloatArray) -> None:
        """Begin an empty bank with where the robot is known to be at a node, in the map."""
        one = np.zeros(1, HYPOTHESIS)
        one['state'][0, :3], one['covariance'][0, :3, :3] = pose, covariance
        for k, sigma in ((RATE, BANK.rate), (SCALE, BANK.scale)):
            one['covariance'][0, k, k] = sigma**2
        self._begin_at({0: one})
        self._first_node = node

    def insert(self, new: Records, odometry: Odometry) -> None:
        """Insert rows, but for their motions, into the order of stamps."""
        oldest = int(np.min(new['stamp_ns']))
        first = len(self)
        if first > 0 and int(self._rows.values[-1]['stamp_ns']) >= oldest:
            first = int(np.searchsorted(self._rows['stamp_ns'], oldest))
        later = new
        if first < len(self):
            later = np.concatenate((self._rows.values[first:], new))
        # those of one stamp by their source, then by their values: not by the order of arrival
        order = np.lexsort(
            (later['mean'][:, 1], later['mean'][:, 0], later['source'], later['stamp_ns']))
        is_new = order >= len(self) - first
        self._rows.truncate(first)
        self._rows.append(later[order])
        # nothing is known of the slow errors of new sources
        before, self.n_sources = self.n_sources, max(
            self.n_sources, int(np.max(new['source'])) + 1)
        for source in range(before, self.n_sources):
            own = new['slow'][new['source'] == source]
            variance = float(self.noise['slow'][0, source]) * float(np.max(own, initial=0.0))
            for hypotheses in (self._bank, *self._kept.values()):
                for k in (ERROR + 2 * source, ERROR + 2 * source + 1):
                    hypotheses['covariance'][:, k, k] = variance
        self._begin_from(first + int(np.argmax(is_new)))
        # the motions to the new rows, and to those behind them
        rows, errors = self._rows.values, np.array(odometry.errors)
        at = first + np.flatnonzero(is_new | np.append(False, is_new[:-1]))
        from_node = np.where(at > 0, rows['node'][at - 1], self._first_node)
        begins, ends = np.searchsorted(odometry.nodes, (from_node, rows['node'][at]))
        # where the chain does not reach there is none
        begins = np.where((from_node < 0) | (ends >= len(odometry.nodes)), ends, begins)
        some = slice(int(np.min(begins)), int(np.max(ends)) + 1)
        stamps_ns = odometry.stamps_ns[np.searchsorted(odometry.known, odometry.nodes[some])]
        poses, sums = odometry.poses[some], odometry.sums[some]
        for row, begin, end in zip(at.tolist(), (begins - some.start).tolist(),
                                   (ends - some.start).tolist(), strict=True):
            join_motions(poses, sums, stamps_ns, errors, rows, row, begin, end)
        # slow errors change also while no node is passed
        at = at[at > 0]
        rows['lever'][at, 2] = 1e-9 * (rows['stamp_ns'][at] - rows['stamp_ns'][at - 1])
        count(rows, first, BANK.period_ns)

    def remove(self, ids: IntArray) -> None:
        """Remove rows whose factors were not added after all, all of them the newest to come."""
        gone = np.isin(self._rows['id'], ids)
        if not np.any(gone):
            return
        first = int(np.argmax(gone))
        self._begin_from(first)
        self._rows.select(np.flatnonzero(~gone))

    def _begin_from(self, row: int) -> None:
        """Take the bank back to before a row."""
        if row >= self.done:
            return
        for at in [at for at in self._kept if at > row]:
            del self._kept[at]
        self.done = max(self._kept)
        kept = self._kept[self.done]
        self._n = len(kept)
        self._bank[:self._n] = kept
        self._tree.truncate(self.done)
        self._traced = min(self._traced, self.done)

    def advance(self, most: int) -> bool:
        """Take the bank along at most so many rows; return whether some are left."""
        first, n = self.done, min(self.done + most, len(self))
        self._tree.append(np.zeros((n - self.done, BANK.hypotheses), BRANCH))
        while self.done < n:
            end = min(n, (self.done // BANK.checkpoint + 1) * BANK.checkpoint)
            self._n = hy.advance(self._bank, self._n, self._rows.values, self.done, end,
                                 self.n_sources, self.noise, self._tree.values)
            self.done = end
            if end % BANK.checkpoint == 0:
                self._kept[end] = self._bank[:self._n].copy()
        if n // BANK.checkpoint > first // BANK.checkpoint:
            last, *kept = sorted(self._kept)
            for at, after in pairwise(kept):
                # the older they are, the farther apart
                if after - last < (n - at) // BANK.kept:
                    del self._kept[at]
                else:
                    last = at
        return n < len(self)

    def decide(self) -> Decided:
        """Take the bank along all rows that it has not seen; return what is decided anew."""
        self.advance(len(self))
        self._note_spread()
        # the best hypothesis is followed back to where it meets the one that was the best before
        n, branches, first = len(self), self._tree.values, 0
        self._path.truncate(n)
        self._path.append(np.zeros(n - len(self._path), dtype=np.int64))
        path = self._path.values
        at = int(np.argmax(self._bank['weight'][:self._n])) if self._n > 0 else 0
        for row in range(n - 1, -1, -1):
            if row < self._traced and path[row] == at:
                first = row + 1
                break
            path[row] = at
            at = int(branches['before'][row, at])
        self._traced = n
        return self.told(first)

    def told(self, first: int) -> Decided:
        """Return what the best hypothesis says of the rows from one on."""
        leaves = self._tree.values[np.arange(first, len(self)), self._path.values[first:]]
        choice = leaves['choice'].astype(np.int64)
        choice[choice == hy.BEGINS_NOISY] = hy.BEGINS     # it is told as any beginning
        return Decided(first, choice, leaves['far'].astype(np.float64),
                       leaves['d2'].astype(np.float64))

    @property
    def evidence(self) -> float:
        """Logarithm of the probability density of all measurements."""
        return float(np.logaddexp.reduce(self._bank['weight'][:self._n]))

    @property
    def heading_sigma(self) -> float:
        """Sigma of the heading at the newest row, by all that may have happened [rad]."""
        some = self._bank[:self._n]
        likely = np.exp(some['weight'] - np.max(some['weight']))
        off = se2.wrap(some['state'][:, 2] - some['state'][np.argmax(likely), 2])
        return math.sqrt(np.average(some['covariance'][:, 2, 2] + off**2, weights=likely))

    def newest(self) -> tuple[FloatArray, FloatArray]:
        """Return the pose at the newest row by the best hypothesis, with its covariance."""
        best = self._bank[np.argmax(self._bank['weight'][:max(self._n, 1)])]
        return best['state'][:3].copy(), best['covariance'][:3, :3].copy()

    def _note_spread(self) -> None:
        """Note what else may have happened, beside the best, at the newest row."""
        some, self.spread = self._bank[:self._n], NO_SPREAD
        if len(some) == 0:
            return
        pose, covariance = self.newest()
        likely, in_fault = np.exp(some['weight'] - np.max(some['weight'])), some['in_fault'] != 0
        best = int(np.argmax(likely))
        likely *= np.any(in_fault != in_fault[best], axis=1) / np.sum(likely)
        wider = None
        if np.any(in_fault[best]) or self._tree.values[-1, best]['choice'] != hy.GOOD:
            # something speaks for it that one was in a fault from the start; a small part that
            # hardly knows where the robot is would make the covariance useless
            own = some['covariance'][:, :3, :3]
            wider = own * (hy.NEAR2 / np.maximum(own[:, :1, :1], hy.NEAR2)) - covariance
        self.spread = Spread(pose, self.by_noise + added_covariance(
            likely, some['state'][:, :3] - pose, wider))

    def again(self, noise: Records, newest: int | None = None, *, learns: bool = False) -> Self:
        """
        Return a bank with the same rows and another noise, before the first of them.

        Or before about so many of the newest ones; what is decided on those before these stays.
        To learn noise all rows count, and how exact receivers are is learnt as it is.
        """
        begin = 0 if newest is None else max(
            (at for at in self._kept if at <= len(self) - newest), default=0)
        other: Self = copy(self)
        other.noise, other._rows = noise, GrowingArray.of(self._rows.values)
        other._begin_at({at: kept for at, kept in self._kept.items() if at <= begin}, begin)
        other._tree.append(self._tree.values[:begin])
        other._path.append(self._path.values[:begin])
        if learns:
            rows = other._rows.values
            rows['least'], rows['decides'][rows['decides'] == FOLLOWS] = 0.0, COUNTS
        return other

    def _begin_at(self, kept: dict[int, Records], begin: int = 0) -> None:
        # hypotheses before some rows; those before the first one are never dropped
        self._kept = kept
        self._tree = GrowingArray((BANK.hypotheses,), BRANCH)
        # the best hypothesis after each row, by number, and up to which row it is known
        self._path, self._traced = GrowingArray((), np.int64), begin
        # number of rows that the bank was taken along, and of hypotheses that it has
        self.done, self._n = begin, len(kept[begin])
        self._bank = np.zeros(BANK.hypotheses, HYPOTHESIS)
        self._bank[:self._n] = kept[begin]

    def forget(self, left: IntArray, least: int) -> None:
        """
        Forget the oldest rows up to a kept state, if their factors are not among those left.

        At least so many rows stay.
        """
        gone = ~np.isin(self._rows['id'], left)
        n_gone = int(np.argmin(gone)) if not np.all(gone) else len(gone)
        most = min(n_gone, self.done, len(self) - least)
        begin = max((at for at in self._kept if at <= most), default=0)
        if begin == 0:
            return
        self._first_node = int(self._rows['node'][begin - 1])
        for column in (self._rows, self._tree):
            column.drop_first(begin)
        # the path may not reach as far yet
        self._path.drop_first(min(begin, len(self._path)))
        self.done, self._traced = self.done - begin, max(self._traced - begin, 0)
        self._kept = {at - begin: kept for at, kept in self._kept.items() if at >= begin}


def added_covariance(likely: FloatArray, off: FloatArray,
                     wider: FloatArray | None = None) -> FloatArray:
    """
    Return what other poses add to the covariance of one, shape (3, 3), in [m, m, rad].

    Given are their probabilities, their differences from it, (N, 3), and by how much their own
    covariances are larger, (N, 3, 3), if they are.
    """
    off = se2.wrapped(off)
    added = (off.T * likely) @ off
    if wider is None:
        return np.asarray(added)
    variances, axes = np.linalg.eigh(added + np.einsum('n,nij', likely, wider))
    return np.asarray((axes * np.maximum(variances, 0.0)) @ axes.T)


def is_believed(choice: IntArray) -> npt.NDArray[np.bool_]:
    return np.asarray((choice == hy.GOOD) | (choice == hy.SLIPPED))


def as_claimed() -> Records:
    """Return the noise of odometry and of sources that are as good as they claim."""
    noise = np.zeros(1, NOISE)
    noise['way'] = noise['turn'] = noise['white'] = noise['tau'] = 1.0
    return noise
