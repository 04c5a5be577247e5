# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Marginal covariances of the nodes of a graph as CSV; part of the tool `pose-graph solve`."""

import numpy as np

from pose_graph_ros.cli.solve_starts import CONFIG, Problem
from pose_graph_ros.core.batch.optimizer import optimize
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import upper
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

HEADER = 'id,x,y,theta,cov_xx,cov_xy,cov_xtheta,cov_yy,cov_ytheta,cov_thetatheta'


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


def csv_lines(problem: Problem, rows: IntArray) -> list[str]:
    """
    Return lines of CSV with poses and covariances in map axes [m, rad], those of points shorter.

    Parameters
    ----------
    rows : ndarray of int, shape (K,), of nodes in a graph that the batch optimiser has solved

    """
    graph = problem.engine
    # H at the optimum; the last step before it was linearised one step away
    optimize(graph, CONFIG)
    smoother = IncrementalSmoother(graph=graph)
    few = 10 * len(rows) < graph.n_nodes
    covariances = (np.array([smoother.covariance(int(row)) for row in rows]) if few
                   else smoother.covariances()[rows])
    lines = [HEADER]
    for row, pose, numbers in zip(rows.tolist(), graph.poses[rows].tolist(),
                                  upper(covariances).tolist(), strict=True):
        texts = [*map(repr, (*pose, *numbers))]
        if not graph.is_pose[row]:
            # a point has no heading
            texts = ['' if k in {2, 5, 7, 8} else text for k, text in enumerate(texts)]
        lines.append(','.join((str(problem.ids[row]), *texts)))
    return lines
