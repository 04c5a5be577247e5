# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Optimisation of a graph from a file from one or several starts; part of `pose-graph solve`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
import re
from typing import TYPE_CHECKING

import numpy as np

from pose_graph_ros.cli.arguments import STARTS
from pose_graph_ros.core.batch.outcome import BatchResult, Start, Status
from pose_graph_ros.core.batch.plain_graph import PlainGraph
from pose_graph_ros.core.batch.plain_optimizer import PlainOptimizer
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import ObservedNodes
from pose_graph_ros.core.graph.graph_update import GraphUpdate
from pose_graph_ros.core.graph.kinds import ObservedKind
from pose_graph_ros.core.io.g2o import compose_missing, GraphFile
from pose_graph_ros.core.solver_config import SolverConfig

if TYPE_CHECKING:
    from pose_graph_ros.core.graph.graph import Graph

WEAK = 1e-7  # information of a weak prior, as a fraction of that of the median constraint
CONFIG = SolverConfig(max_iterations=200)
# Nodes up to which a graph is solved without compiled kernels, if possible.
MOST_PLAIN_NODES = 20_000


@dataclass(frozen=True, slots=True)
class Solution:
    """A graph at the lowest minimum that was found."""

    result: BatchResult
    start: str
    """Poses from which it was reached."""
    determined: bool
    """Whether the constraints determine all poses."""
    tried: tuple[tuple[str, BatchResult], ...] = ()
    """All starts with their results, if there were several."""
    optimizer: PlainOptimizer | None = None
    """What found it, if no compiled kernels were used."""


class Problem:
    """
    A graph from a file that is to be optimised.

    Parameters
    ----------
    file : GraphFile
    plain : bool
        Whether to do without compiled kernels if the graph is simple and not large. Loading them
        takes longer than to solve such a graph.

    """

    def __init__(self, file: GraphFile, *, plain: bool) -> None:
        self.ids, self.has_start, self._file = file.ids, file.has_start, file
        self._held: list[int] = []
        self.plain: PlainGraph | None = None
        """The graph, if no kernels are used."""
        rows = file.rows
        if (plain and len(rows.poses) <= MOST_PLAIN_NODES and not np.all(rows.fixed)
                and PlainGraph.is_covered(rows)):
            self.plain = PlainGraph(rows)

    @property
    def graph(self) -> 'Graph | PlainGraph':
        """The graph, with the best poses that were found."""
        return self._file.graph if self.plain is None else self.plain

    @property
    def engine(self) -> 'Graph':
        """The graph for the compiled kernels, at its present poses; it is used from now on."""
        graph = self._file.graph
        if self.plain is not None:
            graph.apply(GraphUpdate(fix=self._held))
            graph.set_poses(self.plain.poses)
            self.plain = None
        return graph

    def hold_parts(self) -> list[int]:
        """Fix the first node of each part that has no fixed and no observed one; return these."""
        if self.plain is not None:
            self._held = self.plain.hold_parts()
            return self._held
        from pose_graph_ros.core.elimination import symbolic  # noqa: PLC0415

        graph, held = self.engine, []
        while (node := symbolic.loose_part(graph.memory.head)[0]) >= 0:
            graph.apply(GraphUpdate(fix=[int(node)]))
            held.append(int(node))
        return held


def solve(problem: Problem, start: str) -> Solution:
    """
    Return the result of optimising a graph in place.

    Parameters
    ----------
    start : str, one of `STARTS`, or 'present' for the poses of the graph

    """
    if start != 'best':
        return _solve_from(problem, start, problem.graph.poses.copy())
    present = problem.graph.poses.copy()
    # poses that were composed from edges are those of odometry
    names = [name for name in STARTS if name != 'best' and (name != 'file' or problem.has_start)]
    found: list[tuple[Solution, FloatArray]] = []
    for name in names:
        solution = _solve_from(problem, name, present)
        found.append((solution, problem.graph.poses.copy()))
    best, poses = min(found, key=lambda each: (
        each[0].result.status is Status.FAILED, each[0].result.chi2))
    if best is not found[-1][0]:
        best = resumed(problem, best, poses)
    return replace(best, tried=tuple((each.start, each.result) for each, _ in found))


