# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sources whose errors are correlated in time, such as GNSS receivers.

The error of a measurement at time t is `f m(t)` plus a small white part. f^2 is proportional to
the variance that the sender gives (`CorrelatedErrors`); m is a first-order Gauss-Markov process
with variance 1 and time constant tau in each coordinate. `GaussMarkovBias` estimates m as a
*bias*: time is divided into bins of tau / `bins`, each bin with measurements has one state, and
consecutive states are connected by

    m_k = phi m_{k-1} + w,   phi = exp(-gap / tau),   Var w = 1 - phi^2.

The first state has a prior of variance 1. Within a bin `m(t) = phi' m_k + w'`, where phi' follows
from the time between t and the middle of the bin. The bin of a measurement depends on its stamp
alone, and the state of a bin that is filled later is inserted between its neighbours, so the order
of arrival does not matter.

Where older states have left the graph, its prior holds what is known of the first one that stays.
The process is the same backwards in time, so a late state before that one hangs on the next one.
"""

import bisect
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate, NextIds
from pose_graph_ros.core.saved_columns import Integers
from pose_graph_ros.core.sources.settings import SOURCES

# Instead of the id of a transition: the prior of the graph is on the state.
NO_TRANSITION = -1
# Unit of the third number of a state, the error of the heading, in sigmas. Its variance is then
# 1 / STRETCH^2: the number is wrapped like an angle and must stay well below pi.
STRETCH = 10.0
_INFORMATION = np.diag((1.0, 1.0, STRETCH**2))


class CorrelatedErrors(NamedTuple):
    tau: float  # time constant of the correlated part [s]
    # variance of the correlated part, in units of the variance that the sender gives
    correlated: float
    white: float  # variance of the white part, in the same units


@dataclass(frozen=True, slots=True)
class SavedBins:
    width_ns: int
    numbers: Integers  # bin numbers, increasing: bin k begins at the stamp k `width_ns`
    rows: Integers  # id of each state
    # id of the edge from each state to the one before; for the first state that of the observed
    # node that is its prior, -1 if the prior of the graph has it
    ties: Integers


@dataclass(slots=True)
class Additions:
    """Changes of one update, collected row by row; for the fields see `GraphUpdate`."""

    first: NextIds  # ids of the first new rows
    biases: list[FloatArray] = field(default_factory=list)
    dimensions: list[int] = field(default_factory=list)
    factors: list[Factors] = field(default_factory=list)
    remove: list[int] = field(default_factory=list)

    def update(self) -> GraphUpdate:
        return GraphUpdate(
            biases=np.array(self.biases).reshape(-1, 3), dimensions=self.dimensions,
            factors=Factors.joined(self.factors), remove=self.remove)

    def add_bias(self, value: float = 0.0, dimension: int = 3) -> int:
        self.biases.append(np.array((value, 0.0, 0.0)))
        self.dimensions.append(dimension)
        return self.first.node + len(self.biases) - 1

    def add(self, factor: Factors) -> int:
        self.factors.append(factor)
        return self.first.factor + len(self.factors) - 1


class BiasChain:
    """States of a bias in the graph, each for a bin of time."""

    def __init__(self, width_ns: int) -> None:
        self._width_ns = width_ns
        self._begins_ns: list[int] = []  # stamps at which the bins begin, increasing [ns]
        self.nodes: list[int] = []  # ids of their states
        # ids of the edges to the states before; of the first state that of its prior
        self._ties: list[int] = []
        # these lists as they were before the update that has changed them
        self._before: list[list[int]] | None = None

    @property
    def _columns(self) -> list[list[int]]:
        return [self._begins_ns, self.nodes, self._ties]

    def _fill(self, columns: Sequence[list[int]]) -> None:
        self._begins_ns, self.nodes, self._ties = columns

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._before = None

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        if self._before is not None:
            self._fill(self._before)
            self._before = None

    def _keep(self) -> None:
        if self._before is None:
            self._before = [[*column] for column in self._columns]

    def forget(self, nodes: Collection[int]) -> None:
        """Forget states that have left the graph, the oldest ones, by their ids."""
        kept = [k for k, node in enumerate(self.nodes) if node not in nodes]
        if len(kept) == len(self.nodes):
            return
        self._fill([[column[k] for k in kept] for column in self._columns])
        if len(kept) > 0 and NO_TRANSITION not in self._ties:
            self._ties[0] = NO_TRANSITION

    def begin_ns(self, node: int) -> int | None:
        """Return when the bin of a state begins [ns], by its id; None for another source's."""
        return self._begins_ns[self.nodes.index(node)] if node in self.nodes else None


