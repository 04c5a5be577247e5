# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well the measurements of a source fit the estimate, and whether their errors are white."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.sources import autocorrelation
from pose_graph_ros.core.sources.gauss_markov import CorrelatedErrors

# Number of the newest residuals of a source that are evaluated.
MOST_RESIDUALS = 5000
# The whiteness test is skipped below this mean squared residual [sigma^2].
LEAST_ENERGY = 0.1
# Measurements fit badly from this mean squared residual on [sigma^2], if they are so many.
FAR, MANY = 9.0, 30


class SourceReport(NamedTuple):
    """How well the measurements of a source fit."""

    n: int
    """Number of its measurements that are used."""
    energy: float
    """Mean squared residual of a coordinate, in units of its sigma; 0 if there is none."""
    errors: autocorrelation.Autocorrelation
    """Autocorrelation of the newest residuals [m]."""
    in_use: CorrelatedErrors | None
    """Statistics of its errors that the graph is built with; None for white errors."""
    found: bool
    """Whether these are estimated from the errors (`correlation_time` of -1)."""

    @property
    def strain(self) -> float:
        """Mean squared residual, in units of what is known of the errors of the source."""
        known = 1.0 if self.in_use is None else self.in_use.correlated + self.in_use.white
        return self.energy / max(known, 1.0)

    @property
    def fits_badly(self) -> bool:
        """Whether many measurements contradict the estimate, whoever is to blame."""
        return self.n >= MANY and self.strain > FAR

    @property
    def wrongly_white(self) -> bool:
        """
        Whether its errors are treated as white but look correlated: its sigmas are too low.

        Where the statistics of the errors are estimated, that estimate is the better judge.
        """
        return (self.in_use is None and not self.found and self.errors.significant
                and self.energy > LEAST_ENERGY)


def report(
    graph: Graph, rows: IntArray, *, biased: bool, in_use: CorrelatedErrors | None,
    found: bool = False,
) -> SourceReport:
    """
    Return how well the newest measurements of a source fit the estimate.

    Parameters
    ----------
    rows : ndarray of int64, shape (K, 2)
        Stamp [ns] and id of each measurement that is used, in the order of their addition.
    biased : bool, whether the constraints are edges to a bias; else they are observed nodes
    in_use : CorrelatedErrors, optional, statistics in use; None for white errors
    found : bool, whether these are estimated from the errors

    """
    newest = rows[-MOST_RESIDUALS:]
    newest = newest[np.argsort(newest[:, 0], kind='stable')]
    newest = newest[np.diff(newest[:, 0], prepend=-1) > 0]
    stamps, numbers = newest[:, 0], newest[:, 1]
    if biased:
        errors, information = _biased_residuals(graph, graph.edges_at(numbers))
        residuals = errors
    else:
        observed = graph.observed_at(numbers)
        errors, information = graph.observed_errors(observed), observed.information
        # of positions, in map axes
        residuals = np.einsum('kij,kj->ki', se2.rotation(observed.mean[:, 2]), errors[:, :2])
        placed = information[:, 0, 0] > 0.0
        stamps, residuals = stamps[placed], residuals[placed]
    energy = float(np.einsum('ki,kij,kj->', errors, information, errors))
    n_measured = int(np.count_nonzero(np.diagonal(information, axis1=1, axis2=2) > 0.0))
    return SourceReport(len(rows), energy / max(n_measured, 1),
                        autocorrelation.estimate(stamps, residuals), in_use, found)


def _biased_residuals(graph: Graph, edges: Edges) -> tuple[FloatArray, FloatArray]:
    """
    Return residuals of positions in map axes, and their information, for edges to a bias.

    The residual is the whole error of the measurement: the part that the bias explains and the
    white rest.
    """
    errors = graph.edge_errors(edges)[:, :2]
    factor = edges.bias[:, 2]
    total = errors - factor[:, None] * graph.poses_of(edges.j)[:, :2]
    variance = factor**2 + 1.0 / (0.5 * np.trace(
        edges.information[:, :2, :2], axis1=1, axis2=2) + 1e-12)
    return total, np.eye(2) / variance[:, None, None]
