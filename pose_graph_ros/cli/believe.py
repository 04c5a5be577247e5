# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures of a graph from a file to believe; part of the tool `pose-graph solve`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
import sys
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from pose_graph_ros.cli.arguments import METHODS
from pose_graph_ros.cli.closure_scale import give_scale
from pose_graph_ros.cli.solve_starts import Problem
from pose_graph_ros.core.batch.optimizer import (
    optimize,
    optimize_from_linear_start,
    SAME_MINIMUM,
    Status,
    to_the_end,
)
from pose_graph_ros.core.batch.truncated import Choosing, CONFIG, Surrogate, TruncatedProblem
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.error_functions import energies as energies_of
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.closure_search import best
from pose_graph_ros.core.judgement.closures import floored, FLOORS, forward
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import short

TRIES = 5  # sets of closures that are tried to join parts that no odometry joins


@dataclass(frozen=True, slots=True)
class BelievedEdges:
    """Which edges of a graph are believed."""

    closures: IntArray  # rows of all edges that may be doubted, (M,)
    believed: BoolArray  # (M,)
    n_parts: int  # that odometry does not join
    poses: Poses  # of all nodes
    scale: float  # on the sigmas of closures that those believed show, at least 1
    cost: float  # truncated one of the poses, with the sigmas of the file times `scale`
    cost_of_all: float | None  # likewise at the minimum of chi2 with all closures, if computed


def believe(
    graph: Graph, sigmas: FloatArray, method: str = METHODS[0], *, given: bool = False,
) -> BelievedEdges | None:
    """
    Return which edges of a graph to believe, and poses at which they agree; None if it fails.

    Edges between neighbouring poses are odometry, which is believed. Where odometry does not join
    all poses, some closures are taken as known that do; several such sets are tried. The truncated
    cost is never above that of the minimum with all closures, or of the given poses.
    """
    edges = forward(graph.factors)
    place = np.cumsum(graph.is_pose)
    is_motion = edges.kind <= FactorKind.LOOP_CLOSURE
    is_closure = is_motion & (np.abs(place[edges.j] - place[edges.i]) != 1)
    kind = np.where(is_closure, FactorKind.LOOP_CLOSURE, np.where(
        is_motion, FactorKind.ODOMETRY, edges.kind)).astype(np.uint8)
    edges = edges.replaced(kind=kind)
    softened = edges.replaced(information=np.where(
        is_closure[:, None, None], floored(edges, sigmas).information, edges.information))
    closures = np.flatnonzero(is_closure & (edges.weight > 0.0) & (edges.i != edges.j))
    odometry = edges.rows(is_motion & ~is_closure)
    n_parts, part = connected_components(coo_array(
        (np.ones(len(odometry)), (odometry.i, odometry.j)), (graph.n_nodes, graph.n_nodes)))
    n_parts -= int(np.sum(~graph.is_pose))
    best, rows = None, closures
    for k in range(TRIES if n_parts > 1 else 1):
        known = _joining(edges, closures, part.astype(np.int64), k)
        problem = _from_odometry(graph, softened, closures[~np.isin(closures, known)])
        choice = None if problem is None else to_the_end(
            SELECTIONS[method](problem))
        if problem is not None and choice is not None and (
                best is None or choice.cost < best.cost):
            best, rows = choice, problem.ids
    plain = _minimum_of_all(graph, edges, closures)
    starts = [poses for poses in (plain, graph.poses.copy() if given else None)
              if poses is not None]
    for start in starts:
        problem = TruncatedProblem(_filled(graph, softened), closures, start)
        choice = to_the_end(problem.near_start())
        if choice is not None and (best is None or choice.cost < best.cost):
            best, rows = choice, closures
    if best is None:
        return None
    believed = ~np.isin(closures, rows[~best.believed])
    copy = _filled(graph, edges)
    copy.apply(GraphUpdate(remove=closures[~believed].tolist()))
    copy.set_poses(best.poses)
    scale = give_scale(copy, closures[believed])
    optimize(copy, CONFIG)
    result = BelievedEdges(closures, believed, n_parts, copy.poses.copy(), scale, np.inf, None)
    # who asks for more than the usual sigmas wants to believe what costs more by those of the file
    return _not_worse(
        result, graph, edges, starts if np.all(sigmas <= FLOORS) else [], plain)


def _not_worse(
    result: BelievedEdges, graph: Graph, edges: Factors, starts: list[FloatArray],
    plain: FloatArray | None,
) -> BelievedEdges:
    """Return the result, or what is better by the sigmas that it has found, near other poses."""
    closures, information = result.closures, edges.information.copy()
    information[closures] *= result.scale**-2.0
    scaled = edges.replaced(information=information)
    problem = TruncatedProblem(_filled(graph, scaled), closures, result.poses)
    result = replace(result, cost=problem.cost_at(result.poses), cost_of_all=(
        None if plain is None else problem.cost_at(plain)))
    for start in starts:
        if problem.cost_at(start) < result.cost * (1.0 - SAME_MINIMUM):
            problem = TruncatedProblem(_filled(graph, scaled), closures, start)
            choice = to_the_end(problem.near_start())
            if choice is not None and choice.cost < result.cost:
                result = replace(result, believed=choice.believed, poses=choice.poses,
                                 cost=choice.cost)
    return result


