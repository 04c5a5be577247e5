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

from collections.abc import Iterator
from typing import Final, NamedTuple, Self

import numpy as np

from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, Covariances, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.window.sparse_removal import grown, LIMITS, neighbours, NONE


class Segment(NamedTuple):
    """Consecutive poses, and the measurements of them."""

    poses: IntArray  # ids, ascending
    factors: IntArray  # ids of the measurements
    after: int  # id of the next pose


def carriers(graph: Graph) -> IntArray:
    """Return the pose, by id, that holds each factor as a measurement; -1 if it is none."""
    factors, is_pose = graph.factors, graph.is_pose
    measures = is_pose[graph.node_rows(factors.i)] & ((factors.kind == FactorKind.BIAS) | (
        (factors.j < 0) & (factors.kind != FactorKind.NODE_PRIOR)))
    # a rotation, and odometry that is calibrated, is held by the later one of its poses
    return np.where(measures, factors.i, np.where(
        factors.k >= 0, np.maximum(factors.i, factors.j), -1))


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
    holder, factors = carriers(graph), graph.factors
    ahead = older[np.searchsorted(older, first_of(holder)):]
    # how many poses make a stretch, as far as not too many others are around
    some = ahead[:LIMITS.stretch]
    near, size = _near(graph, np.intersect1d(some, leaving)), len(some)
    around, inside = set[int](), set[int]()
    for n, pose in enumerate(some.tolist()):
        if pose in near:
            inside.add(pose)
        around |= near.get(pose, {pose})
        if n > 0 and len(around - inside) > LIMITS.stretch_around:
            size = n
            break
    # after how many poses, at least one, no bias has measurements on both sides: it is in use
    # between its first and its last pose
    poses = ahead[:LIMITS.longest_stretch + 1]
    measured = (holder >= 0) & (factors.j >= 0)
    bias = np.where(factors.k >= 0, factors.k, factors.j)[measured]
    biases, which = np.unique(bias, return_inverse=True)
    at = np.searchsorted(poses, holder[measured])
    first, last = np.full(len(biases), len(poses)), np.zeros(len(biases), dtype=np.int64)
    np.minimum.at(first, which, at)
    np.maximum.at(last, which, at)
    in_use = np.zeros(len(poses) + 2, dtype=np.int64)
    np.add.at(in_use, first + 1, 1)
    np.add.at(in_use, last + 1, -1)
    ends = np.flatnonzero(np.cumsum(in_use)[:-1] == 0)[1:]
    ends = ends[ends < len(ahead)]
    if size == 0 or len(ends) == 0 or len(ahead) <= size:
        return None
    fitting = int(np.searchsorted(ends, size, side='right'))
    end = int(ends[max(fitting - 1, 0)])
    poses = ahead[:end]
    return Segment(poses, graph.factor_ids[np.isin(holder, poses)], int(ahead[end]))


def _near(graph: Graph, poses: IntArray) -> dict[int, set[int]]:
    """Return what other poses are connected with each of some."""
    edges, is_pose = graph.factors.edges, graph.is_pose
    ends = np.column_stack((edges.i, edges.j))
    used = (edges.weight > 0.0) & np.all(is_pose[graph.node_rows(ends)], axis=1)
    return neighbours(poses, ends[used])


def crowded(poses: Poses, preferred: BoolArray, config: ThinningConfig,
            part: int = LIMITS.compared) -> IntArray:
    """
    Return rows of poses that leave, ascending, each with that of its anchor, shape (L, 2).
    """
    from scipy.spatial import KDTree  # noqa: PLC0415  most graphs do not need it

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
    pairs = order[np.column_stack((leaving, anchor[leaving]))]
    return pairs[np.argsort(pairs[:, 0])]


class Places(NamedTuple):
    """Nodes that leave, ascending, with their places relative to nodes that stay."""

    nodes: IntArray  # ids, shape (L,)
    anchors: IntArray  # ids, shape (L,)
    relative: Poses  # in the anchors
    noise: Covariances  # of these, in the frames of the nodes

    @classmethod
    def now(cls, smoother: IncrementalSmoother, nodes: IntArray, anchors: IntArray) -> Self:
        """Return the present places of nodes."""
        graph = smoother.graph
        relative = se2.between(graph.poses_of(anchors), graph.poses_of(nodes))
        edges = Factors(anchors, nodes, relative, np.tile(np.eye(3), (len(nodes), 1, 1)),
                        np.full(len(nodes), FactorKind.PRIOR))
        return cls(nodes, anchors, relative, smoother.innovations(edges).covariances)

    def rows(self, index: BoolArray) -> Self:
        """Return the places of some of the nodes."""
        return type(self)(self.nodes[index], self.anchors[index], self.relative[index],
                          self.noise[index])


NOWHERE: Final = Places(NONE, NONE, np.empty((0, 3)), np.empty((0, 3, 3)))


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

    def places(self, smoother: IncrementalSmoother, config: ThinningConfig, n_made: int,
               keep: IntArray, first: int) -> Places | None:
        """
        Return the nodes from a first one on that leave now, maybe none; None most times.

        Fixed nodes, those to keep and the newest ones never leave.
        """
        if n_made < self._n_made + LIMITS.every:
            return None
        self._n_made = n_made
        graph = smoother.graph
        ids, fixed = graph.node_ids, graph.fixed
        rows = np.flatnonzero(graph.is_pose & (ids >= first))[:-config.newest]
        crowd = rows[crowded(graph.poses[rows], fixed[rows], config)]
        crowd = ids[crowd[~fixed[crowd[:, 0]]]]
        n_stay = int(np.count_nonzero(graph.is_pose)) - len(crowd)
        self._n_stay = max(n_stay, LIMITS.least_area * config.newest)
        if not self.measurements_are_due(graph):
            crowd = crowd[crowd[:, 0] < first_of(carriers(graph))]
        crowd = crowd[~np.isin(crowd[:, 0], keep)]
        # those that are not sure enough to leave must not keep others from being looked at
        order = np.argsort(crowd[:, 0] < self._next, kind='stable')[:LIMITS.looked_at]
        if len(order) > 0:
            self._next = int(crowd[order[-1], 0]) + 1
        chosen = crowd[np.sort(order)]
        return certain(smoother, chosen[:, 0], chosen[:, 1], config)


def groups(graph: Graph, places: Places) -> Iterator[Places]:
    """Yield connected groups of nodes; each must leave the graph before the next is asked for."""
    while len(places.nodes) > 0:
        inside = np.isin(places.nodes, grown(
            _near(graph, places.nodes), int(places.nodes[0]), LIMITS.group_nodes,
            LIMITS.group_neighbours))
        yield places.rows(inside)
        places = places.rows(~inside)


def certain(smoother: IncrementalSmoother, nodes: IntArray, anchors: IntArray,
            config: ThinningConfig) -> Places:
    """
    Return the places of those nodes which are beside their anchors for sure.

    The standard deviation of the position relative to the anchor is at most half of `cell`, that
    of the heading half of `angle`. So what odometry alone brings together is not thinned.
    """
    places = Places.now(smoother, nodes, anchors)
    largest = np.linalg.eigvalsh(places.noise[:, :2, :2])[:, -1]
    return places.rows((largest <= (0.5 * config.cell)**2)
                       & (places.noise[:, 2, 2] <= (0.5 * config.angle)**2))
