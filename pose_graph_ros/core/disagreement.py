# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The source without which all others agree, where measurements contradict one another.

A source that is mounted or set wrongly bends the path, so that others have large residuals, and
not necessarily itself. So a copy of the graph is solved without each of them in turn.
"""

from collections.abc import Mapping
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.optimizer import optimize_from_two_starts, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_view import factor_table
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.settings import SOURCES


class Disagreement(NamedTuple):
    """A source that contradicts the others."""

    source: str
    text: str  # a sentence without capital and full stop that names it, and what may be wrong


class _Part(NamedTuple):
    """The constraints of a source, by their ids."""

    kind: str
    factors: IntArray


def find(
    smoother: IncrementalSmoother, nodes: HiddenNodes, factors: FactorBuilder,
) -> Disagreement | None:
    """
    Return the source that contradicts the others, None if they agree or it cannot be told.

    What is set wrongly most often is tried first: directions before positions. It takes a full
    optimisation for each source that is tried.
    """
    graph = smoother.graph
    parts = _parts(graph, nodes, factors)
    before = _strains(graph, factors, parts)
    others = [source for source, part in parts.items() if source != nodes.primary]
    if max((before[source] for source in others), default=0.0) <= SOURCES.far:
        return None
    worst = max(others, key=lambda source: before[source])
    order = 'turn', 'heading', 'odometry', 'map', 'loop_closure'
    for source in sorted(others, key=lambda source: order.index(parts[source].kind)):
        copy = _solved_without(graph, parts, source)
        if copy is None:
            continue
        rest = _strains(copy, factors, {
            name: part for name, part in parts.items() if name != source})
        if max(rest.values()) <= SOURCES.far and rest.get(worst, 0.0) <= 0.25 * before[worst]:
            whom = ('the other sources, which agree without it' if len(rest) > 1 else
                    f'{nodes.primary}, and no third source tells who is wrong')
            return Disagreement(source, (
                f'{source} contradicts {whom} (the squared residual of {worst} is '
                f'{before[worst]:.2g}){_reason(copy, source, parts[source])}'))
    return Disagreement(nodes.primary, (
        f'{worst} has a squared residual of {before[worst]:.2g}, and no other source alone is to '
        f'blame: several are wrong, or {nodes.primary} is'))


def _parts(graph: Graph, nodes: HiddenNodes, factors: FactorBuilder) -> dict[str, _Part]:
    parts = {}
    for source, (_, held) in factors.held().items():
        some = graph.factors_at(held)
        tells_position = (some.j >= 0) | (some.information[:, 0, 0] > 0.0)
        parts[source] = _Part('map' if np.any(tells_position) else 'heading', held)
    for (source, kind), ids in edges_by_source(graph, nodes, factors).items():
        if len(ids) > 0:
            parts.setdefault(source, _Part(kind, ids))
    return parts


def edges_by_source(
    graph: Graph, nodes: HiddenNodes, factors: FactorBuilder,
) -> Mapping[tuple[str, str], IntArray]:
    """Return the ids of the edges between poses by source and kind."""
    ids, edges = graph.factor_ids, graph.factors
    others = factors.edges()
    found: dict[tuple[str, str], IntArray] = {}
    known = np.concatenate([np.empty(0, dtype=np.int64), *others.values()])
    primary = np.flatnonzero((edges.kind == FactorKind.ODOMETRY) & ~np.isin(ids, known))
    at = np.clip(np.searchsorted(nodes.ids, edges.j[primary]), 0, len(nodes) - 1)
    stamps = nodes.stamps_ns[at].tolist()
    names = np.array([nodes.primary_at(stamp) for stamp in stamps], dtype=str)
    for source in dict.fromkeys(names.tolist()):
        found[source, 'odometry'] = ids[primary[names == source]]
    for source, each in others.items():
        there = each[graph.factor_rows(each) >= 0]
        kinds = graph.factors_at(there).kind
        for kind in (FactorKind.LOOP_CLOSURE, FactorKind.ODOMETRY, FactorKind.TURN):
            if np.any(kinds == kind):
                found.setdefault((source, kind.name.lower()), there[kinds == kind])
    return found


def _strains(graph: Graph, factors: FactorBuilder, parts: Mapping[str, _Part]) -> dict[str, float]:
    """Return the mean squared residual of each source, in units of what is known of its errors."""
    table, strains = factor_table(graph), {}
    for source, part in parts.items():
        if part.kind in ('map', 'heading'):
            strains[source] = factors.report(source, graph).strain
        else:
            rows = graph.factor_rows(part.factors)
            used = rows[table.weights[rows] > 0.0]
            energy = float(np.sum(table.weights[used] * table.energies[used]))
            strains[source] = energy / max(int(np.sum(table.freedom[used])), 1)
    return strains


def _solved_without(graph: Graph, parts: Mapping[str, _Part], source: str) -> Graph | None:
    """Return a copy that is solved without a source; None if that fails."""
    copy, part = Graph(), parts[source]
    copy.fill(graph.rows())
    kinds = {each.kind for name, each in parts.items() if name != source}
    # what nothing else holds is held where the first node is
    first = np.flatnonzero(graph.is_pose)[:0 if 'map' in kinds else 1]
    information = np.tile(np.diag((1.0, 1.0, float('heading' not in kinds))), (len(first), 1, 1))
    copy.apply(GraphUpdate(weigh=dict.fromkeys(part.factors.tolist(), 0.0), factors=Factors.on(
        graph.node_ids[first], None, graph.poses[first], information,
        [FactorKind.GLOBAL_POSE] * len(first))))
    result = optimize_from_two_starts(copy, SolverConfig())
    return None if result.status is Status.FAILED else copy


def _reason(graph: Graph, source: str, part: _Part) -> str:
    """Return what its residuals at the path of the others show, after a colon."""
    if part.kind == 'turn':
        edges = graph.factors_at(part.factors)
        turned = edges.mean[:, 2]
        true = turned + graph.errors(edges)[:, 2]
        slope = float(np.sum(turned * true) / max(np.sum(true**2), 1e-12))
        return (': it turns the other way, so check its mounting' if slope < -0.3 else
                ': it does not turn with the robot, so its z axis is not up (see '
                f'{source}.mounting and /tf_static), or it is dead' if slope < 0.3 else '')
    if part.kind != 'heading':
        return ''
    observed = graph.factors_at(part.factors)
    errors, measured = graph.errors(observed)[:, 2], observed.mean[:, 2]
    off, length = _mean_angle(-errors)
    # from this mean resultant length on, angles are about the same
    if length > 0.9:
        return (f': its headings are off by {math.degrees(off):.0f} degrees, where zero must be '
                f'east; add {-off:.2f} rad to {source}.yaw_offset')
    if _mean_angle(errors + 2.0 * measured)[1] > 0.9:
        return (': its headings turn the other way, as those of NED do (clockwise from north) or '
                'of an IMU upside down; its driver must send ENU of the robot')
    return ': its headings do not change' if _mean_angle(measured)[1] > 0.9 else ''


def _mean_angle(angles: FloatArray) -> tuple[float, float]:
    """Return the mean of angles [rad], and how much they agree: 1 if they are the same."""
    mean = complex(np.mean(np.exp(1j * angles)))
    return float(se2.wrap(math.atan2(mean.imag, mean.real))), abs(mean)
