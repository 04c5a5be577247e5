# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Stretches of the path of which the measurements in the map leave the graph.

Fixes, poses and rotations tell of a node once and for all, and their biases connect it with those
before and after it. So where places are thinned, the measurements leave stretch by stretch, in
the order of time, with the biases that only they need: whether their nodes leave or stay, what
they tell becomes edges and observed nodes of the kind PRIOR (`sparse_removal`).
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, ObservedKind
from pose_graph_ros.core.graph.graph import Graph

# A stretch has at most this many poses; about so many stay in or around it.
MOST_POSES, MOST_AROUND = 10, 12
# It may have so many if a bias is in use that long: half a minute of a car in a town.
LONGEST = 100


class Segment(NamedTuple):
    """Consecutive poses, and the measurements of them."""

    poses: IntArray
    """Ids, ascending."""
    edges: IntArray
    """Ids of the measurements that are edges."""
    observed: IntArray
    """Ids of the others."""
    after: int
    """Id of the next pose."""


def carriers(graph: Graph) -> tuple[IntArray, IntArray]:
    """
    Return the poses that hold the measurements of a graph, by ids.

    Shapes are (M,) for edges, with -1 where an edge is no measurement in the map, and (K,) for
    observed nodes, likewise.
    """
    edges, observed = graph.edges, graph.observed
    is_pose = graph.is_pose
    of_pose = is_pose[graph.node_rows(edges.i)]
    on_bias = (edges.kind == EdgeKind.BIAS) & of_pose
    # a rotation is held by the later one of its poses
    holder = np.where(on_bias, edges.i, np.where(
        edges.kind == EdgeKind.TURN, np.maximum(edges.i, edges.j), -1))
    measured = is_pose[graph.node_rows(observed.node)] & (observed.kind != ObservedKind.PRIOR)
    return holder, np.where(measured, observed.node, -1)


def first_of(holder: IntArray, seen: IntArray) -> int:
    """
    Return the first pose that holds measurements, by its id; one after all poses if none does.

    Parameters
    ----------
    holder, seen : ndarray of int, as returned by `carriers`

    """
    every = np.concatenate((holder, seen))
    return int(np.min(every[every >= 0], initial=np.iinfo(np.int64).max))


def next_segment(graph: Graph, older: IntArray, leaving: IntArray) -> Segment | None:
    """
    Return the next stretch of which the measurements leave; None if it is not complete yet.

    No bias has measurements in it and after it.

    Parameters
    ----------
    graph : Graph
    older : ndarray of int, ids of the poses that are old enough, ascending
    leaving : ndarray of int, ids of those of them that leave

    """
    holder, seen = carriers(graph)
    ahead = older[np.searchsorted(older, first_of(holder, seen)):]
    size = _size(graph, ahead[:MOST_POSES], np.isin(ahead, leaving))
    # where no bias is needed on both sides
    ends = _ends(graph, ahead[:LONGEST + 1], holder)
    ends = ends[ends < len(ahead)]
    if size == 0 or len(ends) == 0 or len(ahead) <= size:
        return None
    fitting = int(np.searchsorted(ends, size, side='right'))
    end = int(ends[max(fitting - 1, 0)])
    poses = ahead[:end]
    return Segment(poses, graph.edge_ids[np.isin(holder, poses)],
                   graph.observed_ids[np.isin(seen, poses)], int(ahead[end]))


def _ends(graph: Graph, poses: IntArray, holder: IntArray) -> IntArray:
    """Return after how many of some poses no bias has measurements on both sides, at least one."""
    edges = graph.edges
    measured = np.flatnonzero(holder >= 0)
    if len(measured) == 0:
        return np.arange(1, len(poses) + 1)
    bias = np.where(edges.kind == EdgeKind.TURN, edges.k, edges.j)[measured]
    order = np.lexsort((holder[measured], bias))
    bias, holder = bias[order], holder[measured][order]
    begins = np.flatnonzero(np.diff(bias, prepend=-2))
    ends = np.append(begins[1:], len(bias)) - 1
    # a bias is in use between its first and its last pose
    opened = np.searchsorted(poses, holder[begins]), np.searchsorted(poses, holder[ends])
    blocked = np.zeros(len(poses) + 2, dtype=np.int64)
    np.add.at(blocked, opened[0] + 1, 1)
    np.add.at(blocked, opened[1] + 1, -1)
    free = np.cumsum(blocked)[:len(poses) + 1] == 0
    return np.flatnonzero(free)[1:]


def _size(graph: Graph, poses: IntArray, leaves: BoolArray) -> int:
    """Return how many of some poses make a stretch, as far as not too many others are around."""
    edges = graph.edges
    is_pose = graph.is_pose
    used = (edges.weight > 0.0) & is_pose[graph.node_rows(edges.i)] & is_pose[
        graph.node_rows(edges.j)]
    ends = np.column_stack((edges.i[used], edges.j[used]))
    around, inside = set[int](), set[int]()
    for size, (pose, leave) in enumerate(zip(poses.tolist(), leaves.tolist(), strict=False)):
        if leave:
            inside.add(pose)
            around.update(ends[np.any(ends == pose, axis=1)].ravel().tolist())
        else:
            around.add(pose)
        if size > 0 and len(around - inside) > MOST_AROUND:
            return size
    return len(poses)
