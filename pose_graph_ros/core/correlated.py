# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sources whose errors live on from one measurement to the next, such as GNSS.

The error of a measurement at t is `f m(t)` plus a small white part: f^2 is the variance that the
sender gives, and m a first-order Gauss-Markov process of variance 1 and time constant tau in each
coordinate. m is estimated, as a *bias*: time is cut into bins of a small part of tau, each bin
with measurements has one hidden state, and consecutive ones are tied by

    m_k = phi m_{k-1} + w,   phi = exp(-gap / tau),   Var w = 1 - phi^2,

the first one by its variance. Within a bin, `m(t) = phi' m_k + w'` likewise, with t counted from
the middle of the bin. Which measurements share a bin depends on their stamps alone, and a bin that
is filled later is tied in between its neighbours, so the order of arrival does not matter.

Inflation is the cheap way: of the measurements within 2 tau each counts as an equal share of one,
which is what errors that live for tau are worth when they are many.
"""

import bisect
from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.binding import Anchor, swept_variance
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.measurements import Absolute, HeadingOnly, Position
from pose_graph_ros.core.saved_columns import Integers
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import MeasurementSource

# Bins in a time constant.
BINS = 64
# An error that is known to the last digit would be told to the solver twice.
LEAST_WHITE = 1e-3
# The third number of a state is wrapped as a heading is, so it is kept small: in units of so many
# sigmas. Its variance is 1 / STRETCH^2.
STRETCH = 10.0
_INFORMATION = np.diag((1.0, 1.0, STRETCH**2))


class GraphSizes(NamedTuple):
    """Of the graph before an update: new rows are numbered from here on."""

    n_nodes: int
    n_edges: int
    n_observed: int


@dataclass(slots=True)
class Additions:
    """What joins the graph in an update, a row a table, and what goes; as `GraphUpdate`."""

    sizes: GraphSizes
    biases: list[FloatArray] = field(default_factory=list)
    edges: list[Edges] = field(default_factory=list)
    observed: list[ObservedNodes] = field(default_factory=list)
    remove_edges: list[int] = field(default_factory=list)
    remove_observed: list[int] = field(default_factory=list)
    weigh_observed: dict[int, float] = field(default_factory=dict)

    def add_bias(self) -> int:
        """Add a state; return its row."""
        self.biases.append(np.zeros(3))
        return self.sizes.n_nodes + len(self.biases) - 1

    def add_edge(self, edge: Edges) -> int:
        """Add an edge; return its row."""
        self.edges.append(edge)
        return self.sizes.n_edges + len(self.edges) - 1

    def add_observed(self, observed: ObservedNodes) -> int:
        """Add an observed node; return its row."""
        self.observed.append(observed)
        return self.sizes.n_observed + len(self.observed) - 1


@dataclass(slots=True)
class _Bin:
    """One state of the error."""

    row: int
    """In the graph."""
    tie: int
    """Edge to the state before; for the first bin the observed node that is its prior."""


@dataclass(frozen=True, slots=True)
class SavedBins:
    """The states of the error of a source."""

    width_ns: int
    numbers: Integers
    """Of the bins, increasing."""
    rows: Integers
    ties: Integers


class BiasChain:
    """
    The states of the error of one source.

    Parameters
    ----------
    source : MeasurementSource
        With a correlation time.

    """

    def __init__(self, source: MeasurementSource) -> None:
        self._source = source
        self._width_ns = max(round(source.correlation_time * 1e9 / BINS), 1)
        self._numbers: list[int] = []
        self._bins: dict[int, _Bin] = {}
        self._journal: list[tuple[int, int | None, int]] = []
        """Bins that were made since `begin`, each with its successor and the tie that had."""

    def begin(self) -> None:
        """Begin an update, which can be undone."""
        self._journal.clear()

    def undo(self) -> None:
        """Forget what has been added since `begin`."""
        for number, after, tie in reversed(self._journal):
            self._numbers.remove(number)
            del self._bins[number]
            if after is not None:
                self._bins[after].tie = tie
        self._journal.clear()

    def saved(self) -> SavedBins:
        """Return the bins that there are."""
        bins = [self._bins[number] for number in self._numbers]
        numbers, rows, ties = (np.array(column, dtype=np.int64) for column in (
            self._numbers, [each.row for each in bins], [each.tie for each in bins]))
        return SavedBins(self._width_ns, numbers, rows, ties)

    def restore(self, saved: SavedBins) -> bool:
        """Go on with saved bins; tell if that can be, as they are as wide as those here."""
        if saved.width_ns != self._width_ns:
            return False
        self._numbers = saved.numbers.tolist()
        for number, row, tie in zip(
                self._numbers, saved.rows.tolist(), saved.ties.tolist(), strict=True):
            self._bins[number] = _Bin(row, tie)
        return True

    def add(self, measurement: Absolute, anchor: Anchor, additions: Additions) -> int:
        """Add a measurement with the state of its error; return the row of its edge."""
        number, rest_ns = divmod(measurement.stamp_ns, self._width_ns)
        if number not in self._bins:
            self._make_bin(number, additions)
        phi = self._phi(abs(rest_ns - self._width_ns / 2))
        return additions.add_edge(_biased_constraint(
            measurement, anchor, self._bins[number].row, phi,
            max(self._source.white_share, LEAST_WHITE)))

    def begin_ns(self, row: int) -> int | None:
        """Return when the time of a state begins [ns], by its row; None if it is not of here."""
        return next((number * self._width_ns for number, made in self._bins.items()
                     if made.row == row), None)

    def _phi(self, gap_ns: float) -> float:
        return math.exp(-gap_ns * 1e-9 / self._source.correlation_time)

    def _make_bin(self, number: int, additions: Additions) -> None:
        """Add a state between its neighbours in time."""
        at = bisect.bisect(self._numbers, number)
        before = self._numbers[at - 1] if at > 0 else None
        after = self._numbers[at] if at < len(self._numbers) else None
        row = additions.add_bias()
        made = _Bin(row, self._tie(row, number, before, additions))
        self._journal.append((number, after, -1 if after is None else self._bins[after].tie))
        self._numbers.insert(at, number)
        self._bins[number] = made
        if after is not None:
            old = self._bins[after]
            if before is None:
                additions.remove_observed.append(old.tie)
            else:
                additions.remove_edges.append(old.tie)
            old.tie = self._tie(old.row, after, number, additions)

    def _tie(self, row: int, number: int, before: int | None, additions: Additions) -> int:
        """Tie a state to the one before; the first one has its variance alone."""
        if before is None:
            return additions.add_observed(ObservedNodes(
                [row], None, np.zeros((1, 3)), _INFORMATION[None], [ObservedKind.GLOBAL_POSE]))
        phi = self._phi((number - before) * self._width_ns)
        return additions.add_edge(Edges(
            [row], [self._bins[before].row], np.zeros((1, 3)),
            _INFORMATION[None] / (1.0 - phi * phi), [EdgeKind.BIAS],
            bias=np.array([(0.0, 0.0, phi, phi)])))


class Shares:
    """
    Inflation: the weights of the measurements of one source.

    Parameters
    ----------
    source : MeasurementSource
        With a correlation time.

    """

    def __init__(self, source: MeasurementSource) -> None:
        self._width_ns = max(round(2e9 * source.correlation_time), 1)
        self._bins: dict[int, list[int]] = {}
        self._journal: list[int] = []

    def begin(self) -> None:
        """Begin an update, which can be undone."""
        self._journal.clear()

    def undo(self) -> None:
        """Forget what has been added since `begin`."""
        for number in reversed(self._journal):
            self._bins[number].pop()
        self._journal.clear()

    def restore(self, rows: IntArray) -> None:
        """Take measurements that are in a graph, by stamp and row, shape (K, 2)."""
        for stamp_ns, row in rows.tolist():
            self._bins.setdefault(stamp_ns // self._width_ns, []).append(row)

    def add(self, stamp_ns: int, observed: ObservedNodes, additions: Additions) -> int:
        """Add a measurement, and weigh those of its time anew; return its row."""
        row = additions.add_observed(observed)
        number = stamp_ns // self._width_ns
        rows = self._bins.setdefault(number, [])
        rows.append(row)
        self._journal.append(number)
        additions.weigh_observed |= dict.fromkeys(rows, 1.0 / len(rows))
        return row


def _biased_constraint(
    measurement: Absolute, anchor: Anchor, bias: int, phi: float, white_share: float,
) -> Edges:
    """
    Return the edge that ties a hidden node to a measurement through the state of its error.

    In map axes, with o the motion since the node and the lever arm, z the measured pose and f the
    deviation of the correlated part: `f m + z - x * o`, where m is phi times the state and a rest
    of variance 1 - phi^2, which is white. Of a covariance with unequal variances the mean is taken
    for f^2.
    """
    factors, information, mean = np.zeros(2), np.zeros((3, 3)), np.zeros(3)
    offset = anchor.motion
    axes = np.eye(3)
    if isinstance(measurement, HeadingOnly):
        variance = measurement.variance
        factors[1], rest = _split(variance, phi)
        mean[2] = measurement.heading - offset[2]
        information[2, 2] = 1.0 / (white_share * variance + rest + anchor.noise[2, 2])
    elif isinstance(measurement, Position):
        cov = measurement.covariance
        factors[0], rest = _split(0.5 * float(np.trace(cov)), phi)
        mean[:2] = measurement.position
        offset = se2.compose(anchor.motion, np.append(measurement.lever_arm, 0.0))
        information[:2, :2] = covariance.information(
            white_share * cov + (rest + swept_variance(measurement, anchor)) * np.eye(2))
    else:
        cov = measurement.covariance
        factors[0], rest = _split(0.5 * float(np.trace(cov[:2, :2])), phi)
        factors[1], rest_heading = _split(float(cov[2, 2]), phi)
        mean = measurement.pose - (0.0, 0.0, offset[2])
        axes[:2, :2] = se2.rotation(float(measurement.pose[2]))
        information = covariance.information(
            white_share * cov + np.diag((rest, rest, rest_heading))
            + axes @ anchor.noise @ axes.T)
    mean[2] = se2.wrap(mean[2])
    return Edges([anchor.node], [bias], [mean], [information], [EdgeKind.BIAS],
                 bias=[(offset[0], offset[1], phi * factors[0], STRETCH * phi * factors[1])])


def _split(variance: float, phi: float) -> tuple[float, float]:
    """Return f, and the variance of what leaves the state of the error within a bin."""
    return math.sqrt(variance), variance * (1.0 - phi * phi)
