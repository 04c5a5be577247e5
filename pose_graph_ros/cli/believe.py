# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which loop closures of a graph from a file to believe, and the factor on their sigmas.

This is a part of the tool `pose-graph solve`. The factor is what residuals of those that are
believed show. That of one in the graph has the covariance `s^2 R - C`, with R the claimed one, s
the factor and `C = J P J^T` its part that the estimate has followed. So `e^T R^-1 e / s^2` is
expected to be its redundancy, `r = 3 - tr(R^-1 C) / s^2`, and s^2 is the sum of all squares over
that of the redundancies, the estimate of a variance component by restricted maximum likelihood
(K.-R. Koch, "Parameter estimation and hypothesis testing in linear models", 1999, section 3.6). A
square counts up to where 99 % of them are, so that one wrong closure does not decide.

Closures of one place often share an error, as the same view is recognised again. So they are one
constraint: their mean, weighted by information, with the sum of the informations. If errors are
independent, it shows the same s, and else a larger one, with which the group counts as what it is.
Its C is taken to be the mean of those of its closures, a little too large.
"""

from collections.abc import Callable, Sequence
from functools import partial
import math
import sys
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.special import gammainc, gammaincc

from pose_graph_ros.cli import arguments, solve
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import optimize, SAME_MINIMUM, Status, to_the_end
from pose_graph_ros.core.batch.truncated import Choosing, CONFIG, Surrogate, TruncatedProblem
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.factors import energies as energies_of
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.closure_search import best
from pose_graph_ros.core.judgement.closures import floored, FLOORS, forward, GATE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.smoother.covariances import innovations

ROUNDS = 6  # of solving and learning
LEAST_SHOWN = 10  # closures, or sum of their redundancies, that show anything
PRIOR_CLOSURES = 10.0  # that a factor of 1 is believed as much as
PLACE_LENGTH = 2.0  # closures with both ends in one such stretch are of one place [m]
LARGEST_SCALE = 10.0
# What is left of the mean of chi2 with three degrees of freedom that counts up to `GATE`.
LEFT = float(gammainc(2.5, GATE / 2.0) + GATE / 3.0 * gammaincc(1.5, GATE / 2.0))
TRIES = 5  # sets of closures that are tried to join parts that no odometry joins


class BelievedEdges(NamedTuple):
    """Which edges of a graph are believed."""

    closures: IntArray  # rows of all edges that may be doubted, (M,)
    believed: BoolArray  # (M,)
    n_parts: int  # that odometry does not join
    poses: Poses  # of all nodes
    scale: float  # on the sigmas of closures that those believed show, at least 1
    cost: float  # truncated one of the poses, with the sigmas of the file times `scale`
    cost_of_all: float | None  # likewise at the minimum of chi2 with all closures, if computed


def believe(graph: Graph, sigmas: FloatArray, method: str = arguments.METHODS[0], *,
            given: bool = False) -> BelievedEdges | None:
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
    edges = edges.replaced(kind=np.where(is_closure, FactorKind.LOOP_CLOSURE, np.where(
        is_motion, FactorKind.ODOMETRY, edges.kind)).astype(np.uint8))
    softened = edges.replaced(information=np.where(
        is_closure[:, None, None], floored(edges, sigmas).information, edges.information))
    closures = np.flatnonzero(is_closure & (edges.weight > 0.0) & (edges.i != edges.j))
    odometry = edges.rows(is_motion & ~is_closure)
    n_parts, part = connected_components(coo_array(
        (np.ones(len(odometry)), (odometry.i, odometry.j)), (graph.n_nodes, graph.n_nodes)))
    n_parts -= int(np.sum(~graph.is_pose))
    best, rows = None, closures
    for k in range(TRIES if n_parts > 1 else 1):
        unsure = closures[~np.isin(closures, _joining(edges, closures, part.astype(np.int64), k))]
        # the start that all other constraints give
        copy = _filled(graph, softened)
        copy.apply(GraphUpdate(remove=unsure.tolist()))
        if optimizer.optimize_from_linear_start(copy, SolverConfig()).status is Status.FAILED:
            continue
        problem = TruncatedProblem(copy, unsure, start=copy.poses.copy())
        choice = to_the_end(SELECTIONS[method](problem))
        if choice is not None and (best is None or choice.cost < best.cost):
            best, rows = choice, problem.ids
    plain, copy = None, _filled(graph, edges)
    problem = TruncatedProblem(copy, closures, graph.poses.copy())
    # so many edges between random nodes that it is nearly dense are never right
    if (problem.factorisation(np.ones(len(closures))) <= BELIEF.most_numbers * graph.n_nodes
            and optimizer.optimize_from_linear_start(copy, CONFIG).status is not Status.FAILED):
        plain = copy.poses.copy()
    starts = ([] if plain is None else [plain]) + ([graph.poses.copy()] if given else [])
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
    return _not_worse(result, graph, edges, starts if np.all(sigmas <= FLOORS) else [], plain)


def _not_worse(result: BelievedEdges, graph: Graph, edges: Factors, starts: list[FloatArray],
               plain: FloatArray | None) -> BelievedEdges:
    """Return the result, or what is better by the sigmas that it has found, near other poses."""
    closures, information = result.closures, edges.information.copy()
    information[closures] *= result.scale**-2.0
    scaled = edges.replaced(information=information)
    problem = TruncatedProblem(_filled(graph, scaled), closures, result.poses)
    result = result._replace(cost=problem.cost_at(result.poses), cost_of_all=(
        None if plain is None else problem.cost_at(plain)))
    for start in starts:
        if problem.cost_at(start) < result.cost * (1.0 - SAME_MINIMUM):
            problem = TruncatedProblem(_filled(graph, scaled), closures, start)
            choice = to_the_end(problem.near_start())
            if choice is not None and choice.cost < result.cost:
                result = result._replace(believed=choice.believed, poses=choice.poses,
                                         cost=choice.cost)
    return result


def _filled(graph: Graph, edges: Factors) -> Graph:
    copy = Graph()
    copy.fill(graph.rows()._replace(factors=edges))
    return copy


SELECTIONS: dict[str, Callable[[TruncatedProblem], Choosing]] = {
    'selection': best, 'gnc': partial(TruncatedProblem.graduated, surrogate=Surrogate.TRUNCATED),
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
    apart, size = pairs[:, 0] != pairs[:, 1], len(part)
    tree = minimum_spanning_tree(coo_array(
        (first[apart] + 1.0, tuple(pairs[apart].T)), (size, size)).tocsr())
    return closures[order[np.sort(tree.data).astype(np.int64) - 1]]


def doubt(problem: solve.Problem, method: str,
          sigma: Sequence[float]) -> tuple[IntArray, dict[str, Any], list[str]]:
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
    doubted = beliefs.closures[~beliefs.believed]
    lines = [f'odometry, edges between neighbouring poses, leaves {beliefs.n_parts} parts; loop '
             'closures that join them are believed'] if beliefs.n_parts > 1 else []
    lines += [f'{len(beliefs.closures)} loop closures: {int(np.sum(beliefs.believed))} '
              f'believed, {len(doubted)} doubted', f'truncated cost {beliefs.cost:.6g}' + (
                  '' if beliefs.cost_of_all is None else
                  f'; {beliefs.cost_of_all:.6g} at the minimum of chi2 with all of them')]
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


# --- the factor on the sigmas of closures

def give_scale(graph: Graph, closures: IntArray) -> float:
    """
    Return the factor on the sigmas of closures, with which the graph is optimised in place.

    All of them are believed; their weights are set to 1 / factor^2. Where odometry does not join
    all nodes, nobody knows which closures are neighbours, and the factor is 1.
    """
    chain, scale = OdometryChain(), 1.0
    chain.extend(graph)
    if len(chain) < graph.n_nodes or len(closures) == 0:
        return scale
    edges = graph.factors_at(closures)
    stretch = np.floor(np.column_stack(
        [chain.travel(nodes) for nodes in (edges.j, edges.i)]) / PLACE_LENGTH)
    group = np.unique(stretch, axis=0, return_inverse=True)[1].ravel()  # those of one place
    for _ in range(ROUNDS):
        if optimize(graph, CONFIG).status is Status.FAILED:
            break
        errors, covariances = innovations(graph.memory.head, edges)
        shown = residual_scale(errors, covariances, edges.information, group, scale)
        if shown <= scale:
            break
        scale = shown
        graph.apply(GraphUpdate(weigh=dict.fromkeys(closures.tolist(), scale**-2.0)))
    return scale


def residual_scale(errors: FloatArray, covariances: FloatArray, information: FloatArray,
                   group: IntArray, scale: float) -> float:
    """
    Return the factor on the sigmas of a source, at least 1, given the present one.

    Errors are the residuals of believed closures, shape (M, 3), covariances their C with the
    closures in the graph, information what is claimed; `group` numbers closures of one place from
    0.
    """
    size = np.bincount(group)
    total, common = np.zeros((len(size), 3, 3)), np.zeros((len(size), 3, 3))
    weighted = np.zeros((len(size), 3))
    np.add.at(total, group, information)
    np.add.at(common, group, covariances)
    np.add.at(weighted, group, np.einsum('mij,mj->mi', information, errors))
    # what no closure of a group measures stays at 0
    largest = np.max(np.abs(total), axis=(1, 2))[:, None, None]
    mean = np.linalg.solve(total + 1e-12 * largest * np.eye(3), weighted[:, :, None])[:, :, 0]
    common /= size[:, None, None]
    trace = np.einsum('mij,mji->m', total, common)
    rank = np.count_nonzero(np.einsum('mii->mi', total) > 0.0, axis=1)
    redundancy = np.maximum(rank - trace / scale**2, 0.0) / 3.0
    if (n := float(np.sum(redundancy))) < LEAST_SHOWN:
        return scale
    squares = np.einsum('mi,mij,mj->m', mean, total, mean)
    shown = math.sqrt(float(np.sum(squares)) / (3.0 * n))
    for _ in range(50):
        # from above, as the sum of what counts shrinks with its limits
        counted = np.minimum(squares, GATE * shown**2 * redundancy)
        shown, before = math.sqrt(float(np.sum(counted)) / (3.0 * LEFT * n)), shown
        if shown > 0.99 * before:
            break
    # if n closures show it
    return min(max(math.exp(
        math.log(max(shown, 1e-3)) * n / (n + PRIOR_CLOSURES)), 1.0), LARGEST_SCALE)
