# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures `pose-graph solve --robust` leaves out: decided, applied and told."""

from collections.abc import Sequence
from dataclasses import dataclass
import sys

import numpy as np

from pose_graph_ros.cli.believe import believe
from pose_graph_ros.cli.solve_starts import Problem
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.error_functions import energies as energies_of
from pose_graph_ros.core.graph.graph_update import GraphUpdate
from pose_graph_ros.core.judgement.texts import short

N_LARGEST = 5  # number of edges that are named


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
