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
from pose_graph_ros.core.compiled.jit import FLAG, INTEGER, INTEGERS, kernel, ROWS
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


def moved(covariances: FloatArray, motions: FloatArray) -> FloatArray:
    """Return covariances of poses, given in frames that motions lead to, where these begin."""
    adjoint = se2.adjoint(motions)
    return np.asarray(adjoint @ covariances @ np.swapaxes(adjoint, -1, -2))


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
            # the pose that odometry begins at
            first = np.flatnonzero(graph.is_pose)[:1]
            if len(first) == 0:
                return
            ends = graph.factor_records['ends'][
                graph.factor_records['kind'] == FactorKind.ODOMETRY]
            if len(ends) > 0 and not _has_left(graph):
                first = ends[np.argmin(ends[:, 1]), :1]
            self._nodes.append(graph.node_ids[first])
            self._poses.append(np.zeros((1, 3)))
            self._sums.append(np.zeros((1, 6)))
            self._travel.append(np.zeros(1))
        begin = graph.first_factor_from(self._next_edge)
        self._next_edge = graph.next_ids.factor
        factors = graph.factor_records[begin:]
        last = len(self) - 1
        end = int(graph.node_rows(self._nodes.values[last]))
        later = factors['ends'][:, 1]
        new = np.flatnonzero((factors['kind'] == FactorKind.ODOMETRY) & (later > end))
        if len(new) == 0:
            return
        new = begin + new[np.argsort(later[new], kind='stable')]
        size, rows = graph.n_nodes - end, np.empty(graph.n_nodes - end, np.int64)
        poses, sums = np.empty((size, 3)), np.empty((size, 6))
        poses[0], sums[0] = self.poses[last], self.sums[last]
        newest = int(graph.node_rows(graph.newest_pose))
        for over_gaps in (False, True):
            n = _extend(graph.memory.head, new, end, self._weighted, over_gaps, rows, poses, sums)
            if (n > 0 and rows[n - 1] == newest) or not _has_left(graph):
                break
        self._nodes.append(graph.node_ids[rows[:n]])
        self._poses.append(poses[1:n + 1])
        self._sums.append(sums[1:n + 1])
        self._travel.append(self._travel.values[last] + _lengths(poses[:n + 1]))

    def correct(self, before: OdometryErrors, after: OdometryErrors, stamps_ns: IntArray,
                by_odometry: BoolArray) -> None:
        """Follow edges that know of other errors now; `by_odometry` tells which steps do."""
        if len(self) < 2:
            return
        poses, sums = self._poses.values, full(self._sums.values)
        seconds = np.asarray(np.diff(stamps_ns) * 1e-9, dtype=np.float64)
        motions = se2.between(poses[:-1], poses[1:])
        noises = moved(np.diff(sums, axis=0), se2.inverse(poses[1:]))
        motions = np.where(by_odometry[:, None], after.motions(
            before.as_odometry_says(motions, seconds), seconds), motions)
        noises = np.where(by_odometry[:, None, None], after.covariances(
            before.inverse_noise.covariances(noises)), noises)
        poses = se2.composed(poses[0], motions)
        steps = moved(noises, poses[1:])
        self._poses.values[:] = poses
        self._sums.values[1:] = upper(sums[:1] + np.cumsum(steps, axis=0))
        self._travel.values[1:] = self._travel.values[0] + _lengths(poses)

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
        if self._n_gone <= len(self):
            return
        # poses and sums become those in the first node, as they lose digits far away from it
        self._n_gone = 0
        if len(self) == 0:
            self._next_edge = 0
            return
        first, sums = self._poses.values[:1].copy(), self._sums.values
        self._poses.values[:] = se2.between(first, self._poses.values)
        self._sums.values[:] = upper(moved(full(sums - sums[0]), se2.inverse(first)))

    def travel(self, nodes: IntArray) -> FloatArray:
        return np.asarray(self._travel.values[self.places(nodes)])

    def between(self, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the poses of nodes j in i by odometry, and their covariances, in j."""
        at_i, at_j = self.places(i), self.places(j)
        for at in (at_i, at_j):
            if np.any(at < 0):
                raise KeyError('expected nodes that are chained by odometry')
        ahead = np.sign(at_j - at_i)[:, None]
        total = full(ahead * (self.sums[at_j] - self.sums[at_i]))
        return (se2.between(self.poses[at_i], self.poses[at_j]),
                moved(total, se2.inverse(self.poses[at_j])))

    def places(self, nodes: IntArray) -> IntArray:
        """Return the places of nodes in the chain, -1 for those that are not in it."""
        own = self._nodes.values
        if len(own) == 0:
            return np.full(len(nodes), -1)
        at = np.minimum(np.searchsorted(own, nodes), len(own) - 1)
        return np.where(own[at] == nodes, at, -1)


def _lengths(poses: FloatArray) -> FloatArray:
    """Return the way from the first of some poses to each of the others."""
    return np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))


def _has_left(graph: Graph) -> bool:
    return graph.n_priors > 0 or bool(np.any(graph.factor_records['kind'] == FactorKind.PRIOR))


@kernel(signature=(tb.HEAD, INTEGERS, INTEGER, FLAG, FLAG, INTEGERS, ROWS, ROWS))
def _extend(  # type: ignore[no-untyped-def]
    head, edges, last, weighted, over_gaps, rows, poses, sums,
):
    """
    Write rows, poses and prefix sums of nodes behind the last of a chain; return how many.

    Edges are the rows of odometry, by their later ends; `last` is the row of the last node, the
    first pose and sum are its own. With `over_gaps` a pose without odometry is appended as well.
    """
    factors, nodes = tb.factors(head), tb.nodes(head)
    n, m = 0, 0
    c, s = math.cos(poses[0, 2]), math.sin(poses[0, 2])     # of the newest heading
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
            dx, dy, turn = f.mean[0], f.mean[1], f.mean[2]
            if f.ends[2] >= 0:
                dx, dy, turn = motion(nodes, f)
            # the inverse of the information
            i = f.information
            xx, xy, xt = (i[3] * i[5] - i[4] * i[4], i[2] * i[4] - i[1] * i[5],
                          i[1] * i[4] - i[2] * i[3])
            yy, yt, tt = (i[0] * i[5] - i[2] * i[2], i[1] * i[2] - i[0] * i[4],
                          i[0] * i[3] - i[1] * i[1])
            scale = 1.0 / (i[0] * xx + i[1] * xy + i[2] * xt)
            if weighted:
                scale /= max(f.weight, _LEAST_WEIGHT)
            xx, xy, xt, yy, yt, tt = (
                scale * xx, scale * xy, scale * xt, scale * yy, scale * yt, scale * tt)
        elif over_gaps:
            one, other = nodes[last].pose, nodes[v].pose
            a, b = math.cos(one[2]), math.sin(one[2])
            far_x, far_y, turn = other[0] - one[0], other[1] - one[1], wrap(other[2] - one[2])
            dx, dy = a * far_x + b * far_y, a * far_y - b * far_x
            far = math.sqrt(dx * dx + dy * dy)
            xy = xt = yt = 0.0
            xx, yy = GAP_ALONG * far + GAP_FLOOR, GAP_ACROSS * far + GAP_FLOOR
            tt = GAP_BY_WAY * far + GAP_BY_TURN * abs(turn) + GAP_FLOOR
        else:
            continue
        last, before, into = v, sums[n], sums[n + 1]
        x, y = poses[n, 0] + c * dx - s * dy, poses[n, 1] + s * dx + c * dy
        th = wrap(poses[n, 2] + turn)
        rows[n], n = v, n + 1
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, th
        # Ad Q Ad^T: rotated, then with the arm (y, -x) of the heading
        c, s = math.cos(th), math.sin(th)
        xt, yt = c * xt - s * yt, s * xt + c * yt
        xx, xy, yy = (c * c * xx - 2.0 * c * s * xy + s * s * yy,
                      c * s * (xx - yy) + (c * c - s * s) * xy,
                      s * s * xx + 2.0 * c * s * xy + c * c * yy)
        into[0] = before[0] + xx + 2.0 * y * xt + y * y * tt
        into[1] = before[1] + xy - x * xt + y * yt - x * y * tt
        into[2] = before[2] + xt + y * tt
        into[3] = before[3] + yy - 2.0 * x * yt + x * x * tt
        into[4] = before[4] + yt - x * tt
        into[5] = before[5] + tt
    return n
