# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factors on the sigmas of all sources together that make their residuals as large as expected.

Where the covariances of a source are wrong, the estimate follows it too much or too little, and
the residuals of the others show it as well. So the factors of all sources are found in one
estimate (`variance_components`), in which each may be above and below 1. Sources whose correlated
errors the graph has as a bias keep their covariances, and what their residuals at the estimate
show; where such errors are taken for independent, nothing is known of the others either.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.measurements import Answer
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.residuals import variance_components as vc
from pose_graph_ros.core.residuals.scale import fit, ScaleFit
from pose_graph_ros.core.residuals.source_residuals import (
    collect,
    inverse,
    scales_in_use,
    SourceResiduals,
)
from pose_graph_ros.core.residuals.whiteness import whiteness
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.measurement_constraints import attach, closure_covariance


class Analysis(NamedTuple):
    """The residuals of each source, and how large its true sigmas are."""

    residuals: Mapping[str, SourceResiduals]
    """At the estimate."""
    at_estimate: Mapping[str, ScaleFit]
    """How large they are."""
    together: Mapping[str, ScaleFit]
    """The same, with the factors of all sources in one estimate."""
    correlated: frozenset[str]
    """
    Sources with correlated errors that the graph takes for independent: the residuals do not show
    how large these are, and what those of other sources show may be because of them.
    """


Closures = tuple[IntArray, IntArray]
"""Ids of the edges of loop closures, and stamps of each and of its other end [ns], (L, 2)."""


def analyse(
    smoother: IncrementalSmoother, nodes: HiddenNodes, factors: FactorBuilder,
    reweighting: Reweighting, closures: Closures,
) -> Analysis:
    """
    Return the residuals of each source, and the factors on sigmas that they show together.

    Parameters
    ----------
    smoother, nodes, factors, reweighting
        Of the engine, all of whose edits have been solved for.
    closures : tuple of ndarray, see `Closures`

    """
    residuals = collect(smoother, nodes, factors, scales_in_use(smoother.graph, reweighting))
    if nodes.primary in residuals:
        # its edges have the noise that was found, and a ratio is one to what is claimed
        of_odometry = residuals[nodes.primary]
        residuals[nodes.primary] = of_odometry._replace(
            scale=of_odometry.scale * nodes.errors.mean_sigma)
    at_estimate = {source: fit(each, factors.errors_in_use(source))
                   for source, each in residuals.items()}
    white = {source: each for source, each in residuals.items()
             if each.kind != 'map' or not np.any(each.is_edge)}
    correlated = frozenset(
        source for source, each in white.items() if each.kind == 'map'
        and (found := whiteness(each)) is not None and found.tau > 0.0)
    together = dict(at_estimate)
    if len(correlated) == 0:
        together |= _together(smoother, nodes, at_estimate, white, closures)
    return Analysis(residuals, at_estimate, together, correlated)


def _together(
    smoother: IncrementalSmoother, nodes: HiddenNodes, at_estimate: Mapping[str, ScaleFit],
    sources: Mapping[str, SourceResiduals], closures: Closures,
) -> dict[str, ScaleFit]:
    """Return the fits of some sources with the factors of all of them in one estimate."""
    graph = smoother.graph
    data = vc.constraints(graph)
    try:
        claimed = inverse(data.information, data.measured)
    except np.linalg.LinAlgError:   # what thinning leaves has no covariance
        return {source: at_estimate[source].unknown for source in sources}
    place = np.full(graph.n_edges + graph.n_observed, -1)
    place[data.rows] = np.arange(len(data.rows))
    own, parts = claimed.copy(), {source: np.zeros_like(claimed) for source in sources}
    for source, row, motion in _motions(graph, nodes, closures):
        # of a graph that was loaded, less is known of what odometry has added
        if (k := place[row]) >= 0 and source in parts and (
                np.linalg.eigvalsh(claimed[k] - motion)[0] > 0.0):
            parts[source][k], own[k] = motion, claimed[k] - motion
    fixed = claimed / data.weight[:, None, None]
    rows = {source: place[graph.edge_rows(each.ids) if np.all(each.is_edge)
                          else graph.n_edges + graph.observed_rows(each.ids)][each.used]
            for source, each in sources.items()}
    for source, at in rows.items():
        parts[source][at] += own[at]
        fixed[at] = 0.0
    components = {(source, kind): part for source, whole in parts.items()
                  for kind, part in enumerate(vc.split(whole)) if np.any(part)}
    found = vc.restricted_likelihood(data, np.array(list(components.values())), fixed)
    if found is None:
        return {source: at_estimate[source].unknown for source in sources}
    return {source: _with_factors(
        at_estimate[source], own[at], found,
        {kind: k for k, (name, kind) in enumerate(components) if name == source},
        in_use=nodes.errors.mean_sigma if source == nodes.primary else 1.0)
        for source, at in rows.items() if len(at) > 0}


def _motions(
    graph: Graph, nodes: HiddenNodes, closures: Closures,
) -> Iterator[tuple[str, int, FloatArray]]:
    """Yield source, row of the edge, and covariance of what odometry adds to loop closures."""
    ids, stamps_ns = closures
    for row, mean, (stamp, other) in zip(graph.edge_rows(ids).tolist(), graph.edges_at(
            ids).mean, stamps_ns.tolist(), strict=True):
        reference, attachment = attach(nodes, other), attach(nodes, stamp)
        if isinstance(reference, Answer) or isinstance(attachment, Answer):
            continue
        pose = se2.compose(se2.compose(se2.inverse(reference.motion), mean), attachment.motion)
        yield nodes.primary_at(stamp), row, closure_covariance(
            np.zeros((3, 3)), pose, reference, attachment)


def _with_factors(
    present: ScaleFit, claimed: FloatArray, found: vc.Found, parts: Mapping[int, int], *,
    in_use: float,
) -> ScaleFit:
    """
    Return a fit with other factors.

    Parameters
    ----------
    claimed : ndarray, shape (M, 3, 3), covariances of the constraints
    parts : mapping, numbers of the components of the source, by 0 for the way and 1 for the turn
    in_use : float, factor on the sigmas that the covariances have already

    """
    sigmas = np.sqrt(np.mean(np.diagonal(claimed, axis1=1, axis2=2), axis=0)).tolist()
    rows = []
    for row in present.rows:
        part = parts.get(row.coordinate // 2)
        ratio, low, high, _ = found.of([] if part is None else [part])
        rows.append(row._replace(
            sigma=sigmas[row.coordinate], ratio=ratio, low=low, high=high))
    ratio, low, high, independent = found.of(list(parts.values()))
    return present._replace(
        rows=tuple(rows), ratio=in_use * ratio, low=in_use * low, high=in_use * high,
        independent=independent)
