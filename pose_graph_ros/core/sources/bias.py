# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Biases: errors of a source that go on in time, as a chain of states in the graph.

Time is divided into bins; each bin with measurements has one state, of up to three coordinates.
The chain is a first-order Gauss-Markov process or a random walk (`Process`): consecutive states
are connected by

    m_k = phi m_{k-1} + w,

and the first state has a prior. The bin of a measurement depends on its stamp alone, and the state
of a bin that is filled later is inserted between its neighbours, so the order of arrival does not
matter. Transitions lead away from the state with the prior, the anchor: a stationary process is
the same backwards in time, so an earlier state hangs on the next one. Where older states have left
the graph, its prior holds what is known of the first one that stays.

A chain is a value: an update that fails leaves the old one.
"""

from dataclasses import dataclass, field
import math
from typing import Final, NamedTuple, Self

import numpy as np

from pose_graph_ros.core.config import GyroSource, OdometrySource
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate, NextIds
from pose_graph_ros.core.saved_columns import Integers
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.sources.settings import SOURCES

# Unit of the third number of a state of correlated errors, the error of the heading, in sigmas.
# Its variance is then 1 / STRETCH^2: the number is wrapped like an angle and must stay well below
# pi.
STRETCH = 10.0
_NONE: Final[IntArray] = np.empty(0, dtype=np.int64)


class CorrelatedErrors(NamedTuple):
    """
    Statistics of errors of which a part is correlated in time, such as those of a GNSS receiver.

    The error of a measurement is `f m(t)` plus a white part, f^2 proportional to the variance that
    the sender gives; m is a stationary process of variance 1 in each coordinate.
    """

    tau: float  # time constant of the correlated part [s]
    # variance of the correlated part, in units of the variance that the sender gives
    correlated: float
    white: float  # variance of the white part, in the same units


WHITE = CorrelatedErrors(0.0, 0.0, 1.0)


class Calibration(NamedTuple):
    """What an odometry is calibrated by at present, with sigmas."""

    rate: float  # what the yaw rate is larger than odometry says [rad/s]
    rate_sigma: float
    scale: float  # by which part the way is longer than odometry says
    scale_sigma: float


class Process(NamedTuple):
    """How a bias goes on in time, in each of its coordinates."""

    bin_ns: int     # the bias has a new state this often
    variances: tuple[float, ...]    # of the first state
    # a random walk: what the variances grow by in a second; without, the process is stationary
    growth: tuple[float, ...] = ()
    tau: float = math.inf   # time constant of a stationary process [s]
    # time without measurements after which it begins anew [s]
    longest_gap: float = math.inf

    @classmethod
    def correlated(cls, errors: CorrelatedErrors) -> Self:
        """Return the process of the correlated part of errors, in units of its sigma."""
        return cls(max(round(errors.tau * 1e9 / SOURCES.bins), 1), (1.0, 1.0, STRETCH**-2.0),
                   tau=errors.tau)

    @classmethod
    def of_gyro(cls, source: GyroSource) -> Self:
        """Return the process of the bias of a gyroscope [rad/s]."""
        return cls(round(source.bias_period * 1e9), (source.sigma_bias**2,),
                   (source.sigma_bias_walk**2,), longest_gap=SOURCES.switched_off)

    @classmethod
    def of_odometry(cls, source: OdometrySource) -> Self:
        """Return the process of bias of the yaw rate [rad/s] and error of the scale."""
        return cls(round(SOURCES.calibration_period * 1e9),
                   tuple(sigma**2 for sigma in source.calibration_sigma),
                   tuple(walk**2 / 3600.0 for walk in source.calibration_walk))

    def transitions(self, later: IntArray, earlier: IntArray, seconds: FloatArray) -> Factors:
        """Return the edges from states to those some seconds before, or behind."""
        phi = np.exp(-seconds / self.tau)
        if len(self.growth) > 0:
            variances = seconds[:, None] * self.growth
        else:
            variances = (1.0 - phi**2)[:, None] * self.variances
        n = len(later)
        return Factors(
            later, earlier, np.zeros((n, 3)), _informations(variances), [FactorKind.BIAS] * n,
            constants=np.column_stack((np.zeros((n, 2)), phi, phi)))

    def priors(self, states: IntArray) -> Factors:
        n = len(states)
        return Factors.on(states, None, np.zeros((n, 3)),
                          _informations(np.tile(self.variances, (n, 1))),
                          [FactorKind.GLOBAL_POSE] * n)


def _informations(variances: FloatArray) -> FloatArray:
    """Return the informations of the first coordinates, given their variances, shape (M, d)."""
    informations = np.zeros((len(variances), 3, 3))
    at = np.arange(variances.shape[1])
    informations[:, at, at] = 1.0 / variances
    return informations


@dataclass(slots=True)
class Additions:
    """Changes of one update, collected; for the fields see `GraphUpdate`."""

    first: NextIds  # ids of the first new rows
    biases: list[FloatArray] = field(default_factory=list)
    dimensions: list[int] = field(default_factory=list)
    factors: list[Factors] = field(default_factory=list)
    remove: list[int] = field(default_factory=list)
    n_factors: int = 0

    def update(self) -> GraphUpdate:
        return GraphUpdate(biases=np.array(self.biases).reshape(-1, 3), dimensions=self.dimensions,
                           factors=Factors.joined(self.factors), remove=self.remove)

    def add(self, factors: Factors) -> IntArray:
        """Add factors; return their ids."""
        begin = self.first.factor + self.n_factors
        self.factors.append(factors)
        self.n_factors += len(factors)
        return np.arange(begin, begin + len(factors))


@dataclass(frozen=True, slots=True)
class BiasChain:
    """The states of a bias in the graph, by time; it is saved as it is."""

    begins_ns: Integers = field(default_factory=_NONE.copy)  # stamps at which the bins begin [ns]
    nodes: Integers = field(default_factory=_NONE.copy)  # ids of the states
    # ids of the edges between each state and the one before; -1 where the process begins anew
    ties: Integers = field(default_factory=_NONE.copy)
    anchor: int = -1  # id of the state that has a prior, the first one if several have
    bin_ns: int = 0  # duration of the newest bins; 0 without any

    def __len__(self) -> int:
        return len(self.nodes)

    def at(self, stamp_ns: int) -> int:
        """Return the number of the state of an instant, -1 before the first one."""
        return int(np.searchsorted(self.begins_ns, stamp_ns, side='right')) - 1

    def state(self, stamp_ns: int) -> int:
        """Return the id of the state of an instant."""
        return int(self.nodes[max(self.at(stamp_ns), 0)])

    def with_bins(self, stamps_ns: IntArray, process: Process, additions: Additions,
                  value: FloatArray) -> 'BiasChain':
        """
        Return the chain with a state for the bin of each stamp.

        What is new goes into an update, with an initial value of the new states, shape (3,).
        """
        new_ns = np.unique(stamps_ns // process.bin_ns * process.bin_ns)
        at = np.searchsorted(self.begins_ns, new_ns, side='right')
        is_new = np.append(-1, self.begins_ns)[at] != new_ns
        new_ns, at = new_ns[is_new], at[is_new]
        if len(new_ns) == 0:
            return self
        begins_ns = np.insert(self.begins_ns, at, new_ns)
        first = additions.first.node + len(additions.biases)
        nodes = np.insert(self.nodes, at, np.arange(first, first + len(new_ns)))
        additions.biases += len(new_ns) * [value]
        additions.dimensions += len(new_ns) * [len(process.variances)]
        ties = np.insert(self.ties, at, -1)
        old = np.insert(np.ones(len(self), dtype=bool), at, values=False)
        seconds = np.diff(begins_ns) * 1e-9
        parted = np.flatnonzero(~(old[1:] & old[:-1])) + 1
        additions.remove += ties[parted][ties[parted] >= 0].tolist()
        ties[parted] = -1

        connected = seconds <= process.longest_gap
        starts = np.flatnonzero(np.append(True, ~connected))
        alone = nodes[starts[~np.logical_or.reduceat(old, starts)]]
        additions.add(process.priors(alone))
        anchor = self.anchor if len(self) > 0 else int(alone[0])

        to = parted[connected[parted - 1]]
        forward = to <= np.flatnonzero(nodes == anchor)
        ties[to] = additions.add(process.transitions(
            np.where(forward, nodes[to - 1], nodes[to]),
            np.where(forward, nodes[to], nodes[to - 1]), seconds[to - 1]))
        return BiasChain(begins_ns, nodes, ties, anchor, process.bin_ns)

    def leaving(self, oldest_ns: int | None) -> list[int]:
        """Return the states before the oldest measurement that stays, but for the newest one."""
        end = len(self) - 1 if oldest_ns is None else self.at(oldest_ns)
        return self.nodes[:max(end, 0)].tolist()

    def without(self, nodes: IntArray) -> 'BiasChain':
        """Return the chain without states that have left the graph, the oldest ones."""
        kept = ~np.isin(self.nodes, nodes)
        if np.all(kept):
            return self
        left, ties = self.nodes[kept], self.ties[kept]
        ties[:1] = -1
        anchor = self.anchor if self.anchor in left else int(left[0]) if len(left) > 0 else -1
        return BiasChain(self.begins_ns[kept], left, ties, anchor, self.bin_ns)


def held_by_bias(queued: Queued, chain: BiasChain, errors: CorrelatedErrors | None) -> Factors:
    """
    Return the edge from a hidden node x to the state of the bias that holds a measurement.

    That is the last one before it; where there is none, the edge leads to -1.

    The error of the edge in map axes is `f m + z - x * o`. o is the motion since the node and the
    lever arm; z is the measured pose; f is the standard deviation of the correlated part, from the
    mean of the variances of x and y. m is phi times the state plus a white rest of variance
    1 - phi^2. What is queued is the measurement if its error were white.
    """
    observed, noise, bias, phi = queued.factor, queued.noise, -1, 1.0
    at = chain.at(queued.stamp_ns)
    if errors is None or at < 0:
        errors = WHITE
    else:
        gap_ns = abs(queued.stamp_ns - int(chain.begins_ns[at]) - chain.bin_ns / 2)
        bias, phi = int(chain.nodes[at]), math.exp(-gap_ns * 1e-9 / errors.tau)
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
