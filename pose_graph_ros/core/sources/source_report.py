# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well the measurements of a source fit the estimate, and whether their errors are white."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.sources.bias import CorrelatedErrors
from pose_graph_ros.core.sources.settings import SOURCES


class Autocorrelation(NamedTuple):
    tau: float  # time constant of the correlated part [s]; 0 if nothing is significant
    # standard deviation of the correlated part of a coordinate, in the unit of the residuals
    sigma_correlated: float

    @property
    def significant(self) -> bool:
        return self.tau > 0.0


def estimate(stamps_ns: IntArray, residuals: FloatArray) -> Autocorrelation:
    """
    Return the time constant of errors, and the sigma of their correlated part.

    The sum of a first-order Gauss-Markov process and white noise has the autocovariance `c(h) =
    s_c^2 exp(-h / tau)` for h > 0 and `c(0) = s_c^2 + s_w^2`, which is fitted to that of the
    residuals at lags of whole periods. These are smaller than the errors, because the estimate
    follows the measurements: s_c comes out a little too small, and so does tau.

    Residuals have the shape (N, d), with independent coordinates of the same statistics, and
    increasing stamps.
    """
    n = len(stamps_ns)
    variance = float(np.mean(residuals**2)) if n > 0 else 0.0
    white = Autocorrelation(0.0, 0.0)
    if n < SOURCES.least_residuals or variance <= 0.0:
        return white
    period = float(np.median(np.diff(stamps_ns))) * 1e-9
    if period <= 0.0:
        return white
    lags, covariance = autocovariances(stamps_ns, residuals)
    if len(lags) == 0 or lags[0] > 1:
        return white
    first = float(covariance[0]) / variance
    deviation = 1.0 / np.sqrt(n * residuals.shape[1])
    if first < max(SOURCES.least_correlation, SOURCES.significant_lag * deviation):
        return white
    faded = np.flatnonzero(covariance < SOURCES.faded * covariance[0])
    end = int(faded[0]) if len(faded) > 0 else len(lags)
    if end < 2:
        # a single lag is left, which cannot separate the two parts
        tau, correlated = -period / np.log(min(first, 0.99)), variance
    else:
        # line through the logarithms; larger covariances are more certain and weigh more
        slope, level = np.polyfit(
            lags[:end] * period, np.log(covariance[:end]), 1, w=covariance[:end])
        tau = -1.0 / slope if slope < 0.0 else float(lags[end - 1] * period)
        correlated = min(float(np.exp(level)), variance)
    return Autocorrelation(float(tau), float(np.sqrt(correlated)))


def autocovariances(stamps_ns: IntArray, residuals: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return lags, in median periods, and the autocovariance at each."""
    times = (stamps_ns - stamps_ns[0]) * 1e-9
    ticks = np.round(times / float(np.median(np.diff(times)))).astype(np.int64)
    lags, values, lag = [], [], 1
    while lag <= SOURCES.longest_lag * len(ticks):
        partner = np.searchsorted(ticks, ticks + lag)
        paired = partner < len(ticks)
        paired[paired] = ticks[partner[paired]] == ticks[paired] + lag
        if np.sum(paired) >= SOURCES.least_residuals // 2:
            lags.append(lag)
            values.append(float(np.mean(residuals[paired] * residuals[partner[paired]])))
        lag = max(lag + 1, int(SOURCES.next_lag * lag))
    return np.array(lags, dtype=np.int64), np.array(values)



class SourceReport(NamedTuple):
    n: int  # number of its measurements that are used
    # mean squared residual of a coordinate, in units of its sigma; 0 if there is none
    energy: float
    errors: Autocorrelation  # autocorrelation of the newest residuals [m]
    # statistics of its errors that the graph is built with; None for white errors
    in_use: CorrelatedErrors | None
    found: bool  # whether these are estimated from the errors (`correlation_time` of -1)

    @property
    def strain(self) -> float:
        """Mean squared residual, in units of what is known of the errors of the source."""
        known = 1.0 if self.in_use is None else self.in_use.correlated + self.in_use.white
        return self.energy / max(known, 1.0)

    @property
    def fits_badly(self) -> bool:
        """Whether many measurements contradict the estimate, whoever is to blame."""
        return self.n >= SOURCES.many and self.strain > SOURCES.far

    @property
    def wrongly_white(self) -> bool:
        """Whether errors that are treated as white, as they were told to be, look correlated."""
        return (self.in_use is None and not self.found and self.errors.significant
                and self.energy > SOURCES.least_energy)


def report(graph: Graph, stamps_ns: IntArray, ids: IntArray, *, in_use: CorrelatedErrors | None,
           found: bool = False) -> SourceReport:
    """
    Return how well the newest measurements of a source fit the estimate.

    Stamps [ns] and ids are those of the measurements that are used, in the order of their
    addition: of an edge to a bias, or of an observed node. `found` says that statistics are
    estimated from the errors.
    """
    newest = np.column_stack((stamps_ns, ids))[-SOURCES.most_residuals:]
    newest = newest[np.argsort(newest[:, 0], kind='stable')]
    newest = newest[np.diff(newest[:, 0], prepend=-1) > 0]
    stamps, observed = newest[:, 0], graph.factors_at(newest[:, 1])
    if np.any(observed.kind == FactorKind.BIAS):    # all are, with a given time constant
        # whole errors of positions in map axes
        factor = observed.constants[:, 2]
        errors = graph.errors(observed)[:, :2]
        errors = errors - factor[:, None] * graph.poses_of(observed.j)[:, :2]
        variance = factor**2 + 1.0 / (0.5 * np.trace(
            observed.information[:, :2, :2], axis1=1, axis2=2) + 1e-12)
        information, residuals = np.eye(2) / variance[:, None, None], errors
    else:
        errors, information = graph.errors(observed), observed.information
        # of positions, in map axes
        residuals = np.einsum('kij,kj->ki', se2.rotation(observed.mean[:, 2]), errors[:, :2])
        placed = information[:, 0, 0] > 0.0
        stamps, residuals = stamps[placed], residuals[placed]
    energy = float(np.einsum('ki,kij,kj->', errors, information, errors))
    n_measured = int(np.count_nonzero(np.diagonal(information, axis1=1, axis2=2) > 0.0))
    return SourceReport(len(ids), energy / max(n_measured, 1),
                        estimate(stamps, residuals), in_use, found)
