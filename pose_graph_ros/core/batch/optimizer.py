# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Batch optimisation of a whole graph in place, from the present poses or from a linear start.

The order of elimination and the cliques are computed once (`symbolic`), the iterations run over
these cliques (`levenberg_marquardt`). Afterwards the tables hold the cliques of the optimised
poses, with which the incremental smoother can continue.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from pose_graph_ros.core.batch import gauss_newton, linear_starts
from pose_graph_ros.core.batch.levenberg_marquardt import (
    BatchResult,
    is_trusted,
    minimize,
    Optimization,
    SAME_MINIMUM,
    Start,
    Status,
    to_the_end,
    TRUSTED_ITERATIONS,
)
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.exceptions import INTERRUPTED, LinearSolveError
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import editing, tables as tb
from pose_graph_ros.core.graph.graph import Graph

# Of tools that run once.
PATIENT = SolverConfig(max_iterations=200)
# Numbers in the cliques of a graph up to which SuperLU looks for a start: it takes several times
# their memory, more than 20 GB for a grid of 10^6 poses.
MOST_VALUES = 100_000_000
# In larger ones what remains of headings far from the fixed node is used as far as it is not
# rounding. That of a grid of 10^6 poses, 4e-8, leads to the minimum.
LEAST_HEADING = 1e-10

__all__ = [
    'PATIENT', 'SAME_MINIMUM', 'TRUSTED_ITERATIONS', 'BatchResult', 'Optimization', 'Start',
    'Status', 'chi2_of', 'in_parts', 'optimize', 'optimize_from_linear_start',
    'optimize_from_two_starts', 'plant', 'to_the_end', 'uproot']


def optimize(graph: Graph, config: SolverConfig,
             starts: Sequence[Start] = (Start.PRESENT,)) -> BatchResult:
    """
    Return the result of moving the hidden nodes to a local minimum of chi2.

    It begins at their poses, or at several starts, which are tried in their order until one
    converges in a few iterations, to a chi2 not above that of the present poses, which should be
    the last of them. The lowest minimum is kept, and the result says from which start it is.
    If the optimisation fails numerically, the result says so, the poses are as before the call,
    and the smoother eliminates everything anew at its next step. All cliques are replaced, so this
    must not be called between `Graph.begin` and `Graph.rollback`.
    """
    return to_the_end(in_parts(graph, config, starts))


def optimize_from_linear_start(graph: Graph, config: SolverConfig) -> BatchResult:
    """Return the result of `optimize` from all starts, of which the present poses are the last."""
    return optimize(graph, config, tuple(Start))


def in_parts(graph: Graph, config: SolverConfig,
             starts: Sequence[Start] = (Start.PRESENT,)) -> Optimization:
    """Return the result of `optimize`, after a pause at each iteration."""
    chi2 = chi2_of(graph)
    if graph.memory.interrupted:
        return _failed(INTERRUPTED, chi2)
    if not np.isfinite(chi2):
        return _failed('chi2 is not finite', chi2)
    if np.all(graph.fixed):
        return BatchResult(Status.CONVERGED, '', 0, chi2)
    cliques = symbolic.analyse(graph.memory.head)
    # the part of the graph that each node is in: a tree of cliques, which follow one another
    roots = np.flatnonzero(cliques.parent[:len(cliques.n_frontal)] < 0)
    part = np.empty(graph.n_nodes, dtype=np.int64)
    part[cliques.nodes] = np.repeat(
        np.arange(len(roots)), np.diff(cliques.first[roots + 1], prepend=0))
    # parts with a fixed or an observed node or an anchored prior
    held = np.zeros(len(roots), dtype=bool)
    held[part[graph.fixed]] = True
    if not np.all(held):    # what is observed takes longer to find
        ends = graph.factor_records['ends']
        held[part[ends[(ends[:, 1] < 0) & (graph.factor_records['weight'] > 0.0), 0]]] = True
    for prior in graph.priors if graph.n_priors > 0 else ():
        held[part[graph.node_rows(prior.nodes[:1])]] |= prior.anchored
    loose = graph.node_ids[~held[part]]
    if len(loose) > 0:
        return _failed(
            f'hidden node {loose[0]} and {len(loose) - 1} others are connected to no fixed '
            f'and no observed node: their poses are not determined', chi2)
    plant(graph, cliques)
    poses = graph.poses.copy()
    if starts == (Start.PRESENT,):
        result = yield from _minimize(graph, config, config.max_iterations)
    else:
        result = yield from _from_starts(graph, config, starts, chi2)
    if result.status is Status.FAILED:
        gauss_newton.put_poses(graph.memory.head, poses)
        editing.restart(graph.memory.head)
        return _failed(result.reason, chi2)
    return result


