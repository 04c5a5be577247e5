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

`InflatedWeights` is a cheap approximation: each of n measurements within 2 tau has the weight
1 / n, because together they are worth about one measurement with an independent error. A new
measurement changes the weights of all others. To bound the work, each one sets those of `RENEWED`
others, in turn, so that no weight is off by more than about 1 / `RENEWED`; `settle` sets the rest.
"""

import bisect
from dataclasses import dataclass, field
import itertools
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import Correlation
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.saved_columns import Integers

# Number of bins in one time constant.
BINS = 64
# Lower bound of the white share of the variance; 0 would make the system singular.
LEAST_WHITE = 1e-3
# Lower bound of the variance of a measurement without the motion since its node, as a share.
LEAST_OWN = 0.01
# Unit of the third number of a state, the error of the heading, in sigmas. Its variance is then
# 1 / STRETCH^2: the number is wrapped like an angle and must stay well below pi.
STRETCH = 10.0
_INFORMATION = np.diag((1.0, 1.0, STRETCH**2))
# Number of older weights in its bin that a measurement renews, and of such weights in other bins.
RENEWED = 32


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
    """Row of each state in the graph."""
    ties: Integers
    """
    Row of the edge from each state to the one before; for the first state the row of the observed
    node that is its prior.
    """


class GraphSizes(NamedTuple):
    """Numbers of rows in the graph before an update, which are the first new row numbers."""

    n_nodes: int
    n_edges: int
    n_observed: int


@dataclass(slots=True)
class Additions:
    """Changes of one update, collected row by row; for the fields see `GraphUpdate`."""

    sizes: GraphSizes
    biases: list[FloatArray] = field(default_factory=list)
    edges: list[Edges] = field(default_factory=list)
    observed: list[ObservedNodes] = field(default_factory=list)
    remove_edges: list[int] = field(default_factory=list)
    remove_observed: list[int] = field(default_factory=list)
    weigh_observed: dict[int, float] = field(default_factory=dict)

    def update(self) -> GraphUpdate:
        """Return the update with all changes but the weights."""
        return GraphUpdate(
            biases=np.array(self.biases).reshape(-1, 3), edges=Edges.joined(self.edges),
            observed=ObservedNodes.joined(self.observed), remove_edges=self.remove_edges,
            remove_observed=self.remove_observed)

    def add_bias(self) -> int:
        """Add a bias state and return its row in the graph."""
        self.biases.append(np.zeros(3))
        return self.sizes.n_nodes + len(self.biases) - 1

    def add_edge(self, edge: Edges) -> int:
        """Add an edge and return its row in the graph."""
        self.edges.append(edge)
        return self.sizes.n_edges + len(self.edges) - 1

    def add_observed(self, observed: ObservedNodes) -> int:
        """Add an observed node and return its row in the graph."""
        self.observed.append(observed)
        return self.sizes.n_observed + len(self.observed) - 1


@dataclass(slots=True)
class _Bin:
    """One state of a bias."""

    row: int
    """Row of the state in the graph."""
    transition: int
    """Row of the edge to the state before; for the first state that of its prior."""


class GaussMarkovBias:
    """The bias of one source: a chain of states in the graph."""

    def __init__(self, errors: CorrelatedErrors) -> None:
        self.errors = errors
        self._width_ns = max(round(errors.tau * 1e9 / BINS), 1)
        self._numbers: list[int] = []
        self._bins: dict[int, _Bin] = {}
        self._log: list[tuple[int, int | None, int]] = []
        """
        Numbers of the bins made since `begin`, each with the number of the next bin and the
        transition that the next bin had.
        """

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._log.clear()

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        for number, after, transition in reversed(self._log):
            self._numbers.remove(number)
            del self._bins[number]
            if after is not None:
                self._bins[after].transition = transition
        self._log.clear()

    def saved(self) -> SavedBins:
        """Return the states of all bins."""
        numbers, rows, ties = np.array(
            [(number, self._bins[number].row, self._bins[number].transition)
             for number in self._numbers], dtype=np.int64).reshape(-1, 3).T.copy()
        return SavedBins(self._width_ns, numbers, rows, ties)

    def restore(self, saved: SavedBins) -> bool:
        """Restore saved states; return False if their bins have another width."""
        if saved.width_ns != self._width_ns:
            return False
        self._numbers = saved.numbers.tolist()
        for number, row, transition in zip(
                self._numbers, saved.rows.tolist(), saved.ties.tolist(), strict=True):
            self._bins[number] = _Bin(row, transition)
        return True

    def add(
        self, stamp_ns: int, observed: ObservedNodes, noise: FloatArray, additions: Additions,
    ) -> int:
        """
        Return the row of the edge that is added, from a measurement's node to its bin's state.

        Parameters
        ----------
        stamp_ns : int
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
        return additions.add_edge(_biased_constraint(
            observed, noise, self._bins[number].row, phi, self.errors))

    def begin_ns(self, row: int) -> int | None:
        """Return when the bin of a state begins [ns], by its row; None for another source's."""
        return next((number * self._width_ns for number, made in self._bins.items()
                     if made.row == row), None)

    def _phi(self, gap_ns: float) -> float:
        return math.exp(-gap_ns * 1e-9 / self.errors.tau)

    def _make_bin(self, number: int, additions: Additions) -> None:
        """Add the state of a bin between its neighbours in time."""
        at = bisect.bisect(self._numbers, number)
        before = self._numbers[at - 1] if at > 0 else None
        after = self._numbers[at] if at < len(self._numbers) else None
        row = additions.add_bias()
        made = _Bin(row, self._add_transition(row, number, before, additions))
        self._log.append((number, after, -1 if after is None else self._bins[after].transition))
        self._numbers.insert(at, number)
        self._bins[number] = made
        if after is not None:
            old = self._bins[after]
            if before is None:
                additions.remove_observed.append(old.transition)
            else:
                additions.remove_edges.append(old.transition)
            old.transition = self._add_transition(old.row, after, number, additions)

    def _add_transition(
        self, row: int, number: int, before: int | None, additions: Additions,
    ) -> int:
        """Add the edge from a state to that of the bin before, or its prior if it is first."""
        if before is None:
            return additions.add_observed(ObservedNodes(
                [row], None, np.zeros((1, 3)), _INFORMATION[None], [ObservedKind.GLOBAL_POSE]))
        phi = self._phi((number - before) * self._width_ns)
        return additions.add_edge(Edges(
            [row], [self._bins[before].row], np.zeros((1, 3)),
            _INFORMATION[None] / (1.0 - phi * phi), [EdgeKind.BIAS],
            bias=np.array([(0.0, 0.0, phi, phi)])))


