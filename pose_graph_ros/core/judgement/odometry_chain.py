# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion between any two hidden nodes by odometry, with its covariance.

The noise xi of an odometry edge to node n, in the frame of n, is the noise `Ad(T_n) xi` in the
frame that the chain begins in, T_n being the pose of n by odometry. There the noises of edges add
up, so that two prefix sums give the covariance of the chain between any two nodes.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.compiled.jit import FLAG, INTEGER, INTEGERS, kernel, NUMBERS, ROWS
from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, full, NodeKind, upper
from pose_graph_ros.core.graph.factors import motion, wrap
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.odometry.motion import OdometryErrors

# Weight that one of 0 counts as.
_LEAST_WEIGHT = 1e-9
# Noise where nodes have left: by the length and the turn between the nodes that are left.
_NOISE = OdometryNoise()
GAP_ALONG, GAP_ACROSS, GAP_BY_WAY, GAP_BY_TURN, GAP_FLOOR = (
    _NOISE.sigma_distance**2, _NOISE.sigma_lateral**2, _NOISE.sigma_heading_distance**2,
    _NOISE.sigma_heading_turn**2, _NOISE.sigma_floor_position**2)


def integrated(motions: FloatArray) -> FloatArray:
    """Return poses from the motions between them, shape (N + 1, 3), the first at the origin."""
    heading = np.concatenate(([0.0], np.cumsum(motions[:, 2])))
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x, y = motions[:, 0], motions[:, 1]
    steps = np.column_stack((c * x - s * y, s * x + c * y))
    return np.column_stack((np.vstack((np.zeros(2), np.cumsum(steps, axis=0))),
                            se2.wrap(heading)))


