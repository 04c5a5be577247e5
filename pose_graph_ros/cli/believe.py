# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures of a graph from a file to believe; part of the tool `pose-graph solve`."""

from dataclasses import dataclass, replace

import numpy as np

from pose_graph_ros.cli.solve_starts import METHODS
from pose_graph_ros.core.batch import gnc
from pose_graph_ros.core.batch.optimizer import optimize_from_linear_start, Status
from pose_graph_ros.core.batch.truncated import Choice, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement import selection
from pose_graph_ros.core.judgement.floors import floored, forward
from pose_graph_ros.core.judgement.residual_scale import give_scale
from pose_graph_ros.core.solver_config import SolverConfig

# Ways to decide: the lowest truncated cost of several sets, or graduated non-convexity alone.
SURROGATES = {'gnc': gnc.Surrogate.TRUNCATED, 'gnc-gm': gnc.Surrogate.GEMAN_MCCLURE}
# Number of sets of closures that are tried to join parts that no odometry joins.
TRIES = 5


@dataclass(frozen=True, slots=True)
class BelievedEdges:
    """Which edges of a graph are believed."""

    closures: IntArray
    """Rows of all edges that may be doubted, shape (M,)."""
    believed: BoolArray
    """Shape (M,)."""
    n_parts: int
    """Number of parts that odometry does not join."""
    poses: FloatArray
    """Of all nodes, shape (N, 3) [m, m, rad]."""
    scale: float
    """Factor on the sigmas of closures that those believed show, at least 1."""


def believe(
    graph: Graph, sigmas: FloatArray, method: str = METHODS[0],
) -> BelievedEdges | None:
    """
    Return which edges of a graph to believe, and poses at which they agree; None if it fails.

    Edges between neighbouring rows are odometry, which is believed. Where odometry does not join
    all nodes, some closures are taken as known that do; several such sets are tried.

    Parameters
    ----------
    graph : Graph, it is not changed
    sigmas : ndarray, shape (3,), least sigmas of closures for the decision [m, m, rad]
    method : str, one of `METHODS`

    """
    edges = forward(graph.edges)
    is_motion = edges.kind <= EdgeKind.LOOP_CLOSURE
    is_closure = is_motion & (np.abs(edges.j - edges.i) != 1)
    kind = np.where(is_closure, EdgeKind.LOOP_CLOSURE, np.where(
        is_motion, EdgeKind.ODOMETRY, edges.kind)).astype(np.uint8)
    given, softened = edges.information, floored(edges, sigmas).information
    information = np.where(is_closure[:, None, None], softened, given)
    edges = replace(edges, information=information, kind=kind)
    closures = np.flatnonzero(is_closure & (edges.weight > 0.0) & (edges.i != edges.j))
    parts = _Parts(graph.n_nodes)
    parts.join(edges.rows(~is_closure))
    n_parts, best, best_rows = parts.count, None, closures
    for k in range(TRIES if n_parts > 1 else 1):
        known = _joining(edges, closures, parts.copy(), k)
        rows = closures[~np.isin(closures, known)]
        choice = _choice(graph, edges, rows, method)
        if choice is not None and (best is None or choice.cost < best.cost):
            best, best_rows = choice, rows
    if best is None:
        return None
    doubted = best_rows[~best.believed]
    believed = ~np.isin(closures, doubted)
    copy = Graph()
    copy.fill(graph.rows()._replace(edges=replace(edges, information=given)))
    copy.apply(GraphUpdate(remove_edges=doubted.tolist()))
    copy.set_poses(best.poses)
    scale = give_scale(copy, closures[believed])
    return BelievedEdges(closures, believed, n_parts, copy.poses.copy(), scale)


def _choice(
    graph: Graph, edges: Edges, closures: IntArray, method: str,
) -> Choice | None:
    """Return a set of closures, from the start that all other constraints give."""
    copy = Graph()
    copy.fill(graph.rows()._replace(edges=edges))
    copy.apply(GraphUpdate(remove_edges=closures.tolist()))
    if optimize_from_linear_start(copy, SolverConfig()).status is Status.FAILED:
        return None
    problem = TruncatedProblem(copy, closures, start=copy.poses.copy())
    if method in SURROGATES:
        return gnc.select(problem, SURROGATES[method], patient=True)
    return selection.best(problem)


class _Parts:
    """The parts of a graph that edges join."""

    def __init__(self, n_nodes: int) -> None:
        self._parent = list(range(n_nodes))
        self.count = n_nodes

    def copy(self) -> '_Parts':
        other = _Parts(0)
        other._parent, other.count = self._parent.copy(), self.count
        return other

    def join(self, edges: Edges) -> BoolArray:
        """Return for each edge whether it has joined two parts."""
        joined = np.zeros(len(edges), dtype=bool)
        for k, (i, j) in enumerate(zip(edges.i.tolist(), edges.j.tolist(), strict=True)):
            a, b = self._root(i), self._root(j)
            if a != b:
                self._parent[max(a, b)] = min(a, b)
                self.count -= 1
                joined[k] = True
        return joined

    def _root(self, node: int) -> int:
        parent = self._parent
        while parent[node] != node:
            parent[node] = node = parent[parent[node]]
        return node


def _joining(edges: Edges, closures: IntArray, parts: _Parts, number: int) -> IntArray:
    """Return closures that join all parts that can be joined, the most accurate ones first."""
    table = edges.rows(closures)
    order = np.lexsort((table.j, table.i, -np.linalg.det(table.information)))
    order = np.roll(order, -(number * len(order)) // TRIES)
    return closures[order[parts.join(table.rows(order))]]
