# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether two loop closures agree, by the odometry between their ends alone.

Closure a, from node i to node j, is predicted through closure b, from k to l, and the two chains
of odometry from i to k and from l to j (J. Mangelson et al., "Pairwise consistent measurement set
maximization", ICRA 2018). With T_n the pose of node n by odometry, `T_i^-1 T_k z_b T_l^-1 T_j` is
to be z_a.

The noise xi of an odometry edge to node n, in the frame of n, is the noise `Ad(T_n) xi` in the
frame that the chain begins in. There the noises of edges add up, so that two prefix sums give the
covariance of the chain between any two nodes, and edges that are in both chains are counted with
their correlation.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.compiled.jit import (
    FLAG,
    INTEGER,
    INTEGERS,
    kernel,
    MATRICES,
    NUMBERS,
    ROWS,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import factors, tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind, full, upper
from pose_graph_ros.core.graph.graph import Graph

# Weight that one of 0 counts as.
_LEAST_WEIGHT = 1e-9
# Relative difference of lengths that is rounding.
_TIE = 1e-9


class Closures(NamedTuple):
    """M loop closures as columns."""

    i: IntArray
    """Nodes that they start from, shape (M,)."""
    j: IntArray
    """Nodes that they lead to, shape (M,)."""
    mean: FloatArray
    """Measured poses of j in i, shape (M, 3) [m, m, rad]."""
    noise: FloatArray
    """Covariances in the frames of the measured poses, shape (M, 3, 3)."""


class OdometryChain:
    """
    The hidden nodes of a graph, chained by the odometry edge that each was made with.

    Parameters
    ----------
    weighted : bool
        Whether an edge counts with its present weight; by default it counts with the information
        that odometry claims.
    by_row : bool
        Whether nodes are given by row instead of by id, as long as none leaves the graph.

    """

    def __init__(self, *, weighted: bool = False, by_row: bool = False) -> None:
        self._weighted, self._by_row = weighted, by_row
        self._nodes = GrowingArray((), np.int64)
        self._poses = GrowingArray((3,), np.float64)
        self._sums = GrowingArray((6,), np.float64)
        self._travel = GrowingArray((), np.float64)
        self._next_edge = 0
        """Id of the first edge that was not looked at."""
        self._n_gone = 0
        """Number of nodes that were forgotten since the poses were made relative to the first."""
        self.noise_factor = 1.0
        """On the covariances of odometry."""

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def nodes(self) -> IntArray:
        """Ids of the nodes, in their order."""
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
            self._nodes.append(first if self._by_row else graph.node_ids[first])
            self._poses.append(np.zeros((1, 3)))
            self._sums.append(np.zeros((1, 6)))
            self._travel.append(np.zeros(1))
        head, begin = graph.memory.head, int(np.searchsorted(graph.edge_ids, self._next_edge))
        self._next_edge = graph.next_ids.edge
        ends = graph.memory['edge_i'][begin:graph.n_edges]
        last = len(self) - 1
        end = int(self._nodes.values[last])
        if not self._by_row:
            end = int(graph.node_rows(end))
        new = begin + np.flatnonzero((ends[:, tb.EDGE_KIND] == EdgeKind.ODOMETRY)
                                     & (ends[:, tb.END_J] > end))
        if len(new) == 0:
            return
        new = new[np.argsort(graph.memory['edge_i'][new, tb.END_J], kind='stable')]
        rows, travel = np.empty(len(new), np.int64), np.empty(len(new))
        poses, sums = np.empty((len(new), 3)), np.empty((len(new), 6))
        n = _extend(
            head, new, end, self._poses.values[last],
            self._sums.values[last], self._weighted, rows, poses, sums, travel)
        self._nodes.append(rows[:n] if self._by_row else graph.node_ids[rows[:n]])
        self._poses.append(poses[:n])
        self._sums.append(sums[:n])
        self._travel.append(self._travel.values[last] + travel[:n])

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

    def travel(self, nodes: IntArray) -> FloatArray:
        """Return the lengths of the path to nodes by odometry, shape (M,) [m]."""
        return np.asarray(self._travel.values[self._places(nodes)])

    def between(self, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray]:
        """
        Return the poses of nodes j in nodes i by odometry, and their covariances.

        Poses have the shape (M, 3) [m, m, rad], covariances the shape (M, 3, 3), in the frames of
        j. Raises KeyError if a node is not in the chain.

        Parameters
        ----------
        i, j : ndarray of int, shape (M,), ids, in any order

        """
        at_i, at_j = self._places(i), self._places(j)
        for at in (at_i, at_j):
            if np.any(at < 0):
                raise KeyError('expected nodes that are chained by odometry')
        ahead = np.sign(at_j - at_i)[:, None]
        adjoint = se2.adjoint(se2.inverse(self._poses.values[at_j]))
        total = full(ahead * (self._sums.values[at_j] - self._sums.values[at_i]))
        return (se2.between(self._poses.values[at_i], self._poses.values[at_j]),
                self.noise_factor * adjoint @ total @ np.swapaxes(adjoint, 1, 2))

    def squared_distances(
        self, closures: Closures, first: IntArray, second: IntArray,
    ) -> FloatArray:
        """
        Return the squared Mahalanobis distances of pairs of closures, shape (P,).

        The first of a pair is compared with its prediction through the second one, which may have
        been measured in the opposite direction: the shorter chains decide. The distance is
        infinite if a node is not chained by odometry.

        Parameters
        ----------
        closures : Closures
        first, second : ndarray of int, shape (P,), rows of `closures`

        """
        first, second = (np.ascontiguousarray(rows, np.int64) for rows in (first, second))
        places = [self._places(nodes[rows]) for rows in (first, second)
                  for nodes in (closures.i, closures.j)]
        out = np.empty(len(first))
        _squared_distances(
            self._poses.values, self._sums.values, self._travel.values, *places,
            np.ascontiguousarray(closures.mean), np.ascontiguousarray(closures.noise),
            first, second, out)
        return out

    def _places(self, nodes: IntArray) -> IntArray:
        """Return the places of nodes in the chain, -1 for those that are not in it."""
        own = self._nodes.values
        if len(own) == 0:
            return np.full(len(nodes), -1)
        at = np.minimum(np.searchsorted(own, nodes), len(own) - 1)
        return np.where(own[at] == nodes, at, -1)


def _first(graph: Graph) -> IntArray:
    """Return the row of the pose that odometry begins at, shape (1,), or (0,) without poses."""
    ends = graph.memory['edge_i'][:graph.n_edges]
    odometry = ends[ends[:, tb.EDGE_KIND] == EdgeKind.ODOMETRY]
    if len(odometry) == 0:
        return np.flatnonzero(graph.is_pose)[:1]
    # a node before it may have no odometry any more, as all nodes in between have left
    return odometry[np.argmin(odometry[:, tb.END_J])][[tb.END_I]].copy()


@kernel(signature=(
    tb.HEAD, INTEGERS, INTEGER, NUMBERS, NUMBERS, FLAG, INTEGERS, ROWS, ROWS, NUMBERS))
def _extend(  # type: ignore[no-untyped-def]
    head, edges, last, pose, before, weighted, rows, poses, sums, travel,
):
    """
    Return the number of nodes that were appended to a chain.

    Parameters
    ----------
    edges : ndarray of int, odometry edges by the rows of their ends
    last, pose, before : int, ndarray, ndarray, row, pose and prefix sum of the last node
    weighted : bool, whether to divide covariances by the weights of the edges
    rows, poses, sums, travel : ndarray, output; the travel from the last node

    """
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    n, length = 0, 0.0
    x, y, th = pose[0], pose[1], pose[2]
    for m in range(len(edges)):
        row, f = edge_i[edges[m]], edge_f[edges[m]]
        if row[tb.END_I] != last:
            continue    # of another source, between nodes that are chained already
        last = row[tb.END_J]
        x, y, th = _composed((x, y, th), (f[tb.MEAN], f[tb.MEAN + 1], f[tb.MEAN + 2]))
        length += math.sqrt(f[tb.MEAN] * f[tb.MEAN] + f[tb.MEAN + 1] * f[tb.MEAN + 1])
        rows[n], travel[n] = last, length
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, th
        xx, xy, xt, yy, yt, tt = _inverse(f[tb.INFO:tb.INFO + 6])
        if weighted:
            loose = 1.0 / max(f[tb.WEIGHT], _LEAST_WEIGHT)
            xx, xy, xt, yy, yt, tt = (
                loose * xx, loose * xy, loose * xt, loose * yy, loose * yt, loose * tt)
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
def _inverse(m):  # type: ignore[no-untyped-def]
    """Return the upper triangle of the inverse of a symmetric matrix, given as its own."""
    a, b, c, d, e, f = m[0], m[1], m[2], m[3], m[4], m[5]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    return (scale * aa, scale * bb, scale * cc, scale * (a * f - c * c),
            scale * (b * c - a * e), scale * (a * d - b * b))


@kernel
def _composed(a, b):  # type: ignore[no-untyped-def]
    """Return the composition of two poses, as tuples of numbers."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], factors.wrap(a[2] + b[2])


@kernel
def _inverted(a):  # type: ignore[no-untyped-def]
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


@kernel
def _set_adjoint(out, a):  # type: ignore[no-untyped-def]
    """Write Ad of a pose, as `se2.adjoint` does."""
    c, s = math.cos(a[2]), math.sin(a[2])
    out[0, 0], out[0, 1], out[0, 2] = c, -s, a[1]
    out[1, 0], out[1, 1], out[1, 2] = s, c, -a[0]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@kernel
def _add_product(out, factor, a, m, b):  # type: ignore[no-untyped-def]
    """Add `factor A M B^T` to a matrix; all have the shape (3, 3)."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for n in range(3):
                    total += a[i, k] * m[k, n] * b[j, n]
            out[i, j] += factor * total


@kernel
def _sum_between(sums, low, high, out):  # type: ignore[no-untyped-def]
    """Write the sum of the covariances of the edges between two places, from the prefix sums."""
    k = 0
    for i in range(3):
        for j in range(i, 3):
            out[i, j] = out[j, i] = sums[high, k] - sums[low, k]
            k += 1


@kernel
def _solved_form(m, e):  # type: ignore[no-untyped-def]
    """Return `e^T M^-1 e` of a positive definite matrix, shape (3, 3)."""
    a = m[0, 0]
    l1, l2 = m[1, 0] / a, m[2, 0] / a
    b = m[1, 1] - l1 * m[1, 0]
    c = m[2, 1] - l1 * m[2, 0]
    l3 = c / b
    d = m[2, 2] - l2 * m[2, 0] - l3 * c
    y = e[1] - l1 * e[0]
    z = e[2] - l2 * e[0] - l3 * y
    return e[0] * e[0] / a + y * y / b + z * z / d


@kernel(signature=(
    ROWS, ROWS, NUMBERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS, ROWS, MATRICES, INTEGERS,
    INTEGERS, NUMBERS), allocates=True)
def _squared_distances(  # type: ignore[no-untyped-def]
    poses, sums, travel, start_a, end_a, start_b, end_b, mean, noise, first, second, out,
):
    """
    Write the squared distances of pairs of closures.

    Parameters
    ----------
    poses, sums, travel : ndarray, of the chain
    start_a, end_a, start_b, end_b : ndarray of int, places of the ends of each pair
    mean, noise, first, second, out : ndarray, as in `OdometryChain.squared_distances`

    """
    work = np.empty((6, 3, 3))
    noise_b, adjoint = work[0], work[1]
    for p in range(len(out)):
        a, b = first[p], second[p]
        i, j, k, l = start_a[p], end_a[p], start_b[p], end_b[p]     # noqa: E741  as the formula
        if min(i, j, k, l) < 0:
            out[p] = np.inf
            continue
        z_a, z_b = (mean[a, 0], mean[a, 1], mean[a, 2]), (mean[b, 0], mean[b, 1], mean[b, 2])
        noise_b[:] = noise[b]
        straight = abs(travel[i] - travel[k]) + abs(travel[l] - travel[j])
        crossed = abs(travel[i] - travel[l]) + abs(travel[k] - travel[j])
        if crossed < (1.0 - _TIE) * straight:
            k, l = l, k     # noqa: E741
            _set_adjoint(adjoint, z_b)
            noise_b[:] = 0.0
            _add_product(noise_b, 1.0, adjoint, noise[b], adjoint)
            z_b = _inverted(z_b)
        out[p] = _squared_distance(poses, sums, (i, j, k, l), z_a, noise[a], z_b, work)


@kernel
def _squared_distance(  # type: ignore[no-untyped-def]
    poses, sums, places, z_a, noise_a, z_b, work,
):
    """
    Return the squared distance of closure a, from i to j, from its prediction through b, k to l.

    Parameters
    ----------
    poses, sums : ndarray, of the chain
    places : tuple of int, i, j, k and l in the chain
    z_a, z_b : tuple of float, measured poses
    noise_a : ndarray, shape (3, 3)
    work : ndarray, shape (6, 3, 3), the first with the noise of b, the others to be overwritten

    """
    noise_b, to_k, to_l, to_end, total, part = (
        work[0], work[1], work[2], work[3], work[4], work[5])
    i, j, k, l = places     # noqa: E741
    T_i, T_k = (poses[i, 0], poses[i, 1], poses[i, 2]), (poses[k, 0], poses[k, 1], poses[k, 2])
    T_l, T_j = (poses[l, 0], poses[l, 1], poses[l, 2]), (poses[j, 0], poses[j, 1], poses[j, 2])
    behind = _composed(_inverted(T_l), T_j)
    from_k = _composed(T_k, _composed(z_b, behind))
    predicted = _composed(_inverted(T_i), from_k)
    dx, dy = predicted[0] - z_a[0], predicted[1] - z_a[1]
    c, s = math.cos(z_a[2]), math.sin(z_a[2])
    error = (c * dx + s * dy, c * dy - s * dx, factors.wrap(predicted[2] - z_a[2]))
    # the noises of both chains and of b, in the frame at the end of the prediction
    _set_adjoint(to_k, _inverted(from_k))
    _set_adjoint(to_end, _inverted(behind))
    _set_adjoint(to_l, _inverted(T_j))
    total[:] = 0.0
    _add_product(total, 1.0, to_end, noise_b, to_end)
    _sum_between(sums, min(i, k), max(i, k), part)
    _add_product(total, 1.0, to_k, part, to_k)
    _sum_between(sums, min(l, j), max(l, j), part)
    _add_product(total, 1.0, to_l, part, to_l)
    low, high = max(min(i, k), min(l, j)), min(max(i, k), max(l, j))
    if low < high:
        # edges in both chains; one of them may be run through backwards
        same = 1.0 if (i < k) == (l < j) else -1.0
        _sum_between(sums, low, high, part)
        _add_product(total, same, to_k, part, to_l)
        _add_product(total, same, to_l, part, to_k)
    # turned to the axes of the error
    turn = to_k
    _set_adjoint(turn, (0.0, 0.0, error[2]))
    for m in range(3):
        for n in range(3):
            part[m, n] = noise_a[m, n]
    _add_product(part, 1.0, turn, total, turn)
    return _solved_form(part, error)
