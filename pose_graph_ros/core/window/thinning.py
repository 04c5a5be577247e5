# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Thinning: which hidden nodes leave a graph of a place that is driven again and again.

Of poses that are near each other and have about the same heading only some stay, the oldest ones.
So those that stay are apart from each other, and their number grows with the area and not with
the time; how a place is divided does not matter, as it would with the cells of a grid, whose
borders the errors of each pass cross anew. A node that leaves has a kept one beside it, its
*anchor*: the node keeps its pose relative to the anchor, and what concerns the node later is
attached to the anchor. Nodes leave in groups of connected ones (`sparse_removal`).

Fixes, poses and rotations tell of a node once and for all, and their biases connect it with those
before and after it. So the measurements leave stretch by stretch, in the order of time, with the
biases that only they need, whether their nodes leave or stay.
"""

from collections.abc import Collection, Iterator
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial import KDTree

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.graph_update import GraphUpdate, Left
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.window.sparse_removal import leaving, LIMITS, with_fewer_edges


class Segment(NamedTuple):
    """Consecutive poses, and the measurements of them."""

    poses: IntArray  # ids, ascending
    factors: IntArray  # ids of the measurements
    after: int  # id of the next pose


def carriers(graph: Graph) -> IntArray:
    """Return the pose, by id, that holds each factor as a measurement; -1 if it is none."""
    factors, is_pose = graph.factors, graph.is_pose
    measures = is_pose[graph.node_rows(factors.i)] & (
        (factors.kind == FactorKind.BIAS)
        | ((factors.j < 0) & (factors.kind != FactorKind.NODE_PRIOR)))
    # a rotation is held by the later one of its poses
    return np.where(measures, factors.i, np.where(
        factors.kind == FactorKind.TURN, np.maximum(factors.i, factors.j), -1))


def first_of(holder: IntArray) -> int:
    """
    Return the first pose that holds measurements, by its id; one after all poses if none does.
    """
    return int(np.min(holder[holder >= 0], initial=np.iinfo(np.int64).max))


def next_segment(graph: Graph, older: IntArray, leaving: IntArray) -> Segment | None:
    """
    Return the next stretch of which the measurements leave; None if it is not complete yet.

    No bias has measurements in it and after it.
    """
    holder = carriers(graph)
    ahead = older[np.searchsorted(older, first_of(holder)):]
    size = _size(graph, ahead[:LIMITS.stretch], np.isin(ahead, leaving))
    # where no bias is needed on both sides
    ends = _ends(graph, ahead[:LIMITS.longest_stretch + 1], holder)
    ends = ends[ends < len(ahead)]
    if size == 0 or len(ends) == 0 or len(ahead) <= size:
        return None
    fitting = int(np.searchsorted(ends, size, side='right'))
    end = int(ends[max(fitting - 1, 0)])
    poses = ahead[:end]
    return Segment(poses, graph.factor_ids[np.isin(holder, poses)], int(ahead[end]))


def _ends(graph: Graph, poses: IntArray, holder: IntArray) -> IntArray:
    """Return after how many of some poses no bias has measurements on both sides, at least one."""
    edges = graph.factors
    measured = np.flatnonzero((holder >= 0) & (edges.j >= 0))
    if len(measured) == 0:
        return np.arange(1, len(poses) + 1)
    bias = np.where(edges.kind == FactorKind.TURN, edges.k, edges.j)[measured]
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
    edges, is_pose = graph.factors.edges, graph.is_pose
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
        if size > 0 and len(around - inside) > LIMITS.stretch_around:
            return size
    return len(poses)


class Crowd(NamedTuple):
    """Nodes that leave, in ascending order, and the kept nodes that stand for them."""

    leaving: IntArray  # shape (L,)
    anchors: IntArray  # shape (L,)


def crowded(
    poses: Poses, preferred: BoolArray, config: ThinningConfig, part: int = LIMITS.compared,
) -> Crowd:
    """Return rows of poses that leave."""
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

    nodes: IntArray  # ids, shape (L,)
    anchors: IntArray  # ids, shape (L,)
    relative: FloatArray  # poses in the anchors, shape (L, 3) [m, m, rad]
    noise: FloatArray  # covariances of these, in the frames of the nodes, shape (L, 3, 3)

    def rows(self, index: BoolArray) -> Self:
        """Return the places of some of the nodes."""
        return type(self)(self.nodes[index], self.anchors[index], self.relative[index],
                          self.noise[index])


class Thinning:
    """Decides now and then which nodes leave; see the module."""

    def __init__(self) -> None:
        self._n_made, self._next = -LIMITS.every, 0
        # number of poses that stay, when it was last looked, or what stands for it
        self._n_stay = 0

    def measurements_are_due(self, graph: Graph) -> bool:
        """Return whether there are so many measurements in the map that the oldest are to go."""
        n_measured = int(np.count_nonzero(carriers(graph) >= 0))
        # with about one for each node that comes before the next look
        return n_measured + LIMITS.every > LIMITS.measurements * self._n_stay

    def places(
        self, smoother: IncrementalSmoother, config: ThinningConfig, n_made: int,
        keep: Collection[int] = (), first: int = 0,
    ) -> Places | None:
        """Return the nodes that leave now, maybe none; None most times."""
        if config.cell == 0.0 or n_made < self._n_made + LIMITS.every:
            return None
        self._n_made = n_made
        graph = smoother.graph
        found = crowd(graph, config, first)
        n_stay = int(np.count_nonzero(graph.is_pose)) - len(found.leaving)
        self._n_stay = max(n_stay, LIMITS.least_area * config.newest)
        if not self.measurements_are_due(graph):
            before = found.leaving < first_of(carriers(graph))
            found = Crowd(*(ids[before] for ids in found))
        found = Crowd(*(ids[~np.isin(found.leaving, list(keep))] for ids in found))
        # those that are not sure enough to leave must not keep others from being looked at
        order = np.argsort(found.leaving < self._next, kind='stable')[:LIMITS.looked_at]
        if len(order) > 0:
            self._next = int(found.leaving[order[-1]]) + 1
        chosen = Crowd(*(ids[np.sort(order)] for ids in found))
        return certain(smoother, chosen, config)


def groups(graph: Graph, places: Places) -> Iterator[Places]:
    """Yield connected groups of nodes; each must leave the graph before the next is asked for."""
    while len(places.nodes) > 0:
        edges = graph.factors.edges
        used = edges.weight > 0.0
        members = group(places.nodes, np.column_stack((edges.i[used], edges.j[used])))
        inside = np.isin(places.nodes, members)
        yield places.rows(inside)
        places = places.rows(~inside)


def removed(smoother: IncrementalSmoother, update: GraphUpdate | None) -> Left | None:
    """
    Return what has left the graph with an update, or None if there is none or the solver fails.
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
    for _ in range(LIMITS.replaced):
        update = with_fewer_edges(smoother.graph, LIMITS.prior_edges)
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
    Return the first group of connected nodes among those that leave, given the ends of edges.
    """
    neighbours: dict[int, set[int]] = {node: set() for node in leaving.tolist()}
    concerned = ends[np.isin(ends, leaving).any(axis=1)]
    for i, j in concerned.tolist():
        for one, other in ((i, j), (j, i)):
            if one in neighbours:
                neighbours[one].add(other)
    first = int(leaving[0])
    members, around = {first}, set(neighbours[first])
    while len(members) < LIMITS.group_nodes:
        node = min(around & neighbours.keys(), default=None)
        if node is None:
            break
        grown = (around | neighbours[node]) - members - {node}
        if len(grown) > LIMITS.group_neighbours:
            break
        members.add(node)
        around = grown
    return np.array(sorted(members), dtype=np.int64)
