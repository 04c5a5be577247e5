# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What constraints contradict one another, in words for people.

The constraints with the largest energies are named by source, stamp and hidden nodes. And where
measurements contradict one another, there may be a source without which all others agree. One that
is mounted or set wrongly bends the path, so that others have large residuals, and not necessarily
itself. So a copy of the graph is solved without each of them in turn.
"""

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.optimizer import optimize_from_two_starts, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_view import DIAGONAL, factor_table, FactorTable
from pose_graph_ros.core.measurements import Range
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.sources.settings import SOURCES


class ConstraintEnergy(NamedTuple):
    """A constraint, and how much of chi2 it is."""

    energy: float  # weighted energy, its part of chi2
    unweighted: float  # energy without the weight, by the covariance alone
    freedom: int  # degrees of freedom, which is the expected value of the unweighted energy
    source: str  # source of the measurement; empty if unknown
    kind: str  # such as `odometry`, `loop_closure`, `global_pose`, `position`, `range` or `bias`
    name: str  # readable name, such as `odom x12 - x13` or `fix at 1695.250 s near x812`
    number: int = -1  # its id in the graph
    # numbers of the hidden nodes of the path that it has, in the order of the name
    nodes: tuple[int, ...] = ()
    # of the measurement, or when the bin of a bias begins [ns]; -1 for edges between poses
    stamp_ns: int = -1


def largest(parts: Parts, n: int) -> list[ConstraintEnergy]:
    """Return the constraints with the largest weighted energies, in descending order."""
    table = factor_table(parts.graph)
    energies = table.weights * table.energies
    n = min(n, int(np.count_nonzero(energies > 0.0)))
    if n <= 0:
        return []
    rows = np.flatnonzero(energies >= np.partition(energies, len(energies) - n)[-n])
    rows = rows[np.argsort(-energies[rows], kind='stable')][:n]
    return [_named(row, float(energies[row]), table, parts) for row in rows.tolist()]


def _named(row: int, energy: float, table: FactorTable, parts: Parts) -> ConstraintEnergy:
    """Return a constraint by its row."""
    graph, nodes, factors = parts.graph, parts.nodes, parts.factors
    number, factor = int(graph.factor_ids[row]), table.records[row]
    ends = factor['ends'][:2]
    ends = ends[ends >= 0]
    places = np.searchsorted(nodes.ids, graph.node_ids[ends[graph.is_pose[ends]]]).tolist()
    kind = FactorKind(int(factor['kind'])).name.lower()
    source, stamp_ns = factors.origin(number)
    of_bias, begin_ns = factors.bias_origin(int(graph.node_ids[ends[0]]))
    if len(places) == 2:
        if source == '' and kind == 'odometry':
            source = nodes.primary_at(int(nodes.stamps_ns[places[1]]))
        name = _name(source or kind, places)
    elif len(places) == 1:
        position, _, heading = factor['information'][DIAGONAL] > 0.0
        if len(ends) == 1 or kind == 'bias':
            kind = 'heading' if not position else 'global_pose' if heading else 'position'
        name = _name(source or kind, places, stamp_ns)
    else:
        # one on a bias alone comes from no measurement and is named after the bias
        kind, source = 'bias', of_bias
        name = kind if source == '' else _name(f'error of {source}', (), begin_ns)
    return ConstraintEnergy(
        energy, float(table.energies[row]), int(table.freedom[row]), source, kind, name,
        number, tuple(places), begin_ns if stamp_ns < 0 else stamp_ns)


def _name(what: str, places: Sequence[int], stamp_ns: int = -1) -> str:
    """Return a readable name, as `ConstraintEnergy` has it."""
    if len(places) == 2:
        return '{} x{} - x{}'.format(what, *places)
    return ''.join((what, f' at {stamp_ns * 1e-9:.3f} s' if stamp_ns >= 0 else '',
                    *(f' near x{place}' for place in places)))


def queued(queue: Sequence[Queued], parts: Parts) -> list[str]:
    """Return the names of constraints that are not in the graph, as in `ConstraintEnergy`."""
    # a landmark is no node of the path
    places = [each.nodes[:1 if each.measured is Range else 2] for each in queue]
    return [_name(each.source, np.searchsorted(parts.nodes.ids, of).tolist(), each.stamp_ns)
            for each, of in zip(queue, places, strict=True)]


class Disagreement(NamedTuple):
    """A source that contradicts the others."""

    source: str
    text: str  # a sentence without capital and full stop that names it, and what may be wrong


class _Part(NamedTuple):
    """The constraints of a source, by their ids."""

    kind: str
    factors: IntArray


def find(parts: Parts) -> Disagreement | None:
    """
    Return the source that contradicts the others, None if they agree or it cannot be told.

    What is set wrongly most often is tried first: directions before positions. It takes a full
    optimisation for each source that is tried.
    """
    graph, primary, sources = parts.graph, parts.nodes.primary, _sources(parts)
    before = _strains(graph, parts, sources)
    others = [source for source in sources if source != primary]
    if max((before[source] for source in others), default=0.0) <= SOURCES.far:
        return None
    worst = max(others, key=lambda source: before[source])
    order = 'turn', 'heading', 'odometry', 'map', 'loop_closure'
    for source in sorted(others, key=lambda source: order.index(sources[source].kind)):
        copy = _solved_without(graph, sources, source)
        if copy is None:
            continue
        others_of = {name: part for name, part in sources.items() if name != source}
        rest = _strains(copy, parts, others_of)
        if max(rest.values()) <= SOURCES.far and rest.get(worst, 0.0) <= 0.25 * before[worst]:
            whom = ('the other sources, which agree without it' if len(rest) > 1 else
                    f'{primary}, and no third source tells who is wrong')
            return Disagreement(source, (
                f'{source} contradicts {whom} (the squared residual of {worst} is '
                f'{before[worst]:.2g}){_reason(copy, source, sources[source])}'))
    return Disagreement(primary, (
        f'{worst} has a squared residual of {before[worst]:.2g}, and no other source alone is to '
        f'blame: several are wrong, or {primary} is'))


def _sources(parts: Parts) -> dict[str, _Part]:
    found = {}
    for source, (_, held) in parts.factors.held().items():
        some = parts.graph.factors_at(held)
        tells_position = (some.j >= 0) | (some.information[:, 0, 0] > 0.0)
        found[source] = _Part('map' if np.any(tells_position) else 'heading', held)
    for (source, kind), ids in edges_by_source(parts).items():
        if len(ids) > 0:
            found.setdefault(source, _Part(kind, ids))
    return found


def edges_by_source(parts: Parts) -> Mapping[tuple[str, str], IntArray]:
    """Return the ids of the edges between poses by source and kind."""
    graph, nodes, others = parts.graph, parts.nodes, parts.factors.edges()
    ids, edges = graph.factor_ids, graph.factors
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


def _strains(graph: Graph, parts: Parts, sources: Mapping[str, _Part]) -> dict[str, float]:
    """Return the mean squared residual of each source, in units of what is known of its errors."""
    table, strains = factor_table(graph), {}
    for source, part in sources.items():
        if part.kind in ('map', 'heading'):
            strains[source] = parts.factors.report(source, graph).strain
        else:
            rows = graph.factor_rows(part.factors)
            used = rows[table.weights[rows] > 0.0]
            energy = float(np.sum(table.weights[used] * table.energies[used]))
            strains[source] = energy / max(int(np.sum(table.freedom[used])), 1)
    return strains


def _solved_without(graph: Graph, parts: Mapping[str, _Part], source: str) -> Graph | None:
    """Return a copy that is solved without a source; None if that fails."""
    copy, part = Graph(graph), parts[source]
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
