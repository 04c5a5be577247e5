# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Iteratively reweighted least squares over the constraints of sources with a robust loss.

At each update the weights of the newest constraints and of some older ones in turn are computed
anew, so that the work does not grow with the graph. The final optimisation computes all of them
repeatedly, starting from weights that do not depend on earlier updates.

The *base weight* of a constraint is its weight without the loss: 1, or less where the errors of
several measurements are correlated.

The weights (see `losses`) depend on the estimate and the estimate on the weights, so both are
computed in turn.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.error_functions import energies
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.losses import costs_and_weights
from pose_graph_ros.core.saved_columns import Choices, Integers, Numbers

# Number of the newest constraints that are reweighted at each update; as many older ones are, too.
WINDOW = 200
# Smallest relative change of a weight that is applied at an update.
LEAST_CHANGE = 0.005
# The same of a refinement: number of constraints at a time, and smallest change.
PART, LEAST_REFINED = 2000, 1e-4

_LOSSES = tuple(Loss)


@dataclass(frozen=True, slots=True)
class SavedLosses:
    """Saved state of the constraints of one table that have a robust loss."""

    rows: Integers
    """Ids of the constraints."""
    losses: Annotated[IntArray, Choices(Loss)]
    thresholds: Numbers
    """[sigma]."""
    shares: Numbers
    """Base weights."""
    cursor: int
    """Index of the older constraint that is reweighted next."""


