# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sources whose errors are correlated in time, such as GNSS receivers.

The error of a measurement at time t is `f m(t)` plus a small white part. f^2 is proportional to
the variance that the sender gives (`CorrelatedErrors`); m is a first-order Gauss-Markov process
with variance 1 and time constant tau in each coordinate. `GaussMarkovBias` estimates m as a
*bias*: time is divided into bins of tau / `BINS`, each bin with measurements has one state, and
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
from collections.abc import Collection
from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphUpdate, NextIds
from pose_graph_ros.core.saved_columns import Integers

# Number of bins in one time constant.
BINS = 64
# Fraction of the variance that is white noise where a time constant is given.
WHITE_SHARE = 0.05
# Lower bound of the variance of a measurement without the motion since its node, as a share.
LEAST_OWN = 0.01
# Instead of the id of a transition: the prior of the graph is on the state.
NO_TRANSITION = -1
# Unit of the third number of a state, the error of the heading, in sigmas. Its variance is then
# 1 / STRETCH^2: the number is wrapped like an angle and must stay well below pi.
STRETCH = 10.0
_INFORMATION = np.diag((1.0, 1.0, STRETCH**2))


class CorrelatedErrors(NamedTuple):
    """Statistics of the errors of a source."""

    tau: float
    """Time constant of the correlated part [s]."""
    correlated: float
    """Variance of the correlated part, in units of the variance that the sender gives."""
    white: float
    """Variance of the white part, in the same units."""


@dataclass(frozen=True, slots=True)
class SavedBins:
    """The states of the bias of one source."""

    width_ns: int
    numbers: Integers
    """Bin numbers, increasing: bin k begins at the stamp k `width_ns`."""
    rows: Integers
    """Id of each state."""
    ties: Integers
    """
    Id of the edge from each state to the one before; for the first state that of the observed
    node that is its prior, -1 if the prior of the graph has it.
    """


@dataclass(slots=True)
class Additions:
    """Changes of one update, collected row by row; for the fields see `GraphUpdate`."""

    first: NextIds
    """Ids of the first new rows."""
    biases: list[FloatArray] = field(default_factory=list)
    dimensions: list[int] = field(default_factory=list)
    edges: list[Edges] = field(default_factory=list)
    observed: list[ObservedNodes] = field(default_factory=list)
    remove_edges: list[int] = field(default_factory=list)
    remove_observed: list[int] = field(default_factory=list)

    def update(self) -> GraphUpdate:
        """Return the update with all changes."""
        return GraphUpdate(
            biases=np.array(self.biases).reshape(-1, 3), dimensions=self.dimensions,
            edges=Edges.joined(self.edges),
            observed=ObservedNodes.joined(self.observed), remove_edges=self.remove_edges,
            remove_observed=self.remove_observed)

    def add_bias(self, value: float = 0.0, dimension: int = 3) -> int:
        """
        Return the id of a bias state that is added.

        Parameters
        ----------
        value : float, initial value of its first number
        dimension : int, how many numbers it has

        """
        self.biases.append(np.array((value, 0.0, 0.0)))
        self.dimensions.append(dimension)
        return self.first.node + len(self.biases) - 1

    def add_edge(self, edge: Edges) -> int:
        """Add an edge and return its id."""
        self.edges.append(edge)
        return self.first.edge + len(self.edges) - 1

    def add_observed(self, observed: ObservedNodes) -> int:
        """Add an observed node and return its id."""
        self.observed.append(observed)
        return self.first.observed + len(self.observed) - 1


@dataclass(slots=True)
class _Bin:
    """One state of a bias."""

    node: int
    """Id of the state."""
    transition: int
    """Id of the edge to the state before; for the first state that of its prior."""


