# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures of a graph from a file to believe; part of the tool `pose-graph solve`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import sys

import numpy as np

from pose_graph_ros.cli.arguments import METHODS
from pose_graph_ros.cli.solve_starts import Problem
from pose_graph_ros.core.batch import gnc
from pose_graph_ros.core.batch.optimizer import (
    optimize,
    optimize_from_linear_start,
    SAME_MINIMUM,
    Status,
)
from pose_graph_ros.core.batch.truncated import Choice, CONFIG, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.error_functions import energies as energies_of
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement import selection
from pose_graph_ros.core.judgement.floors import floored, FLOORS, forward
from pose_graph_ros.core.judgement.residual_scale import give_scale
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.solver_config import SolverConfig

# Ways to decide: the lowest truncated cost of several sets, or graduated non-convexity alone.
SURROGATES = {'gnc': gnc.Surrogate.TRUNCATED, 'gnc-gm': gnc.Surrogate.GEMAN_MCCLURE}
# Number of sets of closures that are tried to join parts that no odometry joins.
TRIES = 5
N_LARGEST = 5  # number of edges that are named


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
    cost: float
    """Truncated cost of the poses, with the sigmas of the file times `scale`."""
    cost_of_all: float | None
    """The same at the minimum of chi2 with all closures, if it was computed."""


def believe(
    graph: Graph, sigmas: FloatArray, method: str = METHODS[0], *, given: bool = False,
) -> BelievedEdges | None:
    """
    Return which edges of a graph to believe, and poses at which they agree; None if it fails.

    Edges between neighbouring poses are odometry, which is believed. Where odometry does not join
    all poses, some closures are taken as known that do; several such sets are tried. The truncated
    cost is never above that of the minimum with all closures, or of the given poses.

    Parameters
    ----------
    graph : Graph, it is not changed
    sigmas : ndarray, shape (3,), least sigmas of closures for the decision [m, m, rad]
    method : str, one of `METHODS`
    given : bool, whether the poses of the graph mean anything

    """
    edges = forward(graph.edges)
    place = np.cumsum(graph.is_pose)
    is_motion = edges.kind <= EdgeKind.LOOP_CLOSURE
    is_closure = is_motion & (np.abs(place[edges.j] - place[edges.i]) != 1)
    kind = np.where(is_closure, EdgeKind.LOOP_CLOSURE, np.where(
        is_motion, EdgeKind.ODOMETRY, edges.kind)).astype(np.uint8)
    edges = replace(edges, kind=kind)
    softened = replace(edges, information=np.where(
        is_closure[:, None, None], floored(edges, sigmas).information, edges.information))
    closures = np.flatnonzero(is_closure & (edges.weight > 0.0) & (edges.i != edges.j))
    parts = _Parts(graph.n_nodes)
    parts.join(edges.rows(is_motion & ~is_closure))
    parts.count -= int(np.sum(~graph.is_pose))
    n_parts, best, rows, lowered = parts.count, None, closures, 1.0
    for k in range(TRIES if n_parts > 1 else 1):
        known = _joining(edges, closures, parts.copy(), k)
        problem = _from_odometry(graph, softened, closures[~np.isin(closures, known)])
        choice = None if problem is None else _choice(problem, method)
        if problem is not None and choice is not None and (
                best is None or choice.cost < best.cost):
            best, rows, lowered = choice, problem.rows, problem.lowered()
    plain = _minimum_of_all(graph, edges, closures)
    starts = [poses for poses in (plain, graph.poses.copy() if given else None)
              if poses is not None]
    for start in starts:
        problem = TruncatedProblem(_filled(graph, softened), closures, start)
        problem.limits *= lowered
        choice = problem.near_start()
        if choice is not None and (best is None or choice.cost < best.cost):
            best, rows = choice, closures
    if best is None:
        return None
    believed = ~np.isin(closures, rows[~best.believed])
    copy = _filled(graph, edges)
    copy.apply(GraphUpdate(remove_edges=closures[~believed].tolist()))
    copy.set_poses(best.poses)
    scale = give_scale(copy, closures[believed])
    optimize(copy, CONFIG)
    result = BelievedEdges(closures, believed, n_parts, copy.poses.copy(), scale, np.inf, None)
    # who asks for more than the usual sigmas wants to believe what costs more by those of the file
    return _not_worse(
        result, graph, edges, starts if np.all(sigmas <= FLOORS) else [], plain)


def _not_worse(
    result: BelievedEdges, graph: Graph, edges: Edges, starts: list[FloatArray],
    plain: FloatArray | None,
) -> BelievedEdges:
    """Return the result, or what is better by the sigmas that it has found, near other poses."""
    closures, information = result.closures, edges.information.copy()
    information[closures] *= result.scale**-2.0
    scaled = replace(edges, information=information)
    problem = TruncatedProblem(_filled(graph, scaled), closures, result.poses)
    result = replace(result, cost=problem.cost_at(result.poses), cost_of_all=(
        None if plain is None else problem.cost_at(plain)))
    for start in starts:
        if problem.cost_at(start) < result.cost * (1.0 - SAME_MINIMUM):
            problem = TruncatedProblem(_filled(graph, scaled), closures, start)
            choice = problem.near_start()
            if choice is not None and choice.cost < result.cost:
                result = replace(result, believed=choice.believed, poses=choice.poses,
                                 cost=choice.cost)
    return result