class OdometryChain:
    """
    The hidden nodes of a graph, chained by the odometry edge that each was made with.

    An edge counts with the information that odometry claims, or `weighted` with its present
    weight. Where nodes have left the graph before the chain was begun, their odometry is not known
    any more: the chain goes on with where the next node is by the graph, and the noise of default
    odometry.
    """

    def __init__(self, *, weighted: bool = False) -> None:
        self._weighted = weighted
        self._nodes = GrowingArray((), np.int64)
        self._poses = GrowingArray((3,), np.float64)
        self._sums = GrowingArray((6,), np.float64)
        self._travel = GrowingArray((), np.float64)
        self._next_edge = 0  # id of the first edge that was not looked at
        # number of nodes that were forgotten since the poses were made relative to the first
        self._n_gone = 0

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def nodes(self) -> IntArray:
        return self._nodes.values

    @property
    def poses(self) -> FloatArray:
        """Their poses by odometry, in the first one, shape (M, 3)."""
        return self._poses.values

    @property
    def sums(self) -> FloatArray:
        """Upper triangles of the summed covariances of the edges up to them, shape (M, 6)."""
        return self._sums.values

    def extend(self, graph: Graph) -> None:
        """Append the nodes that were added to the graph since; the work is linear in these."""
        if len(self) == 0:
            first = _first(graph)
            if len(first) == 0:
                return
            self._nodes.append(graph.node_ids[first])
            self._poses.append(np.zeros((1, 3)))
            self._sums.append(np.zeros((1, 6)))
            self._travel.append(np.zeros(1))
        head, begin = graph.memory.head, int(np.searchsorted(graph.factor_ids, self._next_edge))
        self._next_edge = graph.next_ids.factor
        factors = graph.factor_records[begin:]
        last = len(self) - 1
        end = int(graph.node_rows(self._nodes.values[last]))
        later = factors['ends'][:, 1]
        new = np.flatnonzero((factors['kind'] == FactorKind.ODOMETRY) & (later > end))
        if len(new) == 0:
            return
        new = begin + new[np.argsort(later[new], kind='stable')]
        size = graph.n_nodes - end - 1
        rows, travel = np.empty(size, np.int64), np.empty(size)
        poses, sums = np.empty((size, 3)), np.empty((size, 6))
        newest = int(graph.node_rows(graph.newest_pose))
        for over_gaps in (False, True):
            n = _extend(head, new, end, self._poses.values[last], self._sums.values[last],
                        self._weighted, over_gaps, rows, poses, sums, travel)
            if (n > 0 and rows[n - 1] == newest) or not _has_left(graph):
                break
        self._nodes.append(graph.node_ids[rows[:n]])
        self._poses.append(poses[:n])
        self._sums.append(sums[:n])
        self._travel.append(self._travel.values[last] + travel[:n])

    def correct(
        self, before: OdometryErrors, after: OdometryErrors, stamps_ns: IntArray,
        by_odometry: BoolArray,
    ) -> None:
        """Follow edges that know of other errors now; `by_odometry` tells which steps do."""
        if len(self) < 2:
            return
        poses, sums = self._poses.values, full(self._sums.values)
        seconds = np.asarray(np.diff(stamps_ns) * 1e-9, dtype=np.float64)
        motions = se2.between(poses[:-1], poses[1:])
        back = se2.adjoint(se2.inverse(poses[1:]))
        noises = back @ np.diff(sums, axis=0) @ np.swapaxes(back, 1, 2)
        motions = np.where(by_odometry[:, None], after.motions(
            before.as_odometry_says(motions, seconds), seconds), motions)
        noises = np.where(by_odometry[:, None, None], after.covariances(
            before.inverse_noise.covariances(noises)), noises)
        moved = se2.compose(poses[:1], integrated(motions))
        forth = se2.adjoint(moved[1:])
        steps = forth @ noises @ np.swapaxes(forth, 1, 2)
        length = np.hypot(motions[:, 0], motions[:, 1])
        self._poses.values[:] = moved
        self._sums.values[1:] = upper(sums[:1] + np.cumsum(steps, axis=0))
        self._travel.values[1:] = self._travel.values[0] + np.cumsum(length)

    def forget(self, nodes: IntArray) -> None:
        """Forget nodes that have left the graph; the motion between all others stays known."""
        gone = np.isin(self._nodes.values, nodes)
        n = int(np.count_nonzero(gone))
        if n == 0:
            return
        for column in (self._nodes, self._poses, self._sums, self._travel):
            if np.all(gone[:n]):
                column.drop_first(n)
            else:
                column.select(np.flatnonzero(~gone))
        self._n_gone += n
        if self._n_gone > len(self):
            self._begin_anew()

    def _begin_anew(self) -> None:
        """Make poses and sums those in the first node, as they lose digits far away from it."""
        self._n_gone = 0
        if len(self) == 0:
            self._next_edge = 0
            return
        first, sums = self._poses.values[:1].copy(), self._sums.values
        adjoint = se2.adjoint(se2.inverse(first))
        self._poses.values[:] = se2.between(first, self._poses.values)
        self._sums.values[:] = upper(
            adjoint @ full(sums - sums[0]) @ np.swapaxes(adjoint, 1, 2))

    @property
    def travelled(self) -> FloatArray:
        return self._travel.values

    def travel(self, nodes: IntArray) -> FloatArray:
        return np.asarray(self._travel.values[self.places(nodes)])

    def between(self, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the poses of nodes j in i by odometry, and their covariances, in j."""
        at_i, at_j = self.places(i), self.places(j)
        for at in (at_i, at_j):
            if np.any(at < 0):
                raise KeyError('expected nodes that are chained by odometry')
        ahead = np.sign(at_j - at_i)[:, None]
        adjoint = se2.adjoint(se2.inverse(self._poses.values[at_j]))
        total = full(ahead * (self._sums.values[at_j] - self._sums.values[at_i]))
        return (se2.between(self._poses.values[at_i], self._poses.values[at_j]),
                adjoint @ total @ np.swapaxes(adjoint, 1, 2))

    def places(self, nodes: IntArray) -> IntArray:
        """Return the places of nodes in the chain, -1 for those that are not in it."""
        own = self._nodes.values
        if len(own) == 0:
            return np.full(len(nodes), -1)
        at = np.minimum(np.searchsorted(own, nodes), len(own) - 1)
        return np.where(own[at] == nodes, at, -1)


def _first(graph: Graph) -> IntArray:
    """Return the row of the pose that odometry begins at, shape (1,), or (0,) without poses."""
    factors = graph.factor_records
    ends = factors['ends'][factors['kind'] == FactorKind.ODOMETRY]
    if len(ends) == 0 or _has_left(graph):
        return np.flatnonzero(graph.is_pose)[:1]
    return ends[np.argmin(ends[:, 1]), :1].copy()


def _has_left(graph: Graph) -> bool:
    return graph.n_priors > 0 or bool(np.any(
        graph.factor_records['kind'] == FactorKind.PRIOR))


@kernel(signature=(
    tb.HEAD, INTEGERS, INTEGER, NUMBERS, NUMBERS, FLAG, FLAG, INTEGERS, ROWS, ROWS, NUMBERS),
    allocates=True)
def _extend(  # type: ignore[no-untyped-def]
    head, edges, last, pose, before, weighted, over_gaps, rows, poses, sums, travel,
):
    """
    Return the number of nodes that were appended to a chain.

    Edges are the rows of odometry, by their later ends; `last`, `pose` and `before` are row, pose
    and prefix sum of the last node. With `over_gaps` a pose without odometry is appended as well.
    Rows, poses, sums, and travel since the last node are written.
    """
    factors, nodes = tb.factors(head), tb.nodes(head)
    n, m, length = 0, 0, 0.0
    x, y, th = pose[0], pose[1], pose[2]
    noise = np.empty(6)
    for v in range(last + 1, head[tb.N_NODES]):
        if nodes[v].kind != NodeKind.POSE:
            continue
        edge = -1
        while m < len(edges) and factors[edges[m]].ends[1] <= v:
            # others are of another source, between nodes that are chained already
            ends = factors[edges[m]].ends
            if edge < 0 and ends[0] == last and ends[1] == v:
                edge = edges[m]
            m += 1
        if edge >= 0:
            f = factors[edge]
            step = f.mean[0], f.mean[1], f.mean[2]
            if f.ends[2] >= 0:
                step = motion(nodes, f)
            noise[:] = _inverse(f.information)
            if weighted:
                noise /= max(f.weight, _LEAST_WEIGHT)
        elif over_gaps:
            step = composed(inverted(_pose(head, last)), _pose(head, v))
            far = math.sqrt(step[0] * step[0] + step[1] * step[1])
            noise[:] = 0.0
            noise[0] = GAP_ALONG * far + GAP_FLOOR
            noise[3] = GAP_ACROSS * far + GAP_FLOOR
            noise[5] = GAP_BY_WAY * far + GAP_BY_TURN * abs(step[2]) + GAP_FLOOR
        else:
            continue
        last = v
        x, y, th = composed((x, y, th), step)
        length += math.sqrt(step[0] * step[0] + step[1] * step[1])
        rows[n], travel[n] = last, length
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, th
        xx, xy, xt, yy, yt, tt = noise
        # Ad Q Ad^T: rotated, then with the arm (y, -x) of the heading
        c, s = math.cos(th), math.sin(th)
        xt, yt = c * xt - s * yt, s * xt + c * yt
        xx, xy, yy = (c * c * xx - 2.0 * c * s * xy + s * s * yy,
                      c * s * (xx - yy) + (c * c - s * s) * xy,
                      s * s * xx + 2.0 * c * s * xy + c * c * yy)
        into = sums[n]
        into[0] = before[0] + xx + 2.0 * y * xt + y * y * tt
        into[1] = before[1] + xy - x * xt + y * yt - x * y * tt
        into[2] = before[2] + xt + y * tt
        into[3] = before[3] + yy - 2.0 * x * yt + x * x * tt
        into[4] = before[4] + yt - x * tt
        into[5] = before[5] + tt
        before = into
        n += 1
    return n


@kernel
def _pose(head, v):  # type: ignore[no-untyped-def]
    pose = tb.nodes(head)[v].pose
    return pose[0], pose[1], pose[2]


@kernel
def inverted(a):  # type: ignore[no-untyped-def]
    """Return the inverse of a pose, as tuples of numbers."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


@kernel
def _inverse(m):  # type: ignore[no-untyped-def]
    """Return the upper triangle of the inverse of a symmetric matrix, given as its own."""
    a, b, c, d, e, f = m[0], m[1], m[2], m[3], m[4], m[5]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    return (scale * aa, scale * bb, scale * cc, scale * (a * f - c * c),
            scale * (b * c - a * e), scale * (a * d - b * b))


@kernel
def composed(a, b):  # type: ignore[no-untyped-def]
    """Return the composition of two poses, as tuples of numbers."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrap(a[2] + b[2])