class GaussMarkovBias:
    """The bias of one source: a chain of states in the graph."""

    def __init__(self, errors: CorrelatedErrors) -> None:
        self.errors = errors
        self._width_ns = max(round(errors.tau * 1e9 / BINS), 1)
        self._numbers: list[int] = []
        self._bins: dict[int, _Bin] = {}
        self._carried: int | None = None
        """Number of the bin that the prior of the graph is on, as older ones have left."""
        self._log: list[tuple[int, int | None, int]] = []
        """
        Numbers of the bins made since `begin`, each with the number of the neighbour that got
        another transition, and the one that it had.
        """

    @property
    def nodes(self) -> list[int]:
        """Ids of all states, in the order of time."""
        return [self._bins[number].node for number in self._numbers]

    def leaving(self, oldest_ns: int | None) -> list[int]:
        """
        Return the ids of the states that no measurement needs, but never that of the newest bin.

        `oldest_ns` is the oldest stamp of a measurement that is left [ns], None if there is none.
        """
        last = max(len(self._numbers) - 1, 0)
        end = last if oldest_ns is None else min(
            bisect.bisect_left(self._numbers, oldest_ns // self._width_ns), last)
        return self.nodes[:end]

    def forget(self, nodes: Collection[int]) -> None:
        """Forget states that have left the graph, the oldest ones, by their ids."""
        gone = {number for number in self._numbers if self._bins[number].node in nodes}
        for number in gone:
            del self._bins[number]
        self._numbers = [number for number in self._numbers if number not in gone]
        if len(gone) == 0 or (self._carried is not None and self._carried not in gone):
            return
        self._carried = self._numbers[0] if len(self._numbers) > 0 else None
        if self._carried is not None:
            self._bins[self._carried].transition = NO_TRANSITION

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._log.clear()

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        for number, neighbour, transition in reversed(self._log):
            self._numbers.remove(number)
            del self._bins[number]
            if neighbour is not None:
                self._bins[neighbour].transition = transition
        self._log.clear()

    def saved(self) -> SavedBins:
        """Return the states of all bins."""
        numbers, rows, ties = np.array(
            [(number, self._bins[number].node, self._bins[number].transition)
             for number in self._numbers], dtype=np.int64).reshape(-1, 3).T.copy()
        return SavedBins(self._width_ns, numbers, rows, ties)

    def restore(self, saved: SavedBins) -> bool:
        """Restore saved states; return False if their bins have another width."""
        if saved.width_ns != self._width_ns:
            return False
        self._numbers = saved.numbers.tolist()
        for number, node, transition in zip(
                self._numbers, saved.rows.tolist(), saved.ties.tolist(), strict=True):
            self._bins[number] = _Bin(node, transition)
            if transition == NO_TRANSITION:
                self._carried = number
        return True

    def add(
        self, stamp_ns: int, observed: ObservedNodes, noise: FloatArray, additions: Additions,
    ) -> int:
        """
        Return the id of the edge that is added, from a measurement's node to its bin's state.

        Parameters
        ----------
        observed : ObservedNodes
            One row, the measurement if its error were white; the edge gets its weight.
        noise : array_like, shape (2,)
            What the motion since the node adds to the variances of the position and the heading of
            the measurement [m^2, rad^2].
        additions : Additions, receives the edge, and the state if it is new

        """
        number, rest_ns = divmod(stamp_ns, self._width_ns)
        if number not in self._bins:
            self._make_bin(number, additions)
        phi = self._phi(abs(rest_ns - self._width_ns / 2))
        return additions.add_edge(biased_constraint(
            observed, noise, self._bins[number].node, phi, self.errors))

    def preview(self, stamp_ns: int, observed: ObservedNodes, noise: FloatArray) -> Edges | None:
        """
        Return the edge of a measurement to the last state before it; None without one.

        Parameters
        ----------
        observed, noise : as in `add`

        """
        at = bisect.bisect(self._numbers, stamp_ns // self._width_ns)
        if at == 0:
            return None
        number = self._numbers[at - 1]
        gap_ns = abs(stamp_ns - (number + 0.5) * self._width_ns)
        return biased_constraint(
            observed, noise, self._bins[number].node, self._phi(gap_ns), self.errors)

    def begin_ns(self, node: int) -> int | None:
        """Return when the bin of a state begins [ns], by its id; None for another source's."""
        return next((number * self._width_ns for number, made in self._bins.items()
                     if made.node == node), None)

    def _phi(self, gap_ns: float) -> float:
        return math.exp(-gap_ns * 1e-9 / self.errors.tau)

    def _make_bin(self, number: int, additions: Additions) -> None:
        """
        Add the state of a bin between its neighbours in time.

        Transitions lead away from the state with the prior: back to it, or, from late states
        before one that the prior of the graph is on, forward.
        """
        at = bisect.bisect(self._numbers, number)
        before = self._numbers[at - 1] if at > 0 else None
        after = self._numbers[at] if at < len(self._numbers) else None
        if self._carried is not None and number < self._carried:
            before, after = after, before
        node = additions.add_bias()
        made = _Bin(node, self._add_transition(node, number, before, additions))
        self._log.append((
            number, after, NO_TRANSITION if after is None else self._bins[after].transition))
        self._numbers.insert(at, number)
        self._bins[number] = made
        if after is not None:
            old = self._bins[after]
            if before is None:
                additions.remove_observed.append(old.transition)
            else:
                additions.remove_edges.append(old.transition)
            old.transition = self._add_transition(old.node, after, number, additions)

    def _add_transition(
        self, node: int, number: int, before: int | None, additions: Additions,
    ) -> int:
        """Add the edge from a state to that of the bin before, or its prior if it is first."""
        if before is None:
            return additions.add_observed(ObservedNodes(
                [node], None, np.zeros((1, 3)), _INFORMATION[None], [ObservedKind.GLOBAL_POSE]))
        phi = self._phi(abs(number - before) * self._width_ns)
        return additions.add_edge(Edges(
            [node], [self._bins[before].node], np.zeros((1, 3)),
            _INFORMATION[None] / (1.0 - phi * phi), [EdgeKind.BIAS],
            bias=np.array([(0.0, 0.0, phi, phi)])))


def biased_constraint(
    observed: ObservedNodes, noise: FloatArray, bias: int, phi: float, errors: CorrelatedErrors,
) -> Edges:
    """
    Return the edge from a hidden node x to a state of the bias that holds a measurement.

    The error of the edge in map axes is `f m + z - x * o`. o is the motion since the node and the
    lever arm; z is the measured pose; f is the standard deviation of the correlated part, from the
    mean of the variances of x and y. m is phi times the state plus a white rest of variance
    1 - phi^2.

    Parameters
    ----------
    noise : array_like, shape (2,), as in `GaussMarkovBias.add`
    bias : int, id of the state
    phi : float, correlation of the error with the state

    """
    factors, information, mean = np.zeros(2), np.zeros((3, 3)), observed.mean[0].copy()
    given, kind, offset = observed.information[0], observed.kind[0], observed.offset[0]
    if kind == ObservedKind.HEADING:
        own = _own(1.0 / float(given[2, 2]), noise[1])
        factors[1], rest = _split(errors.correlated * own, phi)
        information[2, 2] = 1.0 / (errors.white * own + rest + noise[1])
    elif kind == ObservedKind.POSITION:
        cov = np.linalg.inv(given[:2, :2])
        total = 0.5 * float(np.trace(cov))
        own = _own(total, noise[0])
        factors[0], rest = _split(errors.correlated * own, phi)
        information[:2, :2] = covariance.information(
            errors.white * own / total * cov + (rest + noise[0]) * np.eye(2))
    else:
        cov = covariance.turned(np.linalg.inv(given), -float(mean[2]))
        total, total_heading = 0.5 * float(np.trace(cov[:2, :2])), float(cov[2, 2])
        own, own_heading = _own(total, noise[0]), _own(total_heading, noise[1])
        factors[0], rest = _split(errors.correlated * own, phi)
        factors[1], rest_heading = _split(errors.correlated * own_heading, phi)
        scale = np.sqrt((own / total, own / total, own_heading / total_heading))
        information = covariance.information(
            errors.white * scale[:, None] * cov * scale
            + np.diag((rest + noise[0], rest + noise[0], rest_heading + noise[1])))
    if kind != ObservedKind.POSITION:
        mean[2] = se2.wrap(mean[2] - offset[2])
    return Edges([observed.node[0]], [bias], [mean], [information], [EdgeKind.BIAS],
                 weight=observed.weight,
                 bias=[(offset[0], offset[1], phi * factors[0], STRETCH * phi * factors[1])])


def _own(total: float, noise: float) -> float:
    """Return the variance of a measurement without that of the motion since its node."""
    return max(total - noise, LEAST_OWN * total)


def _split(variance: float, phi: float) -> tuple[float, float]:
    """Return f, and the variance of the part of `f m(t)` that the state does not explain."""
    return math.sqrt(variance), variance * (1.0 - phi * phi)