class GaussMarkovBias(BiasChain):
    """The bias of one source: a chain of states in the graph."""

    def __init__(self, errors: CorrelatedErrors) -> None:
        super().__init__(max(round(errors.tau * 1e9 / SOURCES.bins), 1))
        self.errors = errors

    def leaving(self, oldest_ns: int | None) -> list[int]:
        """Return the states before the oldest measurement that is left, but the newest."""
        end = last = max(len(self.nodes) - 1, 0)
        if oldest_ns is not None:
            begin_ns = oldest_ns - oldest_ns % self._width_ns
            end = min(bisect.bisect_left(self._begins_ns, begin_ns), last)
        return self.nodes[:end]

    def saved(self) -> SavedBins:
        begins_ns, nodes, ties = (np.array(each, dtype=np.int64) for each in self._columns)
        return SavedBins(self._width_ns, begins_ns // self._width_ns, nodes, ties)

    def restore(self, saved: SavedBins) -> bool:
        """Restore saved states; return False if their bins have another width."""
        if saved.width_ns != self._width_ns:
            return False
        self._fill([each.tolist() for each in (
            saved.numbers * saved.width_ns, saved.rows, saved.ties)])
        return True

    def add(
        self, stamp_ns: int, observed: Factors, noise: FloatArray, additions: Additions,
    ) -> int:
        """
        Return the id of the edge that is added, from a measurement's node to its bin's state.

        `observed` is the measurement if its error were white; the edge gets its weight. `noise` is
        what the motion since the node adds to the variances of its position and heading
        [m^2, rad^2].
        """
        rest_ns = stamp_ns % self._width_ns
        begin_ns = stamp_ns - rest_ns
        at = bisect.bisect_left(self._begins_ns, begin_ns)
        if at == len(self.nodes) or self._begins_ns[at] != begin_ns:
            self._make_bin(at, begin_ns, additions)
        phi = self._phi(abs(rest_ns - self._width_ns / 2))
        return additions.add(biased_constraint(
            observed, noise, self.nodes[at], phi, self.errors))

    def preview(self, stamp_ns: int, observed: Factors, noise: FloatArray) -> Factors | None:
        """Return the edge of a measurement to the last state before it; None without one."""
        at = bisect.bisect(self._begins_ns, stamp_ns) - 1
        if at < 0:
            return None
        gap_ns = abs(stamp_ns - self._begins_ns[at] - self._width_ns / 2)
        return biased_constraint(observed, noise, self.nodes[at], self._phi(gap_ns), self.errors)

    def _phi(self, gap_ns: float) -> float:
        return math.exp(-gap_ns * 1e-9 / self.errors.tau)

    def _make_bin(self, at: int, begin_ns: int, additions: Additions) -> None:
        """
        Add the state of a bin between its neighbours in time.

        Transitions lead away from the state with the prior: back to it, or, from late states
        before one that the prior of the graph is on, forward.
        """
        self._keep()
        before, after = at - 1 if at > 0 else None, at if at < len(self.nodes) else None
        if NO_TRANSITION in self._ties[at:]:
            before, after = after, before
        node = additions.add_bias()
        if before is None:
            tie = additions.add(Factors.on(
                [node], None, np.zeros((1, 3)), _INFORMATION[None], [FactorKind.GLOBAL_POSE]))
        else:
            tie = self._tied(
                node, self.nodes[before], begin_ns - self._begins_ns[before], additions)
        if after is not None:
            additions.remove.append(self._ties[after])
            self._ties[after] = self._tied(
                self.nodes[after], node, self._begins_ns[after] - begin_ns, additions)
        for column, value in zip(self._columns, (begin_ns, node, tie), strict=True):
            column.insert(at, value)

    def _tied(self, node: int, before: int, gap_ns: int, additions: Additions) -> int:
        phi = self._phi(abs(gap_ns))
        return additions.add(Factors(
            [node], [before], np.zeros((1, 3)), _INFORMATION[None] / (1.0 - phi * phi),
            [FactorKind.BIAS], constants=np.array([(0.0, 0.0, phi, phi)])))


def biased_constraint(
    observed: Factors, noise: FloatArray, bias: int, phi: float, errors: CorrelatedErrors,
) -> Factors:
    """
    Return the edge from a hidden node x to a state of the bias that holds a measurement.

    The error of the edge in map axes is `f m + z - x * o`. o is the motion since the node and the
    lever arm; z is the measured pose; f is the standard deviation of the correlated part, from the
    mean of the variances of x and y. m is phi times the state plus a white rest of variance
    1 - phi^2.
    """
    mean, offset = observed.mean[0].copy(), observed.offset[0]
    kind, given, information = observed.kind[0], observed.information[0], np.zeros((3, 3))
    rows = np.flatnonzero(np.diagonal(given) > 0.0)  # what is measured: position, heading or both
    block = np.ix_(rows, rows)
    cov = np.linalg.inv(given[block])
    if kind == FactorKind.GLOBAL_POSE:
        cov = covariance.turned(cov, -float(mean[2]))
    is_heading = (rows == 2).astype(np.int64)
    total = np.diagonal(cov).copy()
    total[rows < 2] = 0.5 * np.sum(total[rows < 2])
    # without that of the motion since the node
    own = np.maximum(total - noise[is_heading], SOURCES.least_own * total)
    correlated, scale = errors.correlated * own, np.sqrt(own / total)
    # of the correlated part, the state does not explain all
    rest = correlated * (1.0 - phi * phi) + noise[is_heading]
    information[block] = covariance.information(
        errors.white * scale[:, None] * cov * scale + np.diag(rest))
    factors = np.zeros(2)
    factors[is_heading] = phi * np.sqrt(correlated) * np.where(is_heading, STRETCH, 1.0)
    if kind != FactorKind.POSITION:
        mean[2] = se2.wrap(mean[2] - offset[2])
    return Factors([observed.i[0]], [bias], [mean], [information], [FactorKind.BIAS],
                 weight=observed.weight, constants=[(offset[0], offset[1], *factors)])
