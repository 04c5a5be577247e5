# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The residuals of all constraints at the estimate, by source, and what they say of its sigmas.

A measurement with the covariance R leaves the residual e, whose covariance is

    S = R - J P J^T,

if all covariances are right: P is the marginal covariance of its nodes at the estimate and J the
Jacobian of the residual, so J P J^T is what the fit takes (R. Mehra, J. Peschon, "An innovations
approach to fault detection and diagnosis in dynamic systems", Automatica 1971, in the form for
smoothing). This holds with correlated errors as well, where R is the whole variance of one
measurement, with that of its bias, and e its whole error. For a measurement that the graph does
not use, `S = R + J P J^T`.

Errors of edges between poses are in the axes of the measured pose: x along and y across the
direction of travel. Those of measurements in the map are in its axes.

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

from collections.abc import Callable, Mapping
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from pose_graph_ros.core.disagreement import edges_by_source
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, Covariances, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.quantities import StampsNs
from pose_graph_ros.core.sources.bias import CorrelatedErrors, STRETCH
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.core.sources.source_report import autocovariances, estimate

# Number of independent residuals below which nothing is said.
LEAST_INDEPENDENT = 10.0
# Probability of the interval of the factor.
INTERVAL = 0.95
_COORDINATES = 3
# A ratio with its interval, where residuals do not show it.
UNKNOWN: dict[str, Any] = {'ratio': math.nan, 'low': math.nan, 'high': math.nan}


class SourceResiduals(NamedTuple):
    """Residuals of the M constraints of one source, in the order of their stamps."""

    source: str
    kind: str  # `odometry`, `loop_closure`, `turn` (a gyroscope) or `map` (fixes, poses, headings)
    stamps_ns: StampsNs  # of edges, the later end
    errors: Poses  # 0 where nothing is measured
    measured: BoolArray  # which coordinates are measured, shape (M, 3)
    covariances: Covariances  # R as the graph uses it; of unused constraints as if of weight 1
    taken: Covariances  # J P J^T; NaN where it was not computed
    used: BoolArray  # which constraints have a weight above 0
    scale: FloatArray  # factor on the claimed sigmas that the graph uses
    ids: IntArray  # in the graph

    def rows(self, which: BoolArray | IntArray) -> 'SourceResiduals':
        """Return some of the constraints."""
        columns: Any = (column[which] for column in self[2:])
        return SourceResiduals(self.source, self.kind, *columns)

    @property
    def sigmas(self) -> FloatArray:
        """Claimed sigmas of the coordinates, shape (M, 3) [m, m, rad]."""
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)
        return np.asarray(np.sqrt(variances) / self.scale[:, None])

    @property
    def energies(self) -> FloatArray:
        """Squared residuals `e^T R^-1 e`, with R as the graph uses it, shape (M,)."""
        return np.asarray(np.einsum('mi,mij,mj->m', self.errors, self.information, self.errors))

    @property
    def information(self) -> FloatArray:
        """R^-1 in the coordinates that are measured, else 0, shape (M, 3, 3)."""
        return inverse(self.covariances, self.measured)

    @property
    def redundancies(self) -> FloatArray:
        """What is expected of the energies, tr(R^-1 S), shape (M,); NaN where not computed."""
        trace = np.einsum('mij,mji->m', self.information, self.taken)
        return np.asarray(np.sum(self.measured, axis=1) - trace)

    @property
    def distances(self) -> FloatArray:
        """Of unused constraints, `sqrt(e^T (R + J P J^T)^-1 e)`, shape (M,) [sigma]."""
        joint = inverse(self.covariances + self.taken, self.measured)
        return np.asarray(np.sqrt(np.einsum('mi,mij,mj->m', self.errors, joint, self.errors)))


