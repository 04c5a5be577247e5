# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Marginal covariances of the nodes of a graph; part of the tool `pose-graph solve`."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.cli.solve_starts import CONFIG, Problem
from pose_graph_ros.core.batch.optimizer import optimize
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import upper
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

COLUMNS = ('id', 'x', 'y', 'theta', 'cov_xx', 'cov_xy', 'cov_xtheta', 'cov_yy', 'cov_ytheta',
           'cov_thetatheta')


def chosen_rows(problem: Problem, which: str) -> IntArray:
    """
    Return the rows of the nodes that are asked for; raise PoseGraphError if there is no such node.

    Parameters
    ----------
    which : str, 'all', 'newest' or ids in the file separated by commas

    """
    if which == 'all':
        return np.arange(len(problem.ids))
    if which == 'newest':
        return np.array([problem.engine.newest_pose])
    names = []
    for word in which.split(','):
        try:
            names.append(int(word))
        except ValueError:
            raise PoseGraphError(f'--marginals: expected all, newest or ids separated by commas, '
                                 f'got {which!r}') from None
    rows = np.searchsorted(problem.ids, names)
    missing = [name for name, row in zip(names, rows.tolist(), strict=True)
               if row == len(problem.ids) or problem.ids[row] != name]
    if len(missing) > 0:
        raise PoseGraphError(f'--marginals: the file has no vertex {missing[0]}')
    return rows


class Marginals(NamedTuple):
    """Poses and covariances in map axes of some nodes."""

    rows: list[dict[str, float | None]]
    """One for each node, with the names of `COLUMNS`; None for the heading of a point."""
    relative_error: float
    """Bound of what rounding changes of a covariance: the condition number times epsilon."""

    def lines(self) -> list[str]:
        """Return lines of CSV."""
        return [','.join(COLUMNS), *(','.join(
            '' if row[name] is None else repr(row[name]) for name in COLUMNS)
            for row in self.rows)]


def marginals(problem: Problem, rows: IntArray) -> Marginals:
    """
    Return the covariances of nodes of a graph that the batch optimiser has solved.

    Parameters
    ----------
    problem : Problem
    rows : ndarray of int, shape (K,), of nodes

    """
    graph = problem.engine
    # H at the optimum; the last step before it was linearised one step away
    optimize(graph, CONFIG)
    covariances = IncrementalSmoother(graph=graph).covariances()
    table = []
    for row, pose, numbers in zip(rows.tolist(), graph.poses[rows].tolist(),
                                  upper(covariances[rows]).tolist(), strict=True):
        values: list[float | None] = [*pose, *numbers]
        if not graph.is_pose[row]:
            values = [None if k in {2, 5, 7, 8} else value for k, value in enumerate(values)]
        table.append(dict(zip(COLUMNS, [int(problem.ids[row]), *values], strict=True)))
    return Marginals(table, float(np.finfo(float).eps) * _condition(graph, covariances))


def _condition(graph: Graph, covariances: FloatArray) -> float:
    """
    Return a bound of the condition number of H with a diagonal of ones.

    The trace of its inverse, each variance times what constraints add to H there.
    """
    known = np.zeros((graph.n_nodes, 3))
    edges, observed = graph.edges_by_row, graph.observed_by_row
    for table, ends in ((edges, (edges.i, edges.j)), (observed, (observed.node,))):
        information = table.weighted_information
        position = information[:, 0, 0] + information[:, 1, 1]
        arm = np.sum(table.mean[:, :2]**2, axis=1) if table is edges else 0.0
        for end in ends:
            for column, share in enumerate((
                    position, position, information[:, 2, 2] + arm * position)):
                np.add.at(known[:, column], end, share)
    return max(float(np.sum(known * np.einsum('mii->mi', covariances))), 1.0)