def _filled(graph: Graph, edges: Edges) -> Graph:
    copy = Graph()
    copy.fill(graph.rows()._replace(edges=edges))
    return copy


def _minimum_of_all(graph: Graph, edges: Edges, closures: IntArray) -> FloatArray | None:
    """
    Return the poses of a minimum of chi2 with all closures from a linear start, shape (N, 3).

    None if there is none, or if so many edges between random nodes make the factorisation nearly
    dense, which right ones never do.
    """
    copy = _filled(graph, edges)
    problem = TruncatedProblem(copy, closures, graph.poses.copy())
    if (problem.factorisation(np.ones(len(closures))) > selection.MOST_NUMBERS * graph.n_nodes
            or optimize_from_linear_start(copy, CONFIG).status is Status.FAILED):
        return None
    return copy.poses.copy()


def _from_odometry(graph: Graph, edges: Edges, closures: IntArray) -> TruncatedProblem | None:
    """Return the problem with the start that all other constraints give."""
    copy = _filled(graph, edges)
    copy.apply(GraphUpdate(remove_edges=closures.tolist()))
    if optimize_from_linear_start(copy, SolverConfig()).status is Status.FAILED:
        return None
    return TruncatedProblem(copy, closures, start=copy.poses.copy())


def _choice(problem: TruncatedProblem, method: str) -> Choice | None:
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


@dataclass(frozen=True, slots=True)
class Doubt:
    """What was decided, and lines about it for people."""

    method: str
    doubted: IntArray
    """Rows of the edges that are left out."""
    n_closures: int
    scale: float
    """Factor on the sigmas of the closures that are believed."""
    cost: float | None
    """Truncated cost; None if there was no decision."""
    cost_of_all: float | None
    """The same with all closures, if it was computed."""
    lines: tuple[str, ...]


def doubt(problem: Problem, method: str, sigma: Sequence[float]) -> Doubt:
    """
    Return which closures are not believed, after giving them the weight 0.

    Parameters
    ----------
    problem : Problem
    method : str, one of `believe.METHODS`
    sigma : sequence of float, least sigmas of closures for the decision [m, rad]

    """
    graph, ids = problem.engine, problem.ids
    beliefs = believe(graph, np.array([sigma[0], sigma[0], sigma[1]]), method,
                      given=problem.has_start)
    if beliefs is None:
        print('warning: there is no set of loop closures with a solution; all are believed',
              file=sys.stderr)
        return Doubt(method, np.empty(0, np.int64), 0, 1.0, None, None, ())
    lines = []
    if beliefs.n_parts > 1:
        lines.append(f'odometry, edges between neighbouring poses, leaves '
                     f'{beliefs.n_parts} parts; loop closures that join them are believed')
    doubted = beliefs.closures[~beliefs.believed]
    lines.append(f'{len(beliefs.closures)} loop closures: {int(np.sum(beliefs.believed))} '
                 f'believed, {len(doubted)} doubted')
    lines.append(f'truncated cost {beliefs.cost:.6g}' + (
        '' if beliefs.cost_of_all is None else
        f'; {beliefs.cost_of_all:.6g} at the minimum of chi2 with all of them'))
    graph.set_poses(beliefs.poses)
    graph.apply(GraphUpdate(remove_edges=doubted.tolist()))
    if beliefs.scale > 1.0:
        lines.append('by their residuals, sigmas of loop closures are '
                     f'{short(beliefs.scale)} times those of the file, and count so')
        graph.apply(GraphUpdate(weigh_edges=dict.fromkeys(
            beliefs.closures[beliefs.believed].tolist(), beliefs.scale**-2.0)))
    edges = graph.edges_at(doubted)
    errors = graph.edge_errors(edges)
    squares = energies_of(errors, edges.information)
    for k in np.argsort(-squares, kind='stable')[:N_LARGEST]:
        x, y, theta = errors[k]
        lines.append(f'  doubted edge {ids[edges.i[k]]} -> {ids[edges.j[k]]}: '
                     f'{short(np.hypot(x, y), 3)} m and {short(abs(theta), 3)} rad off, '
                     f'{short(np.sqrt(squares[k]), 3)} sigma')
    if len(doubted) > N_LARGEST:
        lines.append(f'  and {len(doubted) - N_LARGEST} more; a file written with --out has them '
                     f'all as comments')
    return Doubt(method, doubted, len(beliefs.closures), beliefs.scale, beliefs.cost,
                 beliefs.cost_of_all, tuple(lines))
