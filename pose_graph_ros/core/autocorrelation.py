# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How long the errors of a source live, from its residuals.

An error that wanders as a first-order Gauss-Markov process, on top of a white one, has the
autocovariance `c(h) = s_c^2 exp(-h / tau)` for h > 0 and `c(0) = s_c^2 + s_w^2`. The sample
autocovariance of the residuals, at lags of whole periods of the source, is fitted with that. The
residuals are what the estimate has left of the errors, so both sigmas come out a little small, and
an error that lives longer than the estimate's memory looks shorter.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.se2 import FloatArray, IntArray

# Fewer residuals tell nothing.
LEAST_RESIDUALS = 30
# Lags are looked at up to this fraction of the number of residuals, each longer by this factor.
LONGEST_LAG = 0.25
NEXT_LAG = 1.25
# An autocovariance below this part of the first one is noise.
FADED = 0.2
# A correlation from one residual to the next counts beyond so many of its standard deviations ...
SIGNIFICANT = 4.0
# ... and if it is at least this large.
LEAST_CORRELATION = 0.3


class Autocorrelation(NamedTuple):
    """What residuals tell of the errors of a source."""

    n: int
    """Residuals that were looked at."""
    correlation: float
    """From one residual to the next."""
    tau: float
    """Time constant of the correlated part [s]; 0 if nothing is significant."""
    sigma_correlated: float
    """Of a coordinate, or in units of the residuals."""
    sigma_white: float

    @property
    def significant(self) -> bool:
        """Whether the errors are not white."""
        return self.tau > 0.0


def estimate(stamps_ns: IntArray, residuals: FloatArray) -> Autocorrelation:
    """
    Estimate the time constant of errors and the parts of their variance.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (N,)
        Increasing.
    residuals : ndarray, shape (N, d)
        Of independent coordinates with the same statistics.

    """
    n = len(stamps_ns)
    variance = float(np.mean(residuals**2)) if n > 0 else 0.0
    nothing = Autocorrelation(n, 0.0, 0.0, 0.0, float(np.sqrt(variance)))
    if n < LEAST_RESIDUALS or variance <= 0.0:
        return nothing
    times = (stamps_ns - stamps_ns[0]) * 1e-9
    period = float(np.median(np.diff(times)))
    if period <= 0.0:
        return nothing
    lags, covariance = _covariances(np.round(times / period).astype(np.int64), residuals)
    if len(lags) == 0 or lags[0] > 1:
        return nothing
    first = float(covariance[0]) / variance
    chance = 1.0 / np.sqrt(n * residuals.shape[1])
    if first < max(LEAST_CORRELATION, SIGNIFICANT * chance):
        return nothing._replace(correlation=first)
    faded = np.flatnonzero(covariance < FADED * covariance[0])
    end = int(faded[0]) if len(faded) > 0 else len(lags)
    if end < 2:
        # gone with the next residual: all that can be said
        tau, correlated = -period / np.log(min(first, 0.99)), variance
    else:
        # a straight line through the logarithms, the larger ones being the surer ones
        slope, level = np.polyfit(
            lags[:end] * period, np.log(covariance[:end]), 1, w=covariance[:end])
        tau = -1.0 / slope if slope < 0.0 else float(lags[end - 1] * period)
        correlated = min(float(np.exp(level)), variance)
    return Autocorrelation(
        n, first, float(tau), float(np.sqrt(correlated)), float(np.sqrt(variance - correlated)))


def _covariances(ticks: IntArray, residuals: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return lags, in periods, and the autocovariances there; gaps in time are left out."""
    lags, values, lag = [], [], 1
    while lag <= LONGEST_LAG * len(ticks):
        # residuals that are so far apart, which need not be neighbours by number
        partner = np.searchsorted(ticks, ticks + lag)
        there = partner < len(ticks)
        there[there] = ticks[partner[there]] == ticks[there] + lag
        if np.sum(there) >= LEAST_RESIDUALS // 2:
            lags.append(lag)
            values.append(float(np.mean(residuals[there] * residuals[partner[there]])))
        lag = max(lag + 1, int(NEXT_LAG * lag))
    return np.array(lags, dtype=np.int64), np.array(values)
