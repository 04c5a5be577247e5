# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The positions of a source that have left the graph, with the motion by odometry between them.

The statistics of its errors are estimated from these as well, as a window may be shorter than the
time in which errors change. Their number is bounded: every second one is dropped when there are
too many, and the motions on both sides of it are joined.
"""

from dataclasses import dataclass, field

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import full, upper
from pose_graph_ros.core.saved_columns import Integers, Numbers, Rows2, Rows3, Rows6
from pose_graph_ros.core.sources.error_likelihood import MeasuredPath

# Number of positions that are left when some are dropped.
KEPT = 1000

_Motions = tuple[FloatArray, ...]   # with `noise`, `way` and `lever`


@dataclass(frozen=True, slots=True)
class PastPath:
    """K positions in the order of their stamps; for the columns see `MeasuredPath`."""

    stamps_ns: Integers
    position: Rows2
    variance: Numbers
    offset: Rows2
    motion: Rows3
    """Shape (K + 1, 3); the last one leads to `node`."""
    noise: Rows6
    """Upper triangles of the covariances of the motions, shape (K + 1, 6)."""
    node: int
    """Id of the first node that is left in the graph."""
    way: Rows3 = field(default_factory=lambda: np.empty((0, 3)))
    """Their parts by the way, shape (K + 1, 3); empty in files of older versions."""
    lever: Rows3 = field(default_factory=lambda: np.empty((0, 3)))
    """How a higher yaw rate changes them, shape (K + 1, 3); empty in files of older versions."""

    def continued(self, stamps_ns: IntArray, path: MeasuredPath) -> MeasuredPath:
        """
        Return the path with these positions before those that are in the graph.

        Parameters
        ----------
        stamps_ns : ndarray of int, shape (M,)
        path : MeasuredPath, whose first motion leads from `node` to the first position

        """
        motion, noise, way, lever = _with_next(self, path)
        stamps_ns = np.maximum.accumulate(np.concatenate((self.stamps_ns, stamps_ns)))
        seconds = np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9, dtype=np.float64)
        return MeasuredPath(
            seconds, np.concatenate((self.position, path.position)),
            np.concatenate((self.variance, path.variance)),
            np.concatenate((self.offset, path.offset)), motion, np.ascontiguousarray(noise), way,
            lever, np.concatenate((
                np.zeros((len(motion) - len(path.taken_out), 2)), path.taken_out)))

    def extended(
        self, stamps_ns: IntArray, path: MeasuredPath, node: int,
    ) -> 'PastPath':
        """
        Return these positions with further ones.

        Parameters
        ----------
        stamps_ns : ndarray of int, shape (M,)
        path : MeasuredPath, with one more motion, to `node`; the first leads from the present one
        node : int, id of the first node that is left then

        """
        motion, noise, way, lever = _with_next(self, path)
        grown = PastPath(
            np.concatenate((self.stamps_ns, stamps_ns)),
            np.concatenate((self.position, path.position)),
            np.concatenate((self.variance, path.variance)),
            np.concatenate((self.offset, path.offset)), motion, upper(noise), node, way, lever)
        return grown.thinned() if len(grown.stamps_ns) > 2 * KEPT else grown

    def thinned(self) -> 'PastPath':
        """Return every second position."""
        n = len(self.stamps_ns) // 2 * 2
        first, second = self.motion[:n:2], self.motion[1:n:2]
        noises = full(self.noise)
        joined, noise, way, lever = _joined(
            (first, noises[:n:2], self.way[:n:2], self.lever[:n:2]),
            (second, noises[1:n:2], self.way[1:n:2], self.lever[1:n:2]))
        rest, kept = slice(n, None), slice(1, n, 2)
        every = np.arange(len(self.stamps_ns))
        which = np.append(every[kept], every[rest])
        return PastPath(
            self.stamps_ns[which], self.position[which], self.variance[which],
            self.offset[which], np.concatenate((joined, self.motion[rest])),
            upper(np.concatenate((noise, noises[rest]))), self.node,
            np.concatenate((way, self.way[rest])), np.concatenate((lever, self.lever[rest])))


def no_past(node: int) -> PastPath:
    """Return a path without positions before a node, given by its id."""
    return PastPath(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty((0, 2)),
                    np.zeros((1, 3)), np.zeros((1, 6)), node, np.zeros((1, 3)), np.zeros((1, 3)))


def _with_next(past: PastPath, path: MeasuredPath) -> _Motions:
    """Return the motions of a path, the last of which is joined with the first of others."""
    last = past.motion, full(past.noise), past.way, past.lever
    if len(path.motion) == 0:
        return tuple(column[:-1] for column in last)
    new = path.motion, path.noise, path.way, path.lever
    joined = _joined(tuple(column[-1:] for column in last), tuple(column[:1] for column in new))
    return tuple(np.concatenate((one[:-1], both, other[1:]))
                 for one, both, other in zip(last, joined, new, strict=True))


def _joined(first: _Motions, second: _Motions) -> _Motions:
    """Return motions one after the other, and their covariances in the frames at their ends."""
    adjoint = se2.adjoint(se2.inverse(second[0]))
    turned = np.swapaxes(adjoint, 1, 2)
    way = adjoint[:, :2, :2] @ first[2][:, [[0, 1], [1, 2]]] @ turned[:, :2, :2]
    c, s = np.cos(first[0][:, 2]), np.sin(first[0][:, 2])
    # the second motion and its lever in the frame that the first one begins in
    x, y = (c * second[0][:, 0] - s * second[0][:, 1], s * second[0][:, 0] + c * second[0][:, 1])
    by_x, by_y, time = second[3].T
    lever = first[3] + np.column_stack((
        c * by_x - s * by_y - y * first[3][:, 2], s * by_x + c * by_y + x * first[3][:, 2], time))
    return (np.asarray(se2.compose(first[0], second[0])),
            adjoint @ first[1] @ turned + second[1],
            way[:, [0, 0, 1], [0, 1, 1]] + second[2], lever)