def collect(parts: Parts) -> dict[str, SourceResiduals]:
    """
    Return the residuals of each source that has constraints in the graph.

    Raises ValueError if edits of the graph wait for the solver.
    """
    smoother, nodes, factors = parts.smoother, parts.nodes, parts.factors
    graph, covariances = smoother.graph, smoother.covariances()
    # the factors on claimed sigmas that the graph uses, without those of a robust loss
    weights, rows = graph.weights, graph.factor_rows(parts.reweighting['id'])
    weights[rows[rows >= 0]] = parts.reweighting['base'][rows >= 0]
    scales = np.where(weights > 0.0, weights, 1.0)**-0.5
    found: dict[str, SourceResiduals] = {}
    for source, (stamps, ids) in factors.held().items():
        residuals = _residuals(graph, (source, 'map'), ids, stamps, scales)
        table = graph.factors_at(ids)
        errors = factors.errors_in_use(source)
        # the variance of correlated errors, in units of the claimed one
        total = 1.0 if errors is None else errors.correlated + errors.white
        found[source] = residuals._replace(taken=_taken(graph, covariances, table), scale=np.where(
            table.j >= 0, np.sqrt(total), 1.0) * residuals.scale)
    for name, ids in edges_by_source(parts).items():
        if name[0] not in found:
            edges = graph.factors_at(ids)
            later = np.searchsorted(nodes.ids, np.maximum(edges.i, edges.j))
            residuals = _residuals(
                graph, name, ids, nodes.stamps_ns[np.clip(later, 0, len(nodes) - 1)], scales)
            # each takes up to the depth of the tree
            some = spread(len(ids), 1000)
            residuals.taken[some] = smoother.innovations(edges.rows(some)).covariances
            found[name[0]] = residuals
    return {source: each.rows(np.argsort(each.stamps_ns, kind='stable'))
            for source, each in found.items() if len(each.ids) > 0}


def of_solved(graph: Graph, covariances: Covariances, taken: Callable[[Factors], Covariances],
              groups: Mapping[tuple[str, str], IntArray], stamps_ns: StampsNs,
              ) -> dict[str, SourceResiduals]:
    """
    Return the residuals of rows of factors, given by source and kind, of a graph without sources.

    `taken` tells J P J^T of edges; covariances are those of nodes, stamps those of all factors.
    """
    scales = np.where(graph.weights > 0.0, graph.weights, 1.0)**-0.5
    found: dict[str, SourceResiduals] = {}
    for name, every in groups.items():
        rows = every[np.argsort(stamps_ns[every], kind='stable')]
        residuals = _residuals(graph, name, graph.factor_ids[rows], stamps_ns[rows], scales)
        table = graph.factors_at(residuals.ids)
        if name[1] == 'map':
            residuals = residuals._replace(taken=_taken(graph, covariances, table))
        else:
            some = spread(len(rows), 1000)
            residuals.taken[some] = taken(table.rows(some))
        found[name[0]] = residuals
    return found


def _taken(graph: Graph, covariances: Covariances, table: Factors) -> Covariances:
    """Return J P J^T of measurements of points of the robot, in map axes."""
    rows = graph.node_rows(table.i)
    arms = np.einsum('kij,kj->ki', se2.rotation(graph.poses[rows, 2]), table.constants[:, :2])
    J = np.tile(np.eye(3), (len(rows), 1, 1))
    J[:, 0, 2], J[:, 1, 2] = -arms[:, 1], arms[:, 0]
    return np.asarray(J @ covariances[rows] @ np.swapaxes(J, 1, 2))


def _residuals(graph: Graph, name: tuple[str, str], ids: IntArray, stamps_ns: StampsNs,
               scales: FloatArray) -> SourceResiduals:
    """
    Return the residuals of factors of a source and kind; what the fit takes is not computed.

    A bias is a part of the error of a measurement with an edge to it.
    """
    table, scale = graph.factors_at(ids), scales[graph.factor_rows(ids)]
    measured = np.diagonal(table.information, axis1=1, axis2=2) > 0.0
    # from the frames of poses that were measured in the map to its axes
    turn = np.tile(np.eye(3), (len(ids), 1, 1))
    turn[:, :2, :2] = se2.rotation(np.where(table.j < 0, table.mean[:, 2], 0.0))
    claimed = inverse(turn @ table.information @ np.swapaxes(turn, 1, 2), measured)
    errors = np.einsum('kij,kj->ki', turn, graph.errors(table)) * measured
    biased = table.kind == FactorKind.BIAS
    of_state = table.constants[biased][:, [2, 2, 3]] * measured[biased]
    errors[biased] -= of_state * graph.poses_of(table.j[biased])
    claimed[biased] += (of_state / (1.0, 1.0, STRETCH))[:, :, None]**2 * np.eye(3)
    return SourceResiduals(*name, stamps_ns, errors, measured, claimed * scale[:, None, None]**2,
                           np.full((len(ids), 3, 3), np.nan), table.weight > 0.0, scale, ids)


def spread(n: int, most: int) -> IntArray:
    """Return at most so many of the numbers from 0 to n - 1, evenly spaced."""
    return np.arange(n) if n <= most else np.unique(
        np.round(np.linspace(0, n - 1, most)).astype(np.int64))


