# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Iteratively reweighted least squares over the constraints of sources with a robust loss.

Between two updates the weights of the newest constraints are set anew, and those of some older
ones in turn, so that the work does not grow with the graph. A full optimisation sets all of them,
again and again, from a start that does not depend on what was before.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np

from pose_graph_ros.core import linearize, robust
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.graph import Graph
from pose_graph_ros.core.saved_columns import Integers, Numbers
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import Loss

# So many of the newest constraints are weighed at each update, and as many of the others.
WINDOW = 200
# A smaller change of a weight is left for later, between updates.
LEAST_CHANGE = 0.005

_LOSSES = tuple(Loss)


@dataclass(frozen=True, slots=True)
class SavedLosses:
    """Constraints of one table that have a robust loss."""

    rows: Integers
    losses: Integers
    """0 none, 1 Huber, 2 Cauchy."""
    thresholds: Numbers
    shares: Numbers
    cursor: int


@dataclass
class _Rows:
    """Constraints of one table that have a loss."""

    rows: GrowingArray = field(default_factory=lambda: GrowingArray((), np.int64))
    losses: GrowingArray = field(default_factory=lambda: GrowingArray((2,), np.float64))
    """Index of the loss, and its threshold."""
    shares: GrowingArray = field(default_factory=lambda: GrowingArray((), np.float64))
    """What they weigh without the loss."""
    cursor: int = 0

    @property
    def numbers(self) -> IntArray:
        """Their numbers in the graph."""
        return cast('IntArray', self.rows.values)

    def add(self, row: int, loss: Loss, threshold: float) -> None:
        self.rows.append_one(row)
        self.losses.append_one((_LOSSES.index(loss), threshold))
        self.shares.append_one(1.0)

    def share(self, row: int, share: float) -> None:
        at = int(np.searchsorted(self.numbers, row))
        if at < len(self.rows) and self.numbers[at] == row:
            self.shares.values[at] = share

    def alike(self, weight: float) -> Mapping[int, float]:
        shares = cast('FloatArray', self.shares.values)
        return dict(zip(self.numbers.tolist(), (weight * shares).tolist(), strict=True))

    def saved(self) -> SavedLosses:
        losses = cast('FloatArray', self.losses.values)
        return SavedLosses(
            self.numbers.copy(), losses[:, 0].astype(np.int64), losses[:, 1].copy(),
            cast('FloatArray', self.shares.values).copy(), self.cursor)

    def restore(self, saved: SavedLosses) -> None:
        self.rows.append(saved.rows)
        self.losses.append(np.column_stack((saved.losses, saved.thresholds)))
        self.shares.append(saved.shares)
        self.cursor = saved.cursor

    def some(self) -> IntArray:
        """Return the newest ones, and others in turn, as indices."""
        size = len(self.rows)
        begin = max(size - WINDOW, 0)
        if begin == 0:
            return np.arange(size)
        older = (self.cursor + np.arange(min(WINDOW, begin))) % begin
        self.cursor = int(older[-1] + 1) % begin
        return np.concatenate((older, np.arange(begin, size)))


class Reweighing:
    """The weights of constraints with a robust loss."""

    def __init__(self) -> None:
        self._edges, self._observed = _Rows(), _Rows()

    def __len__(self) -> int:
        return len(self._edges.rows) + len(self._observed.rows)

    def add_edge(self, row: int, loss: Loss, threshold: float) -> None:
        """Take an edge, by its row in the graph; one without a loss is of no concern."""
        if loss is not Loss.NONE:
            self._edges.add(row, loss, threshold)

    def add_observed(self, row: int, loss: Loss, threshold: float) -> None:
        """Take an observed node, likewise."""
        if loss is not Loss.NONE:
            self._observed.add(row, loss, threshold)

    def share(self, row: int, share: float) -> None:
        """Let an observed node weigh so much without its loss; by its row, if it was added."""
        self._observed.share(row, share)

    def saved(self) -> tuple[SavedLosses, SavedLosses]:
        """Return the edges and the observed nodes that have a loss."""
        return self._edges.saved(), self._observed.saved()

    def restore(self, edges: SavedLosses, observed: SavedLosses) -> None:
        """Take what `saved` has returned, where there is nothing yet."""
        self._edges.restore(edges)
        self._observed.restore(observed)

    def changes(self, graph: Graph) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """Return new weights of edges and of observed nodes, of a bounded number of them."""
        return (self._changed(graph, self._edges, self._edges.some(), LEAST_CHANGE, edges=True),
                self._changed(graph, self._observed, self._observed.some(), LEAST_CHANGE,
                              edges=False))

    def all_changes(
        self, graph: Graph, widened: float = 1.0,
    ) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """Return all weights that are not exactly as they should be, by widened thresholds."""
        return tuple(  # type: ignore[return-value]
            self._changed(graph, table, np.arange(len(table.rows)), 0.0, edges=edges,
                          widened=widened)
            for table, edges in ((self._edges, True), (self._observed, False)))

    def all_alike(self, weight: float) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """Return the same weight, of what they have without losses; 1 is plain least squares."""
        return self._edges.alike(weight), self._observed.alike(weight)

    def cost(self, graph: Graph) -> float:
        """Return how much the robust costs lie above the weighted energies, in all."""
        total = 0.0
        for table, edges in ((self._edges, True), (self._observed, False)):
            index = np.arange(len(table.rows))
            if len(index) == 0:
                continue
            energy, weight = _energies(graph, table.numbers[index], edges=edges)
            shares = cast('FloatArray', table.shares.values)
            for loss, threshold, chosen in _groups(table, index):
                costs = robust.costs(loss, energy[chosen], threshold)
                total += float(np.sum(shares[chosen] * costs - weight[chosen] * energy[chosen]))
        return total

    def _changed(
        self, graph: Graph, table: _Rows, index: IntArray, least: float, *, edges: bool,
        widened: float = 1.0,
    ) -> Mapping[int, float]:
        if len(index) == 0:
            return {}
        rows = table.numbers[index]
        energy, weight = _energies(graph, rows, edges=edges)
        wanted = np.empty(len(index))
        for loss, threshold, chosen in _groups(table, index):
            wanted[chosen] = robust.weights(loss, energy[chosen], widened * threshold)
        wanted *= cast('FloatArray', table.shares.values)[index]
        changed = np.abs(wanted - weight) > least * np.minimum(wanted, weight)
        return dict(zip(rows[changed].tolist(), wanted[changed].tolist(), strict=True))


def _groups(
    table: _Rows, index: IntArray,
) -> list[tuple[Loss, float, IntArray]]:
    """Return each loss with its threshold and the positions in `index` that have it."""
    losses = table.losses.values[index]
    kinds, which = np.unique(losses, axis=0, return_inverse=True)
    return [(_LOSSES[int(kind)], float(threshold), np.flatnonzero(which.ravel() == k))
            for k, (kind, threshold) in enumerate(kinds)]


def _energies(graph: Graph, rows: IntArray, *, edges: bool) -> tuple[FloatArray, FloatArray]:
    """Return energies without weights, and the weights, shape (M,) each."""
    if edges:
        some = graph.edges_at(rows)
        return linearize.energies(
            linearize.edge_errors(graph.poses, some), some.information), some.weight
    seen = graph.observed_at(rows)
    return linearize.energies(
        linearize.observed_errors(graph.poses, seen), seen.information), seen.weight