@dataclass
class _Rows:
    """Constraints of one table that have a robust loss, in the order in which they were added."""

    edges: bool
    """Whether they are edges; else they are observed nodes."""
    ids: GrowingArray = field(default_factory=lambda: GrowingArray((), np.int64))
    """Ids of the constraints, ascending."""
    losses: GrowingArray = field(default_factory=lambda: GrowingArray((2,), np.float64))
    """Index of the loss in `Loss`, and its threshold [sigma]."""
    base_weights: GrowingArray = field(default_factory=lambda: GrowingArray((), np.float64))
    cursor: int = 0

    def alike(self, weight: float) -> Mapping[int, float]:
        """Return the base weights times a weight, by id."""
        weights = weight * self.base_weights.values
        return dict(zip(self.ids.values.tolist(), weights.tolist(), strict=True))

    def saved(self) -> SavedLosses:
        losses = self.losses.values
        return SavedLosses(
            self.ids.values.copy(), losses[:, 0].astype(np.int64), losses[:, 1].copy(),
            self.base_weights.values.copy(), self.cursor)

    def restore(self, saved: SavedLosses) -> None:
        self.ids.append(saved.rows)
        self.losses.append(np.column_stack((saved.losses, saved.thresholds)))
        self.base_weights.append(saved.shares)
        self.cursor = saved.cursor

    def index(self, number: int) -> int:
        """Return the index of a constraint by its id, -1 if it was not added."""
        at = int(np.searchsorted(self.ids.values, number))
        return at if at < len(self.ids) and self.ids.values[at] == number else -1

    def forget(self, ids: IntArray) -> None:
        """Forget constraints that have left the graph."""
        gone = np.isin(self.ids.values, ids)
        if not np.any(gone):
            return
        self.cursor -= int(np.count_nonzero(gone[:self.cursor]))
        kept = np.flatnonzero(~gone)
        for column in (self.ids, self.losses, self.base_weights):
            column.select(kept)

    def some(self) -> IntArray:
        """Return the indices of the newest ones and, in turn, of some older ones."""
        size = len(self.ids)
        begin = max(size - WINDOW, 0)
        if begin == 0:
            return np.arange(size)
        older = (self.cursor + np.arange(min(WINDOW, begin))) % begin
        self.cursor = int(older[-1] + 1) % begin
        return np.concatenate((older, np.arange(begin, size)))

    def changes(
        self, graph: Graph, index: IntArray, *, least: float = 0.0, widened: float = 1.0,
    ) -> Mapping[int, float]:
        """Return the new weights of indexed constraints that change by more than `least`."""
        if len(index) == 0:
            return {}
        ids = self.ids.values[index]
        energy, weight = self.energies(graph, ids)
        wanted = np.empty(len(index))
        for loss, threshold, chosen in self.groups(index):
            _, wanted[chosen] = costs_and_weights(loss, energy[chosen], widened * threshold)
        wanted *= self.base_weights.values[index]
        changed = np.abs(wanted - weight) > least * np.minimum(wanted, weight)
        return dict(zip(ids[changed].tolist(), wanted[changed].tolist(), strict=True))

    def groups(self, index: IntArray) -> list[tuple[Loss, float, IntArray]]:
        """Return each pair of loss and threshold with the positions in `index` that have it."""
        kinds, which = np.unique(self.losses.values[index], axis=0, return_inverse=True)
        return [(_LOSSES[int(kind)], float(threshold), np.flatnonzero(which.ravel() == k))
                for k, (kind, threshold) in enumerate(kinds)]

    def energies(self, graph: Graph, ids: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return unweighted energies and weights of constraints, shape (M,) each."""
        some: Edges | ObservedNodes
        if self.edges:
            some = graph.edges_at(ids)
            errors = graph.edge_errors(some)
        else:
            some = graph.observed_at(ids)
            errors = graph.observed_errors(some)
        return energies(errors, some.information), some.weight


class Reweighting:
    """Computes the weights of constraints with a robust loss."""

    def __init__(self) -> None:
        self._edges, self._observed = _Rows(edges=True), _Rows(edges=False)

    def __len__(self) -> int:
        return len(self._edges.ids) + len(self._observed.ids)

    def forget(self, edges: IntArray, observed: IntArray) -> None:
        """
        Forget constraints that have left the graph.

        Parameters
        ----------
        edges, observed : ndarray of int64, ids

        """
        self._edges.forget(edges)
        self._observed.forget(observed)

    def add(self, number: int, loss: Loss, threshold: float, *, edge: bool) -> None:
        """
        Add an edge or an observed node with the base weight 1; one without a loss is ignored.

        Parameters
        ----------
        number : int, id, above those of its kind that were added before
        loss : Loss
        threshold : float, threshold of the loss [sigma]
        edge : bool, whether it is an edge

        """
        if loss is not Loss.NONE:
            table = self._edges if edge else self._observed
            table.ids.append_one(number)
            table.losses.append_one((_LOSSES.index(loss), threshold))
            table.base_weights.append_one(1.0)

    def move(self, number: int, to: int, *, edge: bool, to_edge: bool) -> None:
        """
        Give the loss and the base weight of a constraint to another one that replaces it.

        The base weight of the old one becomes 0. Nothing happens if it has no loss.

        Parameters
        ----------
        number, to : int, ids; one that is new is above those of its kind before
        edge, to_edge : bool, whether they are edges

        """
        old, new = (self._edges if which else self._observed for which in (edge, to_edge))
        at, at_new = old.index(number), new.index(to)
        if at < 0:
            return
        if at_new < 0:
            at_new = len(new.ids)
            new.ids.append_one(to)
            new.losses.append_one(old.losses.values[at])
            new.base_weights.append_one(0.0)
        new.base_weights.values[at_new] = old.base_weights.values[at]
        old.base_weights.values[at] = 0.0

    def scale_base_weights(self, ids: IntArray, factor: float) -> None:
        """
        Multiply the base weights of edges, where they have a loss.

        Parameters
        ----------
        ids : ndarray of int64, of edges
        factor : float

        """
        table = self._edges
        table.base_weights.values[np.isin(table.ids.values, ids)] *= factor

    def knows(self, number: int, *, edge: bool) -> bool:
        """
        Tell whether a constraint has a loss.

        Parameters
        ----------
        number : int, id
        edge : bool, whether it is an edge, else an observed node

        """
        return (self._edges if edge else self._observed).index(number) >= 0

    def base_weight(self, number: int) -> float | None:
        """Return the base weight of an observed node, by its id; None without a loss."""
        table = self._observed
        at = table.index(number)
        return float(table.base_weights.values[at]) if at >= 0 else None

    def uses(self, number: int, weight: float) -> bool:
        """
        Tell whether an observed node is used, even if its loss has left nothing of its weight.

        Parameters
        ----------
        number : int, id
        weight : float, in the graph

        """
        base = self.base_weight(number)
        return (weight if base is None else base) > 0.0

    def set_base_weight(self, number: int, weight: float, *, edge: bool = False) -> None:
        """
        Set the base weight of a constraint, if it was added.

        Parameters
        ----------
        number : int, id
        weight : float
        edge : bool, whether it is an edge, else an observed node

        """
        table = self._edges if edge else self._observed
        at = table.index(number)
        if at >= 0:
            table.base_weights.values[at] = weight

    def base_weights(self) -> tuple[FloatArray, FloatArray]:
        """Return copies of the base weights of edges and of observed nodes."""
        return (self._edges.base_weights.values.copy(), self._observed.base_weights.values.copy())

    def set_base_weights(self, weights: tuple[FloatArray, FloatArray]) -> None:
        """Set what `base_weights` has returned; nothing may have been added in between."""
        for table, values in zip((self._edges, self._observed), weights, strict=True):
            table.base_weights.values[:] = values

    def saved(self) -> tuple[SavedLosses, SavedLosses]:
        """Return the state of the edges and of the observed nodes."""
        return self._edges.saved(), self._observed.saved()

    def restore(self, edges: SavedLosses, observed: SavedLosses) -> None:
        """
        Restore what `saved` returned; nothing may have been added before.

        Parameters
        ----------
        edges, observed : SavedLosses

        """
        self._edges.restore(edges)
        self._observed.restore(observed)

    def changes(self, graph: Graph) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """
        Return new weights of edges and of observed nodes, by id, for the next update.

        At most 2 `WINDOW` constraints of each kind are considered, and only weights that change
        by more than the fraction `LEAST_CHANGE` are returned.
        """
        return (self._edges.changes(graph, self._edges.some(), least=LEAST_CHANGE),
                self._observed.changes(graph, self._observed.some(), least=LEAST_CHANGE))

    def changes_of_part(
        self, graph: Graph, begin: int,
    ) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """
        Return new weights of edges and of observed nodes, by id, for a refinement.

        At most `PART` constraints of each kind are considered, those from an index on, and only
        weights that change by more than the fraction `LEAST_REFINED` are returned.

        Parameters
        ----------
        graph : Graph
        begin : int

        """
        edges, observed = (
            table.changes(graph, (begin + np.arange(min(PART, size))) % max(size, 1),
                          least=LEAST_REFINED)
            for table in (self._edges, self._observed) for size in (len(table.ids),))
        return edges, observed

    def all_changes(
        self, graph: Graph, widened: float = 1.0,
    ) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """
        Return the new weights of all edges and observed nodes whose weight changes, by id.

        Parameters
        ----------
        graph : Graph
        widened : float, factor on all thresholds

        """
        edges, observed = (
            table.changes(graph, np.arange(len(table.ids)), widened=widened)
            for table in (self._edges, self._observed))
        return edges, observed

    def all_alike(self, weight: float) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """
        Return the base weights of all edges and observed nodes times a weight, by id.

        The weight 1 makes it a plain least-squares problem.
        """
        return self._edges.alike(weight), self._observed.alike(weight)

    def cost(self, graph: Graph) -> float:
        """Return the sum of the robust costs minus the sum of the weighted energies."""
        total = 0.0
        for table in (self._edges, self._observed):
            energy, weight = table.energies(graph, table.ids.values)
            for loss, threshold, chosen in table.groups(np.arange(len(table.ids))):
                costs, _ = costs_and_weights(loss, energy[chosen], threshold)
                total += float(np.sum(table.base_weights.values[chosen] * costs
                                      - weight[chosen] * energy[chosen]))
        return total
