# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Time constant of the errors of a source, from the autocorrelation of its residuals.

The sum of a first-order Gauss-Markov process and white noise has the autocovariance
`c(h) = s_c^2 exp(-h / tau)` for h > 0 and `c(0) = s_c^2 + s_w^2`. This model is fitted to the
sample autocovariance of the residuals at lags of whole periods of the source. Residuals are
smaller than the errors, because the estimate follows the measurements: s_c comes out a little too
small, and so does tau.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray

# Minimum number of residuals for an estimate.
LEAST_RESIDUALS = 30
# Longest lag, as a fraction of the number of residuals.
LONGEST_LAG = 0.25
# Ratio of a lag to the one before.
NEXT_LAG = 1.25
# The fit ends where the autocovariance falls below this fraction of that at the first lag.
FADED = 0.2
# Threshold of the correlation of consecutive residuals [standard deviations for white noise].
SIGNIFICANT = 4.0
# Minimum correlation of consecutive residuals that counts as significant.
LEAST_CORRELATION = 0.3


class Autocorrelation(NamedTuple):
    """Estimated statistics of the errors of a source."""

    tau: float
    """Time constant of the correlated part [s]; 0 if nothing is significant."""
    sigma_correlated: float
    """Standard deviation of the correlated part of a coordinate, in the unit of the residuals."""

    @property
    def significant(self) -> bool:
        """Whether the errors are significantly correlated."""
        return self.tau > 0.0


def estimate(stamps_ns: IntArray, residuals: FloatArray) -> Autocorrelation:
    """
    Return the time constant of errors, and the sigma of their correlated part.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (N,), stamps of the residuals [ns], increasing
    residuals : ndarray, shape (N, d), coordinates must be independent and have the same statistics

    """
    n = len(stamps_ns)
    variance = float(np.mean(residuals**2)) if n > 0 else 0.0
    white = Autocorrelation(0.0, 0.0)
    if n < LEAST_RESIDUALS or variance <= 0.0:
        return white
    period = float(np.median(np.diff(stamps_ns))) * 1e-9
    if period <= 0.0:
        return white
    lags, covariance = autocovariances(stamps_ns, residuals)
    if len(lags) == 0 or lags[0] > 1:
        return white
    first = float(covariance[0]) / variance
    deviation = 1.0 / np.sqrt(n * residuals.shape[1])
    if first < max(LEAST_CORRELATION, SIGNIFICANT * deviation):
        return white
    faded = np.flatnonzero(covariance < FADED * covariance[0])
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
    """
    Return lags, in median periods of the stamps, and the autocovariance at each.

    Pairs of residuals are formed by their stamps in whole periods, so gaps in time do not distort
    the lags.

    Parameters
    ----------
    stamps_ns, residuals : ndarray, as for `estimate`, with a period above 0

    """
    times = (stamps_ns - stamps_ns[0]) * 1e-9
    ticks = np.round(times / float(np.median(np.diff(times)))).astype(np.int64)
    lags, values, lag = [], [], 1
    while lag <= LONGEST_LAG * len(ticks):
        partner = np.searchsorted(ticks, ticks + lag)
        paired = partner < len(ticks)
        paired[paired] = ticks[partner[paired]] == ticks[paired] + lag
        if np.sum(paired) >= LEAST_RESIDUALS // 2:
            lags.append(lag)
            values.append(float(np.mean(residuals[paired] * residuals[partner[paired]])))
        lag = max(lag + 1, int(NEXT_LAG * lag))
    return np.array(lags, dtype=np.int64), np.array(values)
