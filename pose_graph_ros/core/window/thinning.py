# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Thinning: which hidden nodes leave a graph of a place that is driven again and again.

Of poses that are near each other and have about the same heading only some stay, the oldest ones.
So those that stay are apart from each other, and their number grows with the area and not with
the time; how a place is divided does not matter, as it would with the cells of a grid, whose
borders the errors of each pass cross anew. A node that leaves has a kept one beside it, its
*anchor*: the node keeps its pose relative to the anchor, and what concerns the node later is
attached to the anchor.

Nodes leave in groups of connected ones. The prior of a group becomes a tree of edges at once
(`marginalization.sparsification`), with the edges that earlier groups have left between the same
nodes taken into it, so that the number of edges stays in proportion to the number of nodes.
"""

from collections.abc import Collection, Iterator
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial import KDTree

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.graph_update import GraphUpdate, Left
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.window.segments import carriers, first_of
from pose_graph_ros.core.window.sparse_removal import leaving, with_fewer_edges

# Nodes leave whenever so many new ones have been made; so many are looked at each time.
EVERY, MOST_AT_ONCE = 10, 40
# Edges of the kind PRIOR for each pose, above which some of them are replaced by fewer ones, and
# how often in one step.
MOST_EDGES, MOST_REPLACED = 2.5, 3
# Fixes, poses and rotations for each pose that stays, up to which they stay as well, with their
# nodes: what they tell of the errors they have in common is exact only as long as they are in the
# graph. A small area counts as so many times the newest nodes.
MOST_MEASUREMENTS, LEAST = 2.0, 4
# A group has at most this many nodes, and about this many neighbours in all.
MOST_IN_GROUP, MOST_NEIGHBOURS = 10, 12
# So many poses are compared at once, or as many as stay: the pairs of all would need too much
# memory where a place has been driven often before it is thinned.
PART = 256


class Crowd(NamedTuple):
    """Nodes that leave, in ascending order, and the kept nodes that stand for them."""

    leaving: IntArray
    """Shape (L,)."""
    anchors: IntArray
    """Shape (L,)."""


def crowded(
    poses: FloatArray, preferred: BoolArray, config: ThinningConfig, part: int = PART,
) -> Crowd:
    """
    Return rows of poses that leave.

    Parameters
    ----------
    poses : ndarray, shape (N, 3), in the order of time, without the newest ones [m, m, rad]
    preferred : ndarray of bool, shape (N,), those that stay before others
    config : ThinningConfig
    part : int, see `PART`

    """
    order = np.argsort(~preferred, kind='stable')
    place, heading = poses[order, :2], poses[order, 2]
    anchor = np.full(len(poses), -1, dtype=np.int64)
    end = 0
    while end < len(poses):
        begin, stay = end, np.flatnonzero(anchor[:end] < 0)
        end = min(begin + max(part, len(stay)), len(poses))
        index = np.concatenate((stay, np.arange(begin, end)))
        pairs = index[KDTree(place[index]).query_pairs(config.cell, output_type='ndarray')]
        pairs = np.sort(pairs[pairs.max(axis=1) >= begin], axis=1)
        turn = np.abs(se2.wrap(heading[pairs[:, 1]] - heading[pairs[:, 0]]))
        pairs = pairs[turn < config.angle]
        pairs = pairs[np.argsort(pairs[:, 1], kind='stable')]
        later, begins = np.unique(pairs[:, 1], return_index=True)
        ends = np.append(begins[1:], len(pairs))
        for row, first, after in zip(*map(np.ndarray.tolist, (later, begins, ends)), strict=False):
            near = pairs[first:after, 0]
            near = near[anchor[near] < 0]
            if len(near) >= config.poses:
                distance = np.hypot(*(place[near] - place[row]).T)
                anchor[row] = near[np.argmin(distance)]
    leaving = np.flatnonzero(anchor >= 0)
    leaving, anchors = order[leaving], order[anchor[leaving]]
    ascending = np.argsort(leaving)
    return Crowd(leaving[ascending], anchors[ascending])


def crowd(graph: Graph, config: ThinningConfig, first: int = 0) -> Crowd:
    """
    Return ids of the hidden nodes of a graph that leave it, and of their anchors.

    Fixed nodes and the newest ones never leave.

    Parameters
    ----------
    graph : Graph
    config : ThinningConfig
    first : int, id of the first node that is not frozen

    """
    rows = np.flatnonzero(graph.is_pose & (graph.node_ids >= first))[:-config.newest]
    fixed = graph.fixed
    found = crowded(graph.poses[rows], fixed[rows], config)
    leaving, anchors = rows[found.leaving], rows[found.anchors]
    free = ~fixed[leaving]
    ids = graph.node_ids
    return Crowd(ids[leaving[free]], ids[anchors[free]])


class Places(NamedTuple):
    """Nodes that leave, ascending, with their places relative to nodes that stay."""

    nodes: IntArray
    """Ids, shape (L,)."""
    anchors: IntArray
    """Ids, shape (L,)."""
    relative: FloatArray
    """Poses in the anchors, shape (L, 3) [m, m, rad]."""
    noise: FloatArray
    """Covariances of these, in the frames of the nodes, shape (L, 3, 3)."""

    def rows(self, index: BoolArray) -> Self:
        """Return the places of some of the nodes."""
        return type(self)(self.nodes[index], self.anchors[index], self.relative[index],
                          self.noise[index])


class Thinning:
    """Decides now and then which nodes leave; see the module."""

    def __init__(self) -> None:
        self._n_made, self._next = -EVERY, 0
        self._n_stay = 0
        """Number of poses that stay, when it was last looked, or what stands for it."""

    def measurements_are_due(self, graph: Graph) -> bool:
        """Return whether there are so many measurements in the map that the oldest are to go."""
        n_measured = sum(int(np.count_nonzero(held >= 0)) for held in carriers(graph))
        # with about one for each node that comes before the next look
        return n_measured + EVERY > MOST_MEASUREMENTS * self._n_stay

    def places(
        self, smoother: IncrementalSmoother, config: ThinningConfig, n_made: int,
        keep: Collection[int] = (), first: int = 0,
    ) -> Places | None:
        """
        Return the nodes that leave now, maybe none; None most times.

        Parameters
        ----------
        smoother : IncrementalSmoother, without edits that wait
        config : ThinningConfig
        n_made : int, how many hidden nodes were made, with those that have left
        keep : collection of int, ids of nodes that do not leave
        first : int, id of the first node that is not frozen

        """
        if config.cell == 0.0 or n_made < self._n_made + EVERY:
            return None
        self._n_made = n_made
        graph = smoother.graph
        found = crowd(graph, config, first)
        n_stay = int(np.count_nonzero(graph.is_pose)) - len(found.leaving)
        self._n_stay = max(n_stay, LEAST * config.newest)
        if not self.measurements_are_due(graph):
            before = found.leaving < first_of(*carriers(graph))
            found = Crowd(*(ids[before] for ids in found))
        found = Crowd(*(ids[~np.isin(found.leaving, list(keep))] for ids in found))
        # those that are not sure enough to leave must not keep others from being looked at
        order = np.argsort(found.leaving < self._next, kind='stable')[:MOST_AT_ONCE]
        if len(order) > 0:
            self._next = int(found.leaving[order[-1]]) + 1
        chosen = Crowd(*(ids[np.sort(order)] for ids in found))
        return certain(smoother, chosen, config)


def groups(graph: Graph, places: Places) -> Iterator[Places]:
    """
    Yield connected groups of nodes; each must leave the graph before the next is asked for.

    Parameters
    ----------
    graph : Graph
    places : Places, all nodes that leave

    """
    while len(places.nodes) > 0:
        edges = graph.edges
        used = edges.weight > 0.0
        members = group(places.nodes, np.column_stack((edges.i[used], edges.j[used])))
        inside = np.isin(places.nodes, members)
        yield places.rows(inside)
        places = places.rows(~inside)


def removed(smoother: IncrementalSmoother, update: GraphUpdate | None) -> Left | None:
    """
    Return what has left the graph with an update, or None if there is none or the solver fails.

    Parameters
    ----------
    smoother : IncrementalSmoother
    update : GraphUpdate, optional

    """
    if update is None:
        return None
    gone = leaving(smoother.graph, update)
    try:
        result = smoother.update(update)
    except GraphUpdateError:    # an approximation that rounding has made invalid
        return None
    return None if result.status is Status.FAILED else gone


def simplify(smoother: IncrementalSmoother) -> Iterator[Left]:
    """Replace some edges between poses by fewer ones where there are many; yield what leaves."""
    for _ in range(MOST_REPLACED):
        update = with_fewer_edges(smoother.graph, MOST_EDGES)
        if update is None:
            return
        gone = removed(smoother, update)
        if gone is None:
            return
        yield gone


def certain(smoother: IncrementalSmoother, found: Crowd, config: ThinningConfig) -> Places:
    """
    Return those nodes that leave which are beside their anchors for sure.

    The standard deviation of the position relative to the anchor is at most half of `cell`, that
    of the heading half of `angle`. So what odometry alone brings together is not thinned.

    Parameters
    ----------
    smoother : IncrementalSmoother, without edits that wait
    found : Crowd, with ids
    config : ThinningConfig

    """
    graph = smoother.graph
    start, end = graph.poses_of(found.anchors), graph.poses_of(found.leaving)
    noise = relative_noise(smoother, found.anchors, found.leaving)
    sure = (np.linalg.eigvalsh(noise[:, :2, :2])[:, -1] <= (0.5 * config.cell)**2) & (
        noise[:, 2, 2] <= (0.5 * config.angle)**2)
    return Places(found.leaving[sure], found.anchors[sure],
                  se2.between(start[sure], end[sure]), noise[sure])


def relative_noise(
    smoother: IncrementalSmoother, anchors: IntArray, nodes: IntArray,
) -> FloatArray:
    """
    Return the covariances of the poses of nodes in others, shape (L, 3, 3).

    They are in the frames of the nodes.

    Parameters
    ----------
    smoother : IncrementalSmoother, without edits that wait
    anchors, nodes : ndarray of int, shape (L,), ids

    """
    start, end = smoother.graph.poses_of(anchors), smoother.graph.poses_of(nodes)
    noise = np.empty((len(start), 3, 3))
    for k, (anchor, node) in enumerate(zip(anchors.tolist(), nodes.tolist(), strict=True)):
        # from both poses in map axes to the frame of the node
        jacobian = np.hstack((-np.eye(3), np.eye(3)))
        jacobian[:2, 2] = end[k, 1] - start[k, 1], start[k, 0] - end[k, 0]
        axes = np.eye(3)
        axes[:2, :2] = se2.rotation(end[k, 2]).T
        jacobian = axes @ jacobian
        noise[k] = jacobian @ smoother.joint_covariance(anchor, node) @ jacobian.T
    return noise


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
