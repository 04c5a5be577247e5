# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A graph from a file before and after its optimisation, as pictures and reports show it."""

from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from pose_graph_ros.core.batch.levenberg_marquardt import BatchResult
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, Factors

if TYPE_CHECKING:
    from pose_graph_ros.cli.solve import Problem


class SolvedGraph(NamedTuple):
    """N hidden nodes and M constraints, whose ends are rows of the nodes."""

    ids: IntArray  # in the file, increasing
    is_pose: BoolArray  # else a landmark
    is_fixed: BoolArray
    before: Poses
    after: Poses
    factors: Factors
    off: FloatArray  # how far each constraint is off, without its weight if that is 0 [sigma]
    is_odometry: BoolArray  # edges with no id of a pose between their two
    is_doubted: BoolArray
    chi2_before: float
    result: BatchResult

    @property
    def is_closure(self) -> BoolArray:
        """Which constraints are loop closures, or sightings of landmarks."""
        return (self.factors.j >= 0) & ~self.is_odometry


def solved_graph(problem: 'Problem', before: Poses, chi2_before: float, result: BatchResult,
                 doubted: IntArray) -> SolvedGraph:
    """Return a graph at its optimum; `doubted` are rows of edges, whose weight is 0."""
    graph = problem.graph
    factors, place = graph.factors_by_row, np.cumsum(graph.is_pose)
    squares = graph.energies().factors
    if len(doubted) > 0:
        squares[doubted] = problem.engine.unweighted_energies(doubted)
    return SolvedGraph(
        problem.ids, graph.is_pose, graph.fixed, before, graph.poses.copy(), factors,
        np.sqrt(squares),
        (factors.kind <= FactorKind.LOOP_CLOSURE) & (
            np.abs(place[factors.j] - place[factors.i]) == 1),
        np.isin(np.arange(len(factors)), doubted), chi2_before, result)