@dataclass(slots=True)
class _WeightBin:
    """The measurements within 2 tau."""

    rows: list[int] = field(default_factory=list)
    """Rows of their observed nodes."""
    next: int = 0
    """Index of the weight that is renewed next."""
    n_waiting: int = 0
    """Number of weights, from there on and in a circle, that are not yet 1 / n."""


class InflatedWeights:
    """Weights of the measurements of one source, lower the more of them lie within 2 tau."""

    def __init__(self, errors: CorrelatedErrors) -> None:
        self.errors = errors
        self._width_ns = max(round(2e9 * errors.tau), 1)
        self._bins: dict[int, _WeightBin] = {}
        self._waiting: dict[int, None] = {}
        """Numbers of the bins with weights that wait to be renewed, the first one first."""
        self._log: list[tuple[int, int, int, int]] = []
        """Number of each bin that has changed since `begin`, and what it was like."""

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._log.clear()

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        for number, size, at, n_waiting in reversed(self._log):
            made = self._bins[number]
            del made.rows[size:]
            made.next, made.n_waiting = at, n_waiting
            self._note(number)
        self._log.clear()

    def restore(self, rows: IntArray) -> None:
        """Restore the measurements of a loaded graph: stamps [ns] and rows, shape (K, 2)."""
        for stamp_ns, row in rows.tolist():
            number = stamp_ns // self._width_ns
            made = self._bins.setdefault(number, _WeightBin())
            made.rows.append(row)
            made.n_waiting += 1     # which of them waited is not saved
            self._note(number)

    def add(self, stamp_ns: int, observed: ObservedNodes, additions: Additions) -> int:
        """
        Return the row of the observed node that is added.

        Parameters
        ----------
        stamp_ns : int
        observed : ObservedNodes, one row
        additions : Additions, receives the row, its weight and some weights of older measurements

        """
        row = additions.add_observed(observed)
        number = stamp_ns // self._width_ns
        made = self._bins.setdefault(number, _WeightBin())
        self._log.append((number, len(made.rows), made.next, made.n_waiting))
        made.rows.append(row)
        made.n_waiting = len(made.rows)
        additions.weigh_observed[row] = 1.0 / len(made.rows)
        self._renew(number, RENEWED, additions)
        left = RENEWED
        for other in list(itertools.islice(self._waiting, RENEWED)):
            if other != number and left > 0:
                left -= self._renew(other, left, additions)
        return row

    def settle(self, additions: Additions) -> None:
        """Add the weights of all measurements, as other ones may be believed than before."""
        for number, made in self._bins.items():
            if len(made.rows) == 0:
                continue    # all of it was rolled back
            self._log.append((number, len(made.rows), made.next, made.n_waiting))
            made.n_waiting = len(made.rows)
            self._renew(number, len(made.rows), additions)

    def _renew(self, number: int, most: int, additions: Additions) -> int:
        """Add some weights of a bin that wait to be renewed, and return how many."""
        made = self._bins[number]
        self._log.append((number, len(made.rows), made.next, made.n_waiting))
        count = min(most, made.n_waiting)
        for k in range(made.next, made.next + count):
            additions.weigh_observed[made.rows[k % len(made.rows)]] = 1.0 / len(made.rows)
        made.next = (made.next + count) % len(made.rows)
        made.n_waiting -= count
        self._note(number)
        return count

    def _note(self, number: int) -> None:
        """Keep the list of bins with weights that wait up to date."""
        if self._bins[number].n_waiting > 0:
            self._waiting[number] = None
        else:
            self._waiting.pop(number, None)


ErrorModel = GaussMarkovBias | InflatedWeights


def new_error_model(errors: CorrelatedErrors, correlation: Correlation) -> ErrorModel:
    """
    Return a model of correlated errors, without measurements.

    Parameters
    ----------
    errors : CorrelatedErrors
    correlation : Correlation

    """
    inflates = correlation is Correlation.INFLATE
    return InflatedWeights(errors) if inflates else GaussMarkovBias(errors)


def _biased_constraint(
    observed: ObservedNodes, noise: FloatArray, bias: int, phi: float, errors: CorrelatedErrors,
) -> Edges:
    """
    Return the edge from a hidden node x to a state of the bias that holds a measurement.

    The error of the edge in map axes is `f m + z - x * o`. o is the motion since the node and the
    lever arm; z is the measured pose; f is the standard deviation of the correlated part, from the
    mean of the variances of x and y. m is phi times the state plus a white rest of variance
    1 - phi^2.
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
