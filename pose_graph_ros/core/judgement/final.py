# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The decision on all loop closures at the end of a stream.

While measurements come, what is believed depends on their order. At the end it must not: the set
is a function of the graph alone. All closures are taken out, the rest is solved with robust
weights computed from initial values, and `selection` decides from there.

That would take long for a very large graph. There the set that is believed already is kept, but
for retests of all closures at its poses.
"""

import numpy as np

from pose_graph_ros.core.batch import final_optimization, optimizer
from pose_graph_ros.core.batch.optimizer import Start, Status
from pose_graph_ros.core.batch.truncated import Choice, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement import selection
from pose_graph_ros.core.judgement.copies import copied_rows, losses_in_rows
from pose_graph_ros.core.judgement.floors import floored, forward
from pose_graph_ros.core.solver_config import SolverConfig

CONFIG = SolverConfig(max_iterations=100)
# Nodes and closures, together, above which the set is only improved, and the number of retests.
MOST, RETESTS = 30_000, 3


def decide(
    graph: Graph, reweighting: Reweighting, ids: IntArray, forced: IntArray, inside: BoolArray,
) -> Choice | None:
    """
    Return which loop closures to believe, with poses by row; None if the graph cannot be solved.

    With more than `MOST` nodes and closures it is `inside`, improved.

    Parameters
    ----------
    graph : Graph, it is not changed
    reweighting : Reweighting, of its constraints with a robust loss; it is not changed
    ids : ndarray of int, shape (M,), edges that may be doubted; their weights do not matter
    forced : ndarray of int, ids of edges that a person has decided to believe
    inside : ndarray of bool, shape (M,), which of `ids` are believed now

    """
    rows, forced = graph.edge_rows(ids), graph.edge_rows(forced)
    copy = _copy(graph, np.union1d(rows, forced))
    if graph.n_nodes + len(rows) > MOST:
        problem = TruncatedProblem(copy, rows, start=copy.poses.copy())
        present = problem.choice(inside)
        return None if present is None else problem.improved(present, RETESTS)
    weights = dict.fromkeys(rows.tolist(), 0.0) | dict.fromkeys(forced.tolist(), 1.0)
    copy.apply(GraphUpdate(weigh_edges=weights))
    others = losses_in_rows(graph, reweighting)
    for row, weight in weights.items():
        others.set_base_weight(row, weight, edge=True)
    starts = (Start.CHORDAL, Start.JOINT, Start.PRESENT)
    result = optimizer.optimize_from_linear_start(copy, CONFIG, starts)
    if result.status is not Status.FAILED and len(others) > 0:
        result = final_optimization.optimize(copy, others, CONFIG, optimizer.optimize)
    if result.status is Status.FAILED:
        return None
    problem = TruncatedProblem(copy, rows, start=copy.poses.copy())
    return selection.best(problem, insured=True)


def _copy(graph: Graph, closures: IntArray) -> Graph:
    """Return a copy of a graph in which closures have the information to decide by; by row."""
    rows, copy = copied_rows(graph), Graph()
    edges = rows.edges
    columns = edges.i.copy(), edges.j.copy(), edges.mean.copy(), edges.information.copy()
    own = floored(forward(edges.rows(closures)))
    for column, values in zip(
            columns, (own.i, own.j, own.mean, own.information), strict=True):
        column[closures] = values
    copy.fill(rows._replace(edges=Edges(*columns, edges.kind, edges.weight, edges.bias, edges.k)))
    return copy
