# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factor on the claimed sigmas that residuals show, how sure it is, and their correlation.

With R the covariances as the graph uses them and S those of the residuals, the squared residuals
`e^T R^-1 e` are expected to be `tr(R^-1 S)`, their redundancy, so that the sum of all squares over
the sum of redundancies is the factor on the variances (K.-R. Koch, "Parameter estimation and
hypothesis testing in linear models", 1999, section 3.6: the estimate of a variance component).
A square counts up to where 99.9 % of them are, so that one wrong measurement does not decide.

Its uncertainty is that of a mean of n independent squares. Let S' be the covariance of all N
normalised residuals of a coordinate, of which a share r is left by the fit. Then n is the smallest
of three numbers:

- `N / c`, with `c = 1 + 2 sum rho_k^2` and rho_k the autocorrelation of the residuals: the mean
  of N squares varies as that of so many independent ones (M. S. Bartlett, "On the theoretical
  specification and sampling properties of autocorrelated time-series", 1946);
- `N r`, the trace of S', as the residuals are not in more dimensions than these;
- `N r^2 c`, the trace of S'^2: half the Fisher information on the logarithm of the factor, as the
  fit follows a source the more, the better it is taken to be.

Of errors that the graph knows to be correlated, with the time constant tau, the residuals have a
slow part s and a white one, in units of the claimed variance. The slow part is as good as T / tau
independent ones in the time T, also where these few happen to be small, so that n is at most
`r^2 / (s^2 tau / T + (r^2 - s^2) / N)`.

Where next to nothing is left, as of odometry that alone determines the poses, n is small, and
nothing is said.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.core.sources.gauss_markov import CorrelatedErrors
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.core.sources.source_report import autocovariances, estimate
from pose_graph_ros.offline.residuals.source_residuals import SourceResiduals

# Number of independent residuals below which nothing is said.
LEAST_INDEPENDENT = 10.0
# Probability of the interval of the factor.
INTERVAL = 0.95
_COORDINATES = 3


class RowFit(NamedTuple):
    """How large the residuals of one coordinate are, in units of the claimed sigma."""

    coordinate: int  # 0 and 1 are positions, 2 is the heading
    n: int
    sigma: float  # root mean square of the claimed sigmas [m or rad]
    expected: float  # root mean square that is expected: 1 less what the fit takes
    found: float
    ratio: float  # of true to claimed sigmas, by this coordinate; NaN if it says nothing
    low: float  # the true ratio is between this and `high` in 95 % of all runs
    high: float


class ScaleFit(NamedTuple):
    """How large the residuals of a source are."""

    n_used: int
    rows: tuple[RowFit, ...]
    energy_expected: float  # mean of the squared residuals of a constraint
    energy_found: float
    within: float  # share of constraints whose squared residual is below the 95 % quantile of chi2
    redundancy: float  # share of the measurements that is left as residuals, 0 to 1
    independent: float  # effective number of independent residuals, of all coordinates together
    ratio: float  # of true to claimed sigmas; NaN if the residuals say nothing
    low: float  # as in `RowFit`
    high: float

    @property
    def says_nothing(self) -> bool:
        """Whether the residuals tell nothing of the covariances."""
        return math.isnan(self.ratio)

    @property
    def unknown(self) -> 'ScaleFit':
        """The same, without saying how large sigmas are."""
        rows = tuple(row._replace(ratio=math.nan, low=math.nan, high=math.nan)
                     for row in self.rows)
        return self._replace(
            rows=rows, ratio=math.nan, low=math.nan, high=math.nan, independent=0.0)


def fit(residuals: SourceResiduals, errors: CorrelatedErrors | None = None) -> ScaleFit:
    """Return how large the residuals of the used constraints of a source are."""
    used = residuals.rows(residuals.used)
    n = len(used.ids)
    known = np.flatnonzero(np.all(np.isfinite(used.taken), axis=(1, 2)))
    if n == 0 or len(known) == 0:
        return ScaleFit(n, (), 0.0, 0.0, 1.0, 0.0, 0.0, math.nan, math.nan, math.nan)
    freedom = np.sum(used.measured, axis=1)
    energies, expected = used.energies, float(np.mean(
        np.maximum(used.rows(known).redundancies, 0.0)))
    redundancy, scale = expected / float(np.mean(freedom)), float(np.median(used.scale))
    independent = sum(_independent(used, row, errors) for row in range(_COORDINATES))
    ratio, low, high = _ratio(energies, freedom, redundancy, independent)
    return ScaleFit(
        n, _rows(used, used.rows(known), errors), expected, float(np.mean(energies)),
        float(np.mean(energies <= _quantiles(freedom, INTERVAL))), redundancy, independent,
        scale * ratio, scale * low, scale * high)


def _rows(
    used: SourceResiduals, known: SourceResiduals, errors: CorrelatedErrors | None,
) -> tuple[RowFit, ...]:
    """Return the fit of each coordinate; `known` are those whose expectation is known."""
    rows = []
    sigmas, left = used.sigmas, _left(known)
    for row in np.flatnonzero(np.any(used.measured, axis=0)).tolist():
        measured = used.measured[:, row]
        if not np.any(known.measured[:, row]):
            continue
        sigma = sigmas[measured, row]
        squares = (used.errors[measured, row] / sigma)**2
        share = float(np.mean(left[known.measured[:, row], row]))
        ratio, low, high = _ratio(
            squares, np.ones(len(squares)), share, _independent(used, row, errors))
        rows.append(RowFit(
            row, len(squares), float(np.sqrt(np.mean(sigma**2))), math.sqrt(share),
            float(np.sqrt(np.mean(squares))), ratio, low, high))
    return tuple(rows)


def _left(residuals: SourceResiduals) -> FloatArray:
    """Return the variances of residuals in units of those of measurements, shape (M, 3)."""
    claimed, taken = (np.diagonal(each, axis1=1, axis2=2)
                      for each in (residuals.covariances, residuals.taken))
    # with a diagonal R these shares add up to the redundancy
    return np.asarray(np.clip(1.0 - taken / np.where(claimed > 0.0, claimed, 1.0), 0.0, 1.0))


def _ratio(
    squares: FloatArray, freedom: FloatArray, redundancy: float, independent: float,
) -> tuple[float, float, float]:
    """Return the ratio of sigmas with its interval, by squares of which a share is left."""
    # where the fit takes nearly all, nothing is said either
    if independent < LEAST_INDEPENDENT or redundancy < 0.005:
        return math.nan, math.nan, math.nan
    expected = redundancy * freedom
    ratio = math.sqrt(np.mean(bounded(squares, expected, freedom)) / np.mean(expected))
    low, high = (ratio * math.sqrt(independent / float(
        chdtri(independent, 0.5 + side * 0.5 * INTERVAL))) for side in (-1.0, 1.0))
    return ratio, low, high


def bounded(squares: FloatArray, expected: FloatArray, freedom: FloatArray) -> FloatArray:
    """
    Return squares up to a quantile of their distribution, if the median of all shows its scale.
    """
    unit = np.where(expected > 0.0, expected / freedom, 1.0)
    median = float(np.median(squares / (unit * _quantiles(freedom, 0.5))))
    return np.asarray(np.minimum(squares, max(median, 1.0) * unit * _quantiles(freedom, 0.999)))


def _quantiles(freedom: FloatArray | BoolArray, probability: float) -> FloatArray:
    """Return quantiles of chi2, shape (M,)."""
    values = chdtri(np.arange(1, _COORDINATES + 1), 1.0 - probability)
    return np.asarray(values[np.clip(freedom.astype(np.int64), 1, _COORDINATES) - 1])


def _independent(
    residuals: SourceResiduals, row: int, errors: CorrelatedErrors | None,
) -> float:
    """Return the effective number of independent squares of one coordinate."""
    measured = residuals.measured[:, row]
    known = residuals.rows(measured & np.all(np.isfinite(residuals.taken), axis=(1, 2)))
    if len(known.ids) == 0:
        return 0.0
    values = residuals.errors[measured, row] / residuals.sigmas[measured, row]
    n, left = len(values), float(np.mean(_left(known)[:, row]))
    correlated = 1.0 + 2.0 * squared_correlations(values)
    found = min(n / correlated, n * left, n * left**2 * correlated)
    if errors is None or left <= 0.0:
        return found
    stamps = residuals.stamps_ns[measured]
    slow = max(left - errors.white / (errors.white + errors.correlated), 0.0)
    stretches = min(max(float(stamps[-1] - stamps[0]) * 1e-9 / errors.tau, 1.0), float(n))
    return min(found, left**2 / (slow**2 / stretches + (left**2 - slow**2) / n))


def squared_correlations(values: FloatArray) -> float:
    """Return the sum of the squared autocorrelations of a series, up to where they fade."""
    n = len(values)
    power = float(np.sum(values**2))
    longest = n // 4
    if longest < 1 or power <= 0.0:
        return 0.0
    size = 1 << int(2 * n - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    correlation = np.fft.irfft(np.abs(spectrum)**2, size)[1:longest + 1] / power
    # into the standard deviations of white residuals
    faded = np.flatnonzero(np.abs(correlation) < 2.0 / math.sqrt(n))
    end = int(faded[0]) if len(faded) > 0 else longest
    return float(np.sum(correlation[:end]**2))


class Whiteness(NamedTuple):
    """Autocorrelation of the normalised residuals of a source."""

    lags: FloatArray  # shape (L,) [s]
    values: FloatArray  # from -1 to 1
    # values of independent residuals are between plus and minus this at 95 % of the lags
    band: float
    tau: float  # time constant of the correlated part [s]; 0 if nothing is significant
    fitted: FloatArray  # model with this time constant at the lags; zeros without one


def whiteness(residuals: SourceResiduals) -> Whiteness | None:
    """
    Return the autocorrelation of the used residuals; None of fewer than 30 or of one stamp.

    The time constant is that of `source_report.estimate`. As residuals are smaller than errors,
    it comes out a little too small where the graph treats the errors as independent.
    """
    used = residuals.rows(np.flatnonzero(residuals.used)[-20_000:])   # the newest
    used = used.rows(np.diff(used.stamps_ns, prepend=-1) > 0)
    if len(used.ids) < SOURCES.least_residuals:
        return None
    columns = np.flatnonzero(np.all(used.measured, axis=0))
    # a position has two coordinates of the same statistics; a heading is in other units
    columns = columns[columns < 2] if np.any(columns < 2) else columns
    if len(columns) == 0:
        return None
    values = used.errors[:, columns] / used.sigmas[:, columns]
    period = float(np.median(np.diff(used.stamps_ns))) * 1e-9
    variance = float(np.mean(values**2))
    if variance <= 0.0:
        return None
    lags, covariance = autocovariances(used.stamps_ns, values)
    found = estimate(used.stamps_ns, values)
    fitted = (found.sigma_correlated**2 / variance * np.exp(-lags * period / found.tau)
              if found.significant else np.zeros(len(lags)))
    return Whiteness(np.asarray(lags * period, dtype=np.float64), covariance / variance,
                     1.96 / math.sqrt(values.size), found.tau, fitted)
