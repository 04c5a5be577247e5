# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hidden nodes that have left the graph while older ones stay, as there are others beside them."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.growing_array import GrowingArray
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


class Places(NamedTuple):
    """Nodes by number, ascending, each with its place relative to one that is in the graph."""

    numbers: IntArray
    """Shape (T,)."""
    anchors: IntArray
    """Numbers of the nodes that stand for them, shape (T,)."""
    relative: npt.NDArray[np.float32]
    """Poses in the anchors, shape (T, 3) [m, m, rad]."""
    noise: npt.NDArray[np.float32]
    """Upper triangles of the covariances, in the frames of the nodes, shape (T, 6)."""


class ThinnedNodes:
    """
    Nodes by number, each with its place relative to another one, its anchor.

    The poses of these nodes move with the graph, and what concerns them later is attached to their
    anchors. If an anchor leaves as well, the nodes that were attached to it are passed on to its
    own anchor once all places are asked for, so that it costs the same to add a node however many
    have left. A node takes 40 bytes.
    """

    def __init__(self) -> None:
        # by number, from the first node that is not frozen on; -1 for nodes that are in the graph
        self._first, self._size = 0, 0
        self._anchors = GrowingArray((), np.int32)
        self._relative = GrowingArray((3,), np.float32)
        self._noise = GrowingArray((6,), np.float32)

    def __len__(self) -> int:
        return self._size

    def add(
        self, numbers: IntArray, anchors: IntArray, relative: FloatArray, noise: FloatArray,
    ) -> None:
        """
        Add nodes.

        Parameters
        ----------
        numbers, anchors : ndarray of int, shape (L,); no anchor is among the numbers
        relative : ndarray, shape (L, 3), poses in the anchors [m, m, rad]
        noise : ndarray, shape (L, 3, 3), covariances, in the frames of the nodes

        """
        if len(numbers) == 0:
            return
        rows = numbers - self._first
        more = int(np.max(rows)) + 1 - len(self._anchors)
        if more > 0:
            self._anchors.append(np.full(more, -1))
            self._relative.append(np.zeros((more, 3)))
            self._noise.append(np.zeros((more, 6)))
        self._anchors.values[rows] = anchors
        self._relative.values[rows], self._noise.values[rows] = relative, _upper(noise)
        self._size += len(rows)

    def place(self, number: int) -> Place | None:
        """Return the place of a node; None if it is not among these."""
        anchor = self._anchor(number)
        if anchor < 0:
            return None
        row = number - self._first
        mean = self._relative.values[row].astype(np.float64)
        noise = _full(self._noise.values[row:row + 1])[0]
        while (further := self._anchor(anchor)) >= 0:
            row = anchor - self._first
            noise = _passed_on(mean, _full(self._noise.values[row:row + 1])[0], noise)
            mean = se2.compose(self._relative.values[row].astype(np.float64), mean)
            anchor = further
        return Place(anchor, mean, noise)

    def _anchor(self, number: int) -> int:
        row = number - self._first
        return int(self._anchors.values[row]) if 0 <= row < len(self._anchors) else -1

    def places(self) -> Places:
        """Return the places of all nodes, relative to nodes that are in the graph."""
        anchors, relative, noise = (
            array.values for array in (self._anchors, self._relative, self._noise))
        rows = np.flatnonzero(anchors >= 0)
        passed = rows
        while len(passed) > 0:
            by = anchors[passed] - self._first
            further = np.zeros(len(passed), dtype=bool)
            inside = by < len(anchors)
            further[inside] = anchors[by[inside]] >= 0
            passed, by = passed[further], by[further]
            mean = relative[passed].astype(np.float64)
            noise[passed] = _upper(_passed_on(mean, _full(noise[by]), _full(noise[passed])))
            relative[passed] = se2.compose(relative[by].astype(np.float64), mean)
            anchors[passed] = anchors[by]
        return Places(rows + self._first, anchors[rows].astype(np.int64), relative[rows],
                      noise[rows])

    def drop_before(self, number: int) -> None:
        """
        Drop the nodes before a number, whose poses are frozen with those of the oldest nodes.

        The anchors of the others must not be before it.
        """
        self.places()
        n = min(number - self._first, len(self._anchors))
        self._size -= int(np.count_nonzero(self._anchors.values[:n] >= 0))
        for array in (self._anchors, self._relative, self._noise):
            array.drop_first(n)
        self._first = number

    def saved(self) -> SavedThinned:
        """Return copies of all columns."""
        places = self.places()
        return SavedThinned(places.numbers, places.anchors, places.relative.astype(np.float64),
                            places.noise.astype(np.float64))

    def restore(self, saved: SavedThinned, first: int) -> None:
        """
        Fill this empty object.

        Parameters
        ----------
        saved : SavedThinned
        first : int, number of the first node that is not frozen

        """
        self._first = first
        self.add(saved.numbers, saved.anchors, saved.relative, _full(saved.noise))


def _passed_on(mean: FloatArray, first: FloatArray, then: FloatArray) -> FloatArray:
    """
    Return the covariances of motions to some places and on from there, in the frames at the end.

    Parameters
    ----------
    mean : ndarray, shape (..., 3), the second motions [m, m, rad]
    first, then : ndarray, shape (..., 3, 3), in the frames at the ends of the motions

    """
    adjoint = se2.adjoint(se2.inverse(mean))
    return np.asarray(adjoint @ first @ np.swapaxes(adjoint, -1, -2) + then)


def _upper(matrices: FloatArray) -> npt.NDArray[np.float32]:
    return matrices[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)].astype(np.float32)


def _full(triangles: npt.NDArray[np.floating]) -> FloatArray:
    return np.asarray(
        triangles[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(-1, 3, 3), dtype=np.float64)