def resumed(problem: Problem, solution: Solution, poses: FloatArray) -> Solution:
    """
    Return a solution after optimising from its poses again, so that the graph is factorised there.

    Parameters
    ----------
    poses : ndarray, shape (N, 3), at the minimum [m, m, rad]

    """
    again = _solve_from(problem, 'present', poses)
    if again.result.status is not Status.CONVERGED:
        return replace(again, start=solution.start)
    return replace(solution, result=replace(solution.result, chi2=again.result.chi2))


def _solve_from(problem: Problem, start: str, poses: FloatArray) -> Solution:
    if problem.plain is not None and start in {'chordal', 'present'}:
        problem.plain.set_poses(poses)
        plain = PlainOptimizer(problem.plain, CONFIG)
        found = plain.from_chordal_start() if start == 'chordal' else plain.from_present_poses()
        if found is not None:
            return Solution(found, found.start.value, True, (), plain)
    # loads the compiled kernels
    from pose_graph_ros.core.batch import optimizer  # noqa: PLC0415

    graph = problem.engine
    graph.set_poses(_composed(graph) if start == 'odometry' else poses)
    optimize = (optimizer.optimize_from_linear_start if start == 'chordal' else optimizer.optimize)
    result, determined = _held_weakly(graph, optimize)
    reason = re.sub(r'hidden node (\d+)', lambda node: f'hidden node {problem.ids[int(node[1])]}',
                    result.reason)
    names = {'file': 'present poses', 'odometry': 'odometry'}
    if result.status is Status.FAILED and start == 'chordal':
        # the poses are those before, but all linear starts were tried
        names[start] = Start.CHORDAL.value
    return Solution(replace(result, reason=reason), names.get(start, result.start.value),
                    determined)


def _composed(graph: 'Graph') -> FloatArray:
    """Return poses composed from odometry if it joins all nodes, else from all edges."""
    edges, poses, known = graph.edges, graph.poses.copy(), graph.fixed.copy()
    edges = edges.rows(edges.weight > 0.0)
    steps = edges.rows(np.abs(edges.j - edges.i) == 1)
    joins_all = len(np.unique(np.minimum(steps.i, steps.j))) == graph.n_nodes - 1
    compose_missing(poses, known, steps if joins_all else edges)
    poses[~graph.is_pose, 2] = 0.0
    return poses


def _held_weakly(
    graph: 'Graph', optimize: Callable[['Graph', SolverConfig], BatchResult],
) -> tuple[BatchResult, bool]:
    """
    Optimise a graph; if poses are not determined, choose those near the present ones.

    The result has the reason then. It is the minimum of chi2 with a weak prior on each node, which
    is not added to the graph. Also return whether the poses are determined.
    """
    result = optimize(graph, CONFIG)
    if result.status is not Status.FAILED or not np.isfinite(result.chi2):
        return result, True
    copy, n = type(graph)(), graph.n_nodes
    copy.fill(graph.rows())
    typical = np.concatenate([np.einsum('mii->mi', table.weighted_information).ravel()
                              for table in (graph.edges, graph.observed)])
    weak = WEAK * np.median(typical[typical > 0.0]) * (
        np.eye(3) * (np.arange(3) < graph.dimension[:, None, None]))
    copy.apply(GraphUpdate(observed=ObservedNodes(
        np.arange(n), None, graph.poses.copy(), weak,
        [ObservedKind.GLOBAL_POSE] * n)))
    other = optimize(copy, CONFIG)
    if other.status is Status.FAILED:
        return result, False
    graph.set_poses(copy.poses)
    return replace(other, chi2=graph.energies().chi2,
                   reason=f'{result.reason}; it is held near its start'), False
