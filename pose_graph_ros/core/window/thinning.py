# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Thinning: which hidden nodes leave a graph of a place that is driven again and again.

The plane is divided into square cells, and the circle of headings into sectors. In each sector of
each cell only some poses stay: those that a believed fix or loop closure tells of, and then the
oldest ones. So the number of nodes grows with the area and not with the time. A node that leaves
has a kept one in its cell, its *anchor*: the node keeps its pose relative to the anchor, and what
concerns the node later is attached to the anchor.

Nodes leave in groups of connected ones. The prior of a group becomes a tree of edges at once
(`marginalization.sparsification`), with the edges that earlier groups have left between the same
nodes taken into it, so that the number of edges stays in proportion to the number of nodes.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import Graph

# A group has at most this many nodes, and about this many neighbours in all.
MOST_IN_GROUP, MOST_NEIGHBOURS = 10, 12


class Crowd(NamedTuple):
    """Nodes that leave, in ascending order, and the kept nodes that stand for them."""

    leaving: IntArray
    """Shape (L,)."""
    anchors: IntArray
    """Shape (L,)."""


def crowded(
    poses: FloatArray, preferred: npt.NDArray[np.generic], config: ThinningConfig,
) -> Crowd:
    """
    Return rows of poses that leave.

    Parameters
    ----------
    poses : ndarray, shape (N, 3), in the order of time, without the newest ones [m, m, rad]
    preferred : ndarray of numbers, shape (N,), those with higher numbers stay before others
    config : ThinningConfig

    """
    cell = _cells(poses, config)
    # by cell, then the preferred ones, then the oldest
    order = np.lexsort((np.arange(len(poses)), -preferred.astype(np.int64), cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    first = np.repeat(begins, np.diff(np.append(begins, len(order))))
    rank = np.arange(len(order)) - first
    out = rank >= config.poses
    leaving, first = order[out], first[out]
    # the nearest one of those that stay in the cell
    kept = order[first[:, None] + np.arange(config.poses)]
    distance = np.hypot(*np.moveaxis(poses[kept, :2] - poses[leaving, None, :2], 2, 0))
    anchors = kept[np.arange(len(leaving)), np.argmin(distance, axis=1)]
    ascending = np.argsort(leaving)
    return Crowd(leaving[ascending], anchors[ascending])


def _cells(poses: FloatArray, config: ThinningConfig) -> IntArray:
    """Return a number of the cell and the sector of each pose, shape (N,), not negative."""
    sectors = max(round(se2.TWO_PI / config.angle), 1)
    sector = np.floor((poses[:, 2] + np.pi) / se2.TWO_PI * sectors).astype(np.int64) % sectors
    x, y = np.floor(poses[:, :2] / config.cell).astype(np.int64).T
    if len(poses) == 0:
        return sector
    x, y = x - np.min(x), y - np.min(y)
    return np.asarray((x * (np.max(y) + 1) + y) * sectors + sector)


def crowd(graph: Graph, config: ThinningConfig) -> Crowd:
    """
    Return ids of the hidden nodes of a graph that leave it, and of their anchors.

    Fixed nodes and the newest ones never leave.

    Parameters
    ----------
    graph : Graph
    config : ThinningConfig

    """
    rows = np.flatnonzero(graph.is_pose)[:-config.newest]
    fixed = graph.fixed
    preferred = np.where(fixed, 2, informed(graph))
    found = crowded(graph.poses[rows], preferred[rows], config)
    leaving, anchors = rows[found.leaving], rows[found.anchors]
    free = ~fixed[leaving]
    ids = graph.node_ids
    return Crowd(ids[leaving[free]], ids[anchors[free]])


def informed(graph: Graph) -> BoolArray:
    """Return which nodes a fix or a loop closure with a weight tells of, by row, shape (N,)."""
    told = np.zeros(graph.n_nodes, dtype=bool)
    edges, observed = graph.edges, graph.observed
    closures = (edges.kind == EdgeKind.LOOP_CLOSURE) & (edges.weight > 0.0)
    biased = (edges.kind == EdgeKind.BIAS) & (edges.weight > 0.0)
    for ids in (edges.i[closures], edges.j[closures], edges.i[biased],
                observed.node[observed.weight > 0.0]):
        told[graph.node_rows(ids)] = True
    return told


def group(leaving: IntArray, ends: IntArray) -> IntArray:
    """
    Return the first group of connected nodes among those that leave, ascending.

    Parameters
    ----------
    leaving : ndarray of int, shape (L,), ids in ascending order
    ends : ndarray of int, shape (M, 2), ids of the ends of all edges

    """
    neighbours: dict[int, set[int]] = {node: set() for node in leaving.tolist()}
    concerned = ends[np.isin(ends, leaving).any(axis=1)]
    for i, j in concerned.tolist():
        for one, other in ((i, j), (j, i)):
            if one in neighbours:
                neighbours[one].add(other)
    first = int(leaving[0])
    members, around = {first}, set(neighbours[first])
    while len(members) < MOST_IN_GROUP:
        node = min(around & neighbours.keys(), default=None)
        if node is None:
            break
        grown = (around | neighbours[node]) - members - {node}
        if len(grown) > MOST_NEIGHBOURS:
            break
        members.add(node)
        around = grown
    return np.array(sorted(members), dtype=np.int64)
