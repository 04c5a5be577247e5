# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the constraints with the largest energies: source, stamp and hidden nodes."""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.graph_view import constraint_tables, ConstraintTable, DIAGONAL
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.sources.constraint_queue import ConstraintOrigin, Queue
from pose_graph_ros.core.sources.factor_builder import FactorBuilder


@dataclass(frozen=True, slots=True)
class ConstraintEnergy:
    """One constraint and its energy."""

    energy: float
    """Weighted energy, its part of chi2."""
    unweighted: float
    """Energy without the weight, by the covariance alone."""
    freedom: int
    """Degrees of freedom, which is the expected value of the unweighted energy."""
    source: str
    """Source of the measurement; empty if unknown."""
    kind: str
    """`odometry`, `loop_closure`, `global_pose`, `position`, `heading`, or `bias`."""
    name: str
    """Readable name, such as `odom x12 - x13` or `fix at 1695.250 s near x812`."""
    edge: bool = True
    """Whether `number` is that of an edge; else of an observed node."""
    number: int = -1
    """Its id in the graph."""
    nodes: tuple[int, ...] = ()
    """Numbers of the hidden nodes of the path that it has, in the order of the name."""
    stamp_ns: int = -1
    """Of the measurement, or when the bin of a bias begins [ns]; -1 for edges between poses."""


def largest(
    graph: Graph, nodes: HiddenNodes, factors: FactorBuilder, n: int,
) -> list[ConstraintEnergy]:
    """
    Return the constraints with the largest weighted energies, in descending order.

    Parameters
    ----------
    factors : FactorBuilder, knows the sources of the constraints
    n : int, number of constraints at most; those without energy are left out

    """
    tables = constraint_tables(graph)
    energies = np.concatenate([table.weights * table.energies for table in tables])
    n = min(n, int(np.count_nonzero(energies > 0.0)))
    if n <= 0:
        return []
    rows = np.flatnonzero(energies >= np.partition(energies, len(energies) - n)[-n])
    rows = rows[np.argsort(-energies[rows], kind='stable')][:n]
    named = []
    for row in rows.tolist():
        edge = row < graph.n_edges
        number, table = (row, tables[0]) if edge else (row - graph.n_edges, tables[1])
        names = _names(number, table, graph, nodes, factors, edge=edge)
        ids = graph.edge_ids if edge else graph.observed_ids
        named.append(ConstraintEnergy(
            float(energies[row]), float(table.energies[number]), int(table.freedom[number]),
            *names, edge, int(ids[number]),
            _numbers(graph, nodes, table.integers[number], edge=edge),
            _stamp_ns(graph, factors, table.integers[number], int(ids[number]), edge=edge)))
    return named


def _numbers(
    graph: Graph, nodes: HiddenNodes, integers: IntArray, *, edge: bool,
) -> tuple[int, ...]:
    """Return the numbers of the hidden nodes in a row of a table, without biases."""
    rows = integers[[tb.END_I, tb.END_J] if edge else [tb.OBS_NODE]]
    ids = graph.node_ids[rows[graph.is_pose[rows]]]
    return tuple(np.searchsorted(nodes.ids, ids).tolist())


def _stamp_ns(
    graph: Graph, factors: FactorBuilder, integers: IntArray, number: int, *, edge: bool,
) -> int:
    """Return the stamp of a measurement or of a bias, given its row and id; -1 for others."""
    node = int(graph.node_ids[integers[tb.END_I if edge else tb.OBS_NODE]])
    origin = factors.origin(number, edge=edge) or factors.bias_origin(node)
    return -1 if origin is None else origin.stamp_ns


def queued(queue: Queue, nodes: HiddenNodes) -> list[str]:
    """Return the names of constraints that are not in the graph, as in `ConstraintEnergy`."""
    ends = [(source, np.searchsorted(nodes.ids, (edge.i[0], edge.j[0])).tolist())
            for source, edge, *_ in queue.edges]
    ends += [(turn.source, np.searchsorted(nodes.ids, (turn.i, turn.j)).tolist())
             for turn in queue.turns]
    return [f'{source} x{i} - x{j}' for source, (i, j) in ends] + [
        f'{each.source} at {each.measurement.stamp_ns * 1e-9:.3f} s near '
        f'x{int(np.searchsorted(nodes.ids, each.attachment.node))}' for each in queue.observed]


def _names(
    row: int, table: ConstraintTable, graph: Graph, nodes: HiddenNodes, factors: FactorBuilder, *,
    edge: bool,
) -> tuple[str, str, str]:
    """Return source, kind and name of a constraint, given its row in the graph."""
    number = int((graph.edge_ids if edge else graph.observed_ids)[row])
    integers, origin = table.integers[row], factors.origin(number, edge=edge)
    if not edge or integers[tb.EDGE_KIND] == EdgeKind.BIAS:
        node = int(graph.node_ids[integers[tb.END_I if edge else tb.OBS_NODE]])
        return _measurement_name(origin, node, table.numbers[row], nodes, factors)
    kind = EdgeKind(int(integers[tb.EDGE_KIND]))
    ends = graph.node_ids[integers[[tb.END_I, tb.END_J]]]
    i, j = np.searchsorted(nodes.ids, ends).tolist()
    source = '' if origin is None else origin.source
    if origin is None and kind == EdgeKind.ODOMETRY:
        source = nodes.primary_at(int(nodes.stamps_ns[j]))
    name = kind.name.lower()
    return source, name, f'{source or name} x{i} - x{j}'


def _measurement_name(
    origin: ConstraintOrigin | None, node: int, numbers: FloatArray, nodes: HiddenNodes,
    factors: FactorBuilder,
) -> tuple[str, str, str]:
    """
    Return source, kind and name of a constraint that was made from a measurement in the map.

    `node` is the id of its hidden node, `numbers` its row of the constraint table. A
    constraint on a bias alone comes from no measurement and is named after the bias.
    """
    number = int(np.searchsorted(nodes.ids, node))
    if number == len(nodes) or nodes.ids[number] != node:
        origin, kind, where = factors.bias_origin(node), 'bias', ''
    else:
        position, _, heading = numbers[DIAGONAL] > 0.0
        kind = 'heading' if not position else 'global_pose' if heading else 'position'
        where = f' near x{number}'
    if origin is None:
        return '', kind, f'{kind}{where}'
    what = f'error of {origin.source}' if kind == 'bias' else origin.source
    return origin.source, kind, f'{what} at {origin.stamp_ns * 1e-9:.3f} s{where}'
