# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the constraints with the largest energies: source, stamp and hidden nodes."""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.graph_view import DIAGONAL, factor_table, FactorTable
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.source_constraints import Queue


@dataclass(frozen=True, slots=True)
class ConstraintEnergy:
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
    ids = graph.node_ids[ends]
    places = np.searchsorted(nodes.ids, ids[graph.is_pose[ends]]).tolist()
    origin, of_bias = factors.origin(number), factors.bias_origin(int(ids[0]))
    known = origin or of_bias
    kind = FactorKind(int(factor['kind'])).name.lower()
    if len(ends) == len(places) == 2:
        i, j = np.searchsorted(nodes.ids, ids).tolist()
        source = '' if origin is None else origin.source
        if origin is None and factor['kind'] == FactorKind.ODOMETRY:
            source = nodes.primary_at(int(nodes.stamps_ns[j]))
        name = f'{source or kind} x{i} - x{j}'
    else:
        if len(places) > 0:
            position, _, heading = factor['information'][DIAGONAL] > 0.0
            if len(ends) == 1 or factor['kind'] == FactorKind.BIAS:
                kind = 'heading' if not position else 'global_pose' if heading else 'position'
            where = f' near x{places[0]}'
        else:
            # one on a bias alone comes from no measurement and is named after the bias
            origin, kind, where = of_bias, 'bias', ''
        source, name = '', f'{kind}{where}'
        if origin is not None:
            source = origin.source
            what = f'error of {source}' if kind == 'bias' else source
            name = f'{what} at {origin.stamp_ns * 1e-9:.3f} s{where}'
    return ConstraintEnergy(
        energy, float(table.energies[row]), int(table.freedom[row]), source, kind, name,
        number, tuple(places), -1 if known is None else known.stamp_ns)


def queued(queue: Queue, nodes: HiddenNodes) -> list[str]:
    """Return the names of constraints that are not in the graph, as in `ConstraintEnergy`."""
    ends = [(each.source, each.ends) for each in queue.edges]
    ends += [(each.source, each.ends) for each in queue.turns]
    return ['{} x{} - x{}'.format(source, *np.searchsorted(nodes.ids, pair).tolist())
            for source, pair in ends] + [
        f'{each.source} at {each.measurement.stamp_ns * 1e-9:.3f} s near '
        f'x{int(np.searchsorted(nodes.ids, each.attachment.node))}' for each in queue.observed]
