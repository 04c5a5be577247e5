# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the constraints with the largest energies: source, stamp and hidden nodes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.graph_view import DIAGONAL, factor_table, FactorTable
from pose_graph_ros.core.measurements import Range
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.queued import Queued


class ConstraintEnergy(NamedTuple):
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


def largest(
    graph: Graph, nodes: HiddenNodes, factors: FactorBuilder, n: int,
) -> list[ConstraintEnergy]:
    """Return the constraints with the largest weighted energies, in descending order."""
    table = factor_table(graph)
    energies = table.weights * table.energies
    n = min(n, int(np.count_nonzero(energies > 0.0)))
    if n <= 0:
        return []
    rows = np.flatnonzero(energies >= np.partition(energies, len(energies) - n)[-n])
    rows = rows[np.argsort(-energies[rows], kind='stable')][:n]
    return [_named(row, float(energies[row]), table, graph, (nodes, factors))
            for row in rows.tolist()]


def _named(
    row: int, energy: float, table: FactorTable, graph: Graph,
    origins: tuple[HiddenNodes, FactorBuilder],
) -> ConstraintEnergy:
    """Return a constraint by its row."""
    nodes, factors = origins
    number, factor = int(graph.factor_ids[row]), table.records[row]
    ends = factor['ends'][:2]
    ends = ends[ends >= 0]
    places = np.searchsorted(nodes.ids, graph.node_ids[ends[graph.is_pose[ends]]]).tolist()
    kind = FactorKind(int(factor['kind'])).name.lower()
    origin, of_bias = factors.origin(number), factors.bias_origin(int(graph.node_ids[ends[0]]))
    known = origin or of_bias
    source = '' if origin is None else origin.source
    if len(places) == 2:
        if origin is None and kind == 'odometry':
            source = nodes.primary_at(int(nodes.stamps_ns[places[1]]))
        name = _name(source or kind, places)
    elif len(places) == 1:
        position, _, heading = factor['information'][DIAGONAL] > 0.0
        if len(ends) == 1 or kind == 'bias':
            kind = 'heading' if not position else 'global_pose' if heading else 'position'
        name = _name(source or kind, places, -1 if origin is None else origin.stamp_ns)
    else:
        # one on a bias alone comes from no measurement and is named after the bias
        kind, source = 'bias', '' if of_bias is None else of_bias.source
        name = kind if of_bias is None else _name(f'error of {source}', (), of_bias.stamp_ns)
    return ConstraintEnergy(
        energy, float(table.energies[row]), int(table.freedom[row]), source, kind, name,
        number, tuple(places), -1 if known is None else known.stamp_ns)


def _name(what: str, places: Sequence[int], stamp_ns: int = -1) -> str:
    """Return a readable name, as `ConstraintEnergy` has it."""
    if len(places) == 2:
        return '{} x{} - x{}'.format(what, *places)
    return ''.join((what, f' at {stamp_ns * 1e-9:.3f} s' if stamp_ns >= 0 else '',
                    *(f' near x{place}' for place in places)))


def queued(queue: Sequence[Queued], nodes: HiddenNodes) -> list[str]:
    """Return the names of constraints that are not in the graph, as in `ConstraintEnergy`."""
    # a landmark is no node of the path
    places = [each.nodes[:1 if each.measured is Range else 2] for each in queue]
    return [_name(each.source, np.searchsorted(nodes.ids, of).tolist(), each.stamp_ns)
            for each, of in zip(queue, places, strict=True)]
