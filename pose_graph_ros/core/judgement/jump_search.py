# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A jump of odometry while driving, tried on a copy of the graph, part by part: see `jumps`."""

from collections.abc import Generator

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement import jumps, strain
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.copies import copied_rows, in_rows
from pose_graph_ros.core.judgement.jumps import Jump
from pose_graph_ros.core.judgement.odometry_motions import Odometry
from pose_graph_ros.core.judgement.swaps import Found, residuals, Swap, write
from pose_graph_ros.core.solver_config import SolverConfig

CONFIG = SolverConfig(max_iterations=20, step_tolerance=1e-3)
# Number of doubted closures that all others are compared with, and of comparisons in a part.
MOST_SEEDS, MOST_COMPARED = 10, 20_000


def search(present: Swap, graph: Graph) -> Generator[None, None, Found | None]:
    """
    Return a set with a jump, None if none pays; part by part.

    Parameters
    ----------
    present : Swap, that has found nothing better than the set that is believed
    graph : Graph, it is not changed

    """
    odometry, poses = Odometry(graph), graph.poses.copy()
    rows, closures = copied_rows(graph), graph.edge_rows(present.ids)
    nodes, edge_ids = graph.node_ids.copy(), graph.edge_ids.copy()
    if np.any(closures < 0):
        return None     # some have left since
    edges = in_rows(graph, present.closures)
    yield
    free_or_in = present.free | present.before
    most_seeds = MOST_COMPARED // max(int(np.sum(free_or_in)), 1)
    found = yield from jumps.places(
        edges.rows(free_or_in), present.before[free_or_in], poses, odometry, (),
        most_seeds=min(max(most_seeds, 1), MOST_SEEDS))
    yield
    for place in found[:1]:
        numbers = np.flatnonzero(free_or_in)
        members, against = numbers[place.members], numbers[place.against]
        inside = present.before.copy()
        inside[against[present.free[against]]], inside[members] = False, True
        motion, = odometry.motion_at(
            np.array([place.at]), place.first, place.last, place.total)
        copy = Graph()
        write(rows.edges, closures, edges, inside)
        copy.fill(jumps.rows_with_motion(rows, odometry, place.at, motion, jumps.LOOSE))
        yield
        result = yield from optimizer.in_parts(copy, CONFIG)
        yield
        if result.status is Status.FAILED:
            continue
        residual = residuals(copy, edges)
        fit = members[residual[members] <= GATE]
        if (present.truncated(copy, closures, residual) + strain.PRICE >= present.cost
                or len(fit) < jumps.MOST_FIT * len(members)
                or strain.n_places(copy.poses, edges.rows(fit), odometry) < strain.PLACES):
            continue
        total = se2.between(*copy.poses[odometry.nodes[[place.first, place.last]]])
        at, motion = odometry.smallest_jump(
            place.first, place.last, place.first, place.last, total)
        first, last = odometry.nodes[[place.first, place.last]].tolist()
        inside = np.where(present.free, residual <= GATE, inside)
        jump = Jump(int(odometry.rows[at]), (first, last), motion, fit)
        return Found(inside, nodes, copy.poses.copy(), jump.with_ids(edge_ids, nodes))
    return None