def inverse(matrices: FloatArray, measured: BoolArray) -> FloatArray:
    """Return the inverses of matrices in the coordinates that are measured, (M, 3), else 0."""
    both = measured[:, :, None] & measured[:, None, :]
    filled = np.where(both, matrices, 0.0) + np.eye(3) * ~measured[:, :, None]
    return np.asarray(np.where(both, np.linalg.inv(filled), 0.0))


class RowFit(NamedTuple):
    """How large the residuals of one coordinate are, in units of the claimed sigma."""

    coordinate: int  # 0 and 1 are positions, 2 is the heading
    n: int
    sigma: float  # root mean square of the claimed sigmas [m or rad]
    expected: float  # root mean square that is expected: 1 less what the fit takes
    found: float
    independent: float  # effective number of independent residuals
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
    independent: float  # of all coordinates together
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
        return self._replace(rows=tuple(row._replace(**UNKNOWN) for row in self.rows),
                             independent=0.0, **UNKNOWN)


def fit(residuals: SourceResiduals, errors: CorrelatedErrors | None = None) -> ScaleFit:
    """Return how large the residuals of the used constraints of a source are."""
    used = residuals.rows(residuals.used)
    # those whose expectation is known
    known = used.rows(np.all(np.isfinite(used.taken), axis=(1, 2)))
    n = len(used.ids)
    if len(known.ids) == 0:
        return ScaleFit(n, (), 0.0, 0.0, 1.0, 0.0, 0.0, **UNKNOWN)
    rows = tuple(_row(used, known, row, errors)
                 for row in np.flatnonzero(np.any(known.measured, axis=0)).tolist())
    freedom, energies = np.sum(used.measured, axis=1), used.energies
    expected = float(np.mean(np.maximum(known.redundancies, 0.0)))
    redundancy, scale = expected / float(np.mean(freedom)), float(np.median(used.scale))
    independent = sum(row.independent for row in rows)
    ratio, low, high = _ratio(energies, freedom, redundancy, independent)
    return ScaleFit(n, rows, expected, float(np.mean(energies)),
                    float(np.mean(energies <= _quantiles(freedom, INTERVAL))), redundancy,
                    independent, scale * ratio, scale * low, scale * high)


def _row(used: SourceResiduals, known: SourceResiduals, row: int,
         errors: CorrelatedErrors | None) -> RowFit:
    """Return the fit of one coordinate."""
    measured = used.measured[:, row]
    sigma = used.sigmas[measured, row]
    values, there = used.errors[measured, row] / sigma, known.measured[:, row]
    claimed, taken = (each[there, row, row] for each in (known.covariances, known.taken))
    # variances of residuals in units of those of measurements; with a diagonal R these shares add
    # up to the redundancy
    left = float(np.mean(np.clip(1.0 - taken / np.where(claimed > 0.0, claimed, 1.0), 0.0, 1.0)))
    independent = _independent(values, left, used.stamps_ns[measured], errors)
    return RowFit(row, len(values), float(np.sqrt(np.mean(sigma**2))),
                  math.sqrt(left), float(np.sqrt(np.mean(values**2))), independent,
                  *_ratio(values**2, np.ones(len(values)), left, independent))


def _ratio(squares: FloatArray, freedom: FloatArray, redundancy: float,
           independent: float) -> tuple[float, float, float]:
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


def _independent(values: FloatArray, left: float, stamps_ns: StampsNs,
                 errors: CorrelatedErrors | None) -> float:
    """Return the effective number of independent squares, of which the fit leaves a share."""
    n, correlated = len(values), 1.0 + 2.0 * squared_correlations(values)
    found = min(n / correlated, n * left, n * left**2 * correlated)
    if errors is None or left <= 0.0:
        return found
    slow = max(left - errors.white / (errors.white + errors.correlated), 0.0)
    stretches = min(max(float(stamps_ns[-1] - stamps_ns[0]) * 1e-9 / errors.tau, 1.0), float(n))
    return min(found, left**2 / (slow**2 / stretches + (left**2 - slow**2) / n))


def squared_correlations(values: FloatArray) -> float:
    """Return the sum of the squared autocorrelations of a series, up to where they fade."""
    n, power = len(values), float(np.sum(values**2))
    if n < 4 or power <= 0.0:
        return 0.0
    size = 1 << int(2 * n - 1).bit_length()
    correlation = np.fft.irfft(np.abs(np.fft.rfft(values, size))**2, size)[1:n // 4 + 1] / power
    # into the standard deviations of white residuals
    faded = np.flatnonzero(np.abs(correlation) < 2.0 / math.sqrt(n))
    return float(np.sum(correlation[:int(faded[0]) if len(faded) > 0 else None]**2))


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
