# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hidden nodes that have left the graph while older ones stay, as there are others beside them."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.saved_columns import Integers, Rows3, Rows6


class Place(NamedTuple):
    """Where a node is relative to another one."""

    anchor: int
    """Number of the node that stands for it."""
    mean: FloatArray
    """Pose in the anchor, shape (3,) [m, m, rad]."""
    noise: FloatArray
    """Covariance of that pose, in the frame of the node, shape (3, 3)."""


@dataclass(frozen=True, slots=True)
class SavedThinned:
    """Saved nodes that have left although older ones stay."""

    numbers: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Numbers of the nodes, ascending, shape (T,)."""
    anchors: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Numbers of the nodes that stand for them, shape (T,)."""
    relative: Rows3 = field(default_factory=lambda: np.empty((0, 3)))
    """Poses in the anchors, shape (T, 3) [m, m, rad]."""
    noise: Rows6 = field(default_factory=lambda: np.empty((0, 6)))
    """Upper triangles of the covariances of these, in the frames of the nodes, shape (T, 6)."""


class ThinnedNodes:
    """
    Nodes by number, each with its place relative to a node that is in the graph.

    The poses of these nodes move with the graph, and what concerns them later is attached to their
    anchors. A node takes 64 bytes.
    """

    def __init__(self) -> None:
        self.numbers: IntArray = np.empty(0, dtype=np.int64)
        """Of the nodes, ascending, shape (T,)."""
        self.anchors: IntArray = np.empty(0, dtype=np.int64)
        """Of their anchors, shape (T,)."""
        self.relative: FloatArray = np.empty((0, 3))
        """Poses in the anchors, shape (T, 3) [m, m, rad]."""
        self.noise: npt.NDArray[np.float32] = np.empty((0, 6), dtype=np.float32)
        """Upper triangles of the covariances, in the frames of the nodes, shape (T, 6)."""

    def __len__(self) -> int:
        return len(self.numbers)

    def add(
        self, numbers: IntArray, anchors: IntArray, relative: FloatArray, noise: FloatArray,
    ) -> None:
        """
        Add nodes, and pass on to their anchors those that were attached to them.

        Parameters
        ----------
        numbers, anchors : ndarray of int, shape (L,); no anchor is among the numbers
        relative : ndarray, shape (L, 3), poses in the anchors [m, m, rad]
        noise : ndarray, shape (L, 3, 3), covariances, in the frames of the nodes

        """
        order = np.argsort(numbers)
        numbers, anchors = numbers[order], anchors[order]
        relative, noise = relative[order], noise[order]
        moved = np.flatnonzero(np.isin(self.anchors, numbers))
        by = np.searchsorted(numbers, self.anchors[moved])
        adjoint = se2.adjoint(se2.inverse(self.relative[moved]))
        passed = adjoint @ noise[by] @ np.swapaxes(adjoint, 1, 2) + _full(self.noise[moved])
        self.relative[moved] = se2.compose(relative[by], self.relative[moved])
        self.noise[moved], self.anchors[moved] = _upper(passed), anchors[by]
        at = np.searchsorted(self.numbers, numbers)
        self.numbers = np.insert(self.numbers, at, numbers)
        self.anchors = np.insert(self.anchors, at, anchors)
        self.relative = np.insert(self.relative, at, relative, axis=0)
        self.noise = np.insert(self.noise, at, _upper(noise), axis=0)

    def place(self, number: int) -> Place | None:
        """Return the place of a node; None if it is not among these."""
        at = int(np.searchsorted(self.numbers, number))
        if at == len(self) or self.numbers[at] != number:
            return None
        return Place(int(self.anchors[at]), self.relative[at].copy(),
                     _full(self.noise[at:at + 1])[0])

    def drop_before(self, number: int) -> None:
        """
        Drop the nodes before a number, whose poses are frozen with those of the oldest nodes.

        The anchors of the others must not be before it.
        """
        begin = int(np.searchsorted(self.numbers, number))
        self.numbers = self.numbers[begin:].copy()
        self.anchors = self.anchors[begin:].copy()
        self.relative = self.relative[begin:].copy()
        self.noise = self.noise[begin:].copy()

    def saved(self) -> SavedThinned:
        """Return copies of all columns."""
        return SavedThinned(self.numbers.copy(), self.anchors.copy(), self.relative.copy(),
                            self.noise.astype(np.float64))

    def restore(self, saved: SavedThinned) -> None:
        """Set all columns to saved ones."""
        self.numbers, self.anchors = saved.numbers.copy(), saved.anchors.copy()
        self.relative, self.noise = saved.relative.copy(), saved.noise.astype(np.float32)


def _upper(matrices: FloatArray) -> npt.NDArray[np.float32]:
    return matrices[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)].astype(np.float32)


def _full(triangles: npt.NDArray[np.float32]) -> FloatArray:
    return np.asarray(
        triangles[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(-1, 3, 3), dtype=np.float64)
