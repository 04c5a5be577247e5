# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The residuals of all constraints at the estimate, by source, with what is expected of them.

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
"""

from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.core.disagreement import edges_by_source
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import (
    BoolArray,
    Covariances,
    FloatArray,
    IntArray,
    Poses,
)
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.quantities import StampsNs
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.gauss_markov import STRETCH


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


def scales_in_use(graph: Graph, reweighting: Reweighting) -> FloatArray:
    """
    Return the factors on the claimed sigmas that a graph uses, without those of a robust loss.

    They are by row.
    """
    weights, saved = graph.weights, reweighting.saved()
    rows = graph.factor_rows(saved.rows)
    weights[rows[rows >= 0]] = saved.shares[rows >= 0]
    return np.asarray(np.where(weights > 0.0, weights, 1.0)**-0.5)


def collect(
    smoother: IncrementalSmoother, nodes: HiddenNodes, factors: FactorBuilder, scales: FloatArray,
) -> dict[str, SourceResiduals]:
    """
    Return the residuals of each source that has constraints in the graph.

    Raises ValueError if edits of the graph wait for the solver.
    """
    graph, covariances = smoother.graph, smoother.covariances()
    found: dict[str, SourceResiduals] = {}
    for source, (stamps, held) in factors.held().items():
        biased = graph.factors_at(held).j >= 0
        observed, edges = held[~biased], held[biased]
        parts = [
            _of_observed(graph, observed, covariances, scales[graph.factor_rows(observed)]),
            _of_biased(graph, edges, covariances, scales[graph.factor_rows(edges)],
                       _total(factors, source))]
        order = np.argsort(biased, kind='stable')
        columns: Any = (
            stamps[order], *map(np.concatenate, zip(*parts, strict=True)), held[order])
        found[source] = _sorted(SourceResiduals(source, 'map', *columns))
    for (source, kind), ids in edges_by_source(graph, nodes, factors).items():
        if source not in found:
            found[source] = _sorted(_of_edges(
                smoother, nodes, (source, kind), ids, scales[graph.factor_rows(ids)]))
    return {source: each for source, each in found.items() if len(each.ids) > 0}


def _total(factors: FactorBuilder, source: str) -> float:
    """Return the variance of a source's correlated errors in use, in units of the claimed one."""
    errors = factors.errors_in_use(source)
    return 1.0 if errors is None else errors.correlated + errors.white


_Columns = tuple[FloatArray, BoolArray, FloatArray, FloatArray, BoolArray, FloatArray]


def _of_observed(
    graph: Graph, ids: IntArray, covariances: FloatArray, scale: FloatArray,
) -> _Columns:
    """Return the columns from `errors` to `scale` of observed nodes, in map axes."""
    observed = graph.factors_at(ids)
    errors = graph.errors(observed)
    turn = _turns(observed.mean[:, 2])
    information = turn @ observed.information @ np.swapaxes(turn, 1, 2)
    measured = np.diagonal(observed.information, axis1=1, axis2=2) > 0.0
    errors = np.einsum('kij,kj->ki', turn, errors) * measured
    return (errors, measured, inverse(information, measured) * scale[:, None, None]**2,
            _taken(graph, observed.i, observed.offset[:, :2], covariances),
            observed.weight > 0.0, scale)


def _of_biased(
    graph: Graph, ids: IntArray, covariances: FloatArray, scale: FloatArray, total: float,
) -> _Columns:
    """Return the same of edges to a bias; the bias is a part of the error."""
    edges = graph.factors_at(ids)
    states, factor = graph.poses_of(edges.j), edges.constants[:, [2, 2, 3]]
    measured = np.diagonal(edges.information, axis1=1, axis2=2) > 0.0
    errors = (graph.errors(edges) - factor * states) * measured
    variance = (factor / (1.0, 1.0, STRETCH))**2 * measured
    covariance = inverse(edges.information, measured) + variance[:, :, None] * np.eye(3)
    return (errors, measured, covariance * scale[:, None, None]**2,
            _taken(graph, edges.i, edges.constants[:, :2], covariances), edges.weight > 0.0,
            np.sqrt(total) * scale)


def _taken(
    graph: Graph, nodes: IntArray, offsets: FloatArray, covariances: FloatArray,
) -> FloatArray:
    """Return J P J^T of measurements of points of the robot, in map axes, shape (K, 3, 3)."""
    rows = graph.node_rows(nodes)
    arms = np.einsum('kij,kj->ki', se2.rotation(graph.poses[rows, 2]), offsets)
    J = np.tile(np.eye(3), (len(rows), 1, 1))
    J[:, 0, 2], J[:, 1, 2] = -arms[:, 1], arms[:, 0]
    return J @ covariances[rows] @ np.swapaxes(J, 1, 2)


def _of_edges(
    smoother: IncrementalSmoother, nodes: HiddenNodes, name: tuple[str, str], ids: IntArray,
    scale: FloatArray,
) -> SourceResiduals:
    """Return the residuals of edges between poses, given their source and kind."""
    graph = smoother.graph
    edges = graph.factors_at(ids)
    measured = np.diagonal(edges.information, axis1=1, axis2=2) > 0.0
    taken = np.full((len(ids), 3, 3), np.nan)
    # each takes up to the depth of the tree
    some = spread(len(ids), 1000)
    taken[some] = smoother.innovations(edges.rows(some)).covariances
    later = np.searchsorted(nodes.ids, np.maximum(edges.i, edges.j))
    return SourceResiduals(
        *name, nodes.stamps_ns[np.clip(later, 0, len(nodes) - 1)],
        graph.errors(edges) * measured, measured,
        inverse(edges.information, measured) * scale[:, None, None]**2, taken,
        edges.weight > 0.0, scale, ids)


def spread(n: int, most: int) -> IntArray:
    """Return at most so many of the numbers from 0 to n - 1, evenly spaced."""
    return np.arange(n) if n <= most else np.unique(
        np.round(np.linspace(0, n - 1, most)).astype(np.int64))


def inverse(matrices: FloatArray, measured: BoolArray) -> FloatArray:
    """Return the inverses of matrices in the coordinates that are measured, (M, 3), else 0."""
    both = measured[:, :, None] & measured[:, None, :]
    filled = np.where(both, matrices, 0.0) + np.eye(3) * ~measured[:, :, None]
    return np.asarray(np.where(both, np.linalg.inv(filled), 0.0))


def _turns(angles: FloatArray) -> FloatArray:
    """Return rotations of poses, shape (M, 3, 3)."""
    turn = np.tile(np.eye(3), (len(angles), 1, 1))
    turn[:, :2, :2] = se2.rotation(angles)
    return turn


def _sorted(residuals: SourceResiduals) -> SourceResiduals:
    return residuals.rows(np.argsort(residuals.stamps_ns, kind='stable'))
