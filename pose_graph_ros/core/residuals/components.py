# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factors on the sigmas of all sources together that make their residuals as large as expected.

Where the covariances of a source are wrong, the estimate follows it too much or too little, and
the residuals of the others show it as well. So all sources are weighed anew by the factors that
their residuals show, on a copy of the graph, and so on until the factors agree with the residuals.
These are the variance components of restricted maximum likelihood (D. A. Harville, "Maximum
likelihood approaches to variance component estimation and to related problems", JASA 1977,
section 5.2: Anderson's iteration). Sources keep their weights where chance explains the factor or
the residuals say nothing, as do those whose correlated errors the graph has as a bias. Odometry is
not weighed more than it claims: where it drifts by a slow error, as of a wheel radius, its
residuals from node to node are small, but what they add up to is not.
"""

from collections.abc import Mapping
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.residuals.scale import fit, ScaleFit
from pose_graph_ros.core.residuals.source_residuals import (
    collect,
    Scales,
    scales_in_use,
    SourceResiduals,
)
from pose_graph_ros.core.residuals.whiteness import whiteness
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import UpdateResult
from pose_graph_ros.core.sources.factor_builder import FactorBuilder

# Largest number of times that the copy is optimised.
ROUNDS = 6
# Factors that change by less than this have converged.
CONVERGED = 0.03
# Largest change of a factor in one round, and largest one in all, either way.
STEP, LARGEST = 3.0, 30.0


class Analysis(NamedTuple):
    """The residuals of each source, and how large its true sigmas are."""

    residuals: Mapping[str, SourceResiduals]
    """At the estimate."""
    at_estimate: Mapping[str, ScaleFit]
    """How large they are."""
    together: Mapping[str, ScaleFit]
    """The same where all sources have been weighed by what their residuals show."""
    correlated: frozenset[str]
    """
    Sources with correlated errors that the graph takes for independent: the residuals do not show
    how large these are, and what those of other sources show may be because of them.
    """


def analyse(
    smoother: IncrementalSmoother, nodes: HiddenNodes, factors: FactorBuilder,
    reweighting: Reweighting,
) -> Analysis:
    """
    Return the residuals of each source, and the factors on sigmas that they show together.

    Parameters
    ----------
    smoother, nodes, factors, reweighting
        Of the engine, all of whose edits have been solved for.

    """
    scales = scales_in_use(smoother.graph, reweighting)
    residuals = collect(smoother, nodes, factors, scales)
    at_estimate = {source: fit(each, factors.errors_in_use(source))
                   for source, each in residuals.items()}
    white = {source: None if np.any(each.is_edge) else whiteness(each)
             for source, each in residuals.items() if each.kind == 'map'}
    correlated = frozenset(
        source for source, found in white.items() if found is not None and found.tau > 0.0)
    together = dict(at_estimate)
    if len(correlated) > 0 or not any(
            _change(source, residuals, at_estimate) != 1.0 for source in residuals):
        return Analysis(residuals, at_estimate, together, correlated)
    copy = Graph()
    copy.fill(smoother.graph.rows())
    other, now = IncrementalSmoother(graph=copy), residuals
    for _ in range(ROUNDS):
        changes = {source: _change(source, now, together) for source in now}
        if all(change == 1.0 for change in changes.values()) or not _weigh(
                other, now, changes, scales):
            break
        now = collect(other, nodes, factors, scales)
        together = {source: fit(each, factors.errors_in_use(source))
                    for source, each in now.items()}
    return Analysis(residuals, at_estimate, together, correlated)


def _change(
    source: str, residuals: Mapping[str, SourceResiduals], fits: Mapping[str, ScaleFit],
) -> float:
    """Return the factor that the sigmas of a source need, 1 where chance may explain it."""
    found, each = fits[source], residuals[source]
    if found.says_nothing or (each.kind == 'map' and np.any(each.is_edge)):
        return 1.0
    present = float(np.median(each.scale[each.used]))
    wanted = min(max(found.ratio, 1.0 / LARGEST), LARGEST)
    if each.kind == 'odometry':
        wanted = max(wanted, min(present, 1.0))
    change = wanted / present
    if found.low <= change <= found.high or abs(math.log(change)) <= CONVERGED:
        return 1.0
    return min(max(change, 1.0 / STEP), STEP)


def _weigh(
    smoother: IncrementalSmoother, residuals: Mapping[str, SourceResiduals],
    changes: Mapping[str, float], scales: Scales,
) -> bool:
    """Multiply sigmas and scales by factors, and optimise; tell whether that was possible."""
    graph = smoother.graph
    weights = graph.weights
    for source, change in changes.items():
        each = residuals[source]
        for weight, scale, rows_of, ids in (
                (weights[0], scales.edges, graph.edge_rows, each.ids[each.is_edge]),
                (weights[1], scales.observed, graph.observed_rows, each.ids[~each.is_edge])):
            rows = rows_of(ids)
            weight[rows] /= change**2
            scale[rows] *= change
    graph.set_weights(weights)
    result: UpdateResult = smoother.update(GraphUpdate())
    return result.reason == ''