def _filled(graph: Graph, edges: Factors) -> Graph:
    copy = Graph()
    copy.fill(graph.rows()._replace(factors=edges))
    return copy


def _minimum_of_all(graph: Graph, edges: Factors, closures: IntArray) -> FloatArray | None:
    """
    Return the poses of a minimum of chi2 with all closures from a linear start, shape (N, 3).

    None if there is none, or if so many edges between random nodes make the factorisation nearly
    dense, which right ones never do.
    """
    copy = _filled(graph, edges)
    problem = TruncatedProblem(copy, closures, graph.poses.copy())
    if (problem.factorisation(np.ones(len(closures))) > BELIEF.most_numbers * graph.n_nodes
            or optimize_from_linear_start(copy, CONFIG).status is Status.FAILED):
        return None
    return copy.poses.copy()


def _from_odometry(graph: Graph, edges: Factors, closures: IntArray) -> TruncatedProblem | None:
    """Return the problem with the start that all other constraints give."""
    copy = _filled(graph, edges)
    copy.apply(GraphUpdate(remove=closures.tolist()))
    if optimize_from_linear_start(copy, SolverConfig()).status is Status.FAILED:
        return None
    return TruncatedProblem(copy, closures, start=copy.poses.copy())


SELECTIONS: dict[str, Callable[[TruncatedProblem], Choosing]] = {
    'selection': best,
    'gnc': partial(TruncatedProblem.graduated, surrogate=Surrogate.TRUNCATED),
    'gnc-gm': partial(TruncatedProblem.graduated, surrogate=Surrogate.GEMAN_MCCLURE)}
"""The lowest truncated cost of several sets, or graduated non-convexity alone."""


def _joining(edges: Factors, closures: IntArray, part: IntArray, number: int) -> IntArray:
    """Return closures that join all parts that can be joined, the most accurate ones first."""
    table = edges.rows(closures)
    order = np.lexsort((table.j, table.i, -np.linalg.det(table.information)))
    order = np.roll(order, -(number * len(order)) // TRIES)
    ends = np.sort(np.column_stack((part[table.i], part[table.j]))[order], axis=1)
    # of several between the same parts the first
    pairs, first = np.unique(ends, axis=0, return_index=True)
    apart = pairs[:, 0] != pairs[:, 1]
    size = len(part)
    tree = minimum_spanning_tree(coo_array(
        (first[apart] + 1.0, tuple(pairs[apart].T)), (size, size)).tocsr())
    return closures[order[np.sort(tree.data).astype(np.int64) - 1]]


def doubt(
    problem: Problem, method: str, sigma: Sequence[float],
) -> tuple[IntArray, dict[str, Any], list[str]]:
    """
    Return rows of closures that are not believed, after giving them the weight 0.

    With them come what JSON says of the decision, and lines for people. `sigma` has the least
    sigmas of closures for the decision [m, rad]. Without a decision its truncated cost is None.
    """
    graph, ids = problem.engine, problem.ids
    beliefs = believe(graph, np.array([sigma[0], sigma[0], sigma[1]]), method,
                      given=problem.has_start)
    decision = {'method': method, 'closures': 0, 'doubted': 0, 'scale': 1.0,
                'truncated_cost': None, 'truncated_cost_of_all': None}
    if beliefs is None:
        print('warning: there is no set of loop closures with a solution; all are believed',
              file=sys.stderr)
        return np.empty(0, np.int64), decision, []
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
    graph.apply(GraphUpdate(remove=doubted.tolist()))
    if beliefs.scale > 1.0:
        lines.append('by their residuals, sigmas of loop closures are '
                     f'{short(beliefs.scale)} times those of the file, and count so')
        graph.apply(GraphUpdate(weigh=dict.fromkeys(
            beliefs.closures[beliefs.believed].tolist(), beliefs.scale**-2.0)))
    edges = graph.factors_at(doubted)
    errors = graph.errors(edges)
    squares = energies_of(errors, edges.information)
    for k in np.argsort(-squares, kind='stable')[:5]:
        x, y, theta = errors[k]
        lines.append(f'  doubted edge {ids[edges.i[k]]} -> {ids[edges.j[k]]}: '
                     f'{short(np.hypot(x, y), 3)} m and {short(abs(theta), 3)} rad off, '
                     f'{short(np.sqrt(squares[k]), 3)} sigma')
    if len(doubted) > 5:
        lines.append(f'  and {len(doubted) - 5} more; a file written with --out has them all as '
                     'comments')
    return doubted, decision | {
        'closures': len(beliefs.closures), 'doubted': len(doubted), 'scale': beliefs.scale,
        'truncated_cost': beliefs.cost, 'truncated_cost_of_all': beliefs.cost_of_all}, lines