def _from_starts(graph: Graph, config: SolverConfig, starts: Sequence[Start],
                 chi2: float) -> Optimization:
    """Optimise from several starts, given chi2 of the present poses."""
    few = min(config.max_iterations, TRUSTED_ITERATIONS)
    poses = best_poses = graph.poses.copy()
    best = result = _failed('', chi2)
    yield
    for start in starts:
        gauss_newton.put_poses(graph.memory.head, poses)
        try:
            gauss_newton.put_poses(graph.memory.head, _start(graph, start))
        except LinearSolveError:
            continue
        yield
        result = replace((yield from _minimize(graph, config, few)), start=start)
        if result.is_better_than(best):
            best, best_poses = result, graph.poses.copy()
        if is_trusted(result, chi2):
            break
    if best.status is Status.FAILED or (
            best is result and best.status is not Status.MAX_ITERATIONS):
        return result
    gauss_newton.put_poses(graph.memory.head, best_poses)
    result = yield from _minimize(graph, config, max(config.max_iterations - best.iterations, 1))
    return replace(result, start=best.start, iterations=best.iterations + result.iterations)


def optimize_from_two_starts(graph: Graph, config: SolverConfig) -> BatchResult:
    """
    Return the better result of optimising a graph from the present poses and a linear start.

    After a long time without a position the heading may have drifted far. Gauss-Newton can then
    converge to a minimum with the heading wrapped the wrong way round, which takes many
    iterations. The lower of the two minima is kept.
    Without observed nodes, only the present poses are a start. All cliques are eliminated anew at
    the result.
    """
    result = optimize(graph, config)
    poses = graph.poses.copy()
    try:
        graph.set_poses(_start(graph, Start.JOINT))
        other = optimize(graph, config)
    except LinearSolveError:
        other = result
    if other.is_better_than(result):
        result, poses = other, graph.poses.copy()
    graph.set_poses(poses)
    return result


def _start(graph: Graph, start: Start) -> FloatArray:
    """Return the poses of a start, or raise LinearSolveError if there are none."""
    graph.memory.check()
    large = graph.memory.head[tb.POOL_F_END] > MOST_VALUES
    if start is Start.CHORDAL:
        return linear_starts.chordal(graph, partial(gauss_newton.solve_chordal, graph.memory),
                                     *([LEAST_HEADING] if large else []))
    if start is Start.PRESENT:
        return graph.poses.copy()
    if large or (start is Start.JOINT and not np.any(graph.factors.j < 0) and not any(
            prior.anchored for prior in graph.priors)):
        raise LinearSolveError('joint start: the graph is too large, or no node is observed')
    return linear_starts.joint(graph, unit=start is Start.UNIT)


def plant(graph: Graph, cliques: symbolic.Cliques) -> None:
    """Store the cliques of a whole graph, without values, in place of its present ones."""
    memory = graph.memory
    keep_f, keep_i = (
        memory.head[tb.POOL_F_END:tb.POOL_I_END + 1] if memory.head[tb.N_PRIORS] > 0 else (0, 0))
    memory.ensure('pool_f', max(cliques.need_f, int(keep_f)), keep=int(keep_f))
    memory.ensure('pool_i', max(cliques.need_i, int(keep_i)), keep=int(keep_i))
    memory.ensure('work_f', cliques.largest)
    symbolic.plant_all(memory.head, cliques)


def uproot(graph: Graph) -> None:
    """Let go of the cliques and their values, half of all memory; the poses stay."""
    if graph.n_priors == 0:     # whose values are among them
        editing.restart(graph.memory.head)
        graph.memory.empty('pool_f')


def chi2_of(graph: Graph) -> float:
    """Return the energy of all constraints, in time proportional to the size of the graph."""
    return float(gauss_newton.evaluate(graph.memory.head, np.empty((graph.n_nodes, 3)))[0])


def _minimize(graph: Graph, config: SolverConfig, most: int) -> Optimization:
    """Optimise from the present poses; the poses after a failure have no meaning."""
    system = gauss_newton.CompiledSystem(graph.memory)
    result = yield from minimize(system, config.step_tolerance, most)
    if result.status is Status.FAILED:
        node = graph.node_ids[graph.memory.head[tb.BAD_NODE]]
        return _failed(INTERRUPTED if graph.memory.interrupted else
                       f'hidden node {node} is not determined', result.chi2)
    editing.settle(graph.memory.head)
    return result


def _failed(reason: str, chi2: float) -> BatchResult:
    return BatchResult(Status.FAILED, reason, 0, chi2)
